"""Charts of the report as SVG: lines, bars, matrices, residual arrows, colour scales."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats
from tools.report.svg import (
    DASHES,
    LEVELS,
    PALETTE,
    Axis,
    drawing,
    element,
    frame,
    number,
    spanning,
    text,
)

_WIDTH = 720.0
_BAR = 15.0  # thickness
_IMAGER = 160.0  # width of a small picture of an imager


@dataclass(frozen=True, kw_only=True)
class Series:
    """One named line: y over x; NaN breaks it. A muted one is drawn thin and grey, unnamed."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    muted: bool = False


@dataclass(frozen=True, kw_only=True)
class Labels:
    """What a chart says in words: title for screen readers, axis labels with units."""

    title: str
    x: str = ""
    y: str = ""


def line_chart(
    series: Sequence[Series],
    labels: Labels,
    *,
    marks: Sequence[tuple[float, str]] = (),
    limit: tuple[float, str] | None = None,
    height: float = 240.0,
) -> str:
    """Lines over a common axis, told apart by colour and dash, with a legend below.

    Args:
        series: the lines.
        labels: words.
        marks: (x, words) vertical rules, such as the borders of takes.
        limit: (y, words) a horizontal rule to stay under or above.
        height: of the plot area, px.
    """
    named = [line for line in series if not line.muted]
    values = [v for line in series for v in line.y] + ([limit[0]] if limit else [])
    places = [v for line in series for v in line.x]
    bottom = 30.0 + height
    span = spanning(places, 0, 1, "") if not places else None
    x = Axis(
        low=min(places) if places else 0.0,
        high=max(places) if places else 1.0,
        start=58.0,
        end=_WIDTH - 14.0,
        label=labels.x,
        whole=span is None and all(float(v).is_integer() for v in places),
    )
    y = spanning(values, bottom, 30.0, labels.y, zero=True)
    parts = [frame(x, y)]
    for place, words in marks:
        at = x(place)
        parts.append(element("line", x1=at, x2=at, y1=30.0, y2=bottom, class_="mark"))
        parts.append(text(at + 4, 40, words, class_="tick"))
    if limit is not None:
        at = y(limit[0])
        parts.append(element("line", x1=x.start, x2=x.end, y1=at, y2=at, class_="limit"))
        parts.append(text(x.end, at - 4, limit[1], class_="tick", text_anchor="end"))
    order = [line for line in series if line.muted] + named
    for line in order:
        colour, dash = _style(named.index(line)) if not line.muted else ("#b9bec6", "")
        parts.append(
            element(
                "path",
                d=_path(line, x, y),
                class_="line",
                stroke=colour,
                stroke_dasharray=dash or None,
                stroke_width="1" if line.muted else None,
            )
        )
    legend, rows = _legend([line.name for line in named], bottom + 52)
    return drawing(_WIDTH, bottom + 48 + 20 * rows, "".join(parts) + legend, labels.title)


def bar_chart(
    names: Sequence[str],
    values: Sequence[float],
    labels: Labels,
    *,
    levels: Sequence[str] = (),
    limit: tuple[float, str] | None = None,
    marks: Sequence[float] = (),
) -> str:
    """Horizontal bars with their numbers written behind them.

    Args:
        names: one a bar.
        values: lengths; NaN draws none.
        labels: words; `x` names the measure and its unit.
        levels: "good", "warn", "bad" or "none" of each bar; plain when empty.
        limit: (value, words) a vertical rule.
        marks: a second value of each bar, drawn as a tick across it; NaN draws none.
    """
    step, top = 21.0, 22.0 if limit else 8.0
    left, parts = _named_rows(names, top, step, _BAR)
    finite = [v for v in [*values, *marks, *([limit[0]] if limit else [])] if math.isfinite(v)]
    x = Axis(low=0.0, high=max(finite, default=1.0) or 1.0, start=left, end=_WIDTH - 70.0)
    for row, (_, value) in enumerate(zip(names, values, strict=True)):
        y = top + step * row
        colour = LEVELS[levels[row]] if levels else PALETTE[0]
        if math.isfinite(value):
            width = max(0.0, x(value) - left)
            parts.append(element("rect", x=left, y=y, width=width, height=_BAR, fill=colour))
        end = max(v for v in (value, 0.0) if math.isfinite(v))
        if marks and math.isfinite(marks[row]):
            at = x(marks[row])
            end = max(end, marks[row])
            parts.append(element("line", x1=at, x2=at, y1=y - 2, y2=y + 17, class_="tickmark"))
        parts.append(text(x(end) + 6, y + 12, number(value), class_="tick"))
    bottom = top + step * len(names)
    if limit is not None:
        at = x(limit[0])
        parts.append(element("line", x1=at, x2=at, y1=top - 4, y2=bottom, class_="limit"))
        parts.append(text(at + 3, top - 8, limit[1], class_="tick"))
    middle = (left + x.end) / 2
    parts.append(text(middle, bottom + 16, labels.x, class_="label", text_anchor="middle"))
    return drawing(_WIDTH, bottom + 26, "".join(parts), labels.title)


