"""Draw a calibration board to print, at true scale, as PDF or SVG.

Made from options, its board file is written beside it: print, measure the bar, write the reading
into that file. docs/boards.md says how to choose, print, mount and measure a board.
Example: likeness board --squares-x 12 --squares-y 9 --square-mm 20 --marker-mm 15 --out board.pdf
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from capture.errors import InputError
from capture.product import replacing
from capture.progress import Progress
from recon.board.april_grid import AprilGrid
from recon.board.body import BoardBody, FlatBoard, read_body
from recon.board.charuco import Board
from tools.board_print.board_text import bar_caption, board_caption, board_toml
from tools.board_print.pattern import bar_pattern, board_pattern
from tools.board_print.sheet import Sheet, lay_out
from tools.board_print.sheet_files import write_pdf, write_svg
from tools.verbs.options import Options

SCALE_BAR = "scale_bar"
_CHARUCO = Board(
    squares_x=12, squares_y=9, square_mm=20.0, marker_mm=15.0, dictionary="DICT_5X5_1000"
)
_APRILGRID = AprilGrid(tags_x=6, tags_y=4, tag_mm=30.0, gap_mm=9.0)
"""What is drawn when nothing is chosen; both fit A4."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness board`."""

    out: Path
    """The sheet to write, .pdf or .svg."""
    board: Path | None = None
    """A board file to draw; the options that describe a board are then left out."""
    face: str | None = None
    """Which of its boards, by name, or scale_bar; every one, a page each, when left out (PDF)."""
    page: str = "A4"
    """A4, A3, A2, A1, A0, turned as fits, or WIDTHxHEIGHT in mm."""
    kind: Literal["charuco", "aprilgrid"] = "charuco"
    """The kind of board."""
    squares_x: int | None = None
    """ChArUco: squares in a row (12)."""
    squares_y: int | None = None
    """ChArUco: squares in a column (9)."""
    square_mm: float | None = None
    """ChArUco: side of a square (20)."""
    marker_mm: float | None = None
    """ChArUco: side of a marker, black border included (15)."""
    legacy: bool | None = None
    """ChArUco: the pattern of OpenCV before 4.6 (no)."""
    tags_x: int | None = None
    """AprilGrid: tags in a row (6)."""
    tags_y: int | None = None
    """AprilGrid: tags in a column (4)."""
    tag_mm: float | None = None
    """AprilGrid: side of a tag, black border included (30)."""
    gap_mm: float | None = None
    """AprilGrid: gap between tags (9)."""
    layout: Literal["kalibr", "opencv"] | None = None
    """AprilGrid: where the ids begin, and which way up the tags are (kalibr)."""
    border_bits: int | None = None
    """AprilGrid: width of a tag's black border, cells (2)."""
    dictionary: str | None = None
    """The marker dictionary (DICT_5X5_1000, DICT_APRILTAG_36h11)."""
    first_id: int | None = None
    """Id of the first marker (0): boards of one body must not share any."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Draw, write, and report what was drawn and what to do next."""
    suffix = arguments.out.suffix.lower()
    if suffix not in (".pdf", ".svg"):
        raise InputError(f"--out {arguments.out}: expected a name ending in .pdf or .svg")
    body = _chosen(arguments)
    sheets = _sheets(body, arguments)
    if suffix == ".svg" and len(sheets) > 1:
        known = ", ".join(sheet.title for sheet in sheets)
        raise InputError(
            f"--out {arguments.out}: an SVG holds one sheet, this body needs {len(sheets)}; choose "
            f"one with --face ({known}), or write a .pdf"
        )
    beside, wanted = None, b""
    if arguments.board is None:
        beside, wanted = _board_file(arguments.out, body.faces[0].board, sheets[0].bar_mm)
    if suffix == ".svg":
        write_svg(arguments.out, sheets[0])
    else:
        write_pdf(arguments.out, sheets)
    if beside is not None:
        with replacing(beside) as partial:
            partial.write_bytes(wanted)
    progress(1, 1, "board")
    return {
        "out": str(arguments.out),
        "sheets": [sheet.title for sheet in sheets],
        "page_mm": [list(sheet.page_mm) for sheet in sheets],
        "bar_mm": [sheet.bar_mm for sheet in sheets],
        "board": str(beside or arguments.board),
        "next": "print at 100 %, measure the bar, write the reading into the board file",
    }


def _chosen(arguments: Arguments) -> BoardBody:
    """The board of a file, or of the options."""
    own = {field.name for field in dataclasses.fields(Options)}
    own |= {"out", "board", "face", "page", "kind"}
    names = [field.name for field in dataclasses.fields(arguments) if field.name not in own]
    given = {
        name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None
    }
    if arguments.board is not None:
        if given or arguments.kind != "charuco":
            told = ", ".join(_option(name) for name in given) or "--kind"
            raise InputError(f"--board {arguments.board} tells all of the board; leave out {told}")
        return read_body(arguments.board, check_print=False)
    default: FlatBoard = _CHARUCO if arguments.kind == "charuco" else _APRILGRID
    known = {field.name for field in dataclasses.fields(default)}
    strange = [_option(name) for name in given if name not in known]
    if strange:
        raise InputError(f"--kind {arguments.kind} has no {', '.join(strange)}")
    return BoardBody.of(dataclasses.replace(default, **given))


def _sheets(body: BoardBody, arguments: Arguments) -> list[Sheet]:
    known = [face.name for face in body.faces] + ([SCALE_BAR] if body.scale_bar else [])
    if arguments.face is not None and arguments.face not in known:
        raise InputError(f"--face {arguments.face}: the board file has {', '.join(known)}")
    sheets = []
    for face in body.faces:
        if arguments.face in (None, face.name):
            caption = board_caption(face.name, face.board)
            drawn = board_pattern(face.board)
            sheets.append(lay_out(drawn, caption, arguments.page, title=face.name))
    if body.scale_bar is not None and arguments.face in (None, SCALE_BAR):
        drawn = bar_pattern(body.scale_bar)
        caption = bar_caption(body.scale_bar)
        sheets.append(lay_out(drawn, caption, arguments.page, title=SCALE_BAR))
    return sheets


def _board_file(sheet: Path, board: FlatBoard, bar_mm: float) -> tuple[Path, bytes]:
    """Where the board file of a sheet stands, and what it holds; one that differs is refused."""
    path = sheet.with_suffix(".toml")
    wanted = board_toml(board, bar_mm).encode()
    if path.exists() and (path.is_dir() or path.read_bytes() != wanted):
        raise InputError(
            f"{path}: exists and says otherwise, with your calliper reading perhaps; draw it with "
            f"--board {path}, or choose another --out"
        )
    return path, wanted


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
