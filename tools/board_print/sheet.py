"""A sheet of paper with a board, its scale bar, its caption and its crop marks, at true scale.

::

    +- - - - - - - - - - - -+   page edge
      |                   |     crop marks
    - +-------------------+ -
        pattern
        |---|---|---|  kind = "charuco", squares_x = 12, ...
        this bar must measure ...
    - +-------------------+ -
      |                   |

Nothing is ever scaled to fit. What is cut out holds the bar and the caption, so that the bar can
still be measured on the mounted board.
"""

from __future__ import annotations

import math
import re
import textwrap
from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats
from capture.errors import InputError
from tools.board_print.pattern import Pattern

PAGES_MM: dict[str, tuple[float, float]] = {
    "A4": (297.0, 210.0),
    "A3": (420.0, 297.0),
    "A2": (594.0, 420.0),
    "A1": (841.0, 594.0),
    "A0": (1189.0, 841.0),
}
"""Width and height of the pages known by name, landscape."""

BAR_MM = 100.0
CROP_MM = 4.0
_EDGE_MM = 5.0  # the outermost paper that most printers leave white
_BAR_STEP_MM = 10.0
_GAP_MM = 2.5  # between pattern and strip
_TICK_MM, _TALL_TICK_MM = 1.6, 3.0
_THIN_MM, _CROP_LINE_MM = 0.15, 0.1
_TEXT_MM, _LINE_MM = 2.0, 2.6
_LETTER = 0.52  # mean width of a letter over the size of the text
_LEAST_CAPTION_MM = 70.0
_CUSTOM = re.compile(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)")


@dataclass(frozen=True)
class Stroke:
    """A straight line from (x0, y0) to (x1, y1), butt ends, page mm."""

    x0: float
    y0: float
    x1: float
    y1: float
    width: float


@dataclass(frozen=True)
class Words:
    """A line of text; (x, y) is the left end of its base line, page mm."""

    x: float
    y: float
    text: str
    size: float = _TEXT_MM


@dataclass(frozen=True, eq=False)
class Sheet:
    """Everything on one page, mm, origin at its top left, +X right, +Y down.

    Attributes:
        title: what the document is called.
        page_mm: width and height.
        origin_mm: where the pattern's origin is.
        bar_mm: length of the scale bar, between the middles of its first and last tick.
        loops: black outlines, even-odd.
        strokes: black lines.
        words: lines of text.
    """

    title: str
    page_mm: tuple[float, float]
    origin_mm: tuple[float, float]
    bar_mm: float
    loops: tuple[Floats, ...]
    strokes: tuple[Stroke, ...]
    words: tuple[Words, ...]