def stacked_chart(
    names: Sequence[str],
    values: Sequence[Sequence[float]],
    colours: Mapping[str, str],
    labels: Labels,
) -> str:
    """Bars of one length, cut into shares.

    Args:
        names: one a bar.
        values: for each bar, a size for each colour.
        colours: by the word of the legend, in the order of the values.
        labels: words; `x` names the measure.
    """
    step, top = 21.0, 8.0
    left, parts = _named_rows(names, top, step, _BAR)
    wide = _WIDTH - 70.0 - left
    for row, (name, sizes) in enumerate(zip(names, values, strict=True)):
        y = top + step * row
        total = float(np.sum(sizes))
        x = left
        for (word, colour), size in zip(colours.items(), sizes, strict=True):
            if total <= 0 or size <= 0:
                continue
            width = wide * size / total
            told = element("title", f"{name}: {word} {100 * size / total:.0f} %")
            bar = element("rect", x=x, y=y, width=width, height=_BAR, fill=colour)
            parts.append(element("g", told + bar))
            x += width
        if total > 0:
            first = f"{100 * sizes[0] / total:.0f} %" if len(sizes) else ""
            parts.append(text(left + wide + 6, y + 12, first, class_="tick"))
    bottom = top + step * len(names)
    parts.append(text(left + wide / 2, bottom + 14, labels.x, class_="label", text_anchor="middle"))
    legend, lines = _legend(list(colours), bottom + 36, list(colours.values()))
    return drawing(_WIDTH, bottom + 32 + 20 * lines, "".join(parts) + legend, labels.title)


def matrix_chart(
    rows: Sequence[str],
    cells: Sequence[Sequence[str]],
    colours: dict[str, str],
    labels: Labels,
) -> str:
    """One coloured cell for each (row, column), equal neighbours drawn as one, with a legend.

    Args:
        rows: one name a row.
        cells: for each row, the word of every column.
        colours: of each word, in the legend's order.
        labels: words; `x` names the columns.
    """
    count = max((len(row) for row in cells), default=1)
    step, top = 15.0, 8.0
    left, parts = _named_rows(rows, top, step, step - 2)
    x = Axis(low=0.0, high=float(count), start=left, end=_WIDTH - 14.0, label=labels.x, whole=True)
    for index, (_, words) in enumerate(zip(rows, cells, strict=True)):
        y = top + step * index
        first = 0
        for column in range(1, len(words) + 1):
            if column < len(words) and words[column] == words[first]:
                continue
            width = x(column) - x(first)
            colour = colours.get(words[first], LEVELS["none"])
            parts.append(
                element("rect", x=x(first), y=y, width=width, height=step - 2, fill=colour)
            )
            first = column
    bottom = top + step * len(rows)
    for value in range(0, count, max(1, math.ceil(count / 10))):
        at = x(value + 0.5) if count <= 40 else x(value)
        parts.append(text(at, bottom + 14, value, class_="tick", text_anchor="middle"))
    middle = (left + x.end) / 2
    parts.append(text(middle, bottom + 30, labels.x, class_="label", text_anchor="middle"))
    legend, lines = _legend(list(colours), bottom + 50, list(colours.values()))
    return drawing(_WIDTH, bottom + 46 + 20 * lines, "".join(parts) + legend, labels.title)


