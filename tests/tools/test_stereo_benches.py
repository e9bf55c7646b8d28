from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture.camera import CameraArray
from recon.pairs import scene_centre
from recon.rectify import rectification
from tests.synthetic import small_array
from tools.bench.bench_disparity import (
    PairCase,
    TrueSurface,
    cones_case,
    matchers,
    score,
    true_disparity,
)

SHARED = Path(__file__).resolve().parents[2].parent / "shared"


def wall(z: float, half: float = 200.0) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.array([-1, 1, 1, -1]) * half, np.array([-1, -1, 1, 1]) * half
    triangles = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    return np.stack([x, y, np.full(4, z)], axis=1), triangles


def test_score_counts_what_is_filled_and_what_is_off() -> None:
    truth = np.array([[10.0, 20.0, 30.0, np.nan]])
    found = np.array([[10.1, 25.0, np.nan, 7.0]], dtype=np.float32)
    row = score(found, truth)
    assert row["filled"] == pytest.approx(2 / 3, abs=1e-4)
    assert row["bad_1px"] == pytest.approx(0.5)
    assert row["rms_px"] == pytest.approx(0.1, abs=1e-4)


def test_true_disparity_is_where_both_views_project_the_surface() -> None:
    array = small_array(4)
    cameras = CameraArray((array[0], array[1]))
    centre = scene_centre(cameras)
    facing = cameras[0].centre + cameras[1].centre - 2 * centre
    assert facing[2] > 0  # the wall below is seen from its front
    geometry = rectification(cameras[0], cameras[1], centre, 60.0)
    vertices, triangles = wall(float(centre[2]))
    surface = TrueSurface(vertices + [centre[0], centre[1], 0], triangles, np.array([True, False]))
    truth = true_disparity(geometry, surface)
    rows, columns = np.nonzero(np.isfinite(truth))
    assert 50 < len(rows) < 0.8 * truth.size  # one of two triangles counts
    matches = np.stack([columns, rows, truth[rows, columns]], axis=1)
    points = geometry.triangulate(matches)
    assert np.abs(points[:, 2] - centre[2]).max() < 1e-3


def test_what_hides_the_surface_from_the_other_view_is_not_scored() -> None:
    array = small_array(4)
    centre = scene_centre(array)
    geometry = rectification(array[0], array[1], centre, 60.0)
    vertices, triangles = wall(float(centre[2]))
    vertices = vertices + [centre[0], centre[1], 0.0]
    towards = geometry.right.centre - centre
    screen, _ = wall(0.0, half=8.0)
    screen = screen + centre + 0.3 * towards
    both = TrueSurface(
        np.concatenate([vertices, screen]),
        np.concatenate([triangles, triangles + 4]).astype(np.int32),
        np.array([True, True, False, False]),
    )
    alone = TrueSurface(vertices, triangles, np.array([True, True]))
    open_, hidden = true_disparity(geometry, alone), true_disparity(geometry, both)
    lost = np.isfinite(open_) & ~np.isfinite(hidden)
    assert lost.sum() > 20
    assert np.isfinite(hidden).sum() > 0.4 * np.isfinite(open_).sum()


@pytest.mark.parametrize("name", list(matchers()))
def test_every_matcher_finds_a_shift(name: str) -> None:
    rng = np.random.default_rng(4)
    row = np.repeat(np.repeat(rng.uniform(0.2, 0.8, (60, 130)), 2, axis=0), 2, axis=1)
    picture = row.astype(np.float32)
    shift = 12
    left, right = picture[:, shift:-8], picture[:, : -shift - 8]
    case = PairCase(
        np.ascontiguousarray(left), np.ascontiguousarray(right), (-20.0, -2.0), np.empty((0, 0))
    )
    found = matchers()[name](case)
    inner = found[20:-20, 60:-60]
    assert np.isfinite(inner).mean() > 0.5
    assert abs(float(np.nanmedian(inner)) + shift) < 0.2


@pytest.mark.shared_data
def test_the_cones_are_read_with_their_unoccluded_pixels() -> None:
    case = cones_case(SHARED / "data" / "middlebury-cones")
    assert np.isfinite(case.truth).mean() == pytest.approx(0.853, abs=1e-3)
    found = matchers()["SGBM HH"](case)
    assert score(found, case.truth)["bad_1px"] < 0.05
