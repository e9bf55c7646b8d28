"""A mesh against the oriented points that it was drawn through: moved onto them, and where it ends.

A Poisson surface answers for whole cells: a fold narrower than one, such as the rim of a lid, comes
out shallow by a tenth of a millimetre. The points know better, and all there is to do is a step
along the normal.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from capture.arrays import Floats, Floats32, Ints, check_shape

_ALIKE = 0.5  # least cosine between normals of the same side of a fold
_LEAST_WEIGHT = 0.2  # of all points near a vertex; with less it stays
_STEPS = 2  # to the surface; a third moves nothing any more


class _Columns(NamedTuple):
    """Oriented points sorted into columns `reach` wide along x and y, and by z within each."""

    positions: Floats32  # (N, 3) mm
    normals: Floats32  # (N, 3) unit
    starts: Ints  # (C + 1,) of the columns, those along y side by side
    size: Ints  # (2,) columns along x and y
    low: Floats  # (3,) mm, corner of the first
    reach: float  # mm


def settled(
    vertices: Floats32,
    normals: Floats32,
    positions: Floats32,
    point_normals: Floats32,
    reach_mm: float,
) -> Floats32:
    """Vertices moved along their normals to the moving-least-squares surface of oriented points.

    The surface is where the mean of the heights over the tangent planes of nearby points is zero;
    a point counts by (1 - (r / reach)^2)^3 and the cosine between its normal and the vertex's, and
    not at all beyond 60 degrees, so that one side of a fold does not pull on the other.

    Args:
        vertices: (V, 3) mm.
        normals: (V, 3) unit.
        positions: (N, 3) mm.
        point_normals: (N, 3) unit.
        reach_mm: how far a point is felt.

    Returns:
        (V, 3) mm; a vertex with too few points near stays where it is.

    References:
        Kolluri, Provably good moving least squares, SODA 2005 (the surface).
    """
    check_shape(
        vertices=(vertices, "V 3"), normals=(normals, "V 3"),
        positions=(positions, "N 3"), point_normals=(point_normals, "N 3"),
    )  # fmt: skip
    if len(positions) == 0:
        return vertices.copy()
    columns = _columns(positions, point_normals, reach_mm)
    return _settle(vertices, normals, columns)  # type: ignore[no-any-return]


def openness(
    vertices: Floats32,
    normals: Floats32,
    positions: Floats32,
    point_normals: Floats32,
    reach_mm: float,
) -> Floats32:
    """How far vertices lie outside of the points about them: 0 in their midst, 1 far off a border.

    That is the length of the mean direction, in the tangent plane, to all points within reach whose
    normal is within 60 degrees of the vertex's; at a straight border it is 2 / pi.

    Args:
        vertices: (V, 3) mm.
        normals: (V, 3) unit.
        positions: (N, 3) mm.
        point_normals: (N, 3) unit.
        reach_mm: how far points are looked for.

    Returns:
        (V,) 0..1; 1 where there is no point.
    """
    check_shape(
        vertices=(vertices, "V 3"), normals=(normals, "V 3"),
        positions=(positions, "N 3"), point_normals=(point_normals, "N 3"),
    )  # fmt: skip
    if len(positions) == 0:
        return np.ones(len(vertices), np.float32)
    columns = _columns(positions, point_normals, reach_mm)
    return _openness(vertices, normals, columns)  # type: ignore[no-any-return]


def _columns(positions: Floats32, normals: Floats32, reach: float) -> _Columns:
    low = positions.min(axis=0).astype(np.float64)
    cell = np.floor((positions[:, :2] - low[:2]) / reach).astype(np.int64)
    size = cell.max(axis=0) + 1
    column = cell[:, 0] * size[1] + cell[:, 1]
    order = np.lexsort((positions[:, 2], column))
    starts = np.searchsorted(column[order], np.arange(size.prod() + 1))
    return _Columns(positions[order], normals[order], starts, size, low, reach)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _settle(
    vertices: Floats32, normals: Floats32, columns: _Columns
) -> Floats32:  # pragma: no cover - compiled
    out = vertices.copy()
    place, direction, total = np.empty(3), np.empty(3), np.empty(5)
    for i in range(len(vertices)):
        for k in range(3):
            place[k], direction[k] = vertices[i, k], normals[i, k]
        for _ in range(_STEPS):
            _sum_near(place, direction, columns, total)
            if total[0] < _LEAST_WEIGHT:
                break
            length = np.sqrt(total[2] ** 2 + total[3] ** 2 + total[4] ** 2)
            for k in range(3):
                direction[k] = total[2 + k] / length
                place[k] -= total[1] / total[0] * direction[k]
        for k in range(3):
            out[i, k] = place[k]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sum_near(
    place: Floats, direction: Floats, columns: _Columns, total: Floats
) -> None:  # pragma: no cover - compiled
    """Sums over the points near a place: of weights, of weighted heights, of weighted normals."""
    positions, normals, starts, size, low, reach = columns
    total[:] = 0.0
    across = int(np.floor((place[0] - low[0]) / reach))
    down = int(np.floor((place[1] - low[1]) / reach))
    for a in range(max(across - 1, 0), min(across + 2, size[0])):
        for b in range(max(down - 1, 0), min(down + 2, size[1])):
            n, end = starts[a * size[1] + b], starts[a * size[1] + b + 1]
            n += np.searchsorted(positions[n:end, 2], place[2] - reach)
            while n < end and positions[n, 2] < place[2] + reach:
                _add_point(place, direction, positions[n], normals[n], reach, total)
                n += 1


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _add_point(
    place: Floats,
    direction: Floats,
    position: Floats32,
    normal: Floats32,
    reach: float,
    total: Floats,
) -> None:  # pragma: no cover - compiled
    x, y, z = place[0] - position[0], place[1] - position[1], place[2] - position[2]
    near = 1.0 - (x * x + y * y + z * z) / (reach * reach)
    alike = normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2]
    if near <= 0.0 or alike < _ALIKE:
        return
    weight = near * near * near * alike
    total[0] += weight
    total[1] += weight * (x * normal[0] + y * normal[1] + z * normal[2])
    for k in range(3):
        total[2 + k] += weight * normal[k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _openness(
    vertices: Floats32, normals: Floats32, columns: _Columns
) -> Floats32:  # pragma: no cover - compiled
    positions, lines, starts, size, low, reach = columns
    out = np.ones(len(vertices), np.float32)
    mean = np.empty(3)
    for i in range(len(vertices)):
        mean[:] = 0.0
        count = 0
        across = int(np.floor((vertices[i, 0] - low[0]) / reach))
        down = int(np.floor((vertices[i, 1] - low[1]) / reach))
        for a in range(max(across - 1, 0), min(across + 2, size[0])):
            for b in range(max(down - 1, 0), min(down + 2, size[1])):
                for n in range(starts[a * size[1] + b], starts[a * size[1] + b + 1]):
                    count += _add_direction(
                        vertices[i], normals[i], positions[n], lines[n], reach, mean
                    )
        if count > 0:
            out[i] = np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2) / count
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _add_direction(
    vertex: Floats32,
    normal: Floats32,
    position: Floats32,
    line: Floats32,
    reach: float,
    mean: Floats,
) -> int:  # pragma: no cover - compiled
    """Add the direction to a point, along the tangent plane; how many were added."""
    x, y, z = position[0] - vertex[0], position[1] - vertex[1], position[2] - vertex[2]
    alike = line[0] * normal[0] + line[1] * normal[1] + line[2] * normal[2]
    if x * x + y * y + z * z >= reach * reach or alike < _ALIKE:
        return 0
    height = x * normal[0] + y * normal[1] + z * normal[2]
    x, y, z = x - height * normal[0], y - height * normal[1], z - height * normal[2]
    length = np.sqrt(x * x + y * y + z * z) + 1e-9
    mean[0] += x / length
    mean[1] += y / length
    mean[2] += z / length
    return 1
