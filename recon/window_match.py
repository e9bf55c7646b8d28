"""Least-squares matching of every window of two views at once.

The sums over windows that the normal equations want are made row by row in a ring buffer that stays
in the processor's cache: products of a row, their weighted sums along it, the sums of those down
the columns, the solution. No plane of products is ever stored.
"""

from __future__ import annotations

import numba
import numpy as np

from capture.arrays import Bools, Floats32, Ints

_PLANES = 10  # mask, a, b, g, aa, bb, gg, ab, ag, bg
_STRIP = 384  # columns worked on at once: the ring of their sums fits the second cache


def match_step(
    left: Floats32, slope: Floats32, warped: Floats32, radius: int
) -> tuple[Floats32, Floats32, Floats32]:
    """One least-squares matching step of every window, with gain and offset.

    The window is shaped like a pyramid, a box passed twice: its spectrum is never negative. With a
    plain box the iteration would amplify disparity waves a little shorter than the window, and
    diverge.

    Args:
        left: (H, W) reference; NaN unknown.
        slope: (H, W) its derivative along the rows, per px; NaN unknown.
        warped: (H, W) the other view at the current disparity; NaN unknown.
        radius: of the window, px.

    Returns:
        Step (H, W), px, to add to the disparity; correlation before the step; predicted standard
        deviation of the disparity, px. NaN where fewer than half of the window is known.
    """
    known = np.isfinite(left) & np.isfinite(slope) & np.isfinite(warped)
    sample = left[::8, ::8][known[::8, ::8]]  # conditions the sums, no more
    level = np.float32(sample.mean()) if len(sample) else np.float32(0.0)
    area = np.float32((1.5 * (radius + 1)) ** 2)
    taps = _taps(radius)
    return _match_rows(left, slope, warped, known, known_ranges(known), (level, area), taps)  # type: ignore[no-any-return]


@numba.njit(cache=True, nogil=True)
def known_ranges(known: Bools) -> Ints:  # pragma: no cover - compiled
    """First and one past the last known column (H, 2) of every row; (0, 0) for an empty row."""
    height, width = known.shape
    out = np.zeros((height, 2), np.int64)
    for i in range(height):
        first, last = width, 0
        for j in range(width):
            if known[i, j]:
                first = j
                break
        for j in range(width - 1, first - 1, -1):
            if known[i, j]:
                last = j + 1
                break
        if last > first:
            out[i, 0], out[i, 1] = first, last
    return out


