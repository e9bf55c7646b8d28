"""Many depth maps to one set of oriented points: what pairs agree on, averaged along normals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from capture.arrays import Bools, Floats, Floats32, Ints, Ints32, check_shape
from capture.settings import check_ranges
from recon.consensus import PackedViews, consensus, lift_pixels, rim
from recon.rectify import Rectification

REJECTIONS = ("ragged", "oblique", "seen_through", "unconfirmed", "mixed")
_RANGES: dict[str, tuple[float, float]] = {
    "agree_px": (0.01, 20.0),
    "agreeing": (0, 20),
    "facing_min": (0.0, 0.95),
    "lone_facing": (0.0, 1.0),
    "lone_sigma_px": (0.0, 10.0),
    "lone_hidden": (0, 100),
    "stride": (1, 16),
    "voxel_px": (0.1, 50.0),
    "passes": (1, 5),
}


@dataclass(frozen=True, kw_only=True)
class FusionSettings:
    """How depth maps are merged.

    Attributes:
        agree_px: two pairs agree when their disparities of a point differ by less.
        agreeing: other pairs that must agree with a point, where so many look at it and see no
            surface in front.
        facing_min: least cosine between the normal and the ray to the reference view.
        lone_facing: as facing_min, for points that no other pair agrees with.
        lone_sigma_px: largest predicted deviation of such points.
        lone_hidden: such points go when more other pairs than this have a surface in front.
        stride: every how many pixels of a diagonal a point is taken, away from the rims of a map;
            at rims all are, and all pixels confirm points.
        voxel_px: points are averaged in voxels of this many pixel footprints.
        passes: rounds of averaging over pairs.
    """

    agree_px: float = 1.0
    agreeing: int = 2
    facing_min: float = 0.15
    lone_facing: float = 0.2
    lone_sigma_px: float = 0.2
    lone_hidden: int = 4
    stride: int = 6
    voxel_px: float = 1.6
    passes: int = 1

    def __post_init__(self) -> None:
        check_ranges("fusion", self, **_RANGES)


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
        rejected: points lifted from the pairs that are not in here, by reason: `ragged` (too few
            neighbours for a normal), `oblique` (below `facing_min`), `seen_through` (no fewer pairs
            see through it than agree), `unconfirmed` (too few agree, or alone and not good
            enough), `mixed` (in a voxel whose normals cancel).
    """

    positions: Floats32
    normals: Floats32
    confidence: Floats32
    support: Ints32
    spacing_mm: float
    agreement_mm: tuple[float, float]
    rejected: Mapping[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.positions)


def lift(view: DepthView, stride: int = 1) -> tuple[Floats32, Floats32, Floats32]:
    """World points, normals and deviations of the known pixels of a depth view, row by row.

    Args:
        view: the depth view.
        stride: only pixels whose row and column add up to a multiple of it, and those at a rim.

    Returns:
        Points (N, 3), mm; unit normals (N, 3) towards the reference view, NaN where the
        neighbourhood is too ragged for a plane; deviation (N,), px.
    """
    points, normals, sigma, _ = _lifted(view, stride)
    return points, normals, sigma


def lift_at(view: DepthView, rows: Ints, columns: Ints) -> tuple[Floats32, Floats32, Floats32]:
    """World points (N, 3), mm, normals (N, 3) and cosines (N,) to the reference view, of pixels.

    Args:
        view: the depth view.
        rows: (N,) of pixels whose disparity is known.
        columns: (N,).

    Returns:
        As `lift`; normals and cosines are NaN where the neighbourhood is too ragged for a plane.
    """
    geometry = view.geometry
    return lift_pixels(  # type: ignore[no-any-return]
        view.disparity, rows, columns, _lens(geometry), geometry.rotation, geometry.left.centre
    )


def _lifted(view: DepthView, stride: int) -> tuple[Floats32, Floats32, Floats32, Floats32]:
    """As `lift`, with the cosine (N,) between the normal and the ray to the reference view."""
    known = np.isfinite(view.disparity)
    rows, columns = np.ogrid[: known.shape[0], : known.shape[1]]
    taken = known & (((rows + columns) % stride == 0) | rim(known))
    rows, columns = np.nonzero(taken)
    points, normals, facing = lift_at(view, rows, columns)
    return points, normals, view.sigma_px[rows, columns], facing


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

    def one(index: int) -> tuple[_Kept, Ints]:
        return _confirmed(views[index], packed, index, settings)

    with ThreadPoolExecutor(max_workers=max(workers, 1)) as pool:
        parts = list(pool.map(one, range(len(views))))
    positions, normals, weights, support, spread = zip(*(part for part, _ in parts), strict=True)
    kept = _Kept(
        np.concatenate(positions),
        np.concatenate(normals),
        np.concatenate(weights),
        np.concatenate(support),
        np.concatenate(spread),
    )
    rejected = np.sum([counts for _, counts in parts], axis=0).tolist()
    return _thin(kept, settings.voxel_px * footprint, dict(zip(REJECTIONS, rejected, strict=False)))


