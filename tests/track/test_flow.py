"""NCC flow: against a literal slow form, and on known motions of a texture."""

import numpy as np
import pytest

from capture.arrays import Floats, Floats32
from capture.errors import SettingsError
from tests.synthetic import small_array
from tests.track.moving_patch import skin
from track.flow import refine_flow, search_flow, window_weights
from track.guide import GuidedView
from track.reference import ReferenceLevel

SIZE, HALF = 120, 6


def _texture(a: Floats, shift: Floats) -> Floats32:
    """The texture seen through x -> a x + shift, px; 1 px is 0.6 mm."""
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(float)
    centre = (SIZE - 1) / 2
    flat = np.stack([x.ravel() - centre, y.ravel() - centre]) - shift[:, None]
    back = np.linalg.solve(a, flat)
    points = 0.6 * np.column_stack([back.T, np.zeros(SIZE * SIZE)])
    return skin(points).reshape(SIZE, SIZE).astype(np.float32)


def _level(image: Floats32) -> ReferenceLevel:
    x = np.arange(25, SIZE - 25, 7)
    centres = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2).astype(np.int32)
    rows, columns = np.gradient(image)
    side = 2 * HALF + 1
    return ReferenceLevel(
        camera=small_array()[0],
        image=image,
        gradient=np.stack([columns, rows]).astype(np.float32),
        triangle=np.zeros((SIZE, SIZE), np.int32),
        barycentric=np.zeros((SIZE, SIZE, 3), np.float32),
        samples=np.arange(len(centres), dtype=np.int32),
        centres=centres,
        windows=np.ones((len(centres), side, side), np.uint8),
    )


def _seen(image: Floats32) -> GuidedView:
    place = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), -1).astype(np.float32)
    return GuidedView(image=image, place=place, solid=np.ones((SIZE, SIZE), np.uint8))


def _literal(level: ReferenceLevel, image: Floats32, radius: int) -> tuple[Floats, Floats]:
    """Best shift and NCC of every sample by loops over float64 windows."""
    weights = window_weights(HALF) / window_weights(HALF).sum()
    shifts, scores = [], []
    for x, y in level.centres:
        best = (-2.0, 0, 0)
        r = level.image[y - HALF : y + HALF + 1, x - HALF : x + HALF + 1].astype(float)
        r = r - (weights * r).sum()
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                v, u = y + dy, x + dx
                w = image[v - HALF : v + HALF + 1, u - HALF : u + HALF + 1].astype(float)
                w = w - (weights * w).sum()
                below = np.sqrt((weights * r * r).sum() * (weights * w * w).sum())
                best = max(best, (float((weights * r * w).sum() / below), dx, dy))
        scores.append(best[0])
        shifts.append(best[1:])
    return np.array(shifts, float), np.array(scores)


def test_search_equals_the_literal_correlation() -> None:
    level = _level(_texture(np.eye(2), np.zeros(2)))
    moved = _texture(np.eye(2), np.array([3.0, -2.0]))
    every = np.ones(len(level.samples), bool)
    found = search_flow(level, _seen(moved), every, 4)
    shifts, scores = _literal(level, moved, 4)
    np.testing.assert_array_equal(found.displacement, shifts)
    np.testing.assert_allclose(found.correlation, scores, atol=2e-4)
    assert (shifts == [3, -2]).all(axis=1).mean() > 0.95
    some = search_flow(level, _seen(moved), np.arange(len(every)) % 2 == 0, 4)
    assert np.isnan(some.displacement[1::2]).all()


@pytest.mark.parametrize("shift", [(0.37, -0.61), (-0.9, 0.25)])
def test_a_known_translation_is_recovered(shift: tuple[float, float]) -> None:
    level = _level(_texture(np.eye(2), np.zeros(2)))
    rng = np.random.default_rng(1)
    moved = 0.85 * _texture(np.eye(2), np.array(shift)) + 0.03  # gain and offset must not matter
    moved = (moved + rng.normal(0, 1.5 / 255, moved.shape)).astype(np.float32)
    found = refine_flow(level, _seen(moved), np.zeros((len(level.samples), 2)), 4)
    error = np.linalg.norm(found.displacement - shift, axis=1)
    assert np.median(error) < 0.03  # px
    assert np.percentile(error, 95) < 0.1
    assert found.correlation.min() > 0.9


def test_a_known_affine_motion_is_recovered() -> None:
    affine = np.array([[1.02, 0.015], [-0.01, 0.985]])
    level = _level(_texture(np.eye(2), np.zeros(2)))
    moved = _texture(affine, np.array([0.3, 0.2]))
    start = search_flow(level, _seen(moved), np.ones(len(level.samples), bool), 2).displacement
    found = refine_flow(level, _seen(moved), start, 4)
    away = level.centres - (SIZE - 1) / 2
    expected = away @ (affine - np.eye(2)).T + [0.3, 0.2]
    error = np.linalg.norm(found.displacement - expected, axis=1)
    assert np.median(error) < 0.05  # px
    assert np.abs(expected).max() > 1.0


def test_hidden_pixels_have_no_say() -> None:
    level = _level(_texture(np.eye(2), np.zeros(2)))
    moved = _texture(np.eye(2), np.array([0.4, 0.1]))
    moved[:, 60:] = np.random.default_rng(0).uniform(0, 1, (SIZE, 60))
    view = _seen(moved)
    view.solid[:, 57:] = 0
    found = refine_flow(level, view, np.zeros((len(level.samples), 2)), 4)
    kept = found.correlation > 0.9
    near = kept & (level.centres[:, 0] > 60 - HALF - 2)
    assert near.sum() > 5  # windows that reach into the noise are still matched
    assert np.abs(found.displacement[kept] - [0.4, 0.1]).max() < 0.1  # px
    assert not kept[level.centres[:, 0] > 66].any()


def test_flat_skin_is_not_matched() -> None:
    flat = np.full((SIZE, SIZE), 0.5, np.float32)
    level = _level(flat)
    found = refine_flow(level, _seen(flat), np.zeros((len(level.samples), 2)), 2)
    assert np.isnan(found.displacement).all()
    assert (found.correlation == -1).all()


def test_a_negative_radius_is_refused() -> None:
    level = _level(_texture(np.eye(2), np.zeros(2)))
    with pytest.raises(SettingsError, match="radius_px: expected at least 0, found -1"):
        search_flow(level, _seen(level.image), np.ones(len(level.samples), bool), -1)
