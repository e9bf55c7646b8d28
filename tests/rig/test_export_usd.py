"""Round trips through OpenUSD's own reader and its skinning evaluation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdSkel

from rig.export import export
from rig.face_rig import FaceRig, read_rig
from tests.rig.exchange_cases import NAMES, performance_file, rig_file, template_file
from track.performance import read_performance


@pytest.fixture(params=[".usdc", ".usda"])
def written(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Usd.Stage, FaceRig]:
    source = rig_file(tmp_path)
    export(source, tmp_path / f"rig{request.param}", fps=75.0)
    return Usd.Stage.Open(str(tmp_path / f"rig{request.param}")), read_rig(source)


def test_stage_says_units_axes_and_rate(written: tuple[Usd.Stage, FaceRig]) -> None:
    stage, _ = written
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.001
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    assert stage.GetTimeCodesPerSecond() == 75.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 4.0)
    assert UsdSkel.Root(stage.GetDefaultPrim())


def test_shapes_are_sparse_and_exact(written: tuple[Usd.Stage, FaceRig]) -> None:
    stage, rig = written
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Head/Mesh"))
    np.testing.assert_array_equal(mesh.GetPointsAttr().Get(), rig.neutral.astype(np.float32))
    counts = (rig.polygons >= 0).sum(axis=1)
    np.testing.assert_array_equal(mesh.GetFaceVertexCountsAttr().Get(), counts)
    np.testing.assert_array_equal(
        mesh.GetFaceVertexIndicesAttr().Get(), rig.polygons[rig.polygons >= 0]
    )
    binding = UsdSkel.BindingAPI(mesh.GetPrim())
    assert tuple(binding.GetBlendShapesAttr().Get()) == NAMES
    targets = binding.GetBlendShapeTargetsRel().GetTargets()
    assert len(targets) == len(NAMES)
    for path, delta in zip(targets, rig.deltas.astype(np.float32), strict=True):
        shape = UsdSkel.BlendShape(stage.GetPrimAtPath(path))
        indices = np.array(shape.GetPointIndicesAttr().Get(), dtype=int)
        np.testing.assert_array_equal(indices, np.flatnonzero(np.abs(delta).max(axis=1)))
        offsets = np.array(shape.GetOffsetsAttr().Get()).reshape(-1, 3)
        np.testing.assert_array_equal(offsets, delta[indices])


def test_usd_skinning_gives_the_rig_s_vertices(written: tuple[Usd.Stage, FaceRig]) -> None:
    stage, rig = written
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Head/Animation"))
    weights = np.array([animation.GetBlendShapeWeightsAttr().Get(f) for f in range(5)])
    np.testing.assert_array_equal(weights, rig.weights.astype(np.float32))
    root = UsdSkel.Root(stage.GetDefaultPrim())
    assert UsdSkel.BakeSkinning(root)
    baked = UsdGeom.Mesh(stage.GetPrimAtPath("/Head/Mesh"))
    for frame in range(5):  # a rigid binding is baked into the transform, row vectors times matrix
        motion = np.array(baked.ComputeLocalToWorldTransform(frame))
        placed = np.array(baked.GetPointsAttr().Get(frame)) @ motion[:3, :3] + motion[3, :3]
        np.testing.assert_allclose(placed, rig.evaluate(frame), atol=1e-4)


def test_template_stands_still(tmp_path: Path) -> None:
    export(template_file(tmp_path), tmp_path / "t.usda")
    stage = Usd.Stage.Open(str(tmp_path / "t.usda"))
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Head/Animation"))
    assert list(animation.GetBlendShapeWeightsAttr().Get()) == [0.0] * 4
    assert not stage.HasAuthoredTimeCodeRange()


def test_performance_is_a_moving_mesh(tmp_path: Path) -> None:
    source = performance_file(tmp_path)
    export(source, tmp_path / "p.usdc", fps=60.0)
    performance = read_performance(source)
    stage = Usd.Stage.Open(str(tmp_path / "p.usdc"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Head/Mesh"))
    confidence = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("confidence")
    assert mesh.GetPointsAttr().GetTimeSamples() == [0.0, 1.0, 2.0]
    for time in range(3):
        np.testing.assert_array_equal(mesh.GetPointsAttr().Get(time), performance.vertices[time])
        np.testing.assert_array_equal(confidence.Get(time), performance.confidence[time])