def lay_out(pattern: Pattern, caption: str, page: str, *, title: str = "board") -> Sheet:
    """Place a pattern on a page.

    Args:
        pattern: what to print.
        caption: what it is, in words; wrapped.
        page: a name of `PAGES_MM`, turned as fits, or `WIDTHxHEIGHT` in mm, taken as it is.
        title: of the document.

    Raises:
        InputError: when no such page is known, or the board does not fit it.
    """
    wide, high = pattern.size_mm
    choices = _page_choices(page)
    border = 2 * (_EDGE_MM + CROP_MM)
    bar = float(min(BAR_MM, _BAR_STEP_MM * ((choices[0][0] - border) // _BAR_STEP_MM)))
    inner = max(wide, bar)
    beside = inner - bar - 5.0 >= _LEAST_CAPTION_MM
    lines = _wrapped(caption, inner - bar - 5.0 if beside else inner)
    block = _TALL_TICK_MM + _LINE_MM
    strip = max(block, len(lines) * _LINE_MM) if beside else block + len(lines) * _LINE_MM
    need = (inner + border, high + _GAP_MM + strip + border)
    fitting = [size for size in choices if need[0] <= size[0] and need[1] <= size[1]]
    if not fitting or bar < _BAR_STEP_MM:
        raise InputError(_does_not_fit(page, choices[0], pattern.size_mm, need))
    page_mm = fitting[0]
    left = 0.5 * (page_mm[0] - inner)
    top = 0.5 * (page_mm[1] - (high + _GAP_MM + strip))
    below = top + high + _GAP_MM
    strokes, words = _scale_bar(left, below, bar)
    x, y = (left + bar + 5.0, below) if beside else (left, below + block)
    words += [Words(x, y + (row + 0.8) * _LINE_MM, line) for row, line in enumerate(lines)]
    strokes += _crop_marks((left, top, left + inner, below + strip))
    origin = (left + 0.5 * (inner - wide), top)
    loops = tuple(loop + np.array(origin) for loop in pattern.loops)
    return Sheet(title, page_mm, origin, bar, loops, tuple(strokes), tuple(words))


def _page_choices(page: str) -> list[tuple[float, float]]:
    named = PAGES_MM.get(page.upper())
    if named is not None:
        return [named, named[::-1]]
    custom = _CUSTOM.fullmatch(page.lower())
    if custom is None or min(float(custom[1]), float(custom[2])) <= 0:
        raise InputError(
            f"--page {page}: expected {', '.join(PAGES_MM)}, or WIDTHxHEIGHT in mm as in 500x350"
        )
    return [(float(custom[1]), float(custom[2]))]


def _does_not_fit(
    page: str, size: tuple[float, float], board: tuple[float, float], need: tuple[float, float]
) -> str:
    larger = [
        name for name, sides in PAGES_MM.items()
        if max(need) <= max(sides) and min(need) <= min(sides)
    ]  # fmt: skip
    hint = f"--page {larger[0]}" if larger else f"--page {math.ceil(need[0])}x{math.ceil(need[1])}"
    return (
        f"--page {page}: the board of {board[0]:g} x {board[1]:g} mm needs "
        f"{math.ceil(need[0])} x {math.ceil(need[1])} mm with its margins, bar and "
        f"caption, the page has "
        f"{size[0]:g} x {size[1]:g} mm; take {hint}, or a smaller board; it is never scaled"
    )


def _scale_bar(left: float, top: float, length: float) -> tuple[list[Stroke], list[Words]]:
    """A ruler with a tick every 10 mm, and what it must measure."""
    base = top + _TALL_TICK_MM
    strokes = [Stroke(left, base - 0.5 * _THIN_MM, left + length, base - 0.5 * _THIN_MM, _THIN_MM)]
    count = round(length / _BAR_STEP_MM)
    for tick in range(count + 1):
        x = left + tick * _BAR_STEP_MM
        height = _TALL_TICK_MM if tick in (0, count) else _TICK_MM
        strokes.append(Stroke(x, base - height, x, base, _THIN_MM))
    told = f"this bar must measure {length:.2f} mm"
    if length >= BAR_MM:
        told += ", middle of first to middle of last tick"
    return strokes, [Words(left, base + 0.8 * _LINE_MM, told)]


def _crop_marks(box: tuple[float, float, float, float]) -> list[Stroke]:
    """Two short lines outside each corner of what is to be cut out."""
    x0, y0, x1, y1 = box[0] - CROP_MM, box[1] - CROP_MM, box[2] + CROP_MM, box[3] + CROP_MM
    marks = []
    for x, outward in ((x0, -1.0), (x1, 1.0)):
        for y, upward in ((y0, -1.0), (y1, 1.0)):
            near, far = 0.5, 4.0
            marks.append(Stroke(x + near * outward, y, x + far * outward, y, _CROP_LINE_MM))
            marks.append(Stroke(x, y + near * upward, x, y + far * upward, _CROP_LINE_MM))
    return marks


def _wrapped(caption: str, width_mm: float) -> list[str]:
    letters = max(20, int(width_mm / (_LETTER * _TEXT_MM)))
    return textwrap.wrap(caption, letters, break_long_words=True)
