"""Turned cameras are found from how pairs disagree, and what they saw is put right."""

import numpy as np
import pytest

from capture.camera import Camera, CameraArray
from capture.pose import Pose
from recon.aim import Aims, aimed, estimate_aims
from recon.fusion import DepthView
from recon.pairs import StereoPair, select_pairs
from recon.rectify import Rectification, rectification
from recon.scan_warnings import aim_warnings
from recon.stereo import PairDepth
from tests.synthetic_stereo import RADII_MM, ring

ARRAY = ring((-36.0, -18.0, 0.0, 18.0, 36.0), (-10.0, 10.0), size=480)


def turned(camera: Camera, turn: np.ndarray) -> Camera:
    """The camera as it really stands: its rays are those calibrated, turned in camera axes."""
    pose = camera.camera_from_world
    rotation = Pose.from_rotation_vector(-turn, np.zeros(3)).rotation @ pose.rotation
    return Camera(
        name=camera.name, width=camera.width, height=camera.height, fx=camera.fx, fy=camera.fy,
        cx=camera.cx, cy=camera.cy, distortion=camera.distortion,
        camera_from_world=Pose(rotation, -rotation @ camera.centre),
    )  # fmt: skip


def struck(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Where rays (N, 3) from a point first meet the ellipsoid (N, 3); NaN where they miss."""
    ray, start = rays / RADII_MM, origin / RADII_MM
    a, b, c = (ray * ray).sum(axis=1), ray @ start, start @ start - 1.0
    inside = b * b - a * c
    t = (-b - np.sqrt(np.where(inside > 0, inside, np.nan))) / a
    return origin + t[:, None] * rays


def directions(geometry: Rectification, camera: Camera, true: Camera, local: np.ndarray):
    """World directions (N, 3) in which a camera really sees rectified directions (N, 3)."""
    calibrated = local @ geometry.rotation @ camera.camera_from_world.rotation.T
    return calibrated @ true.camera_from_world.rotation


def seen(pair: StereoPair, truth: CameraArray, noise: float) -> PairDepth:
    """The exact disparity of a pair whose cameras are believed to stand as in ARRAY."""
    g = rectification(ARRAY[pair.left], ARRAY[pair.right], np.zeros(3), 90.0)
    u, v = np.meshgrid(np.arange(g.width), np.arange(g.height))
    local = np.stack([u - g.left_column, v - g.row, np.full(u.shape, g.focal_px)], -1)
    rays = directions(g, g.left, truth[pair.left], local.reshape(-1, 3).astype(float))
    points = struck(g.left.centre, rays)
    away = points - g.right.centre
    own = truth[pair.right].camera_from_world.rotation
    back = away @ own.T @ g.right.camera_from_world.rotation @ g.rotation.T
    column = g.focal_px * back[:, 0] / back[:, 2] + g.right_column
    facing = (points / RADII_MM**2 * -away).sum(axis=1) > 0
    disparity = np.where(facing, u.ravel() - column, np.nan).reshape(u.shape)
    disparity += np.random.default_rng(pair.left * 50 + pair.right).normal(0, noise, u.shape)
    view = DepthView(g, disparity.astype(np.float32), np.full(u.shape, 0.05, np.float32))
    return PairDepth(pair, view, 1.0, {})


def turns() -> np.ndarray:
    """A third of a pixel or so for every camera, a common part among it."""
    own = np.random.default_rng(3).normal(0, 0.2, (len(ARRAY), 3)) + [0.3, -0.25, 0.0]
    return own / ARRAY[0].fx


@pytest.fixture(scope="module")
def moved() -> tuple[np.ndarray, list[PairDepth]]:
    truth = CameraArray(
        tuple(turned(camera, turn) for camera, turn in zip(ARRAY, turns(), strict=True))
    )
    pairs = select_pairs(ARRAY, np.zeros(3))
    return turns(), [seen(pair, truth, 0.03) for pair in pairs]


def test_turned_cameras_are_found(moved: tuple[np.ndarray, list[PairDepth]]) -> None:
    truth, pairs = moved
    aims = estimate_aims(ARRAY, pairs)
    missed = (aims.turns - truth)[:, :2] * ARRAY[0].fx  # px
    assert np.sqrt((truth[:, :2] ** 2).mean()) * ARRAY[0].fx > 0.3
    assert np.sqrt((missed**2).mean()) < 0.1
    assert aims.agreement[1] < 0.8 * aims.agreement[0]
    shift = aims.shift_px
    np.testing.assert_allclose(shift[:, 0], -aims.turns[:, 1] * aims.focal_px)
    again = estimate_aims(ARRAY, pairs)
    assert again.turns.tobytes() == aims.turns.tobytes()


def test_cameras_that_stand_still_are_left_alone() -> None:
    pairs = [seen(pair, ARRAY, 0.03) for pair in select_pairs(ARRAY, np.zeros(3))]
    aims = estimate_aims(ARRAY, pairs)
    assert np.abs(aims.shift_px).max() < 0.08


def test_true_aims_put_the_disparity_right(moved: tuple[np.ndarray, list[PairDepth]]) -> None:
    truth, _ = moved
    cameras = CameraArray(
        tuple(turned(camera, turn) for camera, turn in zip(ARRAY, truth, strict=True))
    )
    aims = Aims(truth, truth * 0, np.full(len(truth), ARRAY[0].fx), (1.0, 1.0), 1)
    for pair in select_pairs(ARRAY, np.zeros(3))[:4]:
        right = seen(pair, ARRAY, 0.0).view
        wrong, mended = seen(pair, cameras, 0.0), aimed(seen(pair, cameras, 0.0), aims).view
        assert right is not None
        assert wrong.view is not None
        assert mended is not None
        middle = np.s_[120:-120, 120:-120]
        before = np.nanmedian(np.abs(wrong.view.disparity - right.disparity)[middle])
        after = np.nanpercentile(np.abs(mended.disparity - right.disparity)[middle], 90)
        assert before > 0.05
        assert after < 0.02


def test_one_pair_tells_nothing_of_aims() -> None:
    pair = select_pairs(ARRAY, np.zeros(3))[0]
    aims = estimate_aims(ARRAY, [seen(pair, ARRAY, 0.03)])
    np.testing.assert_allclose(aims.turns, 0.0, atol=1e-9)
    nothing = estimate_aims(ARRAY, [PairDepth(pair, None, 0.0, {})])
    assert nothing.samples == 0
    assert not nothing.certain
    assert not nothing.correct
    assert (nothing.turns == 0).all()


def test_only_certain_shifts_beyond_what_light_feigns_are_corrected() -> None:
    focal = np.full(3, 1000.0)
    sure, unsure = np.full((3, 3), 2e-5), np.full((3, 3), 1e-4)
    small, large = np.full((3, 3), 1e-4), np.zeros((3, 3))
    large[1, 0] = 3e-4
    assert not Aims(small, sure, focal, (1.0, 1.0), 9).correct
    assert not Aims(large, unsure, focal, (1.0, 1.0), 9).correct
    aims = Aims(large, sure, focal, (1.0, 1.0), 9)
    assert aims.moved.tolist() == [False, True, False]
    told = aim_warnings(["a", "b", "c"], aims)
    assert len(told) == 1
    assert told[0].startswith("b: its image lies 0.30 px")
    everyone = Aims(np.full((3, 3), 3e-4), sure, focal, (1.0, 1.0), 9)
    assert aim_warnings(["a", "b", "c"], everyone)[0].startswith("all cameras: the images lie")