def _taps(radius: int) -> Floats32:
    """Weights (2 r + 1,) of the window along one axis, 1 in all."""
    boxes = [np.ones(r // 2 * 2 + 1) for r in (radius, radius + 1)]
    taps: Floats32 = np.convolve(boxes[0], boxes[1]).astype(np.float32)
    weights: Floats32 = taps / taps.sum()
    return weights


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _match_rows(
    left: Floats32,
    slope: Floats32,
    warped: Floats32,
    known: Bools,
    ranges: Ints,
    constants: tuple[np.float32, np.float32],
    taps: Floats32,
) -> tuple[Floats32, Floats32, Floats32]:  # pragma: no cover - compiled
    """All windows, strip by strip of columns."""
    out = np.full((3, *known.shape), np.float32(np.nan))
    for first in range(0, known.shape[1], _STRIP):
        last = min(first + _STRIP, known.shape[1])
        _match_strip(left, slope, warped, known, ranges, (first, last), constants, taps, out)
    return out[0], out[1], out[2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _match_strip(
    left: Floats32,
    slope: Floats32,
    warped: Floats32,
    known: Bools,
    ranges: Ints,
    strip: tuple[int, int],
    constants: tuple[np.float32, np.float32],
    taps: Floats32,
    out: Floats32,
) -> None:  # pragma: no cover - compiled
    height, width = known.shape
    level, area = constants
    count = len(taps)
    radius = count // 2
    first, last = strip
    size = last - first
    begin, end = max(first - radius, 0), min(last + radius, width)
    at = begin - first + radius
    raw = np.zeros((_PLANES, size + 2 * radius), np.float32)
    ring = np.zeros((count, _PLANES, size), np.float32)
    filled = np.zeros(count, np.bool_)
    means = np.empty((_PLANES, size), np.float32)
    for i in range(height + radius):
        slot = i % count
        filled[slot] = i < height and ranges[i, 0] < end and ranges[i, 1] > begin
        if filled[slot]:
            _row_products(
                left[i, begin:end], slope[i, begin:end], warped[i, begin:end], known[i, begin:end],
                level, raw, at,
            )  # fmt: skip
            ring[slot] = np.float32(0.0)
            for p in range(_PLANES):
                for k in range(count):
                    _add(taps[k], raw[p, k : k + size], ring[slot, p])
        o = i - radius
        if o < 0 or ranges[o, 0] >= last or ranges[o, 1] <= first:
            continue
        means[:] = np.float32(0.0)
        for row in range(max(o - radius, 0), min(o + radius + 1, height)):
            if filled[row % count]:
                _add_planes(taps[row - o + radius], ring[row % count], means)
        _solve_row(
            means, known[o, first:last], area,
            out[0, o, first:last], out[1, o, first:last], out[2, o, first:last],
        )  # fmt: skip


# The loops below are short and touch few arrays each, so that the compiler turns them into vector
# instructions; none runs over more than a row, which stays in the cache.


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add(weight: np.float32, source: Floats32, total: Floats32) -> None:  # pragma: no cover
    for j in range(len(total)):
        total[j] += weight * source[j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_planes(
    weight: np.float32, source: Floats32, total: Floats32
) -> None:  # pragma: no cover - compiled
    for p in range(_PLANES):
        for j in range(total.shape[1]):
            total[p, j] += weight * source[p, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _multiply(a: Floats32, b: Floats32, out: Floats32) -> None:  # pragma: no cover - compiled
    for j in range(len(out)):
        out[j] = a[j] * b[j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _less_product(a: Floats32, b: Floats32, out: Floats32) -> None:  # pragma: no cover - compiled
    for j in range(len(out)):
        out[j] -= a[j] * b[j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _filled(
    values: Floats32, known: Bools, level: np.float32, out: Floats32
) -> None:  # pragma: no cover - compiled
    for j in range(len(out)):
        out[j] = values[j] - level if known[j] else np.float32(0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _row_products(
    left: Floats32,
    slope: Floats32,
    warped: Floats32,
    known: Bools,
    level: np.float32,
    raw: Floats32,
    at: int,
) -> None:  # pragma: no cover - compiled
    """The ten products of n pixels of a row into raw (10, m) from column `at`; 0 where unknown."""
    end = at + len(known)
    mask, a, b, g = raw[0, at:end], raw[1, at:end], raw[2, at:end], raw[3, at:end]
    for j in range(len(known)):
        mask[j] = np.float32(1.0) if known[j] else np.float32(0.0)
    _filled(left, known, level, a)
    _filled(warped, known, level, b)
    _filled(slope, known, np.float32(0.0), g)
    _multiply(a, a, raw[4, at:end])
    _multiply(b, b, raw[5, at:end])
    _multiply(g, g, raw[6, at:end])
    _multiply(a, b, raw[7, at:end])
    _multiply(a, g, raw[8, at:end])
    _multiply(b, g, raw[9, at:end])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve_row(
    means: Floats32,
    known: Bools,
    area: np.float32,
    step: Floats32,
    ncc: Floats32,
    sigma: Floats32,
) -> None:  # pragma: no cover - compiled
    """The 2x2 normal equations (gain, shift) of a row of pixels from window sums of products."""
    share = means[0]
    for j in range(len(share)):  # a window known by less than half counts as unknown
        enough = known[j] & (share[j] >= np.float32(0.5))
        share[j] = share[j] if enough else np.float32(0.0)
    scale = sigma  # until it is known
    for j in range(len(share)):
        scale[j] = np.float32(1.0) / max(share[j], np.float32(0.5))
    for p in range(1, _PLANES):
        _multiply(means[p], scale, means[p])
    ma, mb, mg = means[1], means[2], means[3]
    saa, sbb, sgg, sab, sag, sbg = means[4], means[5], means[6], means[7], means[8], means[9]
    _less_product(ma, ma, saa)
    _less_product(mb, mb, sbb)
    _less_product(mg, mg, sgg)
    _less_product(ma, mb, sab)
    _less_product(ma, mg, sag)
    _less_product(mb, mg, sbg)
    _correlate(share, saa, sbb, sgg, sab, ncc)
    gain, shift, residual = ma, mb, mg  # the means are not wanted any more
    _solve_pair(saa, sgg, sab, sag, sbg, gain)
    _solve_pair(sgg, saa, sbg, sag, sab, shift)
    for j in range(len(gain)):
        residual[j] = sbb[j] - gain[j] * sab[j] - shift[j] * sbg[j]
    for j in range(
        len(gain)
    ):  # b - mean = gain (a - mean) + shift g: a moved copy of the reference
        moved = min(max(shift[j] / gain[j], np.float32(-0.5)), np.float32(0.5))
        solvable = (ncc[j] >= np.float32(0.1)) & (gain[j] >= np.float32(0.1))
        step[j] = moved if solvable else np.float32(np.nan)
    tiny = np.float32(1e-12)
    for j in range(len(gain)):
        sgg[j] = max(sgg[j] - sag[j] * sag[j] / saa[j], tiny)
    for j in range(len(gain)):
        weight = sgg[j] * max(share[j], np.float32(0.5)) * area
        deviation = np.sqrt(max(residual[j], tiny) / weight) / gain[j]
        sigma[j] = deviation if step[j] == step[j] else np.float32(np.nan)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _correlate(
    share: Floats32, saa: Floats32, sbb: Floats32, sgg: Floats32, sab: Floats32, ncc: Floats32
) -> None:  # pragma: no cover - compiled
    """Normalised cross-correlation; NaN where the window is unknown or has no texture."""
    tiny = np.float32(1e-12)
    for j in range(len(ncc)):
        textured = (saa[j] >= np.float32(1e-10)) & (sbb[j] >= np.float32(1e-10))
        textured = textured & (sgg[j] >= tiny) & (share[j] > np.float32(0.0))
        value = sab[j] / np.sqrt(max(saa[j] * sbb[j], np.float32(1e-24)))
        ncc[j] = value if textured else np.float32(np.nan)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve_pair(
    own: Floats32, other: Floats32, target: Floats32, cross: Floats32, rest: Floats32, out: Floats32
) -> None:  # pragma: no cover - compiled
    """One unknown of [[own, cross], [cross, other]] x = [target, rest]; NaN where unclear."""
    for j in range(len(out)):
        determinant = own[j] * other[j] - cross[j] * cross[j]
        value = (target[j] * other[j] - rest[j] * cross[j]) / determinant
        good = determinant >= np.float32(1e-3) * own[j] * other[j]
        out[j] = value if good else np.float32(np.nan)
