"""`BoardBody`: what is waved before the array: one flat board, or several rigid ones on one body.

The file of one board has a table `[board]` (see `recon.board.charuco`, `recon.board.april_grid`).
That of several has one table a board, and every kind may have a scale bar:

::

    [[boards]]
    name = "front"
    kind = "charuco"          # and the other keys of the board
    [boards.body_from_board]  # left out: its place on the body is solved with the array
    rotation_deg = [0.0, 90.0, 0.0]       # axis times angle
    translation_mm = [240.0, 0.0, 0.0]
    [boards.print]            # left out, or as `recon.board.table` tells: how its sheet came out

    [scale_bar]
    dictionary = "DICT_4X4_50"
    markers = [0, 1]
    marker_mm = 30.0
    length_mm = 400.021       # between the centres of the markers, calibrated

Body space: mm, board space moved by `body_from_board`; that of the first board when no board has
a place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from capture.arrays import Floats
from capture.documents import read_toml
from capture.errors import SettingsError, raise_all
from capture.names import is_plain_name
from capture.pose import Pose
from recon.board.april_grid import AprilGrid
from recon.board.charuco import Board
from recon.board.marker_dictionary import dictionary_family, dictionary_problems
from recon.board.shape import BoardShape
from recon.board.table import field_values, print_problems, sizes_mm, unknown

FlatBoard: TypeAlias = Board | AprilGrid

_KINDS: dict[str, type[FlatBoard]] = {"charuco": Board, "aprilgrid": AprilGrid}
_TABLES = ("board", "boards", "print", "scale_bar")
_FACE_KEYS = ("name", "body_from_board", "print")
_PLACE_KEYS = ("rotation_deg", "translation_mm")
_ONE_OF_MANY = "only a board of several, under [[boards]], has it"
_FARTHEST = 1e6  # mm, and degrees: beyond it a place on a body is a slip


@dataclass(frozen=True, kw_only=True)
class ScaleBar:
    """A stiff bar with two markers whose distance was measured: the length all else rests on.

    Attributes:
        dictionary: name of the marker dictionary in cv2.aruco.
        markers: ids of the two markers.
        marker_mm: side of a marker, black border (one cell) included.
        length_mm: calibrated distance between the centres of the two markers.
    """

    dictionary: str
    markers: tuple[int, int]
    marker_mm: float
    length_mm: float

    def __post_init__(self) -> None:
        problems: list[str] = []
        first, second = self.markers
        if first == second or min(first, second) < 0:
            problems.append(f"markers: expected two ids that differ, found {first} and {second}")
        for key in ("marker_mm", "length_mm"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                problems.append(f"{key}: must be above 0 mm, found {value}")
        if self.length_mm <= self.marker_mm:
            problems.append(
                f"length_mm: the markers lie side by side, so it must be above marker_mm = "
                f"{self.marker_mm}, found {self.length_mm}"
            )
        if not problems:
            for marker in sorted(self.markers):
                need = range(marker, marker + 1)
                problems += dictionary_problems(self.dictionary, need, "the ends of the bar")[:1]
        raise_all("scale_bar", list(dict.fromkeys(problems)), SettingsError)

    def marker_corners_mm(self) -> Floats:
        """Corners (4, 3) of a marker in OpenCV's order about its centre, mm; +Y down."""
        flat = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
        return flat * (0.5 * self.marker_mm)


@dataclass(frozen=True, eq=False)
class BoardFace:
    """One flat board of a body.

    Attributes:
        name: what messages call it.
        board: the board.
        body_from_board: where it is on the body, or None when that is to be solved.
    """

    name: str
    board: FlatBoard
    body_from_board: Pose | None = None

    def corners_mm(self) -> Floats:
        """Corners (N, 3) in body space, mm; in the board's own space when its place is unknown."""
        flat = self.board.corners_mm()
        return flat if self.body_from_board is None else self.body_from_board.apply(flat)


