"""The calibration device by device: residuals over each sensor, coverage, the table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from capture.arrays import Floats
from capture.camera import CameraArray
from tools.report.calibration_gate import RESIDUAL_PX, gate_marks, level_of
from tools.report.calibration_keys import (
    mapping_of,
    names_of,
    number_of,
    rows_of,
    table_of,
    vector_of,
)
from tools.report.cell_charts import Scale, coverage_chart, heat_chart
from tools.report.charts import Labels, arrow_chart, bar_chart, colour_scale
from tools.report.page import figure, flattened, folded, table
from tools.report.picture import stops
from tools.report.svg import MICRO, escape, number

_ARROW = 0.05  # length of a drawn residual at the 95th percentile, in widths of the image
_SIDES = ("left", "right", "up", "down")
BLUES = tuple(f"#{round(222 - 222 * k / 15):02x}{round(236 - 122 * k / 15):02x}"
              f"{round(246 - 68 * k / 15):02x}" for k in range(16))  # fmt: skip


def residual_bars(devices: Sequence[Mapping[str, Any]]) -> str:
    """The mean residual of each device as bars."""
    values = [number_of(entry, "mean_reprojection_px") for entry in devices]
    levels = [level_of(value, *RESIDUAL_PX) for value in values]
    labels = Labels(title="residual by device", x="mean reprojection error, px")
    top = max((value for value in values if np.isfinite(value)), default=0.0)
    good = RESIDUAL_PX[0]
    limit = (good, f"{number(good)} px") if top > 0.5 * good else None
    chart = bar_chart(names_of(devices), values, labels, levels=levels, limit=limit)
    return figure(chart, "Board residuals; one high bar is one bad lens, focus or trigger.")


def coverage_figures(devices: Sequence[Mapping[str, Any]]) -> list[str]:
    """Where the board has been in each image, a figure for each device that tells."""
    out = []
    for name, entry in zip(names_of(devices), devices, strict=True):
        chart, covered = _coverage(entry, name)
        if chart:
            out.append(figure(chart, f"{name}, {covered}"))
    return out


def arrow_figures(report: Mapping[str, Any], array: CameraArray | None) -> list[str]:
    """Residual vectors over each image, a figure for each device that has some."""
    out = []
    for camera in array or ():
        chart, count = _arrows(report, array, camera.name, arrow_scale(report, array))
        if chart:
            out.append(figure(chart, f"{camera.name}, {count} corners"))
    return out


def arrow_scale(report: Mapping[str, Any], array: CameraArray | None) -> float:
    """A round enlargement at which a long residual is easy to see and no arrow crosses another."""
    vectors = mapping_of(report, "residual_vectors")
    tables = [found for key in vectors if (found := _vectors(vectors, key)) is not None]
    sizes = np.concatenate([np.hypot(rows[:, 2], rows[:, 3]) for rows in tables] or [np.zeros(1)])
    long_px = float(np.nanpercentile(sizes, 95)) if np.isfinite(sizes).any() else 0.0
    width = max((camera.width for camera in array or ()), default=1000)
    return 1.0 if long_px <= 0 else _round_below(_ARROW * width / long_px)


def device_cards(report: Mapping[str, Any], array: CameraArray | None) -> str:
    """For each device residual vectors, heat over the sensor with mean residuals, coverage."""
    devices = rows_of(report, "devices")
    scale, heats = arrow_scale(report, array), [_heat(entry) for entry in devices]
    lengths = np.concatenate([h[0].ravel() for h in heats if h is not None] or [np.zeros(0)])
    lengths = lengths[np.isfinite(lengths)]
    top = _round_above(float(np.percentile(lengths, 98))) if len(lengths) else 0.1
    heat_scale = Scale(low=0.0, high=top, stops=stops("warm"))
    cell_px = _cell_px([h[1] for h in heats if h is not None])
    cards, told = [], set[str]()
    for name, entry, heat in zip(names_of(devices), devices, heats, strict=True):
        panels = []
        arrows, count = _arrows(report, array, name, scale)
        if arrows:
            panels.append(figure(arrows, f"{count} residuals"))
            told.add("arrows")
        if heat is not None:
            words = f"mean residual over the sensor of {name}"
            panels.append(
                figure(heat_chart(*heat, heat_scale, words, 1.0 / cell_px), "mean residuals")
            )
            told.add("heat")
        covered, share = _coverage(entry, name)
        if covered:
            panels.append(figure(covered, f"covered: {share}"))
            told.add("coverage")
        if panels:
            cards.append(_card(name, entry, panels))
    if not cards:
        return ""
    legend = colour_scale(heat_scale.stops, 0.0, top, "mean residual, px") if "heat" in told else ""
    return _explained(told, scale, cell_px) + legend + f'<div class="cards">{"".join(cards)}</div>'


def device_table(report: Mapping[str, Any]) -> str:
    """One row a device, columns sorted at a click; below it, why frames were not used."""
    devices, marks = rows_of(report, "devices"), gate_marks(report)
    halves = mapping_of(mapping_of(report, "split_half"), "by_device")
    rows = []
    for name, entry in zip(names_of(devices), devices, strict=True):
        rows.append((name, marks.get(name, ""), _numbers(entry) | {
            "split-half, px": number_of(halves, name)
        }))  # fmt: skip
    used = [key for key in (rows[0][2] if rows else ()) if any(_known(r[2][key]) for r in rows)]
    head = "".join(_head(words) for words in ["device", *used])
    body = "".join(
        f'<tr><th scope="row" class="{level}">{escape(name)}</th>'
        f"{''.join(_cell(values[key], key) for key in used)}</tr>"
        for name, level, values in rows
    )
    out = (
        f'<div class="scroll"><table class="sortable"><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
    return out + _frames(devices)


def plain_numbers(devices: Sequence[Mapping[str, Any]]) -> str:
    """Every single number of each device as a table behind a line that opens it."""
    hidden = ("coverage", "heat")
    rows = [flattened({k: v for k, v in entry.items() if k not in hidden}) for entry in devices]
    head = list(dict.fromkeys(key for row in rows for key in row))
    cells = [["" if row.get(key) is None else row[key] for key in head] for row in rows]
    return folded("numbers by device", table(head, cells))


def _coverage(entry: Mapping[str, Any], name: str) -> tuple[str, str]:
    """The chart and the covered share in words; empty when the device tells none."""
    counts = table_of(entry, "coverage")
    if counts is None:
        return "", ""
    counts = np.nan_to_num(counts)
    top = max(float(np.percentile(counts, 90)), 1.0)
    chart = coverage_chart(counts, Scale(low=0.0, high=top, stops=BLUES), f"coverage of {name}")
    return chart, f"{100 * float((counts > 0).mean()):.0f} %"


def _vectors(vectors: Mapping[str, Any], name: str) -> Floats | None:
    rows = table_of(vectors, name)
    return rows if rows is not None and rows.shape[1] == 4 and np.isfinite(rows).all() else None


def _arrows(
    report: Mapping[str, Any], array: CameraArray | None, name: str, scale: float
) -> tuple[str, int]:
    """The chart and how many residuals it shows; empty when there are none of a known camera."""
    rows = _vectors(mapping_of(report, "residual_vectors"), name)
    size = next(((c.width, c.height) for c in array or () if c.name == name), None)
    if rows is None or size is None:
        return "", 0
    return arrow_chart(size, rows[:, :2], rows[:, 2:], scale, name), len(rows)


def _heat(entry: Mapping[str, Any]) -> tuple[Floats, Floats | None] | None:
    """Mean lengths (rows, columns) and mean residuals (rows, columns, 2) of a device, px."""
    heat = mapping_of(entry, "heat")
    lengths, dx, dy = (table_of(heat, key) for key in ("size_px", "dx_px", "dy_px"))
    if lengths is None or not np.isfinite(lengths).any():
        return None
    if dx is None or dy is None or not dx.shape == dy.shape == lengths.shape:
        return lengths, None
    return lengths, np.stack([dx, dy], axis=2)


def _cell_px(means: Sequence[Floats | None]) -> float:
    """The mean residual, px, that is drawn as long as a cell: a round one that few exceed."""
    sizes = [np.linalg.norm(m, axis=2).ravel() for m in means if m is not None]
    known = np.concatenate(sizes or [np.zeros(0)])
    known = known[np.isfinite(known)]
    top = float(np.percentile(known, 95)) if len(known) else 0.0
    return _round_above(top) if top > 0 else 1.0


def _card(name: str, entry: Mapping[str, Any], panels: Sequence[str]) -> str:
    told = [
        f"{number(number_of(entry, key))} {unit}"
        for key, unit in (("mean_reprojection_px", "px"), ("views", "views"))
        if np.isfinite(number_of(entry, key))
    ]
    words = f" <span>{escape(', '.join(told))}</span>" if told else ""
    return (
        f'<div class="card"><h4>{escape(name)}{words}</h4>'
        f'<div class="panels">{"".join(panels)}</div></div>'
    )


def _explained(told: set[str], scale: float, cell_px: float) -> str:
    parts = {
        "arrows": f"Blue lines: residual vectors, {scale:g} times enlarged.",
        "heat": (
            "Colours: the mean length of the residuals in each part of the sensor. Arrows on "
            f"them, from the dots: their mean; one as long as a cell is {number(cell_px)} px. "
            "Arrows that agree with their neighbours show a lens that the model does not describe."
        ),
        "coverage": "Blue cells: how often the board was seen in each part; grey ones, never.",
    }
    return f"<p>{escape(' '.join(parts[key] for key in parts if key in told))}</p>"


def _numbers(entry: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of a device: numbers, or words; NaN where it is not known."""
    sigmas, tilts = mapping_of(entry, "sigmas"), mapping_of(entry, "tilts_deg")
    focal = number_of(sigmas, "fx_px")
    sides = [number_of(tilts, side) for side in _SIDES]
    covered = number_of(entry, "covered")
    return {
        "views": number_of(entry, "views"),
        "corners": number_of(entry, "corners_used"),
        "rejected": number_of(entry, "corners_rejected"),
        "residual, px": number_of(entry, "mean_reprojection_px"),
        "covered, %": 100 * covered,
        "focal, px": number_of(entry, "fx_px"),
        "focal ±, px": focal if np.isfinite(focal) else number_of(entry, "fx_sigma_px"),
        f"place ±, {MICRO}": length_of(sigmas, "place_um"),
        "turn ±, mdeg": length_of(sigmas, "turn_mdeg"),
        "tilts left, right, up, down, deg": (
            ", ".join("-" if value != value else f"{value:.0f}" for value in sides)
            if np.isfinite(sides).any()
            else float("nan")
        ),
    }


