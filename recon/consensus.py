"""Compiled loops of fusion: pixels lifted to oriented points, and what all pairs say of a point."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from scipy import ndimage

from capture.arrays import Bools, Floats, Floats32, Ints, Ints32

_FIT_RADIUS = 2  # px, window of the plane fitted for a normal
_SIGMA_FLOOR_PX = 0.15  # matches are no better: shading shared by a window, whatever its texture


class PackedViews(NamedTuple):
    """All depth views in flat arrays, Q pairs.

    Attributes:
        disparity: rows of all maps, one after the other, px; NaN where unknown.
        sigma: predicted deviations in the same order, px.
        layout: (Q, 3) start, height, width.
        frame: (Q, 3, 3) rectified from world.
        centre: (Q, 3) reference centre, mm.
        lens: (Q, 5) focal, left column, row, focal * baseline, column offset.
    """

    disparity: Floats32
    sigma: Floats32
    layout: Ints
    frame: Floats
    centre: Floats
    lens: Floats


class Verdict(NamedTuple):
    """What the pairs say of N points.

    Attributes:
        positions: (N, 3) mm, moved along the normal to the weighted mean of those that agree.
        weights: (N,) 1/mm^2.
        support: (N,) pairs that agree, the point's own included.
        against: (N,) other pairs that see through the point.
        hidden: (N,) other pairs that have a surface in front of the point.
        spread: (N,) deviation of the agreeing pairs along the normal, mm; NaN for one alone.
    """

    positions: Floats32
    weights: Floats32
    support: Ints32
    against: Ints32
    hidden: Ints32
    spread: Floats32


@numba.njit(cache=True, nogil=True)
def lift_pixels(
    disparity: Floats32,
    rows: Ints,
    columns: Ints,
    lens: Floats,
    frame: Floats,
    centre: Floats,
) -> tuple[Floats32, Floats32, Floats32]:  # pragma: no cover - compiled
    """World points (N, 3), mm, unit normals (N, 3) and the cosine (N,) between normal and ray.

    The normal is that of a least-squares plane in disparity; it is NaN, and the cosine with it,
    where too few neighbours lie on one surface.

    Args:
        disparity: (H, W) px.
        rows: (N,) of pixels that have a disparity.
        columns: (N,).
        lens: (5,) as in `PackedViews`.
        frame: (3, 3) rectified from world.
        centre: (3,) mm.
    """
    count = len(rows)
    positions = np.empty((count, 3), np.float32)
    normals = np.empty((count, 3), np.float32)
    facing = np.empty(count, np.float32)
    local = np.empty(3)
    for n in range(count):
        i, j = rows[n], columns[n]
        d = np.float64(disparity[i, j])
        u, v = j - lens[1], i - lens[2]
        z = lens[3] / (d - lens[4])
        local[0], local[1], local[2] = u * z / lens[0], v * z / lens[0], z
        for k in range(3):
            positions[n, k] = centre[k] + (
                local[0] * frame[0, k] + local[1] * frame[1, k] + local[2] * frame[2, k]
            )
        across, down = _plane(disparity, i, j)
        a, b = across * lens[0], down * lens[0]
        c = d - lens[4] - u * across - v * down
        length = np.sqrt(a * a + b * b + c * c)
        for k in range(3):
            normals[n, k] = -(a * frame[0, k] + b * frame[1, k] + c * frame[2, k]) / length
        reach = np.sqrt(local[0] ** 2 + local[1] ** 2 + local[2] ** 2)
        facing[n] = (a * local[0] + b * local[1] + c * local[2]) / (length * reach)
    return positions, normals, facing


@numba.njit(cache=True, nogil=True, inline="always")
def _plane(disparity: Floats32, i: int, j: int) -> tuple[float, float]:  # pragma: no cover
    """Slopes along columns and rows, px per px; NaN with few neighbours on the same surface."""
    height, width = disparity.shape
    centre = disparity[i, j]
    count, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
    sxx, sxy, syy, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0
    for di in range(-_FIT_RADIUS, _FIT_RADIUS + 1):
        for dj in range(-_FIT_RADIUS, _FIT_RADIUS + 1):
            if not (0 <= i + di < height and 0 <= j + dj < width):
                continue
            z = np.float64(disparity[i + di, j + dj] - centre)
            if not abs(z) < 3.0:
                continue
            count += 1.0
            sx, sy, sz = sx + dj, sy + di, sz + z
            sxx, sxy, syy = sxx + dj * dj, sxy + dj * di, syy + di * di
            sxz, syz = sxz + dj * z, syz + di * z
    if count < 12.0:
        return np.nan, np.nan
    sxx, sxy, syy = sxx - sx * sx / count, sxy - sx * sy / count, syy - sy * sy / count
    sxz, syz = sxz - sx * sz / count, syz - sy * sz / count
    determinant = sxx * syy - sxy * sxy
    if determinant < 1e-6 * sxx * syy or determinant <= 0.0:
        return np.nan, np.nan
    return (sxz * syy - syz * sxy) / determinant, (syz * sxx - sxz * sxy) / determinant


@numba.njit(cache=True, nogil=True)
def consensus(
    points: Floats32,
    normals: Floats32,
    sigma: Floats32,
    own: int,
    packed: PackedViews,
    agree_px: float,
) -> Verdict:  # pragma: no cover - compiled
    """Ask every pair about points (N, 3), mm, with unit normals (N, 3), that pair `own` found.

    A pair agrees where its disparity at the point differs by less than `agree_px` from that of
    the point; pairs that the surface turns its back on are not asked.
    """
    disparity, deviation, layout, frame, centre, lens = packed
    count = len(points)
    moved = np.empty((count, 3), np.float32)
    weights = np.empty(count, np.float32)
    support = np.empty(count, np.int32)
    against = np.empty(count, np.int32)
    hidden = np.empty(count, np.int32)
    spread = np.empty(count, np.float32)
    for n in range(count):
        total, squares, weight = 0.0, 0.0, 0.0
        agreeing, through, behind = 0, 0, 0
        for q in range(len(layout)):
            lx, ly, lz = (
                points[n, 0] - centre[q, 0],
                points[n, 1] - centre[q, 1],
                points[n, 2] - centre[q, 2],
            )
            along = normals[n, 0] * lx + normals[n, 1] * ly + normals[n, 2] * lz
            if along >= 0.0:
                continue
            z = frame[q, 2, 0] * lx + frame[q, 2, 1] * ly + frame[q, 2, 2] * lz
            if z <= 0.0:
                continue
            expected = lens[q, 3] / z + lens[q, 4]
            if q == own:
                found, error = expected, np.float64(sigma[n])
            else:
                x = frame[q, 0, 0] * lx + frame[q, 0, 1] * ly + frame[q, 0, 2] * lz
                y = frame[q, 1, 0] * lx + frame[q, 1, 1] * ly + frame[q, 1, 2] * lz
                u = lens[q, 0] * x / z + lens[q, 1]
                v = lens[q, 0] * y / z + lens[q, 2]
                found, error = _sample(disparity, deviation, layout[q], u, v)
                if np.isnan(found):
                    continue
                if found < expected - agree_px:
                    through += 1
                    continue
                if found > expected + agree_px:
                    behind += 1
                    continue
            reached = lens[q, 3] / (found - lens[q, 4])
            offset = along * (reached / z - 1.0)
            w = 1.0 / ((error * error + _SIGMA_FLOOR_PX**2) * (z / lens[q, 3] * along) ** 2)
            agreeing += 1
            total += w * offset
            squares += w * offset * offset
            weight += w
        mean = total / weight if weight > 0.0 else 0.0
        for k in range(3):
            moved[n, k] = points[n, k] + mean * normals[n, k]
        weights[n] = weight
        support[n], against[n], hidden[n] = agreeing, through, behind
        spread[n] = np.nan
        if agreeing > 1:
            spread[n] = np.sqrt(max(squares / weight - mean * mean, 0.0))
    return Verdict(moved, weights, support, against, hidden, spread)


@numba.njit(cache=True, nogil=True, inline="always")
def _sample(
    disparity: Floats32, deviation: Floats32, layout: Ints, u: float, v: float
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Bilinear disparity at (u, v) of one packed map, NaN at holes and jumps; nearest deviation."""
    start, height, width = layout[0], layout[1], layout[2]
    if not (u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1):
        return np.nan, np.nan
    i, j = int(v), int(u)
    t, s = u - j, v - i
    at = start + i * width + j
    a, b = np.float64(disparity[at]), np.float64(disparity[at + 1])
    c, d = np.float64(disparity[at + width]), np.float64(disparity[at + width + 1])
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    if not (high - low < 2.0):
        return np.nan, np.nan
    value = (1 - s) * ((1 - t) * a + t * b) + s * ((1 - t) * c + t * d)
    nearest = at + (width if s > 0.5 else 0) + (1 if t > 0.5 else 0)
    return value, np.float64(deviation[nearest])


def rim(known: Bools) -> Bools:
    """Known pixels (H, W) whose plane window reaches an unknown pixel or the border of the map."""
    size = 2 * _FIT_RADIUS + 1
    inner: Bools = ndimage.minimum_filter(known, size, mode="constant", cval=False)
    return known & ~inner
