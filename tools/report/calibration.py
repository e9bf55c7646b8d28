"""The calibration: residuals by camera, residual arrows, coverage, the held-out ratio, warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tools.report.charts import Labels, Series, arrow_chart, bar_chart, line_chart
from tools.report.inputs import ReportInputs
from tools.report.page import Section, Verdict, facts, figure, flattened, folded, gallery, table
from tools.report.svg import PALETTE, drawing, element, escape, number

_GOOD_PX, _FAIR_PX = 0.25, 0.6
_GOOD_RATIO, _FAIR_RATIO = 1.15, 1.5
_ARROW_PX = 40.0  # length of a drawn residual at the 95th percentile, px of the image
_UNLISTED = ("devices", "poses", "residual_vectors", "warnings")


def calibration_section(inputs: ReportInputs) -> list[Section]:
    """What the calibration says of itself; nothing when it says nothing."""
    report = inputs.calibration_report
    if not report:
        return []
    devices = [entry for entry in report.get("devices", []) if isinstance(entry, Mapping)]
    parts = [_warnings(report), facts(_top_numbers(report))]
    if devices:
        parts.append(_residual_bars(devices))
    coverage = [_coverage(entry) for entry in devices if "coverage" in entry]
    if coverage:
        parts.append("<h3>Where the board has been in each image</h3>" + gallery(coverage, "small"))
    scale = _arrow_scale(report)
    arrows = _arrows(report, inputs, scale)
    if arrows:
        words = f"Residual vectors, {scale:g} times enlarged"
        parts.append(f"<h3>{escape(words)}</h3>" + gallery(arrows, "small"))
    poses = [entry for entry in report.get("poses", []) if isinstance(entry, Mapping)]
    if poses:
        parts.append(_pose_chart(poses))
    if devices:
        rows = [_plain(entry) for entry in devices]
        head = list(dict.fromkeys(key for row in rows for key in row))
        cells = [[row.get(key, "") for key in head] for row in rows]
        parts.append(folded("numbers by device", table(head, cells)))
    return [
        Section(
            anchor="calibration",
            title="Calibration",
            body="".join(parts),
            verdicts=calibration_verdicts(report),
        )
    ]


def calibration_verdicts(report: Mapping[str, Any]) -> tuple[Verdict, ...]:
    """On the residual, on the held-out ratio, and on the calibration's own warnings."""
    out = []
    rms = _number(report, "mean_reprojection_px")
    if np.isfinite(rms):
        words = f"mean board residual {number(rms)} px"
        level = _level(rms, _GOOD_PX, _FAIR_PX)
        out.append(Verdict(level=level, subject="Calibration:", words=words))
    held_out = report.get("held_out")
    ratio = _number(held_out, "ratio") if isinstance(held_out, Mapping) else float("nan")
    if np.isfinite(ratio):
        words = f"held-out ratio {ratio:.2f} (residual on unused poses over used ones)"
        level = _level(ratio, _GOOD_RATIO, _FAIR_RATIO)
        out.append(Verdict(level=level, subject="Calibration:", words=words))
    warnings = report.get("warnings")
    if isinstance(warnings, list) and warnings:
        words = (
            str(warnings[0]) if len(warnings) == 1 else f"{len(warnings)} warnings: {warnings[0]}"
        )
        out.append(Verdict(level="warn", subject="Calibration:", words=words))
    return tuple(out)


def _warnings(report: Mapping[str, Any]) -> str:
    warnings = report.get("warnings")
    if not isinstance(warnings, list) or len(warnings) < 2:
        return ""
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in warnings) + "</ul>"


def _top_numbers(report: Mapping[str, Any]) -> dict[str, object]:
    flat = flattened({key: value for key, value in report.items() if key not in _UNLISTED})
    plain = {name: value for name, value in flat.items() if isinstance(value, (int, float))}
    return {name.replace("_", " ").replace(".", ", "): value for name, value in plain.items()}


def _residual_bars(devices: Sequence[Mapping[str, Any]]) -> str:
    values = [_number(entry, "mean_reprojection_px") for entry in devices]
    names = [str(entry.get("name", index)) for index, entry in enumerate(devices)]
    levels = [_level(value, _GOOD_PX, _FAIR_PX) for value in values]
    labels = Labels(title="residual by device", x="mean reprojection error, px")
    limit = (_GOOD_PX, f"{_GOOD_PX:g} px") if max(values, default=0.0) > 0.5 * _GOOD_PX else None
    chart = bar_chart(names, values, labels, levels=levels, limit=limit)
    return figure(chart, "Board residuals; one high bar is one bad lens, focus or trigger.")


def _coverage(entry: Mapping[str, Any]) -> str:
    grid = np.array(entry["coverage"], dtype=np.float64)
    top = max(float(np.percentile(grid, 90)), 1.0)
    step = 110.0 / grid.shape[1]
    cells = [
        element(
            "rect", x=step * column, y=step * row, width=step - 0.6, height=step - 0.6,
            fill="#e8ebee" if count == 0 else PALETTE[0],
            fill_opacity=None if count == 0 else min(1.0, 0.25 + 0.75 * count / top),
        )
        for row, line in enumerate(grid.tolist())
        for column, count in enumerate(line)
    ]  # fmt: skip
    name = str(entry.get("name", ""))
    chart = drawing(110.0, step * grid.shape[0], "".join(cells), f"coverage of {name}")
    covered = 100.0 * float((grid > 0).mean())
    return figure(chart, f"{name}, {covered:.0f} %")


def _pose_chart(poses: Sequence[Mapping[str, Any]]) -> str:
    line = Series(
        name="mean residual",
        x=[float(entry["frame"]) for entry in poses],
        y=[_number(entry, "mean_reprojection_px") for entry in poses],
    )
    labels = Labels(title="residual by board pose", x="frame of the board take", y="residual, px")
    return figure(line_chart([line], labels, height=150.0), "A peak is a board that moved.")


def _arrow_scale(report: Mapping[str, Any]) -> float:
    """A round enlargement at which a long residual is easy to see and no arrow crosses another."""
    vectors = report.get("residual_vectors")
    if not isinstance(vectors, Mapping):
        return 1.0
    rows = [row for device in vectors.values() for row in device]
    sizes = [float(np.hypot(row[2], row[3])) for row in rows if len(row) == 4]
    long_px = float(np.percentile(sizes, 95)) if sizes else 0.0
    if long_px <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(_ARROW_PX / long_px))
    return float(max(m * power for m in (1, 2, 5) if m * power <= _ARROW_PX / long_px))


def _arrows(report: Mapping[str, Any], inputs: ReportInputs, scale: float) -> list[str]:
    array, vectors = inputs.array, report.get("residual_vectors")
    if array is None or not isinstance(vectors, Mapping):
        return []
    out = []
    for camera in array:
        values = np.array(vectors.get(camera.name, []), dtype=np.float64)
        if values.ndim != 2 or values.shape[1] != 4:
            continue
        size = (camera.width, camera.height)
        chart = arrow_chart(size, values[:, :2], values[:, 2:], scale, camera.name)
        out.append(figure(chart, f"{camera.name}, {len(values)} corners"))
    return out


def _plain(entry: Mapping[str, Any]) -> dict[str, object]:
    return flattened({key: value for key, value in entry.items() if key != "coverage"})


def _number(entry: Mapping[str, Any], key: str) -> float:
    value = entry.get(key)
    good = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if good else float("nan")  # type: ignore[arg-type]


def _level(value: float, good: float, fair: float) -> str:
    if not np.isfinite(value):
        return "none"
    return "good" if value <= good else "warn" if value <= fair else "bad"
