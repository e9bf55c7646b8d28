"""A board in words: its TOML table, and the caption of its sheet."""

from __future__ import annotations

import dataclasses

from recon.board.body import FlatBoard, ScaleBar
from recon.board.table import sizes_mm

Value = str | bool | int | float


def board_toml(board: FlatBoard, bar_mm: float) -> str:
    """The board file of a sheet about to be printed, which still asks for the calliper reading.

    Args:
        board: the board as drawn.
        bar_mm: length of the scale bar on the sheet.
    """
    rows = [f"{key} = {text(value)}" for key, value in _fields(board).items()]
    drawn = [f"drawn_{key} = {text(size)}" for key, size in sizes_mm(board).items()]
    sizes = " and ".join(sizes_mm(board))
    return "\n".join(
        [
            "[board]",
            *rows,
            "",
            "# After printing and mounting: measure the bar with a calliper, middle of first to",
            f"# middle of last tick, and write it into the line below. If it is not {bar_mm:g},",
            f"# {sizes} above must be the true ones: likeness tells what to write.",
            "[print]",
            f"bar_mm = {text(bar_mm)}",
            f"# measured_bar_mm = {bar_mm:g}   (take the # away, write what the calliper reads)",
            *drawn,
            "",
        ]
    )


def board_caption(name: str, board: FlatBoard) -> str:
    """What stands beside the bar: the name and every key of the board, and how to print."""
    keys = ", ".join(f"{key} = {text(value)}" for key, value in _fields(board).items())
    return f"{name}: {keys}. Print at 100 %, never fitted to the page."


def bar_caption(bar: ScaleBar) -> str:
    """What stands beside the markers of a scale bar."""
    return (
        f"scale_bar: dictionary = {text(bar.dictionary)}, markers = [{bar.markers[0]}, "
        f"{bar.markers[1]}], marker_mm = {text(bar.marker_mm)}. Cut out, glue on a stiff bar, "
        "upright side by side; measure between the centres. Print at 100 %, never fitted to the "
        "page."
    )


def text(value: Value) -> str:
    """A value as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _fields(board: FlatBoard) -> dict[str, Value]:
    """Every key of the board, its kind first."""
    values: dict[str, Value] = dataclasses.asdict(board)
    return {"kind": values.pop("kind"), **values}