def length_of(entry: Mapping[str, Any], key: str) -> float:
    """The length of a vector of three under a key; NaN when there is none."""
    vector = vector_of(entry, key)
    return float("nan") if vector is None else float(np.linalg.norm(vector))


def _known(value: Any) -> bool:
    return isinstance(value, str) or bool(np.isfinite(value))


def _head(words: str) -> str:
    button = f'<button type="button" disabled>{escape(words)}</button>'
    return f'<th scope="col">{button}</th>'


def _cell(value: Any, key: str) -> str:
    if isinstance(value, str):
        return f"<td>{escape(value)}</td>"
    if not np.isfinite(value):
        return '<td class="num" data-value=""></td>'
    shown = f"{value:.1f}" if key == "focal, px" else number(value)
    level = level_of(value, *RESIDUAL_PX) if key == "residual, px" else "good"
    marked = f" {level}" if level != "good" else ""
    return f'<td class="num{marked}" data-value="{float(value):.9g}">{shown}</td>'


def _frames(devices: Sequence[Mapping[str, Any]]) -> str:
    told = [mapping_of(entry, "frames") for entry in devices]
    head = list(dict.fromkeys(str(key) for row in told for key in row))
    if not head:
        return ""
    rows = [[name, *(row.get(key, 0) for key in head)] for name, row in zip(
        names_of(devices), told, strict=True
    )]  # fmt: skip
    return folded("how many frames each device used, and why not the others",
                  table(["device", *head], rows))  # fmt: skip


def _round_below(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(m * power for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)))


def _round_above(value: float) -> float:
    if value <= 0:
        return 0.1
    power = 10.0 ** np.floor(np.log10(value))
    return float(min(m * power for m in (1, 2, 5, 10) if m * power >= value * (1 - 1e-9)))