@dataclass(frozen=True, eq=False)
class BoardBody:
    """Flat boards that move as one, and the scale bar shown along with them.

    Corners are counted through: those of the first face, then those of the second, and so on. When
    no face has a place, the first one defines body space.

    Attributes:
        faces: at least one.
        scale_bar: None when there is none.
    """

    faces: tuple[BoardFace, ...]
    scale_bar: ScaleBar | None = None

    def __post_init__(self) -> None:
        if not self.faces:
            raise SettingsError("boards: expected at least one board, found none")
        problems: list[str] = []
        names = [face.name for face in self.faces]
        for name in dict.fromkeys(names):
            if not is_plain_name(name):
                problems.append(f"name: expected letters, digits, '-' and '_', found {name!r}")
            elif names.count(name) > 1:
                problems.append(f"name: {names.count(name)} boards are called {name!r}")
        raise_all("boards", problems + self._collisions(), SettingsError)
        if all(face.body_from_board is None for face in self.faces):
            first = self.faces[0]
            placed = BoardFace(first.name, first.board, Pose.identity())
            object.__setattr__(self, "faces", (placed, *self.faces[1:]))

    @classmethod
    def of(cls, board: FlatBoard, scale_bar: ScaleBar | None = None) -> BoardBody:
        """One flat board; body space is board space."""
        return cls((BoardFace("board", board, Pose.identity()),), scale_bar)

    @property
    def corner_count(self) -> int:
        """How many corners all faces have together."""
        return sum(face.board.corner_count for face in self.faces)

    @property
    def pitch_mm(self) -> float:
        """Smallest distance of neighbouring corners on any face."""
        return min(face.board.pitch_mm for face in self.faces)

    def corner_range(self, face: int) -> range:
        """Which corners of the body are those of a face.

        Args:
            face: its index.
        """
        start = sum(before.board.corner_count for before in self.faces[:face])
        return range(start, start + self.faces[face].board.corner_count)

    def shape(self) -> BoardShape:
        """The nominal geometry of all faces."""
        counts = [face.board.corner_count for face in self.faces]
        return BoardShape(
            corners=np.concatenate([face.corners_mm() for face in self.faces]),
            face=np.repeat(np.arange(len(counts), dtype=np.int64), counts),
            flat=np.concatenate([face.board.corners_mm()[:, :2] for face in self.faces]),
            placed=np.array([face.body_from_board is not None for face in self.faces]),
        )

    def _collisions(self) -> list[str]:
        """Which markers stand on two faces, or on a face and the scale bar."""
        holders = [
            (f"board {face.name!r}", face.board.dictionary, set(face.board.marker_ids))
            for face in self.faces
        ]
        if self.scale_bar is not None:
            bar = self.scale_bar
            holders.append(("the scale bar", bar.dictionary, set(bar.markers)))
        problems = []
        for index, (who, dictionary, ids) in enumerate(holders):
            for other, others, theirs in holders[:index]:
                shared = sorted(ids & theirs)
                if dictionary_family(dictionary) == dictionary_family(others) and shared:
                    span = str(shared[0]) if len(shared) == 1 else f"{shared[0]} to {shared[-1]}"
                    problems.append(
                        f"{other} and {who} share markers ({span} of {dictionary}); give them ids "
                        f"of their own by first_id, from {max(theirs) + 1} on"
                    )
        return problems


def read_body(path: Path, *, check_print: bool = True) -> BoardBody:
    """Read a board file: one board, or several on one body, and the scale bar.

    Args:
        path: the TOML file; the docstring of this module and docs/boards.md tell its form.
        check_print: whether sizes must agree with the tables on printing, measured bar included;
            not so for what is yet to be printed.

    Raises:
        SettingsError: naming the file and everything that is missing, unknown, out of range, or
            not as the sheet was printed.
    """
    absent = (
        "no such file; a board file holds a table [board] with kind, squares_x, squares_y, "
        "square_mm, marker_mm, dictionary, or one table [[boards]] for each of several"
    )
    document = read_toml(path, SettingsError, absent=absent)
    problems = unknown(document, _TABLES, "table")
    raise_all(str(path), problems, SettingsError)
    faces: list[BoardFace] = []
    for title, name, table in _face_tables(path, document):
        face = _face(title, name, table, problems)
        if face is not None and check_print and "print" in table:
            wrong = print_problems(sizes_mm(face.board), table["print"])
            problems += [f"{title}: {line}" for line in wrong]
        faces += [] if face is None else [face]
    bar = _scale_bar(document["scale_bar"], problems) if "scale_bar" in document else None
    raise_all(str(path), problems, SettingsError)
    try:
        return BoardBody(tuple(faces), bar)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from error


