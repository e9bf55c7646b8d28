"""Where in the face volume the board has been, and where it is missing, in an operator's words."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.spatial

from capture.arrays import Bools, Floats, check_shape
from capture.camera import CameraArray
from recon.board.shape import BoardShape
from recon.calibration.place_words import (
    Gap,
    find_gaps,
    viewpoint,
    volume_region,
    way_from_middle,
)
from recon.calibration.solver import ArraySolution

FACE_RADIUS_MM = 120.0
_CELLS = 8  # along each edge of the cube around the ball
_LEAST_SHARE = 0.4  # of a region, below which it is thin; good takes reach 0.8 in every octant
_SPACING = 0.75  # a sparse board shows what lies within this share of its corners' distance
_MOST_POSES = 6  # to fill one region
_LEAST_POSES = 2  # two tilts


def volume_coverage(solution: ArraySolution, radius_mm: float = FACE_RADIUS_MM) -> dict[str, Any]:
    """Count the board's corners over the face volume, a ball about the world's origin.

    A corner counts once a pose, at its solved place, when at least two devices saw it there. A cell
    is shown when a corner came near enough to its centre; cells that no two devices have in their
    images are not asked for.

    Args:
        solution: the calibrated array.
        radius_mm: of the ball.

    Returns:
        For JSON. `corners`: by cell (x fastest), null outside the ball; `origin_mm`: centre of cell
        0, 0, 0; `shown`: share of the visible cells that were shown; `visible`: share of the ball
        that two devices have in their images; `pixel_mm`: what a pixel covers at the ball's middle,
        median over devices; `thin`: words for each region where the board is missing, `thin_poses`:
        about how many poses fill it.
    """
    edge = 2.0 * radius_mm / _CELLS
    centres = ball_grid(radius_mm, edge, _CELLS)
    inside = np.linalg.norm(centres, axis=1) <= radius_mm
    points = shared_corners(solution)
    place = np.floor(points / edge + _CELLS / 2).astype(np.int64)
    place = place[((place >= 0) & (place < _CELLS)).all(axis=1)]
    counts = np.zeros(_CELLS**3, dtype=np.int64)
    np.add.at(counts, place @ np.array([1, _CELLS, _CELLS**2]), 1)
    visible = inside & _seen_by_two(solution.state.cameras, centres)
    reach = max(edge, _SPACING * _spacing(solution.shape))
    shown = _near(centres, points, reach)
    gaps = find_gaps(centres[visible] / radius_mm, shown[visible], _LEAST_SHARE)
    slab = _widest_mm2(solution.shape) * 2.0 * reach
    return {
        "centre_mm": [0.0, 0.0, 0.0],
        "radius_mm": float(radius_mm),
        "edge_mm": edge,
        "shape": [_CELLS] * 3,
        "origin_mm": centres[0].tolist(),
        "corners": [n if ok else None for n, ok in zip(counts.tolist(), inside, strict=True)],
        "shown": float(f"{shown[visible].mean():.4g}") if visible.any() else None,
        "visible": float(f"{visible.sum() / inside.sum():.4g}"),
        "pixel_mm": _pixel_mm(solution.state.cameras),
        "thin": [_thin_words(gap, radius_mm) for gap in gaps],
        "thin_poses": [
            int(np.clip(np.ceil(gap.missing * edge**3 / slab), _LEAST_POSES, _MOST_POSES))
            for gap in gaps
        ],
    }


def ball_grid(radius_mm: float, step_mm: float, count: int) -> Floats:
    """Points (count^3, 3) of a cubic grid about the origin, x fastest, mm.

    Args:
        radius_mm: of the ball the grid is for; it must reach from side to side of it.
        step_mm: distance of neighbours.
        count: points along each axis.
    """
    along = step_mm * (np.arange(count) - (count - 1) / 2.0)
    z, y, x = np.meshgrid(along, along, along, indexing="ij")
    grid: Floats = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return grid


def shared_corners(solution: ArraySolution) -> Floats:
    """World places (N, 3), mm, of the corners that two devices or more used, once for each pose."""
    used = solution.observations.select(solution.kept)
    key = np.stack([used.pose, used.corner], axis=1)
    _, first, devices = np.unique(key, axis=0, return_index=True, return_counts=True)
    points = solution.state.points(used)
    check_shape(points=(points, "M 3"))
    shared: Floats = points[first[devices >= 2]]
    return shared


def _thin_words(gap: Gap, radius_mm: float) -> str:
    if gap.signs == ():
        return (
            f"the board was in {100 * gap.share:.0f} % of the face volume only, a ball of "
            f"{radius_mm:.0f} mm about the point the array looks at: hold the board where the "
            "face will be"
        )
    little = "nothing" if gap.share < 0.05 else "little"
    way = way_from_middle(gap.middle * radius_mm, radius_mm)
    where = volume_region(gap.signs) + viewpoint(gap.signs) + (f", {way}" if way else "")
    return f"{little} was shown in {where}: hold the board there"


def _seen_by_two(cameras: CameraArray, points: Floats) -> Bools:
    seen = np.zeros(len(points), dtype=np.int64)
    for camera in cameras:
        seen += camera.contains(camera.project(points))
    shared: Bools = seen >= 2
    return shared


def _near(centres: Floats, points: Floats, reach: float) -> Bools:
    if not len(points):
        return np.zeros(len(centres), dtype=np.bool_)
    apart, _ = scipy.spatial.KDTree(points).query(centres)
    near: Bools = np.asarray(apart) <= reach
    return near


def _spacing(shape: BoardShape) -> float:
    """Usual distance of neighbouring corners on a face, mm."""
    apart = []
    for face in range(shape.face_count):
        flat = shape.flat[shape.face == face]
        if len(flat) > 1:
            nearest, _ = scipy.spatial.KDTree(flat).query(flat, k=2)
            apart.append(float(np.median(np.asarray(nearest)[:, 1])))
    return max(apart, default=0.0)


def _widest_mm2(shape: BoardShape) -> float:
    """Area of the largest face, between its outermost corners, mm^2."""
    sides = [np.ptp(shape.flat[shape.face == face], axis=0) for face in range(shape.face_count)]
    return max(float(np.prod(side)) for side in sides)


def _pixel_mm(cameras: CameraArray) -> float | None:
    middle = np.zeros((1, 3))
    sizes = [
        float(camera.depths(middle)[0]) / float(np.sqrt(camera.fx * camera.fy))
        for camera in cameras
    ]
    before = [size for size in sizes if size > 0]
    return float(f"{np.median(before):.6g}") if before else None
