"""OpenUSD (.usdc, .usda): a rig as UsdSkel blend shapes, a performance as a moving mesh.

The only module that imports pxr.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from capture.arrays import Floats, Floats32, Ints32
from capture.errors import ExtraError, WorkError
from capture.product import replacing
from rig.exchange import polygon_corners, single, sparse_rows
from rig.face_rig import FaceRig
from rig.quaternion import quaternions
from track.performance import Performance

if TYPE_CHECKING:
    from pxr import Usd

_JOINT = "head"


def write_usd_rig(path: Path, rig: FaceRig, fps: float) -> None:
    """Write a rig as one SkelRoot: mesh, sparse blend shapes, and one joint that carries the head.

    Names that USD does not accept as prim names are bent; `skel:blendShapes` keeps the true ones.
    The file is in millimetres (`metersPerUnit` 0.001), +Y up; time code f is frame f. The mesh is a
    Catmull-Clark cage, whose normals follow from its points, so none are written.

    Args:
        path: `.usdc` (binary) or `.usda` (text), written or replaced.
        rig: the rig; with F = 0 no time sample is written.
        fps: time codes per second.

    Raises:
        ExtraError: when usd-core is not installed.

    References:
        OpenUSD, "UsdSkel: Skeleton Schema", sections on blend shapes and skinning.
    """
    _need_usd()
    from pxr import UsdGeom, UsdSkel

    with replacing(path) as partial:
        stage = _stage(partial, fps, len(rig.weights))
        root = UsdSkel.Root.Define(stage, "/Head")
        stage.SetDefaultPrim(root.GetPrim())
        mesh = UsdGeom.Mesh.Define(stage, "/Head/Mesh")
        _topology(mesh, rig.polygons)
        mesh.CreatePointsAttr(_vectors(rig.neutral))
        mesh.CreateExtentAttr(_vectors(_extent(single(rig.neutral))))
        skeleton = UsdSkel.Skeleton.Define(stage, "/Head/Skeleton")
        _skeleton(skeleton)
        names = [str(name) for name in rig.names]
        shapes = _blend_shapes(stage, rig)
        animation = UsdSkel.Animation.Define(stage, "/Head/Animation")
        _animation(animation, rig, names)
        UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets(
            [animation.GetPath()]
        )
        binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
        binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
        binding.CreateBlendShapesAttr(names)
        binding.CreateBlendShapeTargetsRel().SetTargets(shapes)
        binding.CreateJointIndicesPrimvar(True, 1).Set([0])
        binding.CreateJointWeightsPrimvar(True, 1).Set([1.0])
        _save(stage, path)


def write_usd_performance(path: Path, performance: Performance, fps: float) -> None:
    """Write a performance as one mesh with time-sampled points and a confidence primvar.

    Args:
        path: `.usdc` (binary) or `.usda` (text), written or replaced.
        performance: F frames; time code k is the k-th of them, in world mm.
        fps: time codes per second.

    Raises:
        ExtraError: when usd-core is not installed.
    """
    _need_usd()
    from pxr import Sdf, UsdGeom, Vt

    with replacing(path) as partial:
        stage = _stage(partial, fps, len(performance.vertices))
        root = UsdGeom.Xform.Define(stage, "/Head")
        stage.SetDefaultPrim(root.GetPrim())
        mesh = UsdGeom.Mesh.Define(stage, "/Head/Mesh")
        _topology(mesh, performance.polygons)
        points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
        kind = Sdf.ValueTypeNames.FloatArray
        seen = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("confidence", kind, UsdGeom.Tokens.vertex)
        for time, vertices in enumerate(performance.vertices):
            points.Set(_vectors(vertices), time)
            extent.Set(_vectors(_extent(vertices)), time)
            seen.Set(Vt.FloatArray.FromNumpy(single(performance.confidence[time])), time)
        _save(stage, path)


def _need_usd() -> None:
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise ExtraError("export to USD", "usd-core", "usd") from error


def _stage(path: Path, fps: float, count: int) -> Usd.Stage:
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.CreateNew(str(path))
    except Tf.ErrorException as error:
        raise WorkError(f"{path}: OpenUSD could not make the file: {error}") from error
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.001)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    if count:
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(count - 1)
    return stage


def _save(stage: Usd.Stage, path: Path) -> None:
    if not stage.GetRootLayer().Save():
        raise WorkError(f"{path}: OpenUSD could not write the file")


def _topology(mesh: Any, polygons: Ints32) -> None:
    from pxr import UsdGeom, Vt

    counts, corners = polygon_corners(polygons)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.catmullClark)


def _skeleton(skeleton: Any) -> None:
    from pxr import Gf, Vt

    still = Vt.Matrix4dArray([Gf.Matrix4d(1.0)])
    skeleton.CreateJointsAttr([_JOINT])
    skeleton.CreateBindTransformsAttr(still)
    skeleton.CreateRestTransformsAttr(still)


def _blend_shapes(stage: Usd.Stage, rig: FaceRig) -> list[Any]:
    from pxr import Tf, UsdSkel, Vt

    paths: list[Any] = []
    taken: set[str] = set()
    for name, delta in zip(rig.names, rig.deltas, strict=True):
        valid = Tf.MakeValidIdentifier(name)
        while valid in taken:
            valid += "_"
        taken.add(valid)
        shape = UsdSkel.BlendShape.Define(stage, f"/Head/Mesh/{valid}")
        moved, rows = sparse_rows(single(delta))
        shape.CreateOffsetsAttr(_vectors(rows))
        shape.CreatePointIndicesAttr(Vt.IntArray.FromNumpy(moved))
        paths.append(shape.GetPath())
    return paths


def _animation(animation: Any, rig: FaceRig, names: list[str]) -> None:
    from pxr import Gf, Vt

    animation.CreateJointsAttr([_JOINT])
    animation.CreateBlendShapesAttr(names)
    translations = animation.CreateTranslationsAttr()
    rotations = animation.CreateRotationsAttr()
    animation.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1.0, 1.0, 1.0)]))
    weights = animation.CreateBlendShapeWeightsAttr()
    if not len(rig.weights):
        translations.Set(Vt.Vec3fArray([Gf.Vec3f(0.0)]))
        rotations.Set(Vt.QuatfArray([Gf.Quatf(1.0)]))
        weights.Set(Vt.FloatArray([0.0] * len(names)))
    turns = quaternions(rig.head_from_rig[:, :3, :3]).tolist()
    for time, (row, matrix) in enumerate(zip(rig.weights, rig.head_from_rig, strict=True)):
        w, x, y, z = turns[time]
        translations.Set(_vectors(matrix[None, :3, 3]), time)
        rotations.Set(Vt.QuatfArray([Gf.Quatf(w, Gf.Vec3f(x, y, z))]), time)
        weights.Set(Vt.FloatArray.FromNumpy(single(row)), time)


def _extent(vertices: Floats32) -> Floats32:
    return np.stack([vertices.min(axis=0), vertices.max(axis=0)])


def _vectors(rows: Floats | Floats32) -> Any:
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(single(rows))
