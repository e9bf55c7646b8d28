"""Sub-pixel refinement against known disparity, and the compiled loops against plain ones."""

import numpy as np
import pytest
from scipy import ndimage

from recon.refine import (
    Refiner,
    grow,
    row_slope,
    smooth_step,
    spline_rows,
    warp_rows,
)
from recon.window_match import match_step


def scene(noise: float = 0.003, size: int = 120) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left, right and the slanted, curved disparity of the left view, px."""
    generator = np.random.default_rng(7)
    texture = ndimage.gaussian_filter(generator.normal(0, 1, (size, 4 * size)), 1.6, mode="wrap")
    texture = 0.5 + 0.15 * texture / texture.std()
    v, u = np.mgrid[:size, :size].astype(np.float64)
    disparity = 3.3 + 0.12 * (u - 60) + 0.05 * (v - 60) - 0.0015 * (u - 60) ** 2
    rows = ndimage.spline_filter1d(texture, order=3, axis=1, mode="mirror")
    right = np.stack([_row(rows[i], u[i] + 60.0) for i in range(size)])
    left = np.stack([_row(rows[i], u[i] - disparity[i] + 60.0) for i in range(size)])
    left = 1.2 * left - 0.05 + generator.normal(0, noise, left.shape)
    right = right + generator.normal(0, noise, right.shape)
    return left.astype(np.float32), right.astype(np.float32), disparity


def _row(coefficients: np.ndarray, columns: np.ndarray) -> np.ndarray:
    return ndimage.map_coordinates(coefficients, [columns], order=3, prefilter=False, mode="mirror")


def test_a_slanted_subpixel_disparity_is_recovered():
    left, right, truth = scene()
    start = np.where(truth > -50, np.rint(truth), np.nan).astype(np.float32)
    start[:3] = np.nan
    found = Refiner(left, right).refine(start, radius=4, iterations=12, smoothness=20.0)
    inner = np.s_[12:-12, 25:-25]
    error = found.disparity[inner] - truth[inner]
    assert np.sqrt(np.mean(error**2)) < 0.05  # px
    assert abs(np.median(error)) < 0.005
    assert np.nanmedian(found.ncc[inner]) > 0.95
    assert np.isnan(found.disparity[:3]).all()


def test_more_iterations_do_not_diverge():
    left, right, truth = scene()
    inner = np.s_[12:-12, 25:-25]
    errors = []
    for iterations in (10, 60):
        found = Refiner(left, right).refine(
            truth.astype(np.float32), radius=4, iterations=iterations, smoothness=20.0
        )
        errors.append(np.sqrt(np.mean((found.disparity[inner] - truth[inner]) ** 2)))
    assert errors[0] < 0.03  # px
    assert errors[1] < 0.05


def test_warping_agrees_with_a_plain_spline():
    _, right, truth = scene(size=60)
    disparity = truth.astype(np.float32)
    disparity[5, 7] = np.nan
    warped = warp_rows(spline_rows(right), right, disparity)
    plain = np.full_like(right, np.nan)
    coefficients = spline_rows(right).astype(np.float64)
    for i in range(60):
        for j in range(60):
            x = j - float(disparity[i, j])
            if 1 <= x < 58:
                plain[i, j] = _row(coefficients[i], np.array([x]))[0]
    assert np.isnan(warped[5, 7])
    np.testing.assert_allclose(warped, plain, atol=2e-6)


def test_the_compiled_window_step_is_the_least_squares_one():
    left, right, truth = scene(size=60)
    warped = warp_rows(spline_rows(right), right, (truth + 0.1).astype(np.float32))
    slope = row_slope(left)
    radius = 4
    step, ncc, _ = match_step(left, slope, warped, radius)
    box = np.convolve(np.ones(5), np.ones(5))
    window = np.outer(box, box)
    for i, j in ((30, 30), (20, 41), (44, 33)):
        cut = np.s_[i - radius : i + radius + 1, j - radius : j + radius + 1]
        a, b, g = (plane[cut].astype(np.float64) for plane in (left, warped, slope))
        root = np.sqrt(window).ravel()
        design = np.stack([a.ravel(), g.ravel(), np.ones(a.size)], axis=1) * root[:, None]
        gain, shift, _ = np.linalg.lstsq(design, b.ravel() * root, rcond=None)[0]
        assert step[i, j] == pytest.approx(shift / gain, abs=1e-3)
        weights = window / window.sum()
        da, db = a - (weights * a).sum(), b - (weights * b).sum()
        power = (weights * da**2).sum() * (weights * db**2).sum()
        plain = (weights * da * db).sum() / np.sqrt(power)
        assert ncc[i, j] == pytest.approx(plain, abs=1e-4)


def test_smoothing_keeps_curved_surfaces_and_agrees_with_a_plain_loop():
    v, u = np.mgrid[:30, :40].astype(np.float64)
    curved = (2 + 0.1 * u + 0.003 * u**2 - 0.002 * v**2).astype(np.float32)
    nothing = np.full_like(curved, np.nan)
    kept = smooth_step(curved, nothing, nothing, np.float32(5.0))
    np.testing.assert_allclose(kept[4:-4, 4:-4], curved[4:-4, 4:-4], atol=1e-4)
    rough = curved + np.random.default_rng(1).normal(0, 0.1, curved.shape).astype(np.float32)
    step = np.random.default_rng(2).normal(0, 0.05, curved.shape).astype(np.float32)
    sigma = np.random.default_rng(3).uniform(0.02, 0.2, curved.shape).astype(np.float32)
    fast = smooth_step(rough, step, sigma, np.float32(2.0))
    for i, j in ((10, 12), (5, 30), (4, 4)):
        assert fast[i, j] == pytest.approx(_plain_smooth(rough + step, sigma, i, j, 2.0), abs=1e-4)


def _plain_smooth(moved: np.ndarray, sigma: np.ndarray, i: int, j: int, smoothness: float) -> float:
    total, weight = 0.0, 0.0
    for n in (1, 2):
        for line in (
            moved[i, j - 2 * n : j + 2 * n + 1 : n],
            moved[i - 2 * n : i + 2 * n + 1 : n, j],
        ):
            far, near = (line[0] + line[4]) / 2, (line[1] + line[3]) / 2
            bend = abs(line[1] - line[2]) - abs(line[3] - line[2])
            total += (4 * near - far) / 3 / (1 + bend**2 / 4) ** 4
            weight += 1 / (1 + bend**2 / 4) ** 4
    trust, pull = 0.01 / (sigma[i, j] ** 2 + 1e-4), smoothness * weight / 4
    share = 0.8 * pull / (trust + pull)
    return float(moved[i, j] + share * (total / weight - moved[i, j]))


def test_growing_continues_a_plane():
    v, u = np.mgrid[:30, :40].astype(np.float64)
    plane = (1 + 0.4 * u - 0.2 * v).astype(np.float32)
    part = plane.copy()
    part[:, 20:] = np.nan
    grown = grow(part, 3)
    np.testing.assert_allclose(grown[5:-5, :23], plane[5:-5, :23], atol=0.05)
    assert np.isnan(grown[:, 23:]).all()
    np.testing.assert_array_equal(grow(part, 0), part)


def test_the_same_views_give_the_same_bytes():
    left, right, truth = scene(size=60)
    start = truth.astype(np.float32)
    a = Refiner(left, right).refine(start, radius=3, iterations=4, smoothness=5.0)
    b = Refiner(left, right).refine(start, radius=3, iterations=4, smoothness=5.0)
    assert a.disparity.tobytes() == b.disparity.tobytes()


def test_gaps_are_bridged_straight_before_the_spline():
    nan = np.nan
    image = np.array([[nan, 1, 3, nan, nan, 6, nan], [nan] * 7], np.float32)
    bridged = np.array([[1, 1, 3, 4, 5, 6, 6], [0] * 7], np.float32)
    np.testing.assert_allclose(spline_rows(image), spline_rows(bridged), atol=1e-6)
    assert np.isfinite(spline_rows(image)).all()
