"""Head motion: found beside moving skin, the same after a rigid move."""

import numpy as np

from capture.pose import Pose
from tests.track.moving_patch import patch_mesh
from track.head_motion import damped_motion, head_motion


def test_moving_skin_has_no_say() -> None:
    rest = patch_mesh().vertices
    rng = np.random.default_rng(0)
    poses = [
        Pose.from_rotation_vector(rng.normal(0, 0.1, 3), rng.normal(0, 3, 3)) for _ in range(6)
    ]
    frames = []
    for f, pose in enumerate(poses):
        face = rest.copy()
        face[rest[:, 1] < 5] += [0.0, -4.0 * f / 5, 1.0 * f]  # the lower face opens
        frames.append(pose.apply(face) + rng.normal(0, 0.02, face.shape))
    found = head_motion(rest, np.stack(frames), np.ones((6, len(rest))))
    for matrix, pose in zip(found.head_from_neutral, poses, strict=True):
        away = Pose.from_matrix(matrix).apply(rest) - pose.apply(rest)
        assert np.abs(away).max() < 0.05  # mm
    assert found.rigid_weights[rest[:, 1] < 5].max() < 0.05
    assert np.median(found.rigid_weights[rest[:, 1] > 5]) > 0.2


def test_damping_goes_part_of_the_way() -> None:
    rest = patch_mesh().vertices
    whole = Pose.from_rotation_vector(np.array([0.0, 0.2, 0.0]), np.array([3.0, 0.0, 0.0]))
    weights = np.ones(len(rest))
    half = damped_motion(rest, whole.apply(rest), weights, 0.5)
    np.testing.assert_allclose(half.rotation_vector(), [0.0, 0.1, 0.0], atol=1e-9)
    centre = whole.apply(rest).mean(axis=0)
    step = centre - rest.mean(axis=0)
    np.testing.assert_allclose(half.apply(centre), centre + 0.5 * step, atol=1e-9)
    full = damped_motion(rest, whole.apply(rest), weights, 1.0)
    np.testing.assert_allclose(full.rotation, whole.rotation, atol=1e-9)
