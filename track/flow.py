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
_DONE_PX = 0.005
ALIGNED = 0.85  # correlation at which a sample needs no search: refinement will do
# Sums may be reordered: they fill vector lanes. What is compiled so, and what calls it below a
# kernel, is inlined by force: of a callee that is not, two copies that were optimised apart exist,
# and which of them runs hangs on whether the kernel came from the cache.
_FAST = {"reassoc", "contract", "arcp", "nsz"}


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

    A sample that correlates by more than 0.85 where the guide puts it is not searched: it stays.

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
        (level.image, level.gradient), view.image, view.solid, level.centres, level.windows,
        chosen, radius_px,
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


def better(one: FlowMatches, other: FlowMatches) -> FlowMatches:
    """Of two matches of every sample the one that correlates more, the first when alike."""
    second = other.correlation > one.correlation
    return FlowMatches(
        displacement=np.where(second[:, None], other.displacement, one.displacement),
        correlation=np.where(second, other.correlation, one.correlation),
        information=np.where(second[:, None], other.information, one.information),
    )


@numba.njit(cache=True, nogil=True)
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
    patch = np.empty((4, side, padded(side)), np.float32)
    for n in range(count):
        x0, y0 = centres[n, 0] - side // 2, centres[n, 1] - side // 2
        if not chosen[n] or not _inside(image, x0, y0, radius, patch):
            continue
        if not template(reference, solid, windows[n], (x0, y0), (0, 0), weights, patch):
            continue
        best_score[n] = correlation_at(patch, image, x0, y0)
        if best_score[n] > -1.0:
            best_shift[n] = 0.0
        if best_score[n] > ALIGNED:
            continue
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                score = correlation_at(patch, image, x0 + dx, y0 + dy)
                if score > best_score[n]:
                    best_score[n] = score
                    best_shift[n, 0], best_shift[n, 1] = dx, dy
    return best_shift, best_score


@numba.njit(cache=True)
def padded(side: int) -> int:
    """Columns of a window's row in memory: a multiple of what the processor adds at once."""
    return (side + 7) // 8 * 8


@numba.njit(cache=True)
def _inside(image: Any, x0: int, y0: int, margin: int, patch: Any) -> bool:
    """Whether the padded window and a margin around it lie in the image."""
    rows, columns = patch.shape[1], patch.shape[2]
    across = x0 - margin >= 0 and x0 + columns + margin <= image.shape[1]
    return across and y0 - margin >= 0 and y0 + rows + margin <= image.shape[0]


@numba.njit(cache=True, fastmath=_FAST, forceinline=True)
def correlation_at(patch: Any, image: Any, x0: int, y0: int) -> float:
    """Weighted NCC of a template with the image at one whole-pixel place."""
    mean = square = cross = np.float32(0.0)
    middle = patch.shape[1] // 2
    grey = image[y0 + middle, x0 + middle]  # keeps the sums small: their digits are in the variance
    for j in range(patch.shape[1]):
        weight, value, row = patch[0, j], patch[1, j], image[y0 + j]
        for i in range(patch.shape[2]):
            w = row[x0 + i] - grey
            gw = weight[i] * w
            mean += gw
            square += gw * w
            cross += gw * value[i]
    variance = square - mean * mean
    if variance < _FLAT:
        return -1.0
    return cross / np.sqrt(variance)  # type: ignore[no-any-return]


@numba.njit(cache=True, nogil=True)
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
    width = padded(side)
    patch = np.empty((4, side, width), np.float32)  # weight, value, column and row gradient
    scratch = np.empty((side + 3, width), np.float32), np.empty((side, width), np.float32)
    for n in range(count):
        if not np.isfinite(start[n, 0]):
            continue
        x0, y0 = centres[n, 0] - side // 2, centres[n, 1] - side // 2
        ix, iy = int(np.rint(start[n, 0])), int(np.rint(start[n, 1]))
        if not template(reference, solid, windows[n], (x0, y0), (ix, iy), weights, patch):
            continue
        score[n] = descend(
            image, patch, scratch, (x0, y0), start[n], iterations, (found[n], information[n])
        )
        if score[n] <= -1.0:
            found[n] = np.nan
    return found, score, information


@numba.njit(cache=True, forceinline=True)
def descend(
    image: Any, patch: Any, scratch: Any, corner: Any, start: Any, iterations: int, out: Any
) -> float:
    """Gauss-Newton from `start`; fills displacement and information, returns the NCC."""
    found, information = out
    lines, values = scratch
    xx, xy, yy = _hessian(patch)
    determinant = xx * yy - xy * xy
    if determinant < 1e-8:
        return -1.0
    dx, dy = start[0], start[1]
    score = -1.0
    for step in range(iterations + 1):
        if not _shifted(image, corner[0], corner[1], dx, dy, lines, values):
            return -1.0
        score, bx, by = _residual(patch, values)
        if score <= -1.0 or step == iterations:
            break
        sx = (xy * by - yy * bx) / determinant
        sy = (xy * bx - xx * by) / determinant
        size = max(abs(sx), abs(sy))
        long = max(size, _MAX_STEP_PX) / _MAX_STEP_PX
        dx, dy = dx + sx / long, dy + sy / long
        if size < _DONE_PX:
            break
    found[0], found[1] = dx, dy
    information[0], information[1], information[2] = xx, xy, yy
    return score