class _Kept(NamedTuple):
    """Points that passed, in the order of the views and their rows."""

    positions: Floats32
    normals: Floats32
    weights: Floats32
    support: Ints32
    spread: Floats32


def _pack(views: Sequence[DepthView]) -> PackedViews:
    layout, start = [], 0
    for view in views:
        check_shape(disparity=(view.disparity, "H W"), sigma_px=(view.sigma_px, "H W"))
        layout.append((start, *view.disparity.shape))
        start += view.disparity.size
    return PackedViews(
        np.concatenate([view.disparity.ravel() for view in views]),
        np.concatenate([view.sigma_px.ravel() for view in views]),
        np.array(layout, dtype=np.int64),
        np.stack([view.geometry.rotation for view in views]),
        np.stack([view.geometry.left.centre for view in views]),
        np.stack([_lens(view.geometry) for view in views]),
    )


def _lens(geometry: Rectification) -> Floats:
    """Focal length, left column, row, focal length * baseline, column offset."""
    offset = geometry.left_column - geometry.right_column
    through = geometry.focal_px * geometry.baseline_mm
    return np.array([geometry.focal_px, geometry.left_column, geometry.row, through, offset])


def _footprint(view: DepthView) -> float:
    """Median size of a pixel on the surface, mm; infinite for an empty map."""
    known = view.disparity[np.isfinite(view.disparity)]
    if len(known) == 0:
        return np.inf
    return float(view.geometry.depth(np.array(np.median(known))) / view.geometry.focal_px)


def _confirmed(
    view: DepthView, packed: PackedViews, own: int, settings: FusionSettings
) -> tuple[_Kept, Ints]:
    """The points of one view that pass, and how many did not, in the order of `REJECTIONS`."""
    points, normals, sigma, facing = _lifted(view, settings.stride)
    ragged = ~np.isfinite(facing)
    oblique = facing <= settings.facing_min
    good = ~(ragged | oblique)
    points, normals, sigma, facing = points[good], normals[good], sigma[good], facing[good]
    for _ in range(settings.passes):
        verdict = consensus(points, normals, sigma, own, packed, settings.agree_px)
        points = verdict.positions
    _, weights, support, against, hidden, spread = verdict
    seen_through = against >= support
    alone = (support == 1) & (
        (facing <= settings.lone_facing)
        | (sigma >= settings.lone_sigma_px)
        | (hidden > settings.lone_hidden)
    )
    others = np.minimum(support - 1 + against, settings.agreeing)
    unconfirmed = (support - 1 < others) | alone
    keep: Bools = ~(seen_through | unconfirmed)
    counts = np.array(
        [
            ragged.sum(),
            oblique.sum(),
            seen_through.sum(),
            (unconfirmed & ~seen_through).sum(),
        ]
    )
    kept = _Kept(points[keep], normals[keep], weights[keep], support[keep], spread[keep])
    return kept, counts


def _thin(kept: _Kept, spacing: float, rejected: dict[str, int]) -> Points:
    """Weighted means in voxels of side `spacing`, in the order of the voxels."""
    positions, normals, weights, support, spread = kept
    known = spread[np.isfinite(spread)]
    low, high = (np.nan, np.nan) if len(known) == 0 else np.percentile(known, [50, 95]).tolist()
    if len(positions) == 0:
        return Points(positions, normals, weights, support, spacing, (low, high), rejected)
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
    sizes = np.diff(starts, append=len(order))
    confidence = length[:, 0] * (1.0 - np.exp(-best / 3.0))
    return Points(
        mean(positions)[keep].astype(np.float32),
        (direction / np.maximum(length, 1e-9))[keep].astype(np.float32),
        confidence[keep].astype(np.float32),
        best[keep].astype(np.int32),
        spacing,
        (low, high),
        {**rejected, "mixed": int(sizes[~keep].sum())},
    )
