"""The error strip: one row a figure, one column a frame, coloured from good to bad."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tools.report.svg import drawing, element, number, text

_WIDTH, _LEFT, _RIGHT = 720.0, 168.0, 92.0
_STEP, _BAR, _TOP = 20.0, 16.0, 8.0
# white through orange to dark red; the numbers at the right say what the ends mean
_RAMP = ((246, 244, 240), (247, 209, 148), (228, 132, 84), (178, 44, 56), (96, 12, 40))
_GAP = "#c9cdd3"
_MARK = "#b3261e"


@dataclass(frozen=True, kw_only=True)
class StripRow:
    """One figure through the frames.

    Attributes:
        name: with its unit.
        values: one a frame; NaN where there is none.
        good: the number that is drawn lightest.
        bad: the number that is drawn darkest; it may be the smaller of the two.
    """

    name: str
    values: Sequence[float]
    good: float
    bad: float


def strip_chart(
    rows: Sequence[StripRow], frames: Sequence[int], flagged: Sequence[bool], title: str
) -> str:
    """Rows of coloured cells over the frames, with a mark under each flagged frame.

    Args:
        rows: the figures, each with as many values as there are frames.
        frames: their numbers.
        flagged: which of them are flagged.
        title: words for screen readers.
    """
    count = max(len(frames), 1)
    wide = (_WIDTH - _LEFT - _RIGHT) / count
    parts = []
    for index, row in enumerate(rows):
        y = _TOP + _STEP * index
        parts.append(text(_LEFT - 8, y + 12, row.name, class_="tick", text_anchor="end"))
        for column, value in enumerate(row.values):
            bar = element(
                "rect", x=_LEFT + wide * column, y=y, width=wide + 0.3, height=_BAR,
                fill=_colour(value, row.good, row.bad),
            )  # fmt: skip
            words = number(value) if math.isfinite(value) else "none"
            told = element("title", f"frame {frames[column]}: {row.name} {words}")
            parts.append(element("g", told + bar))
        ends = f"{number(row.good)} to {number(row.bad)}"
        parts.append(text(_WIDTH - _RIGHT + 8, y + 12, ends, class_="tick"))
    bottom = _TOP + _STEP * len(rows)
    for column, bad in enumerate(flagged):
        if bad:
            x = _LEFT + wide * (column + 0.5)
            parts.append(element("path", d=f"M{x - 4:.1f} {bottom + 8:.1f}h8l-4 -8z", fill=_MARK))
    for column in range(0, len(frames), max(1, math.ceil(count / 12))):
        x = _LEFT + wide * (column + 0.5)
        parts.append(text(x, bottom + 22, frames[column], class_="tick", text_anchor="middle"))
    parts.append(text(_LEFT - 8, bottom + 10, "flagged", class_="tick", text_anchor="end"))
    parts.append(text(_LEFT - 8, bottom + 22, "frame", class_="tick", text_anchor="end"))
    return drawing(_WIDTH, bottom + 30, "".join(parts), title)


def _colour(value: float, good: float, bad: float) -> str:
    if not math.isfinite(value):
        return _GAP
    place = min(max((value - good) / ((bad - good) or 1.0), 0.0), 1.0) * (len(_RAMP) - 1)
    low = min(int(place), len(_RAMP) - 2)
    share = place - low
    mixed = [round(a + share * (b - a)) for a, b in zip(_RAMP[low], _RAMP[low + 1], strict=True)]
    return "#{:02x}{:02x}{:02x}".format(*mixed)
