"""SVG pieces: elements with escaped text, axes with round ticks, the palette of the report."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

# Okabe and Ito's palette without its yellow and sky blue, which print too pale for thin lines
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#8c6d1f", "#000000", "#e69f00")
DASHES = ("", "7 3", "2 3", "9 3 2 3")
MICRO = "\u00b5m"  # micrometres
LEVELS = {"good": "#1b7f4b", "warn": "#c27c00", "bad": "#b3261e", "none": "#8a8f98"}


def escape(text: object) -> str:
    """Text made safe inside HTML and SVG, attributes included."""
    return html.escape(str(text), quote=True)


def element(name: str, content: str = "", **attributes: object) -> str:
    """One SVG or HTML element; `_` in attribute names stands for `-`; numbers get two digits."""
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{_attribute(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    return f"<{name}{written}>{content}</{name}>" if content else f"<{name}{written}/>"


def text(x: float, y: float, words: object, **attributes: object) -> str:
    """A line of text at (x, y)."""
    return element("text", escape(words), x=x, y=y, **attributes)


def drawing(width: float, height: float, content: str, label: str) -> str:
    """A whole drawing that scales to its place and says in words what it shows."""
    inner = element("title", escape(label)) + content
    box = f"0 0 {width:g} {height:g}"
    return element(
        "svg", inner, viewBox=box, role="img", class_="chart", style=f"max-width:{width:g}px"
    )


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers, at steps of 1, 2 or 5 times a power of ten, that lie in low..high."""
    span = high - low
    if not math.isfinite(span) or span <= 0:
        return [low]
    raw = span / max(1, count)
    power = 10.0 ** math.floor(math.log10(raw))
    step = min((m * power for m in (1, 2, 5, 10)), key=lambda s: abs(math.log(s / raw)))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [step * k for k in range(first, last + 1)]


def number(value: float) -> str:
    """A number for reading: three digits, no needless zeros."""
    if not math.isfinite(value):
        return "n/a"
    if value == 0:
        return "0"
    size = abs(value)
    if size >= 1e6 or size < 1e-4:
        return f"{value:.2e}"
    digits = max(0, 2 - math.floor(math.log10(size)))
    shown = f"{value:.{min(digits, 5)}f}"
    return shown.rstrip("0").rstrip(".") if "." in shown else shown


@dataclass(frozen=True, kw_only=True)
class Axis:
    """A linear axis from values to drawing units.

    Attributes:
        low: value at `start`.
        high: value at `end`.
        start: drawing units.
        end: drawing units.
        label: what is measured, with its unit.
    """

    low: float
    high: float
    start: float
    end: float
    label: str = ""
    whole: bool = False
    ticks: list[float] = field(default_factory=list)

    def __call__(self, value: float) -> float:
        """The place of a value."""
        span = self.high - self.low or 1.0
        return self.start + (value - self.low) / span * (self.end - self.start)


def spanning(
    values: Sequence[float], start: float, end: float, label: str, *, zero: bool = False
) -> Axis:
    """An axis that spans the finite values, with a little room, and 0 when asked."""
    finite = [v for v in values if math.isfinite(v)]
    low, high = (min(finite), max(finite)) if finite else (0.0, 1.0)
    if zero:
        low, high = min(low, 0.0), max(high, 0.0)
    if high - low < 1e-12:
        low, high = (low, low + 1.0) if zero else (low - 0.5, high + 0.5)
    room = 0.05 * (high - low)
    low_edge = low if zero and low == 0.0 else low - room
    return Axis(low=low_edge, high=high + room, start=start, end=end, label=label)


def frame(x: Axis, y: Axis) -> str:
    """Grid, tick labels and axis labels of a plot area."""
    parts = []
    top, bottom = min(y.start, y.end), max(y.start, y.end)
    left, right = min(x.start, x.end), max(x.start, x.end)
    for value in y.ticks or ticks(y.low, y.high, 4):
        place = y(value)
        parts.append(element("line", x1=left, x2=right, y1=place, y2=place, class_="grid"))
        parts.append(text(left - 6, place + 4, number(value), class_="tick", text_anchor="end"))
    marks = x.ticks or ticks(x.low, x.high, 8)
    for value in marks:
        if x.whole and value != round(value):
            continue
        place = x(value)
        parts.append(element("line", x1=place, x2=place, y1=bottom, y2=bottom + 4, class_="axis"))
        parts.append(text(place, bottom + 17, number(value), class_="tick", text_anchor="middle"))
    parts.append(element("line", x1=left, x2=right, y1=bottom, y2=bottom, class_="axis"))
    parts.append(
        text((left + right) / 2, bottom + 34, x.label, class_="label", text_anchor="middle")
    )
    parts.append(text(left - 44, top - 10, y.label, class_="label"))
    return "".join(parts)


def _attribute(value: object) -> str:
    if isinstance(value, float):
        shown = f"{value:.2f}".rstrip("0").rstrip(".")
        return "0" if shown in ("-0", "") else shown
    return escape(value)
