"""What is black on a board: closed outlines, so that no hairline shows between two cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Ints
from recon.board.april_grid import AprilGrid
from recon.board.body import FlatBoard, ScaleBar
from recon.board.charuco import Board
from recon.board.marker_dictionary import marker_cells

_BAR_GAP = 0.5  # white between the two markers of a scale bar, over their side


@dataclass(frozen=True, eq=False)
class Pattern:
    """A flat drawing in black on white.

    Attributes:
        size_mm: width and height.
        loops: closed polygons (n, 2), mm, origin at the top left, +X right, +Y down. Black is what
            lies inside an odd number of them. No two share a stretch of edge.
    """

    size_mm: tuple[float, float]
    loops: tuple[Floats, ...]


def board_pattern(board: FlatBoard) -> Pattern:
    """The drawing of a board, its origin that of board space."""
    loops = _grid_loops(board) if isinstance(board, AprilGrid) else _charuco_loops(board)
    return Pattern(board.size_mm, tuple(loops))


def bar_pattern(bar: ScaleBar) -> Pattern:
    """The two markers of a scale bar side by side, to be cut out and glued on."""
    side, step = bar.marker_mm, (1 + _BAR_GAP) * bar.marker_mm
    loops: list[Floats] = []
    for index, marker in enumerate(bar.markers):
        cells = marker_cells(bar.dictionary, marker, 1)
        loops += _placed(cells, (index * step, 0.0), side)
    return Pattern((step + side, side), tuple(loops))


def outlines(cells: Bools) -> list[Ints]:
    """Outlines of the black cells, in corners of cells.

    Args:
        cells: (H, W), True for black.

    Returns:
        Closed polygons (n, 2) (column, row) with a point at every turn; cells that meet at a corner
        alone stay apart.
    """
    padded = np.pad(cells, 1)
    steps: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for row, column in np.argwhere(cells).tolist():
        # Clockwise about each black cell, where its neighbour is white.
        for down, right, start, end in (
            (-1, 0, (0, 0), (1, 0)),
            (0, 1, (1, 0), (1, 1)),
            (1, 0, (1, 1), (0, 1)),
            (0, -1, (0, 1), (0, 0)),
        ):
            if not padded[row + 1 + down, column + 1 + right]:
                key = (column + start[0], row + start[1])
                steps.setdefault(key, []).append((column + end[0], row + end[1]))
    loops = []
    while steps:
        first = min(steps)
        loops.append(_follow(steps, first))
    return loops


def _follow(steps: dict[tuple[int, int], list[tuple[int, int]]], first: tuple[int, int]) -> Ints:
    """Take one loop out of the directed steps, turning right where two ways are open."""
    path, here, heading = [first], first, (0, 0)
    while True:
        ways = steps[here]
        right = (-heading[1], heading[0])
        there = next((w for w in ways if (w[0] - here[0], w[1] - here[1]) == right), ways[0])
        ways.remove(there)
        if not ways:
            del steps[here]
        turned = (there[0] - here[0], there[1] - here[1])
        if turned == heading:
            path.pop()
        path.append(there)
        here, heading = there, turned
        if here == first:
            break
    corners = path[:-1]
    start, end = corners[1], corners[-1]
    if start[0] == end[0] or start[1] == end[1]:
        corners = corners[1:]  # the first point lies on a straight stretch
    return np.array(corners, dtype=np.int64)


def _charuco_loops(board: Board) -> list[Floats]:
    square, inset = board.square_mm, 0.5 * (board.square_mm - board.marker_mm)
    white = np.zeros((board.squares_y, board.squares_x), dtype=np.bool_)
    loops: list[Floats] = []
    # OpenCV tells where its markers are: the legacy pattern has them elsewhere.
    corners = np.asarray(board.pattern().getObjPoints(), dtype=np.float64).reshape(-1, 4, 3)
    for marker, middle in zip(board.marker_ids, corners.mean(axis=1), strict=True):
        column, row = np.floor(middle[:2] / square).astype(int).tolist()
        white[row, column] = True
        place = (column * square + inset, row * square + inset)
        loops += _placed(marker_cells(board.dictionary, marker, 1), place, board.marker_mm)
    for row, column in np.argwhere(~white).tolist():
        loops.append(_rectangle(column * square, row * square, square))
    return loops


def _grid_loops(grid: AprilGrid) -> list[Floats]:
    step = grid.tag_mm + grid.gap_mm
    loops: list[Floats] = []
    for index, marker in enumerate(grid.marker_ids):
        cells = marker_cells(grid.dictionary, marker, grid.border_bits)
        turned = cells[::-1, ::-1] if grid.half_turned else cells
        loops += _placed(turned, grid.place(index), grid.tag_mm)
    for row in range(grid.tags_y + 1):
        for column in range(grid.tags_x + 1):
            loops.append(_rectangle(column * step, row * step, grid.gap_mm))
    return loops


def _placed(cells: Bools, place: tuple[float, float], side_mm: float) -> list[Floats]:
    scale = side_mm / len(cells)
    return [np.array(place) + loop * scale for loop in outlines(cells)]


def _rectangle(x: float, y: float, side: float) -> Floats:
    return np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]])
