"""glTF 2.0 binary (.glb): a rig with sparse morph targets, a performance as a target a frame.

The only module that imports pygltflib. Metres, +Y up.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Floats, Floats32
from capture.errors import ExtraError, InputError
from capture.product import replacing
from recon.mesh import Mesh
from rig.exchange import single, sparse_rows
from rig.face_rig import FaceRig
from rig.quaternion import quaternions
from track.performance import Performance

if TYPE_CHECKING:
    import pygltflib

_METRES = 0.001
_MAX_TARGETS = 600  # frames of a performance: the weights alone grow with their square
_FLOAT, _UINT = 5126, 5125
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963


def write_glb_rig(path: Path, rig: FaceRig, fps: float) -> None:
    """Write a rig as one mesh with sparse morph targets, animated weights and head motion.

    Args:
        path: the file to write or replace.
        rig: the rig in mm; written in metres. Quads become triangles, vertex order is kept.
        fps: frames per second.

    Raises:
        ExtraError: when pygltflib is not installed.

    References:
        Khronos, glTF 2.0 Specification, 3.6.2.3 Sparse Accessors, 3.7.2.2 Morph Targets,
        3.11 Animations.
    """
    mesh = Mesh(rig.neutral, rig.polygons)
    scene = _Scene()
    rest = scene.surface(mesh, rig.neutral)
    for delta in rig.deltas:
        scene.target(delta, _normals(mesh, rig.neutral + delta) - rest)
    scene.name_targets(rig.names)
    if len(rig.weights):
        times = scene.times(len(rig.weights), fps)
        if rig.names:
            scene.animate("weights", times, rig.weights.astype(np.float32).reshape(-1, 1))
        scene.animate("translation", times, rig.head_from_rig[:, :3, 3] * _METRES)
        scene.animate("rotation", times, quaternions(rig.head_from_rig[:, :3, :3])[:, [1, 2, 3, 0]])
    scene.write(path)


def write_glb_performance(path: Path, performance: Performance, fps: float) -> None:
    """Write a performance as one mesh with a morph target for every frame but the first.

    At each frame its target has weight 1 and all others 0; between frames the weights, so the
    vertices, are interpolated linearly.

    Args:
        path: the file to write or replace.
        performance: F frames, world mm; written in metres.
        fps: frames per second.

    Raises:
        InputError: when there are more frames than viewers bear.
        ExtraError: when pygltflib is not installed.
    """
    count = len(performance.vertices)
    if not 0 < count <= _MAX_TARGETS:
        raise InputError(
            f"{path}: a performance in glTF is a morph target a frame: 1 to {_MAX_TARGETS} frames "
            f"are supported, found {count}; export to .usdc or .npz, or export its rig"
        )
    first = performance.vertices[0].astype(np.float64)
    mesh = Mesh(first, performance.polygons)
    scene = _Scene()
    rest = scene.surface(mesh, first)
    for vertices in performance.vertices[1:]:
        scene.target(vertices - first, _normals(mesh, vertices.astype(np.float64)) - rest)
    scene.name_targets([f"frame_{int(frame):04d}" for frame in performance.frames[1:]])
    if count > 1:
        weights = np.eye(count, dtype=np.float32)[:, 1:]
        scene.animate("weights", scene.times(count, fps), weights.reshape(-1, 1))
    scene.write(path)


class _Scene:
    """A glTF document with one mesh, filled piece by piece."""

    def __init__(self) -> None:
        try:
            import pygltflib
        except ImportError as error:
            raise ExtraError("export to glTF", "pygltflib", "gltf") from error
        self._lib = pygltflib
        self._bytes = bytearray()
        self._primitive = pygltflib.Primitive(attributes=pygltflib.Attributes(), targets=[])
        self._mesh = pygltflib.Mesh(name="head", primitives=[self._primitive], extras={})
        material = pygltflib.Material(
            name="skin",
            pbrMetallicRoughness=pygltflib.PbrMetallicRoughness(
                baseColorFactor=[0.72, 0.6, 0.54, 1.0], metallicFactor=0.0, roughnessFactor=0.6
            ),
            doubleSided=True,
        )
        self._document = pygltflib.GLTF2(
            asset=pygltflib.Asset(version="2.0", generator="likeness"),
            scene=0,
            scenes=[pygltflib.Scene(nodes=[0])],
            nodes=[pygltflib.Node(name="head", mesh=0)],
            meshes=[self._mesh],
            materials=[material],
        )
        self._primitive.material = 0

    def surface(self, mesh: Mesh, vertices: Floats) -> Floats32:
        """Add triangles, positions (V, 3) in mm and normals; gives the normals."""
        normals = _normals(mesh, vertices)
        self._primitive.attributes.POSITION = self._dense(_metres(vertices), _VERTEX_BUFFER, True)
        self._primitive.attributes.NORMAL = self._dense(normals, _VERTEX_BUFFER)
        corners = mesh.triangles.reshape(-1, 1).astype(np.uint32)
        self._primitive.indices = self._dense(corners, _INDEX_BUFFER)
        return normals

    def target(self, delta: Floats, turned: Floats32) -> None:
        """Add a morph target: offsets (V, 3) in mm and changes of the unit normals (V, 3)."""
        self._primitive.targets.append(
            {"POSITION": self._sparse(_metres(delta)), "NORMAL": self._sparse(turned)}
        )

    def name_targets(self, names: Any) -> None:
        """Name the targets where every reader looks for their names."""
        self._mesh.extras = {"targetNames": list(names)}
        self._mesh.weights = [0.0] * len(self._primitive.targets)

    def times(self, count: int, fps: float) -> int:
        """Add the times of `count` frames, in seconds; gives their accessor."""
        return self._dense((np.arange(count) / fps).reshape(-1, 1), None, True)

    def animate(self, what: str, times: int, values: NDArray[Any]) -> None:
        """Animate `weights`, `translation` or `rotation` of the mesh's node."""
        lib = self._lib
        if not self._document.animations:
            self._document.animations.append(lib.Animation(name="take", channels=[], samplers=[]))
        animation = self._document.animations[0]
        sampler = lib.AnimationSampler(
            input=times, output=self._dense(values, None), interpolation="LINEAR"
        )
        target = lib.AnimationChannelTarget(node=0, path=what)
        animation.channels.append(
            lib.AnimationChannel(sampler=len(animation.samplers), target=target)
        )
        animation.samplers.append(sampler)

    def write(self, path: Path) -> None:
        """Write the document and its bytes, whole or not at all."""
        if not self._primitive.targets:
            self._primitive.targets = None
            self._mesh.extras, self._mesh.weights = {}, None
        self._document.buffers = [self._lib.Buffer(byteLength=len(self._bytes))]
        self._document.set_binary_blob(bytes(self._bytes))
        with replacing(path) as partial:
            self._document.save_binary(str(partial))

    def _view(self, array: NDArray[Any], target: int | None = None) -> int:
        data = np.ascontiguousarray(array).tobytes()
        view = self._lib.BufferView(
            buffer=0, byteOffset=len(self._bytes), byteLength=len(data), target=target
        )
        self._bytes += data + b"\0" * (-len(data) % 4)
        self._document.bufferViews.append(view)
        return len(self._document.bufferViews) - 1

    def _dense(self, rows: NDArray[Any], target: int | None, bounds: bool = False) -> int:
        whole = rows.dtype == np.uint32
        rows = rows if whole else rows.astype(np.float32)
        accessor = self._accessor(rows, bounds)
        accessor.componentType = _UINT if whole else _FLOAT
        accessor.bufferView = self._view(rows, target)
        return len(self._document.accessors) - 1

    def _sparse(self, rows: Floats32) -> int:
        lib = self._lib
        accessor = self._accessor(rows, True)
        moved, values = sparse_rows(rows)
        if len(moved):
            accessor.sparse = lib.Sparse(
                count=len(moved),
                indices=lib.AccessorSparseIndices(
                    bufferView=self._view(moved.astype(np.uint32)),
                    byteOffset=0,
                    componentType=_UINT,
                ),
                values=lib.AccessorSparseValues(bufferView=self._view(values), byteOffset=0),
            )
        return len(self._document.accessors) - 1

    def _accessor(self, rows: NDArray[Any], bounds: bool) -> pygltflib.Accessor:
        kinds = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
        accessor = self._lib.Accessor(
            componentType=_FLOAT, count=len(rows), type=kinds[rows.shape[1]]
        )
        if bounds:
            accessor.min = [float(value) for value in rows.min(axis=0)]
            accessor.max = [float(value) for value in rows.max(axis=0)]
        self._document.accessors.append(accessor)
        return accessor


def _normals(mesh: Mesh, vertices: Floats) -> Floats32:
    normals = mesh.with_vertices(vertices).normals()
    lost = ~np.isfinite(normals).all(axis=1)
    normals[lost] = [0.0, 0.0, 1.0]
    return normals.astype(np.float32)


def _metres(rows: Floats) -> Floats32:
    return single(rows * _METRES)
