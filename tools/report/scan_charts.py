"""Charts of a scan: which pairs covered how much, why pixels were rejected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tools.report.charts import Labels, stacked_chart
from tools.report.picture import stops
from tools.report.svg import LEVELS, drawing, element, number, text

_WIDTH = 720.0
_CELL = 30.0
_REASONS = {
    "KEPT": ("matched", "#1b7f4b"),
    "NO_SEED": ("no match at low resolution", "#b9bec6"),
    "NO_TEXTURE": ("no texture above the noise", "#dfe3e8"),
    "LOW_CORRELATION": ("views look different", "#d55e00"),
    "UNCERTAIN": ("too uncertain", "#e69f00"),
    "LEFT_RIGHT": ("hidden from the other view", "#56b4e9"),
    "FRAGMENT": ("patch too small", "#cc79a7"),
    "HIGHLIGHT": ("highlight, at white", "#f0e442"),
    "EDGE": ("at an edge", "#8c6d1f"),
}
_OTHER = "#7b3294"


def coverage_matrix(names: Sequence[str], pairs: Sequence[Mapping[str, Any]]) -> str:
    """How much of what two cameras both look at was matched, a cell a pair, in percent.

    Args:
        names: of the cameras, in order.
        pairs: `left`, `right`, `angle_deg` and `coverage` of each.
    """
    place = {name: index for index, name in enumerate(names)}
    colours = stops("sequential", 11)
    left, top = 20.0 + 7.2 * max((len(name) for name in names), default=4), 24.0
    same = _shared_beginning(names)
    parts = []
    for index, name in enumerate(names):
        middle = _CELL * (index + 0.62)
        parts.append(text(left - 8, top + middle, name, class_="tick", text_anchor="end"))
        short = name[same:][-4:] or name[-4:]
        parts.append(
            text(left + _CELL * (index + 0.5), 16, short, class_="tick", text_anchor="middle")
        )
    for pair in pairs:
        if pair.get("left") not in place or pair.get("right") not in place:
            continue
        row, column = sorted((place[pair["left"]], place[pair["right"]]))
        share = float(pair.get("coverage") or 0.0)
        colour = colours[round(10 * min(max(share, 0.0), 1.0))] if share > 0 else LEVELS["bad"]
        words = (
            f"{pair['left']} and {pair['right']}: {100 * share:.0f} % at "
            f"{number(float(pair.get('angle_deg') or 0.0))} degrees"
        )
        for i, j in ((row, column), (column, row)):
            x, y = left + _CELL * j, top + _CELL * i
            cell = element("title", words) + element(
                "rect", x=x, y=y, width=_CELL - 2, height=_CELL - 2, fill=colour
            )
            shown = f"{100 * share:.0f}"
            cell += element(
                "text", shown, x=x + 14, y=y + 18, text_anchor="middle",
                style=f"fill:{'#1d2229' if share > 0.6 else '#ffffff'};font-size:11px",
            )  # fmt: skip
            parts.append(element("g", cell))
    size = _CELL * len(names)
    title = "coverage of pairs, percent"
    return drawing(max(left + size + 10, 240.0), top + size + 8, "".join(parts), title)


def _shared_beginning(names: Sequence[str]) -> int:
    """How many letters all names begin with alike."""
    letters = list(zip(*names, strict=False)) if len(names) > 1 else []
    alike = [len(set(column)) == 1 for column in letters]
    return alike.index(False) if False in alike else len(alike)


def reason_bars(
    names: Sequence[str],
    pairs: Sequence[Mapping[str, Any]],
    reasons: Sequence[Mapping[str, int]],
) -> str:
    """What became of the pixels of each camera's pairs, as shares of a bar, with a legend.

    Args:
        names: of the cameras, in order.
        pairs: `left` and `right` of each.
        reasons: of each pair, pixels by reason; those off the images are left out.
    """
    rows = []
    for name in names:
        own = [
            counts
            for pair, counts in zip(pairs, reasons, strict=False)
            if name in (pair.get("left"), pair.get("right"))
        ]
        keys = dict.fromkeys(key for counts in own for key in counts if key != "OUTSIDE")
        rows.append({key: float(sum(counts.get(key, 0) for counts in own)) for key in keys})
    order = [key for key in _REASONS if any(row.get(key) for row in rows)]
    order += sorted({key for row in rows for key in row if row[key]} - set(_REASONS))
    words = [_REASONS.get(key, (key.lower().replace("_", " "), _OTHER)) for key in order]
    values = [[row.get(key, 0.0) for key in order] for row in rows]
    return stacked_chart(
        names, values, dict(words), Labels(title="what became of the pixels", x="share of pixels")
    )
