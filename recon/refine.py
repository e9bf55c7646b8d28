"""Sub-pixel refinement of a disparity map: least-squares matching coupled to surface smoothness.

One iteration warps the right view by the current disparity, so that the window of every pixel
follows the surface found so far, slanted or curved; takes one least-squares step on brightness,
gain and offset within the window; and pulls the result towards the second-order smooth surface of
its neighbours, the weaker the better the step is determined.

The loops are compiled without threads and release the interpreter: pairs run side by side in
threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from scipy import ndimage

from capture.arrays import Bools, Floats32

# A cubic through neighbours 1 and 2 steps away answers -5/3 to its shortest wave: undamped, that
# wave would grow. Neighbours 2 and 4 away calm waves as long as the window, which matching cannot
# see.
_DAMPING = np.float32(0.8)
_WAYS = ((0, 1), (1, 0), (0, 2), (2, 0))


@dataclass(frozen=True, eq=False)
class Refined:
    """A refined disparity map.

    Attributes:
        disparity: (H, W) float32 px; NaN where there was no start, or none is left.
        ncc: (H, W) float32 normalised cross-correlation of the windows, -1..1; NaN where undefined.
        sigma_px: (H, W) float32 predicted standard deviation of the disparity, px; NaN where
            undefined.
    """

    disparity: Floats32
    ncc: Floats32
    sigma_px: Floats32


def refine_disparity(
    left: Floats32,
    right: Floats32,
    start: Floats32,
    *,
    radius: int,
    iterations: int,
    smoothness: float,
) -> Refined:
    """Refine a disparity map of a rectified pair by coupled matching and smoothing.

    Args:
        left: (H, W) reference view; NaN off the image.
        right: (H, W) other view; NaN off the image.
        start: (H, W) disparity, px, within about a pixel of the truth; NaN where unknown.
        radius: of the square window, px.
        iterations: steps; each moves a pixel by at most half a pixel.
        smoothness: weight of the smooth surface against a match that is known to 0.1 px.

    Returns:
        The refined map; the mask of known pixels only shrinks.

    References:
        Gruen, Adaptive least squares correlation, 1985 (the step); Baker and Matthews,
        Lucas-Kanade 20 years on, IJCV 2004 (gradient of the reference, which does not correlate
        with the noise of the warped view); Beeler et al., High-quality single-shot capture of
        facial geometry, 2010, section 4 (coupling to second-order smoothness by confidence).
    """
    coefficients = spline_rows(right)
    slope = row_slope(left)
    disparity = start.astype(np.float32, copy=True)
    ncc = np.full_like(disparity, np.nan)
    sigma = np.full_like(disparity, np.nan)
    for _ in range(iterations):
        warped = warp_rows(coefficients, right, disparity)
        step, ncc, sigma = match_step(left, slope, warped, radius)
        disparity = smooth_step(disparity, step, sigma, np.float32(smoothness))
    return Refined(disparity, ncc, sigma)


def spline_rows(image: Floats32) -> Floats32:
    """Cubic B-spline coefficients of every row of (H, W); NaN counts as the nearest known pixel."""
    filled = np.where(np.isnan(image), np.float32(0.0), image)
    rows = ndimage.spline_filter1d(filled, order=3, axis=1, output=np.float32, mode="mirror")
    return np.ascontiguousarray(rows)


def row_slope(image: Floats32) -> Floats32:
    """Derivative along the rows of (H, W) of the cubic spline, per px; NaN at its borders."""
    coefficients = spline_rows(image)
    slope = np.full_like(image, np.nan)
    slope[:, 1:-1] = 0.5 * (coefficients[:, 2:] - coefficients[:, :-2])
    slope[np.isnan(image)] = np.nan
    return slope


@numba.njit(cache=True, nogil=True)
def warp_rows(
    coefficients: Floats32, image: Floats32, disparity: Floats32
) -> Floats32:  # pragma: no cover - compiled
    """The right view (H, W) drawn at (u - d, v); NaN where d is unknown or leaves the image."""
    height, width = coefficients.shape
    out = np.full((height, width), np.float32(np.nan))
    sixth, third2, half, two = (
        np.float32(1.0 / 6.0),
        np.float32(2.0 / 3.0),
        np.float32(0.5),
        np.float32(2.0),
    )
    for i in range(height):
        for j in range(width):
            x = np.float32(j) - disparity[i, j]
            if not (x >= np.float32(1.0) and x < np.float32(width - 2)):
                continue
            x0 = int(x)
            t = x - np.float32(x0)
            s = np.float32(1.0) - t
            if np.isnan(image[i, x0]) or np.isnan(image[i, x0 + 1]):
                continue
            out[i, j] = (
                s * s * s * sixth * coefficients[i, x0 - 1]
                + (third2 - half * t * t * (two - t)) * coefficients[i, x0]
                + (third2 - half * s * s * (two - s)) * coefficients[i, x0 + 1]
                + t * t * t * sixth * coefficients[i, x0 + 2]
            )
    return out


def match_step(
    left: Floats32, slope: Floats32, warped: Floats32, radius: int
) -> tuple[Floats32, Floats32, Floats32]:
    """One least-squares matching step of every window, with gain and offset.

    Args:
        left: (H, W) reference.
        slope: (H, W) its derivative along the rows, per px.
        warped: (H, W) the other view at the current disparity.
        radius: of the window, px.

    Returns:
        Step (H, W), px, to add to the disparity; correlation before the step; predicted standard
        deviation of the disparity, px. NaN where fewer than half of the window is known.
    """
    known = np.isfinite(left) & np.isfinite(slope) & np.isfinite(warped)
    level = np.float32(left[known].mean()) if known.any() else np.float32(0.0)
    means = _products(left, slope, warped, known, level)
    for plane in means:
        _window_mean(plane, radius)
    step, ncc, sigma = _solve_windows(means, known, (1.5 * (radius + 1)) ** 2)
    return step, ncc, sigma


@numba.njit(cache=True, nogil=True)
def _products(
    left: Floats32, slope: Floats32, warped: Floats32, known: Bools, level: np.float32
) -> Floats32:  # pragma: no cover - compiled
    """Planes (10, H, W): mask, a, b, g and their six products, 0 where not known."""
    height, width = known.shape
    out = np.zeros((10, height, width), np.float32)
    for i in range(height):
        for j in range(width):
            if not known[i, j]:
                continue
            a, b, g = left[i, j] - level, warped[i, j] - level, slope[i, j]
            out[0, i, j] = np.float32(1.0)
            out[1, i, j], out[2, i, j], out[3, i, j] = a, b, g
            out[4, i, j], out[5, i, j], out[6, i, j] = a * a, b * b, g * g
            out[7, i, j], out[8, i, j], out[9, i, j] = a * b, a * g, b * g
    return out


def _window_mean(plane: Floats32, radius: int) -> None:
    """Weighted mean of (H, W), in place, over a pyramid-shaped window; 0 counts outside.

    The window is a box passed twice: its spectrum is never negative. With a plain box the iteration
    would amplify disparity waves a little shorter than the window, and diverge.
    """
    for length in (radius // 2 * 2 + 1, (radius + 1) // 2 * 2 + 1):
        size = (length, length)
        cv2.boxFilter(plane, cv2.CV_32F, size, dst=plane, borderType=cv2.BORDER_CONSTANT)


@numba.njit(cache=True, nogil=True)
def _solve_windows(
    means: Floats32, known: Bools, area: float
) -> tuple[Floats32, Floats32, Floats32]:  # pragma: no cover - compiled
    """The 2x2 normal equations (gain, shift) of every pixel from window means of products."""
    height, width = known.shape
    step = np.full((height, width), np.float32(np.nan))
    ncc = np.full((height, width), np.float32(np.nan))
    sigma = np.full((height, width), np.float32(np.nan))
    for i in range(height):
        for j in range(width):
            share = means[0, i, j]
            if not known[i, j] or share < 0.5:
                continue
            ma, mb, mg = means[1, i, j] / share, means[2, i, j] / share, means[3, i, j] / share
            saa = means[4, i, j] / share - ma * ma
            sbb = means[5, i, j] / share - mb * mb
            sgg = means[6, i, j] / share - mg * mg
            sab = means[7, i, j] / share - ma * mb
            sag = means[8, i, j] / share - ma * mg
            sbg = means[9, i, j] / share - mb * mg
            if saa < 1e-10 or sbb < 1e-10 or sgg < 1e-12:
                continue
            correlation = sab / np.sqrt(saa * sbb)
            ncc[i, j] = correlation
            determinant = saa * sgg - sag * sag
            if correlation < 0.1 or determinant < 1e-3 * saa * sgg:
                continue
            # b - mean = gain (a - mean) + shift g: the warped view as a moved copy of the reference
            gain = (sab * sgg - sbg * sag) / determinant
            shift = (sbg * saa - sab * sag) / determinant
            if gain < 0.1:
                continue
            moved = shift / gain
            step[i, j] = min(max(moved, np.float32(-0.5)), np.float32(0.5))
            residual = max(sbb - gain * sab - shift * sbg, np.float32(1e-12))
            across = max(sgg - sag * sag / saa, np.float32(1e-12))
            sigma[i, j] = np.sqrt(residual / (across * share * area)) / gain
    return step, ncc, sigma


def grow(disparity: Floats32, steps: int) -> Floats32:
    """Continue known disparities (H, W) into the unknown, by planes fitted to the known nearby.

    Args:
        disparity: (H, W) px; NaN unknown.
        steps: how many pixels the known area grows.
    """
    out = disparity
    for _ in range(steps):
        out = _grow_once(out)
    return out.copy() if steps == 0 else out


@numba.njit(cache=True, nogil=True)
def _grow_once(disparity: Floats32) -> Floats32:  # pragma: no cover - compiled
    """One pixel of growth: the plane through the known of a 7 x 7 window, or their mean."""
    height, width = disparity.shape
    out = disparity.copy()
    for i in range(height):
        for j in range(width):
            if not np.isnan(disparity[i, j]):
                continue
            touching = 0
            for di in range(-1, 2):
                for dj in range(-1, 2):
                    if 0 <= i + di < height and 0 <= j + dj < width:
                        touching += not np.isnan(disparity[i + di, j + dj])
            if touching >= 2:
                out[i, j] = _extrapolated(disparity, i, j)
    return out


@numba.njit(cache=True, nogil=True)
def _extrapolated(disparity: Floats32, i: int, j: int) -> np.float32:  # pragma: no cover
    """Value at (i, j) of the plane through the known pixels around it, kept within their range."""
    height, width = disparity.shape
    n, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
    sxx, sxy, syy, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0
    low, high = np.inf, -np.inf
    for di in range(-3, 4):
        for dj in range(-3, 4):
            if not (0 <= i + di < height and 0 <= j + dj < width):
                continue
            z = np.float64(disparity[i + di, j + dj])
            if np.isnan(z):
                continue
            n += 1.0
            sx, sy, sz = sx + dj, sy + di, sz + z
            sxx, sxy, syy = sxx + dj * dj, sxy + dj * di, syy + di * di
            sxz, syz = sxz + dj * z, syz + di * z
            low, high = min(low, z), max(high, z)
    mean = sz / n
    if n < 8.0:
        return np.float32(mean)
    sxz, syz = sxz - sx * mean, syz - sy * mean
    sxx, sxy, syy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
    determinant = sxx * syy - sxy * sxy
    if determinant < 0.05 * sxx * syy:
        return np.float32(mean)
    a = (sxz * syy - syz * sxy) / determinant
    b = (syz * sxx - sxz * sxy) / determinant
    value = mean - a * sx / n - b * sy / n
    reach = 0.5 * (high - low) + 0.25
    return np.float32(min(max(value, low - reach), high + reach))


@numba.njit(cache=True, nogil=True)
def smooth_step(
    disparity: Floats32, step: Floats32, sigma: Floats32, smoothness: np.float32
) -> Floats32:  # pragma: no cover - compiled
    """Apply matching steps, then pull towards the second-order smooth surface of the neighbours.

    Args:
        disparity: (H, W) px; NaN unknown.
        step: (H, W) px; NaN takes no step and follows the surface alone.
        sigma: (H, W) px, deviation of the match.
        smoothness: weight of the surface against a match known to 0.1 px.

    Returns:
        (H, W) px; NaN where `disparity` is.
    """
    height, width = disparity.shape
    moved = np.empty((height, width), np.float32)
    for i in range(height):
        for j in range(width):
            s = step[i, j]
            moved[i, j] = disparity[i, j] if np.isnan(s) else disparity[i, j] + s
    out = moved.copy()
    for i in range(height):
        for j in range(width):
            centre = moved[i, j]
            if np.isnan(centre):
                continue
            total, weight = np.float32(0.0), np.float32(0.0)
            for way in range(4):
                di, dj = _WAYS[way]
                predicted, bend = _second_order(moved, i, j, di, dj)
                if np.isnan(predicted):
                    continue
                w = np.exp(-bend * bend)
                total += w * predicted
                weight += w
            if weight < np.float32(1e-6) or smoothness <= np.float32(0.0):
                continue
            target = total / weight
            trust = np.float32(0.0)
            if not np.isnan(step[i, j]):
                trust = np.float32(0.01) / (sigma[i, j] * sigma[i, j] + np.float32(1e-4))
            pull = smoothness * weight * np.float32(0.25)
            out[i, j] = centre + _DAMPING * pull / (trust + pull) * (target - centre)
    return out


@numba.njit(cache=True, nogil=True, inline="always")
def _second_order(
    field: Floats32, i: int, j: int, di: int, dj: int
) -> tuple[np.float32, np.float32]:  # pragma: no cover - compiled
    """The value that a cubic through four neighbours along one axis predicts, and the bend there.

    Falls back on the mean of the two nearest where the outer ones are unknown.
    """
    height, width = field.shape
    nan = np.float32(np.nan)
    if i - di < 0 or j - dj < 0 or i + di >= height or j + dj >= width:
        return nan, nan
    low, high = field[i - di, j - dj], field[i + di, j + dj]
    if np.isnan(low) or np.isnan(high):
        return nan, nan
    mean = np.float32(0.5) * (low + high)
    bend = abs(low - field[i, j]) - abs(high - field[i, j])
    if i - 2 * di >= 0 and j - 2 * dj >= 0 and i + 2 * di < height and j + 2 * dj < width:
        outer = np.float32(0.5) * (field[i - 2 * di, j - 2 * dj] + field[i + 2 * di, j + 2 * dj])
        if not np.isnan(outer):
            return (np.float32(4.0) * mean - outer) / np.float32(3.0), bend
    return mean, bend
