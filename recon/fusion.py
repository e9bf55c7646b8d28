"""Many depth maps to one set of oriented points: what pairs agree on, averaged along normals."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np

from capture.arrays import Bools, Floats, Floats32, Ints, Ints32, check_shape
from capture.errors import SettingsError
from recon.rectify import Rectification

_FIT_RADIUS = 2  # px, window of the plane fitted for a normal
_SIGMA_FLOOR_PX = 0.05  # no match is trusted beyond this
_RANGES = (
    ("agree_px", 0.01, 20.0),
    ("agreeing", 0, 20),
    ("facing_min", 0.0, 0.95),
    ("lone_facing", 0.0, 1.0),
    ("lone_sigma_px", 0.0, 10.0),
    ("stride", 1, 16),
    ("voxel_px", 0.1, 50.0),
    ("passes", 1, 5),
)


@dataclass(frozen=True, kw_only=True)
class FusionSettings:
    """How depth maps are merged.

    Attributes:
        agree_px: two pairs agree when their disparities of a point differ by less.
        agreeing: other pairs that must agree with a point, where so many can see it.
        facing_min: least cosine between the normal and the ray to the reference view.
        lone_facing: as facing_min, for points that no other pair has a surface near.
        lone_sigma_px: largest predicted deviation of such points.
        stride: every how many pixels of a diagonal a point is taken; all pixels confirm points.
        voxel_px: points are averaged in voxels of this many pixel footprints.
        passes: rounds of averaging over pairs.
    """

    agree_px: float = 0.7
    agreeing: int = 2
    facing_min: float = 0.25
    lone_facing: float = 0.3
    lone_sigma_px: float = 0.25
    stride: int = 2
    voxel_px: float = 1.2
    passes: int = 1

    def __post_init__(self) -> None:
        for name, low, high in _RANGES:
            value = getattr(self, name)
            if not low <= value <= high:
                raise SettingsError(f"{name}: expected {low}..{high}, found {value}")


@dataclass(frozen=True, eq=False)
class DepthView:
    """The disparity map of one rectified pair, as fusion needs it.

    Attributes:
        geometry: of the pair; its size is that of the map.
        disparity: (H, W) float32 px; NaN where unknown.
        sigma_px: (H, W) float32 predicted deviation, px.
    """

    geometry: Rectification
    disparity: Floats32
    sigma_px: Floats32


@dataclass(frozen=True, eq=False)
class Points:
    """Oriented points in world space.

    Attributes:
        positions: (N, 3) float32 mm.
        normals: (N, 3) float32 unit, out of the surface.
        confidence: (N,) float32 0..1.
        support: (N,) int32 pairs that agree with the point, its own included.
        spacing_mm: side of the voxels the points were averaged in.
        agreement_mm: (2,) median and 95th percentile of the distance between pairs along the
            normal.
    """

    positions: Floats32
    normals: Floats32
    confidence: Floats32
    support: Ints32
    spacing_mm: float
    agreement_mm: tuple[float, float]

    def __len__(self) -> int:
        return len(self.positions)


def lift(view: DepthView, stride: int = 1) -> tuple[Floats32, Floats32, Floats32]:
    """World points, normals and deviations of the known pixels of a depth view, row by row.

    Args:
        view: the depth view.
        stride: only pixels whose row and column add up to a multiple of it.

    Returns:
        Points (N, 3), mm; unit normals (N, 3) towards the reference view, NaN where the
        neighbourhood is too ragged for a plane; deviation (N,), px.
    """
    geometry = view.geometry
    offset = geometry.left_column - geometry.right_column
    rows, columns = np.nonzero(np.isfinite(view.disparity))
    taken = (rows + columns) % stride == 0
    rows, columns = rows[taken], columns[taken]
    disparity = view.disparity[rows, columns].astype(np.float64)
    matches = np.stack([columns.astype(np.float64), rows.astype(np.float64), disparity], axis=1)
    slopes = _plane_slopes(view.disparity, rows, columns)
    across = (columns - geometry.left_column) * slopes[:, 0] + (rows - geometry.row) * slopes[:, 1]
    normals = np.stack(
        [
            slopes[:, 0] * geometry.focal_px,
            slopes[:, 1] * geometry.focal_px,
            disparity - offset - across,
        ],
        axis=1,
    )
    normals = -(normals / np.linalg.norm(normals, axis=1, keepdims=True)) @ geometry.rotation
    points = geometry.triangulate(matches)
    return (
        points.astype(np.float32),
        normals.astype(np.float32),
        view.sigma_px[rows, columns],
    )


def fuse(views: Sequence[DepthView], settings: FusionSettings, *, workers: int = 1) -> Points:
    """Merge depth views: keep what other pairs confirm, move it to the consensus, thin it.

    Args:
        views: one or more.
        settings: see there.
        workers: threads; the result does not depend on it.

    Returns:
        Oriented points; none when no two pairs agree anywhere.
    """
    packed = _pack(views)
    footprint = float(np.median([_footprint(view) for view in views]))

    def one(index: int) -> tuple[Floats32, Floats32, Floats32, Ints32, Floats32]:
        return _confirmed(views[index], packed, index, settings)

    with ThreadPoolExecutor(max_workers=max(workers, 1)) as pool:
        parts = list(pool.map(one, range(len(views))))
    positions, normals, weights, support, spread = (
        np.concatenate([part[k] for part in parts]) for k in range(5)
    )
    spacing = settings.voxel_px * footprint
    known = spread[np.isfinite(spread)]
    agreement = (
        (np.nan, np.nan) if len(known) == 0 else tuple(np.percentile(known, [50, 95]).tolist())
    )
    return _thin(positions, normals, weights, support, spacing, agreement)


class _Packed(NamedTuple):
    """All depth views in flat arrays, for the compiled loops."""

    disparity: Floats32  # concatenated rows of all maps
    sigma: Floats32
    layout: Ints  # (Q, 3) start, height, width
    frame: Floats  # (Q, 3, 3) rectified from world
    centre: Floats  # (Q, 3) reference centre, mm
    lens: Floats  # (Q, 5) focal, left column, row, focal * baseline, column offset


def _pack(views: Sequence[DepthView]) -> _Packed:
    layout, lens, start = [], [], 0
    for view in views:
        check_shape(disparity=(view.disparity, "H W"), sigma_px=(view.sigma_px, "H W"))
        g = view.geometry
        layout.append((start, *view.disparity.shape))
        start += view.disparity.size
        lens.append(
            (
                g.focal_px,
                g.left_column,
                g.row,
                g.focal_px * g.baseline_mm,
                g.left_column - g.right_column,
            )
        )
    return _Packed(
        np.concatenate([view.disparity.ravel() for view in views]),
        np.concatenate([view.sigma_px.ravel() for view in views]),
        np.array(layout, dtype=np.int64),
        np.stack([view.geometry.rotation for view in views]),
        np.stack([view.geometry.left.centre for view in views]),
        np.array(lens),
    )


def _footprint(view: DepthView) -> float:
    """Median size of a pixel on the surface, mm; infinite for an empty map."""
    known = view.disparity[np.isfinite(view.disparity)]
    if len(known) == 0:
        return np.inf
    return float(view.geometry.depth(np.array(np.median(known))) / view.geometry.focal_px)


def _confirmed(
    view: DepthView, packed: _Packed, own: int, settings: FusionSettings
) -> tuple[Floats32, Floats32, Floats32, Ints32, Floats32]:
    points, normals, sigma = lift(view, settings.stride)
    towards = view.geometry.left.centre.astype(np.float32) - points
    facing = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    good = facing > settings.facing_min  # NaN fails
    points, normals, sigma = points[good], normals[good], sigma[good]
    for _ in range(settings.passes):
        points, weights, support, seeing, against, spread = _consensus(
            points, normals, sigma, own, packed, settings.agree_px
        )
    wanted = 1 + np.minimum(settings.agreeing, seeing)
    lone = (support > 1) | (
        (facing[good] > settings.lone_facing) & (sigma < settings.lone_sigma_px)
    )
    keep: Bools = (support >= wanted) & (against < support) & lone
    return points[keep], normals[keep], weights[keep], support[keep], spread[keep]


@numba.njit(cache=True, nogil=True)
def _consensus(
    points: Floats32,
    normals: Floats32,
    sigma: Floats32,
    own: int,
    packed: _Packed,
    agree_px: float,
) -> tuple[Floats32, Floats32, Ints32, Ints32, Ints32, Floats32]:  # pragma: no cover - compiled
    """Move every point along its normal to the weighted mean of the pairs that agree with it.

    Returns points, weights (1/mm^2), agreeing pairs (own included), other pairs with a surface
    there, pairs that see through the point, and the deviation of the agreeing pairs along the
    normal, mm.
    """
    disparity, deviation, layout, frame, centre, lens = packed
    count = len(points)
    moved = np.empty((count, 3), np.float32)
    weights = np.empty(count, np.float32)
    support = np.empty(count, np.int32)
    seeing = np.empty(count, np.int32)
    against = np.empty(count, np.int32)
    spread = np.empty(count, np.float32)
    for n in range(count):
        total, squares, weight = 0.0, 0.0, 0.0
        agreeing, others, through = 0, 0, 0
        for q in range(len(layout)):
            lx, ly, lz = (
                points[n, 0] - centre[q, 0],
                points[n, 1] - centre[q, 1],
                points[n, 2] - centre[q, 2],
            )
            z = frame[q, 2, 0] * lx + frame[q, 2, 1] * ly + frame[q, 2, 2] * lz
            if z <= 0.0:
                continue
            along = normals[n, 0] * lx + normals[n, 1] * ly + normals[n, 2] * lz
            if along >= 0.0:
                continue
            x = frame[q, 0, 0] * lx + frame[q, 0, 1] * ly + frame[q, 0, 2] * lz
            y = frame[q, 1, 0] * lx + frame[q, 1, 1] * ly + frame[q, 1, 2] * lz
            u = lens[q, 0] * x / z + lens[q, 1]
            v = lens[q, 0] * y / z + lens[q, 2]
            expected = lens[q, 3] / z + lens[q, 4]
            if q == own:
                found, error = expected, np.float64(sigma[n])
            else:
                found, error = _sample(disparity, deviation, layout[q], u, v)
                if np.isnan(found):
                    continue
                others += 1
                if found < expected - agree_px:
                    through += 1
                    continue
                if found > expected + agree_px:
                    continue
            reached = lens[q, 3] / (found - lens[q, 4])
            offset = along * (reached / z - 1.0)
            error = np.sqrt(error * error + _SIGMA_FLOOR_PX**2) * z / lens[q, 3] * along
            w = 1.0 / (error * error)
            agreeing += 1
            total += w * offset
            squares += w * offset * offset
            weight += w
        mean = total / weight if weight > 0.0 else 0.0
        for k in range(3):
            moved[n, k] = points[n, k] + mean * normals[n, k]
        weights[n] = weight
        support[n], seeing[n], against[n] = agreeing, others, through
        spread[n] = np.nan
        if agreeing > 1:
            spread[n] = np.sqrt(max(squares / weight - mean * mean, 0.0))
    return moved, weights, support, seeing, against, spread


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


@numba.njit(cache=True, nogil=True)
def _plane_slopes(disparity: Floats32, rows: Ints, columns: Ints) -> Floats:  # pragma: no cover
    """Least-squares slopes (N, 2) along columns and rows, px per px; NaN with few neighbours."""
    height, width = disparity.shape
    out = np.full((len(rows), 2), np.nan)
    for n in range(len(rows)):
        i, j = rows[n], columns[n]
        centre = disparity[i, j]
        count, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
        sxx, sxy, syy, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0
        for di in range(-_FIT_RADIUS, _FIT_RADIUS + 1):
            for dj in range(-_FIT_RADIUS, _FIT_RADIUS + 1):
                if not (0 <= i + di < height and 0 <= j + dj < width):
                    continue
                z = disparity[i + di, j + dj] - centre
                if not abs(z) < 3.0:
                    continue
                count += 1.0
                sx, sy, sz = sx + dj, sy + di, sz + z
                sxx, sxy, syy = sxx + dj * dj, sxy + dj * di, syy + di * di
                sxz, syz = sxz + dj * z, syz + di * z
        if count < 12.0:
            continue
        sxx, sxy, syy = sxx - sx * sx / count, sxy - sx * sy / count, syy - sy * sy / count
        sxz, syz = sxz - sx * sz / count, syz - sy * sz / count
        determinant = sxx * syy - sxy * sxy
        if determinant < 1e-6 * sxx * syy or determinant <= 0.0:
            continue
        out[n, 0] = (sxz * syy - syz * sxy) / determinant
        out[n, 1] = (syz * sxx - sxz * sxy) / determinant
    return out


def _thin(
    positions: Floats32,
    normals: Floats32,
    weights: Floats32,
    support: Ints32,
    spacing: float,
    agreement: tuple[float, ...],
) -> Points:
    """Weighted means in voxels of side `spacing`, in the order of the voxels."""
    numbers = (float(agreement[0]), float(agreement[1]))
    if len(positions) == 0:
        return Points(positions, normals, weights, support, spacing, numbers)
    cell = np.floor(positions.astype(np.float64) / spacing).astype(np.int64)
    cell -= cell.min(axis=0)
    size = cell.max(axis=0) + 1
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    w = weights[order].astype(np.float64)
    total = np.add.reduceat(w, starts)

    def mean(values: Floats32) -> Floats:
        columns = [
            np.add.reduceat(w * values[order, k], starts) / total for k in range(values.shape[1])
        ]
        return np.stack(columns, axis=1)

    direction = mean(normals)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    best = np.maximum.reduceat(support[order], starts)
    keep = length[:, 0] > 0.5
    confidence = length[:, 0] * (1.0 - np.exp(-best / 3.0))
    return Points(
        mean(positions)[keep].astype(np.float32),
        (direction / np.maximum(length, 1e-9))[keep].astype(np.float32),
        confidence[keep].astype(np.float32),
        best[keep].astype(np.int32),
        spacing,
        numbers,
    )
