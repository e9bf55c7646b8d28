"""Round trips through pygltflib's reader, and what the glTF specification asks of accessors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest

from capture.archive import write_archive
from capture.errors import InputError
from rig.export import export
from rig.face_rig import read_rig
from rig.quaternion import quaternions
from tests.rig.exchange_cases import NAMES, performance_file, rig_file, template_file
from track.performance import read_performance

_TYPES = {5126: np.float32, 5125: np.uint32}
_WIDTH = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def _rows(document: pygltflib.GLTF2, index: int) -> np.ndarray:
    accessor = document.accessors[index]
    width = _WIDTH[accessor.type]
    out = np.zeros((accessor.count, width), _TYPES[accessor.componentType])
    if accessor.bufferView is not None:
        out[:] = _view(document, accessor.bufferView, out.dtype).reshape(-1, width)
    if accessor.sparse is not None:
        ids = _view(document, accessor.sparse.indices.bufferView, np.uint32)
        rows = _view(document, accessor.sparse.values.bufferView, np.float32).reshape(-1, width)
        assert len(ids) == accessor.sparse.count
        assert (np.diff(ids.astype(int)) > 0).all(), "sparse indices must increase"
        out[ids] = rows
    if accessor.min:
        np.testing.assert_array_equal(np.array(accessor.min, np.float32), out.min(axis=0))
        np.testing.assert_array_equal(np.array(accessor.max, np.float32), out.max(axis=0))
    return out


def _view(document: pygltflib.GLTF2, index: int, kind: Any) -> np.ndarray:
    view = document.bufferViews[index]
    start = view.byteOffset or 0
    assert start % 4 == 0
    return np.frombuffer(document.binary_blob()[start : start + view.byteLength], kind)


def _channel(document: pygltflib.GLTF2, path: str) -> np.ndarray:
    animation = document.animations[0]
    found = [channel for channel in animation.channels if channel.target.path == path]
    sampler = animation.samplers[found[0].sampler]
    times = _rows(document, sampler.input)[:, 0]
    np.testing.assert_array_equal(times, (np.arange(len(times)) / 75.0).astype(np.float32))
    return _rows(document, sampler.output)


def test_rig_comes_back_in_metres_with_sparse_named_targets(tmp_path: Path) -> None:
    source = rig_file(tmp_path)
    export(source, tmp_path / "rig.glb", fps=75.0)
    document, rig = pygltflib.GLTF2().load(str(tmp_path / "rig.glb")), read_rig(source)
    primitive = document.meshes[0].primitives[0]
    neutral = _rows(document, primitive.attributes.POSITION)
    np.testing.assert_array_equal(neutral, (rig.neutral * 0.001).astype(np.float32))
    assert tuple(document.meshes[0].extras["targetNames"]) == NAMES
    assert len(primitive.targets) == len(NAMES)
    for target, delta in zip(primitive.targets, rig.deltas, strict=True):
        accessor = document.accessors[target["POSITION"]]
        moved = int(np.abs(delta).max(axis=1).astype(bool).sum())
        assert (accessor.sparse.count if accessor.sparse else 0) == moved
        assert accessor.bufferView is None, "zeros are not stored"
        assert min(accessor.min) <= 0.0 <= max(accessor.max)
        np.testing.assert_array_equal(
            _rows(document, target["POSITION"]), (delta * 0.001).astype(np.float32)
        )
        posed = _rows(document, primitive.attributes.NORMAL) + _rows(document, target["NORMAL"])
        np.testing.assert_allclose(np.linalg.norm(posed, axis=1), 1.0, atol=1e-5)


def test_rig_moves_as_solved(tmp_path: Path) -> None:
    source = rig_file(tmp_path)
    export(source, tmp_path / "rig.glb", fps=75.0)
    document, rig = pygltflib.GLTF2().load(str(tmp_path / "rig.glb")), read_rig(source)
    weights = _channel(document, "weights").reshape(5, 4)
    np.testing.assert_array_equal(weights, rig.weights.astype(np.float32))
    moves, turns = _channel(document, "translation"), _channel(document, "rotation")
    primitive = document.meshes[0].primitives[0]
    shapes = np.stack([_rows(document, target["POSITION"]) for target in primitive.targets])
    for frame in range(5):
        x, y, z, w = turns[frame].astype(float)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        points = _rows(document, primitive.attributes.POSITION)
        points = points + np.tensordot(weights[frame], shapes, axes=1)
        placed = points @ rotation.T + moves[frame]
        np.testing.assert_allclose(1000.0 * placed, rig.evaluate(frame), atol=1e-4)


def test_triangles_keep_the_vertex_order(tmp_path: Path) -> None:
    source = template_file(tmp_path)
    export(source, tmp_path / "t.glb")
    document = pygltflib.GLTF2().load(str(tmp_path / "t.glb"))
    indices = _rows(document, document.meshes[0].primitives[0].indices)[:, 0]
    assert len(indices) == 3 * (2 * 29 + 2)
    assert int(indices.max()) == 41
    assert not document.animations


def test_performance_is_a_target_a_frame(tmp_path: Path) -> None:
    source = performance_file(tmp_path)
    export(source, tmp_path / "p.glb", fps=75.0)
    document = pygltflib.GLTF2().load(str(tmp_path / "p.glb"))
    performance = read_performance(source)
    primitive = document.meshes[0].primitives[0]
    assert document.meshes[0].extras["targetNames"] == ["frame_0006", "frame_0007"]
    base = _rows(document, primitive.attributes.POSITION)
    weights = _channel(document, "weights").reshape(3, 2)
    np.testing.assert_array_equal(weights, [[0, 0], [1, 0], [0, 1]])
    shapes = np.stack([_rows(document, target["POSITION"]) for target in primitive.targets])
    for frame in range(3):
        points = 1000.0 * (base + np.tensordot(weights[frame], shapes, axes=1))
        np.testing.assert_allclose(points, performance.vertices[frame], atol=3e-5)


def test_a_long_performance_is_refused(tmp_path: Path) -> None:
    count = 601
    write_archive(
        tmp_path / "p.npz",
        {
            "vertices": np.zeros((count, 3, 3), np.float32),
            "confidence": np.ones((count, 3), np.float32),
            "polygons": np.array([[0, 1, 2, -1]], np.int32),
            "frames": np.arange(count),
            "head_from_neutral": np.tile(np.eye(4), (count, 1, 1)),
            "reference": np.zeros(count, np.int64),
        },
    )
    with pytest.raises(InputError, match="1 to 600 frames are supported, found 601"):
        export(tmp_path / "p.npz", tmp_path / "p.glb")
    assert not (tmp_path / "p.glb").exists()


def test_quaternions_bring_back_rotations_and_go_the_short_way() -> None:
    rng = np.random.default_rng(3)
    angle = np.linspace(0.0, 4 * np.pi, 60)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turns = [np.eye(3) + np.sin(a) * cross + (1 - np.cos(a)) * cross @ cross for a in angle]
    rows = quaternions(np.stack(turns))
    expected = np.column_stack([np.cos(angle / 2), np.sin(angle / 2)[:, None] * axis])
    np.testing.assert_allclose(rows, expected, atol=1e-12)
