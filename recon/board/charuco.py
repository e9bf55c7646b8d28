"""The calibration board: a flat ChArUco pattern, and the strict reader of its file.

::

    [board]
    kind = "charuco"          # squares_x x squares_y chessboard squares
    squares_x = 12
    squares_y = 9
    square_mm = 20.0
    marker_mm = 15.0
    dictionary = "DICT_5X5_1000"
    legacy = false            # the pattern of OpenCV before 4.6
    first_id = 0              # id of the first marker: the boards of one body share none

Board space: origin at the outer corner of square (0, 0), +X along the squares of a row, +Y along
the columns, +Z into the board, so that a board seen upright from the front agrees with OpenCV's
camera axes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from capture.arrays import Floats
from capture.documents import read_toml
from capture.errors import SettingsError, raise_all
from recon.board.marker_dictionary import cut_dictionary, dictionary_problems
from recon.board.table import field_values, print_problems, sizes_mm, unknown

_LEAST_SQUARES = 3


@dataclass(frozen=True, kw_only=True)
class Board:
    """A flat ChArUco board as printed and measured.

    Attributes:
        kind: "charuco", the only kind so far.
        squares_x: squares in a row.
        squares_y: squares in a column.
        square_mm: measured side of a square.
        marker_mm: measured side of a marker, black border included.
        dictionary: name of the marker dictionary in cv2.aruco.
        legacy: whether the pattern is that of OpenCV before 4.6 (and of some board printers).
        first_id: id of the first marker in the dictionary; the others follow it.
    """

    squares_x: int
    squares_y: int
    square_mm: float
    marker_mm: float
    dictionary: str
    kind: str = "charuco"
    legacy: bool = False
    first_id: int = 0

    def __post_init__(self) -> None:
        problems: list[str] = []
        if self.kind != "charuco":
            problems.append(f'kind: only "charuco" is known, found {self.kind!r}')
        if self.first_id < 0:
            problems.append(f"first_id: at least 0, found {self.first_id}")
        for key in ("squares_x", "squares_y"):
            if getattr(self, key) < _LEAST_SQUARES:
                problems.append(f"{key}: at least {_LEAST_SQUARES}, found {getattr(self, key)}")
        for key in ("square_mm", "marker_mm"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                problems.append(f"{key}: must be above 0 mm, found {value}")
        if self.marker_mm >= self.square_mm:
            problems.append(
                f"marker_mm: a marker lies inside its square, so it must be below "
                f"square_mm = {self.square_mm}, found {self.marker_mm}"
            )
        if self.first_id >= 0:
            what = f"{self.squares_x} x {self.squares_y} squares"
            problems += dictionary_problems(self.dictionary, self.marker_ids, what)
        raise_all("board", problems, SettingsError)

    @property
    def marker_ids(self) -> range:
        """Ids of the markers in their dictionary."""
        return range(self.first_id, self.first_id + self.squares_x * self.squares_y // 2)

    @property
    def pitch_mm(self) -> float:
        """Distance of neighbouring corners."""
        return self.square_mm

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the printed pattern."""
        return self.squares_x * self.square_mm, self.squares_y * self.square_mm

    @property
    def corner_count(self) -> int:
        """How many inner chessboard corners the board has."""
        return (self.squares_x - 1) * (self.squares_y - 1)

    def corners_mm(self) -> Floats:
        """Nominal inner corners (N, 3), board space, mm, in the order of their ids."""
        column, row = np.meshgrid(
            np.arange(1, self.squares_x, dtype=np.float64),
            np.arange(1, self.squares_y, dtype=np.float64),
        )
        flat = np.stack([column, row, np.zeros_like(column)], axis=-1).reshape(-1, 3)
        scaled: Floats = flat * self.square_mm
        return scaled

    def pattern(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's object for this board: detects it, draws it.

        Its markers are counted from 0, whatever `first_id` is.
        """
        dictionary = cut_dictionary(self.dictionary, self.marker_ids)
        board = cv2.aruco.CharucoBoard(
            (self.squares_x, self.squares_y), self.square_mm, self.marker_mm, dictionary
        )
        board.setLegacyPattern(self.legacy)
        return board


def read_board(path: Path) -> Board:
    """Read the file of one ChArUco board; `recon.board.body.read_body` reads every kind.

    Args:
        path: a TOML file with one table, `[board]`, and perhaps `[print]`.

    Raises:
        SettingsError: naming the file and every key that is missing, unknown or out of range.
    """
    absent = (
        "no such file; a board file holds a table [board] with kind, squares_x, "
        "squares_y, square_mm, marker_mm, dictionary"
    )
    document = read_toml(path, SettingsError, absent=absent)
    raise_all(str(path), unknown(document, ("board", "print"), "table"), SettingsError)
    table = document.get("board")
    if not isinstance(table, Mapping):
        raise SettingsError(
            f"{path}: expected a table [board], found {sorted(document) or 'nothing'}"
        )
    values, problems = field_values(Board, table)
    raise_all(f"{path}: [board]", problems, SettingsError)
    try:
        board = Board(**values)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from error
    if "print" in document:
        raise_all(str(path), print_problems(sizes_mm(board), document["print"]), SettingsError)
    return board
