"""The topology of the actor's skin: a wrapped grid of quads with slits for the eyes and the mouth.

Rows run from the crown (0) down to the neck, columns around the head: column 0 is the midline of
the face, positive columns lie on the actor's left (+X). The top row is welded left to right, so
that the head closes in a seam along the crown. Along each slit the vertices are doubled, and rings
of quads roll inwards from it: the thickness of the lids, the inner lips and the bag of the mouth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from capture.arrays import Floats32, Ints, Ints32

COLUMNS = 104
ROWS = 104
EYE_ROW = 36
MOUTH_ROW = 70
EYE_COLUMNS = (9, 24)  # corner to corner, on the actor's left
MOUTH_COLUMNS = (-13, 13)
_EYE_RINGS = 3
_MOUTH_RINGS = 7


@dataclass(frozen=True, eq=False)
class Slit:
    """One opening of the skin, in the order of growing column.

    Attributes:
        columns: (n + 2,) signed columns, corners included.
        corners: (2,) vertex ids.
        upper: (n,) vertex ids of the upper edge, corners left out.
        lower: (n,) vertex ids of the lower edge, of the same columns.
        rings: (K, 2 n + 2) vertex ids of the rings that roll inwards, each in the order first
            corner, upper edge, second corner, lower edge backwards; ring 0 is the edge itself.
    """

    columns: Ints
    corners: Ints
    upper: Ints
    lower: Ints
    rings: Ints

    @property
    def pairs(self) -> Ints:
        """(n, 2) ids of upper and lower edge vertices that face each other."""
        return np.stack([self.upper, self.lower], axis=1)


@dataclass(frozen=True, eq=False)
class Lattice:
    """The skin's topology, shared by every identity.

    Attributes:
        row: (V,) grid row of each vertex; ring vertices carry that of their slit.
        column: (V,) signed grid column.
        side: (V,) +1 above or on the upper edge of the slit, -1 below, for ring and edge vertices;
            0 elsewhere.
        ring: (V,) 0 for the outer skin, k for the k-th ring.
        grid: (ROWS, COLUMNS) vertex ids of the outer skin; a slit's upper copy where doubled.
        polygons: (P, 4) quads, outward by the right-hand rule.
        uv: (P, 4, 2) texture coordinates of the corners; the rings have a strip of their own.
        eyes: right (-X) and left (+X) eye.
        mouth: the mouth.
    """

    row: Ints
    column: Ints
    side: Ints
    ring: Ints
    grid: Ints
    polygons: Ints32
    uv: Floats32
    eyes: tuple[Slit, Slit]
    mouth: Slit

    def at(self, row: int, column: int) -> int:
        """The vertex id at a row and a signed column, the upper copy on a slit."""
        return int(self.grid[row, column % COLUMNS])


class _Builder:
    """Collects vertices and quads."""

    def __init__(self) -> None:
        self.row: list[int] = []
        self.column: list[int] = []
        self.side: list[int] = []
        self.ring: list[int] = []
        self.polygons: list[list[int]] = []
        self.uv: list[list[tuple[float, float]]] = []

    def vertex(self, row: int, column: int, side: int = 0, ring: int = 0) -> int:
        self.row.append(row)
        self.column.append(column)
        self.side.append(side)
        self.ring.append(ring)
        return len(self.row) - 1

    def quad(self, ids: list[int], uv: list[tuple[float, float]]) -> None:
        self.polygons.append(ids)
        self.uv.append(uv)


def signed(column: int) -> int:
    """The column in -COLUMNS/2 + 1 .. COLUMNS/2."""
    column %= COLUMNS
    return column if column <= COLUMNS // 2 else column - COLUMNS


@cache
def make_lattice() -> Lattice:
    """Build the topology: about eleven thousand vertices, quads only."""
    build = _Builder()
    grid = np.zeros((ROWS, COLUMNS), np.int64)
    for row in range(ROWS):
        for column in range(COLUMNS):
            mirrored = -column % COLUMNS
            if row == 0 and mirrored < column:
                grid[row, column] = grid[row, mirrored]
            else:
                grid[row, column] = build.vertex(row, signed(column))
    first, last = EYE_COLUMNS
    spans = [(EYE_ROW, -last, -first, _EYE_RINGS), (EYE_ROW, first, last, _EYE_RINGS),
             (MOUTH_ROW, *MOUTH_COLUMNS, _MOUTH_RINGS)]  # fmt: skip
    lower = grid.copy()
    slits = [_cut(build, grid, lower, span, strip) for strip, span in enumerate(spans)]
    for row in range(ROWS - 1):
        for column in range(COLUMNS):
            right = (column + 1) % COLUMNS
            ids = [
                lower[row, column],
                grid[row + 1, column],
                grid[row + 1, right],
                lower[row, right],
            ]
            left_u = (signed(right) - 1 + COLUMNS / 2) / COLUMNS
            u, v, du, dv = left_u, 1 - 0.9 * row / (ROWS - 1), 1 / COLUMNS, 0.9 / (ROWS - 1)
            corners = [(u, v), (u, v - dv), (u + du, v - dv), (u + du, v)]
            build.quad([int(i) for i in ids], corners)
    return Lattice(
        row=np.array(build.row), column=np.array(build.column), side=np.array(build.side),
        ring=np.array(build.ring), grid=grid, polygons=np.array(build.polygons, np.int32),
        uv=np.array(build.uv, np.float32), eyes=(slits[0], slits[1]), mouth=slits[2],
    )  # fmt: skip


def _cut(
    build: _Builder, grid: Ints, lower: Ints, span: tuple[int, int, int, int], strip: int
) -> Slit:
    """Double the inner vertices of one slit and roll its rings inwards."""
    row, first, last, rings = span
    columns = np.arange(first, last + 1)
    inner = columns[1:-1]
    upper_ids = grid[row, inner % COLUMNS]
    for vertex in upper_ids:
        build.side[vertex] = 1
    lower_ids = np.array([build.vertex(row, int(c), -1) for c in inner])
    lower[row, inner % COLUMNS] = lower_ids
    corners = grid[row, [first % COLUMNS, last % COLUMNS]]
    loops = [np.concatenate([corners[:1], upper_ids, corners[1:], lower_ids[::-1]])]
    around = np.concatenate([columns[:-1], columns[:0:-1]])
    sides = np.concatenate([[0], np.ones(len(inner), int), [0], -np.ones(len(inner), int)])
    for k in range(1, rings + 1):
        ids = [build.vertex(row, int(c), int(s), k) for c, s in zip(around, sides, strict=True)]
        loops.append(np.array(ids))
    count = len(around)
    left, width = (0.02, 0.36, 0.7)[strip], 0.28
    for k in range(rings):
        for i in range(count):
            j = (i + 1) % count
            ids = [int(loops[k][j]), int(loops[k][i]), int(loops[k + 1][i]), int(loops[k + 1][j])]
            u, du = left + width * i / count, width / count
            v, dv = 0.085 - 0.08 * k / rings, 0.08 / rings
            build.quad(ids, [(u + du, v), (u, v), (u, v - dv), (u + du, v - dv)])
    return Slit(
        columns=columns, corners=corners, upper=upper_ids, lower=lower_ids, rings=np.stack(loops)
    )
