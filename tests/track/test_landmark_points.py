"""Landmarks meet in space although half of the views are grossly wrong."""

import numpy as np
import pytest

from capture.camera import CameraArray
from tools.bench.neutral_scene import arc_cameras
from track.face_landmarks import LANDMARK_NAMES, LANDMARKS, Detection, surface_landmarks
from track.landmark_points import meet_landmarks


@pytest.fixture(scope="module")
def cameras() -> CameraArray:
    return arc_cameras(np.zeros(3), count=16)


def seen(cameras: CameraArray, points: np.ndarray, noise_px: float) -> dict[str, Detection]:
    rng = np.random.default_rng(7)
    return {
        camera.name: Detection(
            pixels=camera.project(points) + rng.normal(0.0, noise_px, (LANDMARKS, 2)),
            sigma_px=np.full(LANDMARKS, noise_px),
        )
        for camera in cameras
    }


def truth() -> np.ndarray:
    return np.random.default_rng(3).uniform(-60.0, 60.0, (LANDMARKS, 3))


def test_layout_has_68_names_and_51_on_the_surface() -> None:
    assert len(LANDMARK_NAMES) == len(set(LANDMARK_NAMES)) == 68
    assert [LANDMARK_NAMES[i] for i in (8, 17, 27, 36, 45, 48, 54, 60, 67)] == [
        "jaw_8", "brow_right_0", "nose_bridge_0", "lids_right_0", "lids_left_3", "lip_outer_0",
        "lip_outer_6", "lip_inner_0", "lip_inner_7",
    ]  # fmt: skip
    assert len(surface_landmarks()) == 51


def test_exact_views_meet_exactly(cameras: CameraArray) -> None:
    found = meet_landmarks(cameras, seen(cameras, truth(), 0.0))
    assert np.abs(found.positions - truth()).max() < 1e-6
    assert (found.views == 16).all()
    assert found.miss_mm.max() < 1e-6


@pytest.mark.parametrize("wrong", [6, 9])
def test_views_that_fail_grossly_have_no_say(cameras: CameraArray, wrong: int) -> None:
    """Nine of sixteen views show a face elsewhere; the others are 4 px (1.7 mm) off."""
    detections = seen(cameras, truth(), 4.0)
    rng = np.random.default_rng(1)
    for name in cameras.names[:wrong]:
        shift = rng.uniform(60.0, 200.0) * rng.choice([-1.0, 1.0], 2)
        detections[name] = Detection(
            pixels=detections[name].pixels + shift, sigma_px=np.ones(LANDMARKS)
        )
    found = meet_landmarks(cameras, detections)
    gap = np.linalg.norm(found.positions - truth(), axis=1)
    assert np.median(gap) < 2.0
    assert gap.max() < 12.0  # seven of sixteen rays, 1.7 mm off each
    assert (found.views <= 16 - wrong).mean() > 0.9
    assert np.nanmedian(found.miss_mm) < 3.0


def test_landmarks_of_one_view_or_none_stay_unknown(cameras: CameraArray) -> None:
    detections = seen(cameras, truth(), 0.0)
    for index, name in enumerate(cameras.names):
        pixels = detections[name].pixels.copy()
        pixels[5] = np.nan
        if index > 0:
            pixels[6] = np.nan
        detections[name] = Detection(pixels=pixels, sigma_px=np.ones(LANDMARKS))
    found = meet_landmarks(cameras, detections)
    assert np.isnan(found.positions[5:7]).all()
    assert found.views[5:7].tolist() == [0, 0]
    assert np.isfinite(np.delete(found.positions, [5, 6], axis=0)).all()
    one = meet_landmarks(cameras, {cameras.names[0]: detections[cameras.names[0]]})
    assert np.isnan(one.positions).all()