def _face_tables(path: Path, document: Mapping[str, Any]) -> list[tuple[str, str | None, Any]]:
    """What messages call each board's table, its name where the table has none, the table."""
    if "boards" not in document:
        table = document.get("board")
        if not isinstance(table, Mapping):
            raise SettingsError(
                f"{path}: expected a table [board], found {sorted(document) or 'nothing'}"
            )
        apart = [
            f"{key}: {'the table [print] stands by itself' if key == 'print' else _ONE_OF_MANY}"
            for key in _FACE_KEYS
            if key in table
        ]
        raise_all(f"{path}: [board]", apart, SettingsError)
        printed = {"print": document["print"]} if "print" in document else {}
        return [("[board]", "board", {**table, **printed})]
    if "board" in document or "print" in document:
        raise SettingsError(
            f"{path}: [board] and [print] are for one board; a file with [[boards]] has "
            f"[boards.print] below each board instead"
        )
    tables = document["boards"]
    if not isinstance(tables, list) or not tables:
        raise SettingsError(f"{path}: expected a table [[boards]] for each board, found {tables!r}")
    return [
        (f"[[boards]] {table.get('name', index) if isinstance(table, Mapping) else index}",
         None, table)
        for index, table in enumerate(tables)
    ]  # fmt: skip


def _face(title: str, name: str | None, table: Any, problems: list[str]) -> BoardFace | None:
    """The face of one table; what is wrong with it is added to `problems`."""
    if not isinstance(table, Mapping):
        problems.append(f"{title}: expected a table, found {table!r}")
        return None
    kind = table.get("kind", "charuco")
    if not isinstance(kind, str) or kind not in _KINDS:
        known = " and ".join(f'"{name}"' for name in _KINDS)
        problems.append(f"{title}: kind: only {known} are known, found {kind!r}")
        return None
    values, wrong = field_values(_KINDS[kind], table, _FACE_KEYS)
    if name is None:
        name = table.get("name")
        if not isinstance(name, str):
            wrong.append(f"name: expected text, found {name!r}" if name else "missing key 'name'")
    place = None
    if "body_from_board" in table:
        place = _place(table["body_from_board"], wrong)
    problems += [f"{title}: {line}" for line in wrong]
    if wrong:
        return None
    try:
        board: FlatBoard = _KINDS[kind](**values)
    except SettingsError as error:
        problems.append(f"{title}: {error}")
        return None
    return BoardFace(str(name), board, place)


def _place(table: Any, wrong: list[str]) -> Pose | None:
    if not isinstance(table, Mapping):
        wrong.append(f"body_from_board: expected a table, found {table!r}")
        return None
    found = [f"body_from_board: {line}" for line in unknown(table, _PLACE_KEYS, "key")]
    vectors = []
    for key in _PLACE_KEYS:
        value = table.get(key)
        if _are_numbers(value, 3):
            vectors.append(np.array(value, dtype=np.float64))
        else:
            found.append(
                f"body_from_board: {key}: expected three numbers up to {_FARTHEST:g}, "
                f"found {value!r}"
            )
    wrong += found
    return None if found else Pose.from_rotation_vector(np.radians(vectors[0]), vectors[1])


def _scale_bar(table: Any, problems: list[str]) -> ScaleBar | None:
    if not isinstance(table, Mapping):
        problems.append(f"[scale_bar]: expected a table, found {table!r}")
        return None
    plain = {key: value for key, value in table.items() if key != "markers"}
    values, wrong = field_values(ScaleBar, plain)
    wrong = [line for line in wrong if line != "missing key 'markers'"]
    markers = table.get("markers", [])
    whole = isinstance(markers, list) and all(type(marker) is int for marker in markers)
    if "markers" not in table:
        wrong.append("missing key 'markers'")
    elif not (whole and len(markers) == 2):
        wrong.append(f"markers: expected the ids of two markers, found {markers!r}")
    problems += [f"[scale_bar]: {line}" for line in wrong]
    if wrong:
        return None
    try:
        return ScaleBar(**values, markers=(markers[0], markers[1]))
    except SettingsError as error:
        problems.append(str(error))
        return None


def _are_numbers(value: Any, count: int) -> bool:
    return (
        isinstance(value, list)
        and len(value) == count
        and all(
            type(number) in (int, float) and abs(float(str(number))) <= _FARTHEST
            for number in value
        )
    )
