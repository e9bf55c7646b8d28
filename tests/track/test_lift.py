"""Triangulation: the true motion, outliers, single views."""

import numpy as np

from capture.arrays import Floats
from tests.track.moving_patch import patch_array
from track.lift import Observations, triangulate

COUNT = 60


def _observed(motion: Floats, noise_px: float, seed: int) -> tuple[Observations, Floats]:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-30, 30, (COUNT, 3))
    parts = []
    for camera in patch_array(6):
        offset = camera.project(points + motion) - camera.project(points)
        parts.append(
            (offset + rng.normal(0, noise_px, offset.shape), camera.project_jacobian(points))
        )
    offset = np.concatenate([part[0] for part in parts])
    return Observations(
        sample=np.tile(np.arange(COUNT, dtype=np.int32), 6),
        offset=offset,
        jacobian=np.concatenate([part[1] for part in parts]),
        information=np.tile([100.0, 0.0, 100.0], (len(offset), 1)),
    ), points


def test_small_motions_are_recovered() -> None:
    motion = np.random.default_rng(5).normal(0, 0.2, (COUNT, 3))
    observed, _ = _observed(motion, 0.0, 1)
    lifted = triangulate(observed, COUNT, scale_px=1.0, prior_mm=1e3)
    assert np.abs(lifted.motion - motion).max() < 0.01  # mm: what linear projection leaves
    assert (lifted.views == 6).all()


def test_outliers_are_left_out() -> None:
    motion = np.random.default_rng(6).normal(0, 0.1, (COUNT, 3))
    observed, _ = _observed(motion, 0.05, 2)
    observed.offset[:COUNT] += [6.0, -4.0]  # one view of six is wrong everywhere
    lifted = triangulate(observed, COUNT, scale_px=0.7, prior_mm=1.0)
    error = np.linalg.norm(lifted.motion - motion, axis=1)
    assert np.median(error) < 0.05  # mm
    assert (lifted.views == 5).mean() > 0.95
    assert np.nanmax(lifted.residual_px) < 0.3


def test_order_of_observations_does_not_matter() -> None:
    observed, _ = _observed(np.full((COUNT, 3), 0.1), 0.05, 3)
    forward = triangulate(observed, COUNT, 0.7, 1.0)
    sample = observed.sample
    order = np.concatenate([np.flatnonzero(sample == n) for n in range(COUNT)[::-1]])
    shuffled = Observations(
        sample=sample[order],
        offset=observed.offset[order],
        jacobian=observed.jacobian[order],
        information=observed.information[order],
    )
    again = triangulate(shuffled, COUNT, 0.7, 1.0)
    assert again.motion.tobytes() == forward.motion.tobytes()


def test_a_single_view_moves_a_sample_across_itself_only() -> None:
    camera = patch_array(1)[0]
    point = np.array([[5.0, -3.0, 2.0]])
    motion = np.array([[0.3, 0.2, 0.0]])
    observed = Observations(
        sample=np.zeros(1, np.int32),
        offset=camera.project(point + motion) - camera.project(point),
        jacobian=camera.project_jacobian(point),
        information=np.array([[100.0, 0.0, 100.0]]),
    )
    lifted = triangulate(observed, 2, scale_px=1.0, prior_mm=1.0)
    ray = (point[0] - camera.centre) / np.linalg.norm(point[0] - camera.centre)
    assert abs(lifted.motion[0] @ ray) < 0.01  # mm
    moved = camera.project(point + lifted.motion[:1]) - camera.project(point)
    np.testing.assert_allclose(moved, observed.offset, atol=0.02)  # px
    assert lifted.views.tolist() == [1, 0]
    assert (lifted.motion[1] == 0).all()
    assert np.isnan(lifted.residual_px[1])
