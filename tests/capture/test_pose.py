"""Group laws of rigid motions."""

from __future__ import annotations

import numpy as np
import pytest

from capture.errors import ShapeError
from capture.pose import Pose

ANGLES = (0.0, 1e-9, 1e-5, 1e-4, 0.3, 3.0, np.pi - 1e-9, np.pi)


def random_pose(seed: int, angle: float | None = None) -> Pose:
    rng = np.random.default_rng(seed)
    axis = rng.normal(0, 1, 3)
    axis /= np.linalg.norm(axis)
    turn = rng.uniform(0, 3) if angle is None else angle
    return Pose.from_rotation_vector(axis * turn, rng.normal(0, 100, 3))


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("seed", range(3))
def test_a_motion_and_its_inverse_cancel(seed: int, angle: float) -> None:
    a_from_b = random_pose(seed, angle)
    assert np.abs((a_from_b @ a_from_b.inverse()).matrix() - np.eye(4)).max() < 1e-12


@pytest.mark.parametrize("seed", range(5))
def test_composition_is_associative_and_acts_as_one_motion_after_another(seed: int) -> None:
    p, q, r = (random_pose(10 * seed + k) for k in range(3))
    points = np.random.default_rng(seed).normal(0, 100, (7, 3))
    assert np.abs(((p @ q) @ r).matrix() - (p @ (q @ r)).matrix()).max() < 1e-10
    assert np.abs((p @ q).apply(points) - p.apply(q.apply(points))).max() < 1e-10
    assert np.abs((p @ Pose.identity()).matrix() - p.matrix()).max() == 0


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("seed", range(3))
def test_rotation_vectors_survive_the_round_trip(seed: int, angle: float) -> None:
    pose = random_pose(seed, angle)
    again = Pose.from_rotation_vector(pose.rotation_vector(), pose.translation)
    assert np.abs(again.rotation - pose.rotation).max() < 1e-8
    assert 0 <= np.linalg.norm(pose.rotation_vector()) <= np.pi + 1e-12


def test_distances_do_not_change() -> None:
    points = np.random.default_rng(0).normal(0, 100, (20, 3))
    moved = random_pose(4).apply(points)
    assert np.allclose(np.linalg.norm(np.diff(moved, axis=0), axis=1),
                       np.linalg.norm(np.diff(points, axis=0), axis=1))  # fmt: skip


def test_matrices_survive_the_round_trip() -> None:
    pose = random_pose(2)
    assert np.array_equal(Pose.from_matrix(pose.matrix()).matrix(), pose.matrix())


def test_nan_stays_nan() -> None:
    moved = random_pose(1).apply(np.array([[np.nan, 0, 0], [0, 0, 0]], dtype=np.float64))
    assert np.isnan(moved[0]).all()
    assert np.isfinite(moved[1]).all()


def test_a_pose_cannot_be_changed_through_its_arrays() -> None:
    rotation = np.eye(3)
    pose = Pose(rotation, np.zeros(3))
    rotation[0, 0] = 5.0
    assert pose.rotation[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        pose.translation[0] = 1.0


@pytest.mark.parametrize(
    ("rotation", "words"),
    [
        (np.diag([1.0, 1.0, -1.0]), "determinant"),
        (1.01 * np.eye(3), "orthonormal"),
        (np.full((3, 3), np.nan), "finite"),
        (np.eye(4), "shape"),
    ],
)
def test_what_is_no_rotation_is_refused(rotation: np.ndarray, words: str) -> None:
    with pytest.raises(ShapeError, match=words):
        Pose(rotation, np.zeros(3))
    with pytest.raises(ShapeError, match="last row 0 0 0 1"):
        Pose.from_matrix(np.diag([1.0, 1, 1, 2]))
