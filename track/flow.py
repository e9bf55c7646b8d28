"""Flow from the reference: normalised cross-correlation over windows, whole pixels, then parts.

Both images lie in the reference's frame (see `track.guide`), so what is measured is what the
guide has missed. Whole-pixel search takes the best correlation; sub-pixel refinement is the
inverse compositional Gauss-Newton step on zero-mean, unit-variance windows, which maximises the
same correlation, with Catmull-Rom interpolation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from capture.arrays import Floats, check_shape
from capture.errors import SettingsError
from track.guide import GuidedView
from track.reference import ReferenceLevel

_FLAT = 1e-5  # variance of an image in 0..1 below which a window has no texture
_MIN_PIXELS = 20
_MAX_STEP_PX = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class FlowMatches:
    """Displacements of a view's samples, in the reference's pixels.

    Attributes:
        displacement: (M, 2) px to add to the guide's reference position; NaN where not matched.
        correlation: (M,) NCC at that place, -1 where not matched.
        information: (M, 3) xx, xy, yy of the inverse covariance shape, px^-2, for windows
            normalised to unit variance.
    """

    displacement: Floats
    correlation: Floats
    information: Floats


def window_weights(half: int) -> Floats:
    """Gaussian weights (S, S) of a window with S = 2 half + 1; sigma is 0.6 half."""
    line = np.exp(-0.5 * (np.arange(-half, half + 1) / (0.6 * half)) ** 2)
    return np.outer(line, line)


def search_flow(
    level: ReferenceLevel, view: GuidedView, chosen: np.ndarray[Any, Any], radius_px: int
) -> FlowMatches:
    """Find the whole-pixel displacement of highest NCC within a square.

    Args:
        level: the reference of the view.
        view: the frame's image, guided into it.
        chosen: (M,) bool: which of the level's samples to search; the others stay unmatched.
        radius_px: half side of the square, >= 0.

    Returns:
        Matches of all M samples; `information` is 0.
    """
    if radius_px < 0:
        raise SettingsError(f"radius_px: expected at least 0, found {radius_px}")
    check_shape(chosen=(chosen, "M"), samples=(level.samples, "M"))
    half = level.windows.shape[1] // 2
    displacement, correlation = _search(
        level.image, view.image, view.solid, level.centres, level.windows, chosen, radius_px,
        window_weights(half),
    )  # fmt: skip
    blank = np.zeros((len(displacement), 3))
    return FlowMatches(displacement=displacement, correlation=correlation, information=blank)


def refine_flow(
    level: ReferenceLevel, view: GuidedView, start: Floats, iterations: int
) -> FlowMatches:
    """Refine displacements to a fraction of a pixel.

    Args:
        level: the reference of the view.
        view: the frame's image, guided into it.
        start: (M, 2) px displacements to start from; NaN skips the sample.
        iterations: Gauss-Newton steps, each at most one pixel long.

    Returns:
        Matches of all M samples.

    References:
        Baker and Matthews 2004, "Lucas-Kanade 20 years on", section 3.2 (inverse compositional);
        mean and gain are projected out of the steepest descent images, so the step is that of NCC.
    """
    check_shape(start=(start, "M 2"), samples=(level.samples, "M"))
    half = level.windows.shape[1] // 2
    displacement, correlation, information = _refine(
        (level.image, level.gradient), (view.image, view.solid), level.centres, level.windows,
        start, iterations, window_weights(half),
    )  # fmt: skip
    return FlowMatches(displacement=displacement, correlation=correlation, information=information)


@numba.njit(cache=True, parallel=True)
def _search(
    reference: Any,
    image: Any,
    solid: Any,
    centres: Any,
    windows: Any,
    chosen: Any,
    radius: int,
    weights: Any,
) -> tuple[Any, Any]:
    count, side = len(centres), windows.shape[1]
    best_shift = np.full((count, 2), np.nan)
    best_score = np.full(count, -1.0)
    for n in numba.prange(count):
        if not chosen[n]:
            continue
        x0, y0 = centres[n, 0] - side // 2, centres[n, 1] - side // 2
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                score = _correlation(reference, image, solid, windows[n], x0, y0, dx, dy, weights)
                if score > best_score[n]:
                    best_score[n] = score
                    best_shift[n, 0], best_shift[n, 1] = dx, dy
    return best_shift, best_score


@numba.njit(cache=True)
def _correlation(
    reference: Any,
    image: Any,
    solid: Any,
    window: Any,
    x0: int,
    y0: int,
    dx: int,
    dy: int,
    weights: Any,
) -> float:
    """Weighted NCC of one window at one whole-pixel shift; -1 when too little of it shows."""
    height, width = image.shape
    side = window.shape[0]
    total = r1 = w1 = rr = ww = rw = 0.0
    used = wanted = 0
    for j in range(side):
        v = y0 + j + dy
        for i in range(side):
            if window[j, i] == 0:
                continue
            wanted += 1
            u = x0 + i + dx
            if u < 0 or v < 0 or u >= width or v >= height or solid[v, u] == 0:
                continue
            g = weights[j, i]
            r = reference[y0 + j, x0 + i]
            w = image[v, u]
            total += g
            r1 += g * r
            w1 += g * w
            rr += g * r * r
            ww += g * w * w
            rw += g * r * w
            used += 1
    if used < _MIN_PIXELS or 2 * used < wanted:
        return -1.0
    r1, w1 = r1 / total, w1 / total
    r_variance, w_variance = rr / total - r1 * r1, ww / total - w1 * w1
    if r_variance < _FLAT or w_variance < _FLAT:
        return -1.0
    return (rw / total - r1 * w1) / np.sqrt(r_variance * w_variance)  # type: ignore[no-any-return]


@numba.njit(cache=True, parallel=True)
def _refine(
    reference: Any,
    frame: Any,
    centres: Any,
    windows: Any,
    start: Any,
    iterations: int,
    weights: Any,
) -> tuple[Any, Any, Any]:
    image, solid = frame
    count, side = len(centres), windows.shape[1]
    found = np.full((count, 2), np.nan)
    score = np.full(count, -1.0)
    information = np.zeros((count, 3))
    for n in numba.prange(count):
        if not np.isfinite(start[n, 0]):
            continue
        x0, y0 = centres[n, 0] - side // 2, centres[n, 1] - side // 2
        dx, dy = start[n]
        patch = np.empty((4, side, side), np.float32)  # weight, value, column and row gradient
        if not _template(reference, solid, windows[n], x0, y0, dx, dy, weights, patch):
            continue
        xx, xy, yy = _hessian(patch)
        determinant = xx * yy - xy * xy
        if determinant < 1e-8:
            continue
        values = np.empty((side, side), np.float32)
        lines = np.empty((side + 3, side), np.float32)
        for step in range(iterations + 1):
            if not _shifted(image, x0, y0, dx, dy, lines, values):
                score[n] = -1.0
                break
            score[n], bx, by = _residual(patch, values)
            if score[n] <= -1.0 or step == iterations:
                break
            sx = (xy * by - yy * bx) / determinant
            sy = (xy * bx - xx * by) / determinant
            long = max(abs(sx), abs(sy), _MAX_STEP_PX) / _MAX_STEP_PX
            dx, dy = dx + sx / long, dy + sy / long
        if score[n] > -1.0:
            found[n, 0], found[n, 1] = dx, dy
            information[n, 0], information[n, 1], information[n, 2] = xx, xy, yy
    return found, score, information


@numba.njit(cache=True)
def _template(
    reference: Any,
    solid: Any,
    window: Any,
    x0: int,
    y0: int,
    dx: float,
    dy: float,
    weights: Any,
    patch: Any,
) -> bool:
    """Normalised reference window and its steepest descent images; False without texture."""
    image, gradient = reference
    height, width = image.shape
    side = window.shape[0]
    ix, iy = int(np.rint(dx)), int(np.rint(dy))
    total = mean = 0.0
    used = wanted = 0
    for j in range(side):
        for i in range(side):
            patch[0, j, i] = patch[1, j, i] = patch[2, j, i] = patch[3, j, i] = 0.0
            if window[j, i] == 0:
                continue
            wanted += 1
            u, v = x0 + i + ix, y0 + j + iy
            if u < 1 or v < 1 or u >= width - 1 or v >= height - 1:
                continue
            if solid[v, u - 1] + solid[v, u + 1] + solid[v - 1, u] + solid[v + 1, u] < 4:
                continue
            patch[0, j, i] = weights[j, i]
            patch[1, j, i] = image[y0 + j, x0 + i]
            patch[2, j, i] = gradient[0, y0 + j, x0 + i]
            patch[3, j, i] = gradient[1, y0 + j, x0 + i]
            total += patch[0, j, i]
            mean += patch[0, j, i] * patch[1, j, i]
            used += 1
    if used < _MIN_PIXELS or 2 * used < wanted:
        return False
    mean /= total
    return _normalise(patch, total, mean)  # type: ignore[no-any-return]


@numba.njit(cache=True)
def _normalise(patch: Any, total: float, mean: float) -> bool:
    """Make weights sum to 1, values zero-mean and unit; take mean and gain out of the gradients."""
    side = patch.shape[1]
    variance = gx = gy = 0.0
    for j in range(side):
        for i in range(side):
            patch[0, j, i] /= total
            g = patch[0, j, i]
            patch[1, j, i] -= mean
            variance += g * patch[1, j, i] ** 2
            gx += g * patch[2, j, i]
            gy += g * patch[3, j, i]
    if variance < _FLAT:
        return False
    deviation = np.sqrt(variance)
    hx = hy = 0.0
    for j in range(side):
        for i in range(side):
            g = patch[0, j, i]
            patch[1, j, i] /= deviation
            patch[2, j, i] = (patch[2, j, i] - gx) / deviation
            patch[3, j, i] = (patch[3, j, i] - gy) / deviation
            hx += g * patch[1, j, i] * patch[2, j, i]
            hy += g * patch[1, j, i] * patch[3, j, i]
    for j in range(side):
        for i in range(side):
            patch[2, j, i] -= hx * patch[1, j, i]
            patch[3, j, i] -= hy * patch[1, j, i]
    return True


@numba.njit(cache=True)
def _hessian(patch: Any) -> tuple[float, float, float]:
    xx = xy = yy = 0.0
    for j in range(patch.shape[1]):
        for i in range(patch.shape[2]):
            g = patch[0, j, i]
            xx += g * patch[2, j, i] * patch[2, j, i]
            xy += g * patch[2, j, i] * patch[3, j, i]
            yy += g * patch[3, j, i] * patch[3, j, i]
    return xx, xy, yy


@numba.njit(cache=True)
def _shifted(image: Any, x0: int, y0: int, dx: float, dy: float, lines: Any, values: Any) -> bool:
    """The window of `image` at a fractional shift, Catmull-Rom; False outside the image."""
    height, width = image.shape
    side = values.shape[0]
    ix, iy = int(np.floor(dx)), int(np.floor(dy))
    left, top = x0 + ix - 1, y0 + iy - 1
    if left < 0 or top < 0 or left + side + 3 > width or top + side + 3 > height:
        return False
    t = np.float32(dx - ix)
    a0 = np.float32(((-0.5 * t + 1.0) * t - 0.5) * t)
    a1 = np.float32((1.5 * t - 2.5) * t * t + 1.0)
    a2 = np.float32(((-1.5 * t + 2.0) * t + 0.5) * t)
    a3 = np.float32((0.5 * t - 0.5) * t * t)
    for j in range(side + 3):
        row = image[top + j]
        for i in range(side):
            k = left + i
            lines[j, i] = a0 * row[k] + a1 * row[k + 1] + a2 * row[k + 2] + a3 * row[k + 3]
    t = np.float32(dy - iy)
    a0 = np.float32(((-0.5 * t + 1.0) * t - 0.5) * t)
    a1 = np.float32((1.5 * t - 2.5) * t * t + 1.0)
    a2 = np.float32(((-1.5 * t + 2.0) * t + 0.5) * t)
    a3 = np.float32((0.5 * t - 0.5) * t * t)
    for j in range(side):
        for i in range(side):
            values[j, i] = (
                a0 * lines[j, i]
                + a1 * lines[j + 1, i]
                + a2 * lines[j + 2, i]
                + a3 * lines[j + 3, i]
            )
    return True


@numba.njit(cache=True)
def _residual(patch: Any, values: Any) -> tuple[float, float, float]:
    """NCC, and the steepest descent images times the normalised difference."""
    side = patch.shape[1]
    mean = square = cross = bx = by = 0.0
    for j in range(side):
        for i in range(side):
            g = patch[0, j, i]
            w = values[j, i]
            mean += g * w
            square += g * w * w
            cross += g * w * patch[1, j, i]
            bx += g * w * patch[2, j, i]
            by += g * w * patch[3, j, i]
    variance = square - mean * mean
    if variance < _FLAT:
        return -1.0, 0.0, 0.0
    deviation = np.sqrt(variance)  # gradients hold neither mean nor gain: no other term is left
    return cross / deviation, bx / deviation, by / deviation
