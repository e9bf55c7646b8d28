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
from tools.bench.bench_robust import Fault, clipped, faults, unequal, verdict
from tools.bench.bench_stereo import Instant, fewer, horizontal_neighbours, shrunk
from tools.bench.scan_takes import studio

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


def instant(count: int = 10, dtype: type = np.uint8) -> Instant:
    """Bright discs before a dark ground."""
    array = small_array(count)
    rows, columns = np.mgrid[0:48, 0:64]
    lit = (rows - 24) ** 2 + (columns - 32) ** 2 < 20**2
    rng = np.random.default_rng(1)
    top = np.iinfo(dtype).max
    images = {
        name: np.where(lit, rng.uniform(0.4, 0.7, lit.shape), 0.05) * top for name in array.names
    }
    return Instant(array, {name: image.astype(dtype) for name, image in images.items()})


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_tenth_of_what_is_lit_clips(dtype: type) -> None:
    before = instant(dtype=dtype)
    after = clipped(before)
    top = np.iinfo(dtype).max
    lit = np.stack([image > 0.2 * top for image in before.images.values()])
    at_top = np.stack([image == top for image in after.images.values()])
    assert (at_top & lit).sum() / lit.sum() == pytest.approx(0.1, abs=0.02)


def test_gain_is_off_on_those_named_alone() -> None:
    before = instant()
    after = unequal(before, ("cam01", "cam04"))
    ratios = {
        name: float(after.images[name].mean()) / float(before.images[name].mean())
        for name in before.images
    }
    assert ratios.pop("cam01") == pytest.approx(0.7, abs=0.02)
    assert ratios.pop("cam04") == pytest.approx(1.3, abs=0.02)
    assert set(ratios.values()) == {1.0}


def test_every_fault_touches_its_devices_and_no_other() -> None:
    before = instant()
    cases = faults(before.cameras.names)
    assert len(cases) == 10
    for fault in cases:
        after = fault.apply(before)
        touched = {
            name
            for name in before.cameras.names
            if name not in after.images
            or not np.array_equal(after.images[name], before.images[name])
            or after.cameras.by_name(name).cx != before.cameras.by_name(name).cx
            or after.cameras.by_name(name).cy != before.cameras.by_name(name).cy
        }
        assert touched == set(fault.devices), fault.words
    moved = cases[-1].apply(before)
    steps = [
        np.hypot(after.cx - one.cx, after.cy - one.cy)
        for one, after in zip(before.cameras, moved.cameras, strict=True)
    ]
    assert np.allclose(steps, 0.3)


def test_the_verdict_tells_the_silent_from_the_blamed() -> None:
    names = ("cam00", "cam01", "cam02")
    fault = Fault("gain off", lambda instant: instant, ("cam00", "cam01"))
    found = verdict(fault, ["cam01: 30 % darker", "cam02: out of focus"], names)
    assert (found["named"], found["silent"], found["blamed"]) == (["cam01"], ["cam00"], ["cam02"])
    assert found["told"]
    assert not verdict(fault, [], names)["told"]
    assert verdict(Fault("none", fault.apply), [], names)["told"]
    assert not verdict(Fault("none", fault.apply), ["all cameras: off"], names)["told"]
    shared = Fault("all shifted", fault.apply, names)
    assert verdict(shared, ["3 of 3 cameras: off each other"], names)["silent"] == []
    assert verdict(fault, ["cam00, cam01: no image"], names)["silent"] == []


def test_the_opponent_takes_neighbours_side_by_side() -> None:
    pairs = horizontal_neighbours(studio(128, 5))
    assert [(pair.left, pair.right) for pair in pairs] == [(i, i + 2) for i in range(14)]


def test_a_shrunk_instant_is_seen_by_the_same_lenses() -> None:
    before = instant()
    after = shrunk(before, 0.5)
    point = np.array([[3.0, -5.0, 8.0]])
    fine, coarse = before.cameras.project(point), after.cameras.project(point)
    assert np.allclose(coarse + 0.5, 0.5 * (fine + 0.5), atol=1e-9)
    assert after.images["cam03"].shape == (24, 32)
    assert fewer(before, 4).cameras.names == ("cam03", "cam04", "cam05", "cam06")
