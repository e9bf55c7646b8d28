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

import numba
import numpy as np
from scipy import ndimage

from capture.arrays import Floats32, Ints
from recon.window_match import known_ranges, match_step

# A cubic through neighbours 1 and 2 steps away answers -5/3 to its shortest wave: undamped, that
# wave would grow.
_DAMPING = np.float32(0.8)
_PAD = 4  # farthest neighbour looked at, px
_WAYS = ((0, 1), (1, 0), (0, 2), (2, 0))  # (down, right) to the near neighbours


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


class Refiner:
    """Refines disparity maps of one rectified pair at one resolution."""

    def __init__(self, left: Floats32, right: Floats32) -> None:
        """Prepare two views (H, W), NaN off the image."""
        self._left, self._right = left, right
        self._coefficients = spline_rows(right)
        self._slope = row_slope(left)

    def refine(
        self, start: Floats32, *, radius: int, iterations: int, smoothness: float
    ) -> Refined:
        """Refine a disparity map by coupled matching and smoothing.

        Args:
            start: (H, W) disparity, px, within about a pixel of the truth; NaN where unknown.
            radius: of the window, px.
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
        disparity = start.astype(np.float32, copy=True)
        ncc = np.full_like(disparity, np.nan)
        sigma = np.full_like(disparity, np.nan)
        for _ in range(iterations):
            warped = warp_rows(self._coefficients, self._right, disparity)
            step, ncc, sigma = match_step(self._left, self._slope, warped, radius)
            disparity = smooth_step(disparity, step, sigma, np.float32(smoothness))
        return Refined(disparity, ncc, sigma)


def spline_rows(image: Floats32) -> Floats32:
    """Cubic B-spline coefficients of every row of (H, W); gaps of NaN are bridged straight."""
    rows = ndimage.spline_filter1d(
        _bridged(image), order=3, axis=1, output=np.float32, mode="mirror"
    )
    return np.ascontiguousarray(rows)


@numba.njit(cache=True, nogil=True)
def _bridged(image: Floats32) -> Floats32:  # pragma: no cover - compiled
    """Unknown pixels on the line between the known ones on either side in the row, or like one."""
    height, width = image.shape
    out = image.copy()
    for i in range(height):
        last = -1  # known
        for j in range(width + 1):
            if j < width and np.isnan(image[i, j]):
                continue
            if last < 0 and j == width:
                out[i] = np.float32(0.0)
            for k in range(last + 1, j):
                if last < 0:
                    out[i, k] = image[i, j] if j < width else np.float32(0.0)
                elif j == width:
                    out[i, k] = image[i, last]
                else:
                    share = np.float32(k - last) / np.float32(j - last)
                    out[i, k] = image[i, last] + share * (image[i, j] - image[i, last])
            last = j
    return out


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
    count = np.zeros((3, width + 2), np.uint8)  # known of each 3 wide piece of three rows, a ring
    for i in range(-1, height):
        line = count[(i + 1) % 3]
        line[:] = 0
        if i + 1 < height:
            for j in range(width):
                if disparity[i + 1, j] == disparity[i + 1, j]:
                    line[j] += 1
                    line[j + 1] += 1
                    line[j + 2] += 1
        if i < 0:
            continue
        for j in range(width):
            touching = count[0, j + 1] + count[1, j + 1] + count[2, j + 1]
            if touching >= 2 and np.isnan(disparity[i, j]):
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


def smooth_step(
    disparity: Floats32, step: Floats32, sigma: Floats32, smoothness: np.float32
) -> Floats32:
    """Apply matching steps, then pull towards the second-order smooth surface of the neighbours.

    Along each axis, a cubic through four neighbours one and two steps away predicts the value; so
    does one through neighbours two and four away, which calms waves as long as the window, which
    matching cannot see. Where the outer neighbours are unknown the mean of the inner two serves. A
    bend at the pixel lowers the weight of that axis.

    Args:
        disparity: (H, W) px; NaN unknown.
        step: (H, W) px; NaN takes no step and follows the surface alone.
        sigma: (H, W) px, deviation of the match.
        smoothness: weight of the surface against a match known to 0.1 px.

    Returns:
        (H, W) px; NaN where `disparity` is.
    """
    height, width = disparity.shape
    padded = np.full((height + 2 * _PAD, width + 2 * _PAD), np.float32(np.nan))
    ranges = known_ranges(np.isfinite(disparity))
    return _smooth_rows(disparity, step, sigma, np.float32(smoothness), ranges, padded)  # type: ignore[no-any-return]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _smooth_rows(
    disparity: Floats32,
    step: Floats32,
    sigma: Floats32,
    smoothness: np.float32,
    ranges: Ints,
    padded: Floats32,
) -> Floats32:  # pragma: no cover - compiled
    height, width = disparity.shape
    zero = np.float32(0.0)
    for i in range(height):
        line = padded[i + _PAD]
        for j in range(ranges[i, 0], ranges[i, 1]):
            s = step[i, j]
            line[j + _PAD] = disparity[i, j] + (s if s == s else zero)
    out = np.full((height, width), np.float32(np.nan))
    scratch = np.empty((4, width), np.float32)
    for i in range(height):
        low, high = ranges[i, 0], ranges[i, 1]
        if high <= low:
            continue
        total, weight = scratch[0, low:high], scratch[1, low:high]
        predicted, share = scratch[2, low:high], scratch[3, low:high]
        total[:] = weight[:] = zero
        row, first, last = i + _PAD, low + _PAD, high + _PAD
        centre = padded[row, first:last]
        for way in range(4):
            down, right = _WAYS[way]
            below = padded[row - down, first - right : last - right]
            above = padded[row + down, first + right : last + right]
            down, right = 2 * down, 2 * right
            far_below = padded[row - down, first - right : last - right]
            far_above = padded[row + down, first + right : last + right]
            _predict(far_below, below, above, far_above, predicted)
            _weigh(below, centre, above, predicted, share)
            _accumulate(predicted, share, total, weight)
        _settle(
            centre, step[i, low:high], sigma[i, low:high], smoothness, total, weight,
            out[i, low:high],
        )  # fmt: skip
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _predict(
    far_below: Floats32, below: Floats32, above: Floats32, far_above: Floats32, out: Floats32
) -> None:  # pragma: no cover - compiled
    """What a cubic through four neighbours says, or the mean of the near two; NaN without those."""
    half, third = np.float32(0.5), np.float32(1.0 / 3.0)
    for j in range(len(out)):
        mean = half * (below[j] + above[j])
        outer = half * (far_below[j] + far_above[j])
        cubic = mean + (mean - outer) * third
        out[j] = cubic if cubic == cubic else mean


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weigh(
    below: Floats32, centre: Floats32, above: Floats32, predicted: Floats32, out: Floats32
) -> None:  # pragma: no cover - compiled
    """The say of one axis: less across a bend, none where it predicts nothing."""
    one, quarter = np.float32(1.0), np.float32(0.25)
    for j in range(len(out)):
        bend = abs(below[j] - centre[j]) - abs(above[j] - centre[j])
        flat = one / (one + quarter * bend * bend)
        flat = flat * flat
        out[j] = flat * flat if predicted[j] == predicted[j] else np.float32(0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(
    predicted: Floats32, share: Floats32, total: Floats32, weight: Floats32
) -> None:  # pragma: no cover - compiled
    zero = np.float32(0.0)
    for j in range(len(total)):
        total[j] += share[j] * predicted[j] if share[j] > zero else zero
    for j in range(len(total)):
        weight[j] += share[j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _settle(
    centre: Floats32,
    step: Floats32,
    sigma: Floats32,
    smoothness: np.float32,
    total: Floats32,
    weight: Floats32,
    out: Floats32,
) -> None:  # pragma: no cover - compiled
    """Between the match and the surface, by their weights."""
    zero, quarter, tiny = np.float32(0.0), np.float32(0.25), np.float32(1e-6)
    small, hundredth = np.float32(1e-4), np.float32(0.01)
    for j in range(len(out)):
        total[j] = total[j] / weight[j] - centre[j] if weight[j] >= tiny else zero
    for j in range(len(out)):
        trust = hundredth / (sigma[j] * sigma[j] + small)
        trust = trust if step[j] == step[j] else zero
        pull = smoothness * weight[j] * quarter
        share = pull / max(trust + pull, tiny)
        out[j] = centre[j] + _DAMPING * share * total[j]