@numba.njit(cache=True, forceinline=True)
def template(
    reference: Any, solid: Any, window: Any, corner: Any, shift: Any, weights: Any, patch: Any
) -> bool:
    """Normalised reference window and its steepest descent images; False without texture."""
    image, gradient = reference
    (x0, y0), (ix, iy) = corner, shift
    height, width = image.shape
    side = window.shape[0]
    total = mean = 0.0
    used = wanted = 0
    patch[:] = 0.0
    for j in range(side):
        for i in range(side):
            if window[j, i] == 0:
                continue
            wanted += 1
            u, v = x0 + i + ix, y0 + j + iy
            if u < 0 or v < 0 or u >= width or v >= height or solid[v, u] == 0:
                continue
            patch[0, j, i] = weights[j, i]
            patch[1, j, i] = image[y0 + j, x0 + i]
            patch[2, j, i] = gradient[0, y0 + j, x0 + i]
            patch[3, j, i] = gradient[1, y0 + j, x0 + i]
            total += weights[j, i]
            mean += weights[j, i] * image[y0 + j, x0 + i]
            used += 1
    if used < _MIN_PIXELS or 2 * used < wanted:
        return False
    return _normalise(patch, np.float32(total), np.float32(mean / total))  # type: ignore[no-any-return]


@numba.njit(cache=True, fastmath=_FAST, forceinline=True)
def _normalise(patch: Any, total: float, mean: float) -> bool:
    """Make weights sum to 1, values zero-mean and unit; take mean and gain out of the gradients."""
    rows, columns = patch.shape[1], patch.shape[2]
    variance = gx = gy = hx = hy = np.float32(0.0)
    share = np.float32(1.0) / total
    for j in range(rows):
        for i in range(columns):
            g = patch[0, j, i] * share
            value = patch[1, j, i] - mean
            patch[0, j, i], patch[1, j, i] = g, value
            variance += g * value * value
            gx += g * patch[2, j, i]
            gy += g * patch[3, j, i]
            hx += g * value * patch[2, j, i]
            hy += g * value * patch[3, j, i]
    if variance < _FLAT:
        return False
    gain = np.float32(1.0) / np.float32(np.sqrt(variance))
    hx, hy = hx * gain * gain, hy * gain * gain
    for j in range(rows):
        for i in range(columns):
            value = patch[1, j, i]
            patch[2, j, i] = (patch[2, j, i] - gx - hx * value) * gain
            patch[3, j, i] = (patch[3, j, i] - gy - hy * value) * gain
            patch[1, j, i] = value * gain
    return True


@numba.njit(cache=True, fastmath=_FAST, forceinline=True)
def _hessian(patch: Any) -> tuple[float, float, float]:
    xx = xy = yy = np.float32(0.0)
    for j in range(patch.shape[1]):
        weight, across, along = patch[0, j], patch[2, j], patch[3, j]
        for i in range(patch.shape[2]):
            xx += weight[i] * across[i] * across[i]
            xy += weight[i] * across[i] * along[i]
            yy += weight[i] * along[i] * along[i]
    return float(xx), float(xy), float(yy)


@numba.njit(cache=True, fastmath=_FAST, forceinline=True)
def _shifted(image: Any, x0: int, y0: int, dx: float, dy: float, lines: Any, values: Any) -> bool:
    """The window of `image` at a fractional shift, Catmull-Rom; False outside the image."""
    height, width = image.shape
    rows, columns = values.shape
    ix, iy = int(np.floor(dx)), int(np.floor(dy))
    left, top = x0 + ix - 1, y0 + iy - 1
    if left < 0 or top < 0 or left + columns + 3 > width or top + rows + 3 > height:
        return False
    a0, a1, a2, a3 = _cubic(np.float32(dx - ix))
    for j in range(rows + 3):
        row, line = image[top + j], lines[j]
        for i in range(columns):
            k = left + i
            line[i] = a0 * row[k] + a1 * row[k + 1] + a2 * row[k + 2] + a3 * row[k + 3]
    a0, a1, a2, a3 = _cubic(np.float32(dy - iy))
    for j in range(rows):
        one, two, three, four = lines[j], lines[j + 1], lines[j + 2], lines[j + 3]
        line = values[j]
        for i in range(columns):
            line[i] = a0 * one[i] + a1 * two[i] + a2 * three[i] + a3 * four[i]
    return True


@numba.njit(cache=True, forceinline=True)
def _cubic(t: Any) -> tuple[Any, Any, Any, Any]:
    """Catmull-Rom weights of the four neighbours at fraction t, float32."""
    half, one, two = np.float32(0.5), np.float32(1.0), np.float32(2.0)
    return (
        ((-half * t + one) * t - half) * t,
        (one + half) * t * t * t - (two + half) * t * t + one,
        ((-(one + half) * t + two) * t + half) * t,
        (half * t - half) * t * t,
    )


@numba.njit(cache=True, fastmath=_FAST, forceinline=True)
def _residual(patch: Any, values: Any) -> tuple[float, float, float]:
    """NCC, and the steepest descent images times the normalised difference."""
    mean = square = cross = bx = by = np.float32(0.0)
    grey = values[patch.shape[1] // 2, patch.shape[1] // 2]  # keeps the sums small
    for j in range(patch.shape[1]):
        weight, value, across, along = patch[0, j], patch[1, j], patch[2, j], patch[3, j]
        line = values[j]
        for i in range(patch.shape[2]):
            w = line[i] - grey
            gw = weight[i] * w
            mean += gw
            square += gw * w
            cross += gw * value[i]
            bx += gw * across[i]
            by += gw * along[i]
    variance = square - mean * mean
    if variance < _FLAT:
        return -1.0, 0.0, 0.0
    deviation = np.sqrt(variance)  # gradients hold neither mean nor gain: no other term is left
    return float(cross / deviation), float(bx / deviation), float(by / deviation)