def arrow_chart(
    size: tuple[int, int], places: Floats, vectors: Floats, scale: float, title: str
) -> str:
    """Residual vectors over an image: dots at (N, 2) px with arrows `scale` times as long.

    Args:
        size: (width, height) of the image, px.
        places: (N, 2) px.
        vectors: (N, 2) px.
        scale: enlargement of the vectors.
        title: words.
    """
    width, height = size
    shrink = _IMAGER / max(width, 1)
    parts = [element("rect", x=0, y=0, width=_IMAGER, height=height * shrink, class_="imager")]
    ends = places + scale * vectors
    d = "".join(
        f"M{a:.1f} {b:.1f}L{c:.1f} {e:.1f}"
        for (a, b), (c, e) in zip((places * shrink).tolist(), (ends * shrink).tolist(), strict=True)
    )
    parts.append(element("path", d=d, class_="arrows"))
    return drawing(_IMAGER, height * shrink, "".join(parts), f"residual vectors of {title}")


def colour_scale(stops: Sequence[str], low: float, high: float, label: str) -> str:
    """A bar of colours from `low` to `high`, with the unit in the label."""
    step = 200.0 / len(stops)
    parts = [
        element("rect", x=16 + step * k, y=2, width=step + 0.5, height=10, fill=colour)
        for k, colour in enumerate(stops)
    ]
    for value in np.linspace(low, high, 3).tolist():
        place = 16 + 200.0 * (value - low) / ((high - low) or 1.0)
        parts.append(text(place, 26, number(value), class_="tick", text_anchor="middle"))
    parts.append(text(224, 12, label, class_="tick"))
    return drawing(420.0, 30.0, "".join(parts), f"colour scale: {label}")


def _style(index: int) -> tuple[str, str]:
    turn = 2 * (index // len(PALETTE)) + index % 2  # neighbours, often left and right, differ
    return PALETTE[index % len(PALETTE)], DASHES[turn % len(DASHES)]


def _path(line: Series, x: Axis, y: Axis) -> str:
    d, pen_down = [], False
    for a, b in zip(line.x, line.y, strict=True):
        if not math.isfinite(b):
            pen_down = False
            continue
        d.append(f"{'L' if pen_down else 'M'}{x(a):.1f} {y(b):.1f}")
        pen_down = True
    if len(d) == 1:  # a single frame still leaves a dot
        d.append("h0.1")
    return "".join(d)


def _named_rows(
    names: Sequence[str], top: float, step: float, thickness: float
) -> tuple[float, list[str]]:
    """Where rows begin, px, and their names in front of that."""
    left = 20.0 + 7.2 * max((len(name) for name in names), default=4)
    parts = []
    for row, name in enumerate(names):
        y = top + step * row + 0.5 * thickness + 4.5
        parts.append(text(left - 8, y, name, class_="tick", text_anchor="end"))
    return left, parts


def _legend(
    names: Sequence[str], top: float, colours: Sequence[str] | None = None
) -> tuple[str, int]:
    if colours is None and len(names) < 2:
        return "", 0
    parts, left, row = [], 58.0, 0
    for index, name in enumerate(names):
        wide = 42.0 + 6.8 * len(name)
        if left + wide > _WIDTH and left > 58.0:
            left, row = 58.0, row + 1
        y = top + 20 * row
        if colours is not None:
            parts.append(element("rect", x=left, y=y - 9, width=12, height=10, fill=colours[index]))
        else:
            colour, dash = _style(index)
            parts.append(
                element(
                    "line", x1=left - 6, x2=left + 18, y1=y - 4, y2=y - 4, class_="line",
                    stroke=colour, stroke_dasharray=dash or None,
                )
            )  # fmt: skip
        parts.append(text(left + 24, y, name, class_="tick"))
        left += wide
    return "".join(parts), row + 1
