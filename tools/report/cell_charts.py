"""Charts made of coloured cells: heat over an image sensor, slices through a volume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats
from tools.report.calibration_keys import Grid
from tools.report.svg import drawing, element, number, text

_SENSOR = 160.0  # width of a small picture of a sensor
_SLICE, _LAYER = 300.0, 226.0  # widths of a slice and of a layer, with their axes
_MARGIN, _HEAD, _FOOT = 40.0, 8.0, 34.0
_EMPTY, _MISSING = "#e3e6ea", "#f4cfcb"
_WRITTEN = 12  # no numbers are written into the cells of a grid that has more columns
_VIEWS = (
    ("from the front", 0, 1, 2),
    ("from the side; the face looks right", 2, 1, 0),
    ("from above; the face looks down", 0, 2, 1),
)  # words; the axis drawn to the right, the other one (y upwards, z downwards), the one cut across


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Colours of values: the first stop at `low` and below, the last at `high` and above."""

    low: float
    high: float
    stops: Sequence[str]

    def level(self, values: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
        """Which stop each value has; -1 for NaN."""
        place = np.clip((values - self.low) / ((self.high - self.low) or 1.0), 0.0, 1.0)
        place = np.round(place * (len(self.stops) - 1))
        return np.where(np.isfinite(place), place, -1).astype(np.int64)

    def colour(self, value: float) -> str:
        """The colour of a finite value."""
        return self.stops[int(self.level(np.array([value]))[0])]


@dataclass(frozen=True, kw_only=True)
class _Look:
    """How a layer is drawn; the cells of the mask `red` in red, whatever their value."""

    scale: Scale
    width: float
    red: Bools | None = None


def heat_chart(lengths: Floats, means: Floats | None, scale: Scale, words: str, by: float) -> str:
    """Mean residual lengths over a sensor as colours, mean residuals as arrows on them.

    Args:
        lengths: (rows, columns) px; NaN where no corner was seen.
        means: (rows, columns, 2) mean residual x, y, px, drawn from the middle of each cell; None
            draws no arrows.
        scale: colours of the lengths.
        words: title for screen readers.
        by: enlargement of the arrows: cells of the drawing for each px.
    """
    rows, columns = lengths.shape
    cell = _SENSOR / columns
    parts = [cells(lengths, scale, cell, (0.0, 0.0))]
    if means is not None:
        parts.append(_mean_arrows(means, cell, by))
    return drawing(_SENSOR, cell * rows, "".join(parts), words)


def coverage_chart(counts: Floats, scale: Scale, words: str) -> str:
    """Corners seen in each cell (rows, columns) of a sensor; empty cells are grey."""
    rows, columns = counts.shape
    cell = _SENSOR / columns
    shown = cells(np.where(counts > 0, counts, np.nan), scale, cell, (0.0, 0.0))
    return drawing(_SENSOR, cell * rows, shown, words)


def middle_slices(grid: Grid, scale: Scale, words: str) -> list[tuple[str, str]]:
    """Three orthogonal slices through the middle of a grid: (chart, caption) of each."""
    out = []
    for told, right, other, across in _VIEWS:
        index = grid.values.shape[2 - across] // 2
        layer = np.take(grid.values, index, axis=2 - across)  # rows are the later axis of x, y, z
        layer = layer if right < other else layer.T
        at = f"{'xyz'[across]} = {number(_round(grid.place_mm(across, index)))} mm"
        look = _Look(scale=scale, width=_SLICE)
        chart = _slice(grid, layer, look, (right, other), f"{words}, {told}, {at}")
        out.append((chart, f"{told.capitalize()}, {at}."))
    return out


def front_layers(grid: Grid, scale: Scale, words: str, most: int = 9) -> list[tuple[str, str]]:
    """Layers of a grid of counts seen from the front, from the back to the nearest.

    Args:
        grid: counts.
        scale: colours; a cell without any is red when those that touch its sides have none too.
        words: title for screen readers.
        most: of more layers, so many are drawn, evenly spread.
    """
    count, lonely = grid.values.shape[0], _lonely(grid.values)
    chosen = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
    out = []
    for index in chosen.tolist():
        layer = grid.values[index]
        if not np.isfinite(layer).any():
            continue
        at = f"z = {number(_round(grid.place_mm(2, index)))} mm"
        look = _Look(scale=scale, width=_LAYER, red=lonely[index])
        chart = _slice(grid, layer, look, (0, 1), f"{words}, {at}")
        ends = {0: ", the back", count - 1: ", nearest to the array"}
        out.append((chart, at + ends.get(index, "")))
    return out


def cells(
    values: Floats, scale: Scale, cell: float, corner: tuple[float, float], *, empty: str = _EMPTY
) -> str:
    """Squares of values (rows, columns), one path a colour.

    Args:
        values: (rows, columns); NaN is drawn in the colour `empty`.
        scale: colours.
        cell: side of a square, drawing units.
        corner: (x, y) of the first square, drawing units.
        empty: a colour, or "none".
    """
    level = scale.level(values)
    y, x = (
        (start + cell * np.arange(count + 1)).tolist()
        for start, count in zip(corner[::-1], values.shape, strict=True)
    )
    out = []
    for one in np.unique(level).tolist():
        d = "".join(
            f"M{x[first]:.1f} {y[row]:.1f}H{x[last]:.1f}V{y[row + 1]:.1f}H{x[first]:.1f}z"
            for row, first, last in _runs(level == one)
        )
        fill = empty if one < 0 else scale.stops[one]
        if fill != "none":
            out.append(element("path", d=d, fill=fill, shape_rendering="crispEdges"))
    return "".join(out)


def _runs(mask: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> list[tuple[int, int, int]]:
    """Stretches of true cells: row, first column, the column behind the last."""
    out = []
    for row, line in enumerate(mask.tolist()):
        first = None
        for column, here in enumerate([*line, False]):
            if here and first is None:
                first = column
            elif not here and first is not None:
                out.append((row, first, column))
                first = None
    return out


def _slice(grid: Grid, layer: Floats, look: _Look, view: tuple[int, int], words: str) -> str:
    """One layer, its columns along the first axis of the view and its rows along the second."""
    right, other = view
    upwards = other == 1
    shown = layer[::-1] if upwards else layer
    rows, columns = shown.shape
    cell = (look.width - _MARGIN - 8.0) / max(rows, columns)
    parts = [cells(shown, look.scale, cell, (_MARGIN, _HEAD), empty="none")]
    if look.red is not None:
        red = np.where(look.red[::-1] if upwards else look.red, 0.0, np.nan)
        only = Scale(low=0.0, high=1.0, stops=(_MISSING,))
        parts.append(cells(red, only, cell, (_MARGIN, _HEAD), empty="none"))
    if columns <= _WRITTEN:
        parts.append(_numbers(shown, look, cell))
    bottom = _HEAD + rows * cell
    for column in _marks(columns):
        at = _MARGIN + (column + 0.5) * cell
        value = number(_round(grid.place_mm(right, column)))
        parts.append(text(at, bottom + 14, value, class_="tick", text_anchor="middle"))
    for row in _marks(rows):
        value = number(_round(grid.place_mm(other, rows - 1 - row if upwards else row)))
        at = _HEAD + (row + 0.5) * cell + 4
        parts.append(text(_MARGIN - 5, at, value, class_="tick", text_anchor="end"))
    middle = _MARGIN + columns * cell / 2
    axis = f"{'xyz'[right]}, mm"
    parts.append(text(middle, bottom + 29, axis, class_="tick", text_anchor="middle"))
    parts.append(text(2, 14, "xyz"[other], class_="tick"))
    return drawing(look.width, bottom + _FOOT, "".join(parts), words)


def _lonely(counts: Floats) -> Bools:
    """Cells (nz, ny, nx) of the volume that are empty, as are those that touch their sides."""
    some = np.pad(np.nan_to_num(counts) > 0, 1)
    near = some.copy()
    for axis in range(3):
        near |= np.roll(some, 1, axis=axis) | np.roll(some, -1, axis=axis)
    lonely: Bools = np.isfinite(counts) & ~near[1:-1, 1:-1, 1:-1]
    return lonely


def _numbers(values: Floats, look: _Look, cell: float) -> str:
    """The values written into their cells, light on dark ones."""
    written: dict[bool, list[str]] = {False: [], True: []}
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            x, y = _MARGIN + (column + 0.5) * cell, _HEAD + (row + 0.5) * cell + 3.5
            light = _is_dark(look.scale.colour(float(value)))
            written[light].append(text(x, y, _short(float(value))))
    return "".join(
        element("g", "".join(texts), class_="count light" if light else "count",
                text_anchor="middle")
        for light, texts in written.items()
        if texts
    )  # fmt: skip


def _is_dark(colour: str) -> bool:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return 0.299 * red + 0.587 * green + 0.114 * blue < 140


def _mean_arrows(means: Floats, cell: float, by: float) -> str:
    lines, dots = [], []
    for row in range(means.shape[0]):
        for column in range(means.shape[1]):
            dx, dy = means[row, column].tolist()
            if not np.isfinite(dx + dy):
                continue
            x, y = (column + 0.5) * cell, (row + 0.5) * cell
            lines.append(f"M{x:.1f} {y:.1f}l{dx * by * cell:.1f} {dy * by * cell:.1f}")
            dots.append(f"M{x:.1f} {y:.1f}h0")
    line = element("path", d="".join(lines), class_="mean")
    return line + element("path", d="".join(dots), class_="root")


def _marks(count: int) -> list[int]:
    """The first and the last of so many cells, and the one in the middle where there is one."""
    return sorted({0, count - 1} | ({count // 2} if count % 2 else set()))


def _round(value: float) -> float:
    return round(value, 1) + 0.0


def _short(value: float) -> str:
    if value >= 1000:
        return f"{value / 1000:.0f}k"
    return f"{value:.0f}" if value >= 9.95 or value == round(value) else f"{value:.1f}"
