"""Where the white and the black of a calibration board are, far from the edges of the print."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from capture.arrays import Floats
from capture.errors import SettingsError
from recon.board.april_grid import AprilGrid
from recon.board.body import BoardBody, FlatBoard
from recon.board.charuco import Board

_PRINT = 8.0  # pixels a millimetre of the pattern that is searched for white
_DISCS = 4  # at most so many white places a square
_HALF_WHITE = 128
_LEAST_PRINT_PX = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardSpots:
    """Places of one colour on a board, each inside a disc of that colour.

    Attributes:
        places: (S, 3) middle of the disc, space of the board's corners, mm.
        across: (S, 3) unit vector along the rows of the board.
        down: (S, 3) unit vector along the columns; `across` x `down` points into the board.
        radius_mm: (S,) radius of the disc.
    """

    places: Floats
    across: Floats
    down: Floats
    radius_mm: Floats

    def __len__(self) -> int:
        return len(self.radius_mm)


def white_spots(body: BoardBody) -> BoardSpots:
    """The widest white discs of every face, those among the cells of a marker included.

    Of a ChArUco board they are those of its white squares, of an AprilGrid those between its tags.
    Nothing is taken from outside the pattern: how wide the paper is there is not known.

    Args:
        body: every face of it placed.

    Raises:
        SettingsError: naming a face whose place on the body is not known.
    """
    return _on_body(body, _white_of)


def ink_spots(body: BoardBody) -> BoardSpots:
    """The discs inscribed in the black squares of every face; arguments as of `white_spots`."""
    return _on_body(body, _ink_of)


def _on_body(body: BoardBody, spots_of: Callable[[FlatBoard], tuple[Floats, Floats]]) -> BoardSpots:
    places, across, down, radii = [], [], [], []
    for face in body.faces:
        if face.body_from_board is None:
            raise SettingsError(
                f"board {face.name!r}: its place on the body is not known; give body_from_board, "
                "or a file with this board left out"
            )
        flat, radius = spots_of(face.board)
        turn = face.body_from_board.rotation
        local = np.column_stack([flat, np.zeros(len(flat))])
        places.append(face.body_from_board.apply(local))
        across.append(np.tile(turn[:, 0], (len(flat), 1)))
        down.append(np.tile(turn[:, 1], (len(flat), 1)))
        radii.append(radius)
    return BoardSpots(
        places=np.concatenate(places), across=np.concatenate(across), down=np.concatenate(down),
        radius_mm=np.concatenate(radii),
    )  # fmt: skip


def _white_of(board: FlatBoard) -> tuple[Floats, Floats]:
    """Middles (S, 2) and radii (S,) of the white discs of a flat board, mm."""
    return _white_between_tags(board) if isinstance(board, AprilGrid) else _white_squares(board)


@lru_cache(maxsize=8)
def _white_squares(board: Board) -> tuple[Floats, Floats]:
    wide, high = board.size_mm
    size = (round(wide * _PRINT), round(high * _PRINT))
    drawn = board.pattern().generateImage(size, marginSize=0)
    step = np.array([wide / size[0], high / size[1]])
    padded = np.pad((np.asarray(drawn) > _HALF_WHITE).astype(np.uint8), 1)
    room = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1] - 0.5
    places, radii = [], []
    for row in range(board.squares_y):
        for column in range(board.squares_x):
            first = np.array([column, row]) * board.square_mm / step
            left, top = first.round().astype(int)
            right, low = (first + board.square_mm / step).round().astype(int)
            for x, y, radius in _discs(room[top:low, left:right].astype(np.float64)):
                places.append(((left + x + 0.5) * step[0], (top + y + 0.5) * step[1]))
                radii.append(radius * float(step.min()))
    found = np.array(places).reshape(-1, 2), np.array(radii)
    for array in found:
        array.flags.writeable = False
    return found


def _discs(room: Floats) -> list[tuple[int, int, float]]:
    """The widest discs (column, row, radius) of a map of distances, none overlapping another."""
    out: list[tuple[int, int, float]] = []
    left = room.copy()
    rows, columns = np.mgrid[: room.shape[0], : room.shape[1]]
    while len(out) < _DISCS:
        row, column = np.unravel_index(int(np.argmax(left)), left.shape)
        radius = float(left[row, column])
        if radius < _LEAST_PRINT_PX or (out and radius < 0.5 * out[0][2]):
            break
        out.append((int(column), int(row), radius))
        left[np.hypot(rows - row, columns - column) < radius + left] = 0.0
    return out


def _white_between_tags(grid: AprilGrid) -> tuple[Floats, Floats]:
    """Discs as wide as the gap, along the strips between two tags and two black squares."""
    step = grid.tag_mm + grid.gap_mm
    along = grid.gap_mm * (np.arange(max(1, int(grid.tag_mm / grid.gap_mm))) + 0.5)
    along += 0.5 * (grid.tag_mm - along[-1] - along[0])
    places = []
    for column in range(grid.tags_x):
        for row in range(grid.tags_y):
            left, top = grid.gap_mm + step * column, grid.gap_mm + step * row
            if column > 0:
                places += [(left - 0.5 * grid.gap_mm, top + d) for d in along.tolist()]
            if row > 0:
                places += [(left + d, top - 0.5 * grid.gap_mm) for d in along.tolist()]
    return np.array(places).reshape(-1, 2), np.full(len(places), 0.5 * grid.gap_mm)


def _ink_of(board: FlatBoard) -> tuple[Floats, Floats]:
    """Middles (S, 2) and radii (S,) of the black squares of a flat board, mm."""
    if isinstance(board, AprilGrid):
        step = board.tag_mm + board.gap_mm
        x, y = np.meshgrid(np.arange(board.tags_x + 1), np.arange(board.tags_y + 1))
        tags = step * np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float64)
        tags += 0.5 * board.gap_mm
        return tags, np.full(len(tags), 0.5 * board.gap_mm)
    x, y = np.meshgrid(np.arange(board.squares_x), np.arange(board.squares_y))
    squares = np.stack([x, y], axis=-1).reshape(-1, 2)
    marker = np.asarray(board.pattern().getObjPoints()[0])[:, :2].mean(axis=0)
    white = int((marker / board.square_mm).astype(int).sum()) % 2  # markers lie in white squares
    black = squares[squares.sum(axis=1) % 2 != white]
    return (black + 0.5) * board.square_mm, np.full(len(black), 0.5 * board.square_mm)
