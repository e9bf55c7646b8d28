from __future__ import annotations

import numpy as np
import pytest

from capture.camera import CameraArray
from capture.errors import CameraError
from capture.pose import Pose
from tests.synthetic import small_array
from tools.truth import SkinPoints, scan_distances, world_from_truth


def bumpy(size: int = 12) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(size) * 5.0, np.arange(size) * 5.0)
    vertices = np.stack([x, y, 3.0 * np.sin(x / 9) * np.cos(y / 7)], -1).reshape(-1, 3)
    corner = np.arange(size * size).reshape(size, size)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    triangles = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    return vertices, triangles.astype(np.int32)


@pytest.mark.parametrize("seed", range(3))
def test_worlds_are_aligned_by_the_cameras(seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion = Pose.from_rotation_vector(rng.normal(0, 1, 3), rng.normal(0, 50, 3))
    true = small_array(4)
    ours = CameraArray(
        tuple(camera.posed(camera.camera_from_world @ motion.inverse()) for camera in true)
    )
    near = rng.normal(0.0, 20.0, (40, 3))
    found = world_from_truth(ours, true, near)
    assert np.abs(found.matrix() - motion.matrix()).max() < 1e-6


def test_aligning_needs_two_cameras() -> None:
    with pytest.raises(CameraError, match="found 1"):
        world_from_truth(small_array(1), small_array(4), np.zeros((5, 3)))


@pytest.mark.parametrize("seed", range(3))
def test_attached_points_move_with_the_skin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, triangles = bumpy()
    points = vertices[triangles].mean(axis=1)[::7]
    motion = Pose.from_rotation_vector(rng.normal(0, 0.3, 3), rng.normal(0, 9, 3))
    skin = SkinPoints.attach(points, vertices, triangles)
    assert np.abs(skin.at(vertices) - points).max() < 1e-3
    assert np.abs(skin.at(motion.apply(vertices)) - motion.apply(points)).max() < 1e-3


def test_scan_distance_is_the_distance_from_the_surface() -> None:
    vertices, triangles = bumpy()
    flat = vertices * [1.0, 1.0, 0.0]
    lifted = flat[triangles].mean(axis=1) + [0.0, 0.0, 0.7]
    assert np.abs(scan_distances(lifted, flat, triangles) - 0.7).max() < 1e-4
