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

Board space: origin at the outer corner of square (0, 0), +X along the squares of a row, +Y along
the columns, +Z into the board, so that a board seen upright from the front agrees with OpenCV's
camera axes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture.arrays import Floats
from capture.documents import read_toml
from capture.errors import SettingsError, raise_all
from capture.names import known_hint

_LEAST_SQUARES = 3
_DICTIONARY = "DICT_"


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
    """

    squares_x: int
    squares_y: int
    square_mm: float
    marker_mm: float
    dictionary: str
    kind: str = "charuco"
    legacy: bool = False

    def __post_init__(self) -> None:
        problems: list[str] = []
        if self.kind != "charuco":
            problems.append(f'kind: only "charuco" is known, found {self.kind!r}')
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
        problems += self._dictionary_problems()
        raise_all("board", problems, SettingsError)

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
        """OpenCV's object for this board: detects it, draws it."""
        whole = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        need = self.squares_x * self.squares_y // 2
        # Comparing with this board's markers alone makes detection ten times faster.
        dictionary = cv2.aruco.Dictionary(
            whole.bytesList[:need], whole.markerSize, whole.maxCorrectionBits
        )
        board = cv2.aruco.CharucoBoard(
            (self.squares_x, self.squares_y), self.square_mm, self.marker_mm, dictionary
        )
        board.setLegacyPattern(self.legacy)
        return board

    def _dictionary_problems(self) -> list[str]:
        known = _dictionaries()
        if self.dictionary not in known:
            hint = known_hint(self.dictionary.upper(), known)
            return [f"dictionary: no marker dictionary is called {self.dictionary!r}; {hint}"]
        have = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        need = self.squares_x * self.squares_y // 2
        if need > have:
            return [
                f"dictionary: {self.squares_x} x {self.squares_y} squares need {need} markers, "
                f"{self.dictionary} has {have}; take a larger dictionary"
            ]
        return []


def read_board(path: Path) -> Board:
    """Read a board file.

    Args:
        path: a TOML file with one table, `[board]`.

    Raises:
        SettingsError: naming the file and every key that is missing, unknown or out of range.
    """
    absent = (
        "no such file; a board file holds a table [board] with kind, squares_x, "
        "squares_y, square_mm, marker_mm, dictionary"
    )
    document = read_toml(path, SettingsError, absent=absent)
    raise_all(str(path), _unknown(document, ("board",), "table"), SettingsError)
    table = document.get("board")
    if not isinstance(table, Mapping):
        raise SettingsError(
            f"{path}: expected a table [board], found {sorted(document) or 'nothing'}"
        )
    fields = dataclasses.fields(Board)
    problems = _unknown(table, tuple(field.name for field in fields), "key")
    values: dict[str, Any] = {}
    for field in fields:
        if field.name in table:
            try:
                values[field.name] = _typed(field.name, str(field.type), table[field.name])
            except SettingsError as error:
                problems.append(str(error))
        elif field.default is dataclasses.MISSING:
            problems.append(f"missing key {field.name!r}")
    raise_all(f"{path}: [board]", problems, SettingsError)
    try:
        return Board(**values)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from error


def _typed(name: str, kind: str, value: Any) -> Any:
    wanted: dict[str, tuple[type, ...]] = {
        "int": (int,),
        "float": (int, float),
        "str": (str,),
        "bool": (bool,),
    }
    if not isinstance(value, wanted[kind]) or (kind != "bool" and isinstance(value, bool)):
        raise SettingsError(f"{name}: expected {kind}, found {value!r}")
    return float(str(value)) if kind == "float" else value


def _unknown(found: Mapping[str, Any], known: tuple[str, ...], what: str) -> list[str]:
    return [
        f"unknown {what} {key!r}; {known_hint(key, known)}" for key in found if key not in known
    ]


def _dictionaries() -> list[str]:
    return sorted(name for name in dir(cv2.aruco) if name.startswith(_DICTIONARY))
