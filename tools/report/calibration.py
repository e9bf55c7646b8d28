"""The calibration in the report of a take: the gate, key numbers, residuals, coverage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import numpy as np

from tools.report.calibration_devices import (
    arrow_figures,
    arrow_scale,
    coverage_figures,
    plain_numbers,
    residual_bars,
)
from tools.report.calibration_gate import (
    RATIO,
    RESIDUAL_PX,
    gate_reasons,
    gate_verdict,
    key_numbers,
    level_of,
    other_numbers,
)
from tools.report.calibration_keys import mapping_of, number_of, rows_of, words_of
from tools.report.charts import Labels, Series, line_chart
from tools.report.inputs import ReportInputs
from tools.report.page import Section, Verdict, figure, gallery
from tools.report.svg import escape, number


def calibration_section(inputs: ReportInputs) -> list[Section]:
    """What the calibration says of itself, in short; nothing when it says nothing."""
    report = inputs.calibration_report
    if not report:
        return []
    devices, poses = rows_of(report, "devices"), rows_of(report, "poses")
    parts = [calibration_style(), gate_reasons(report), remarks(report)]
    parts += [key_numbers(report), other_numbers(report)]
    if devices:
        parts.append(residual_bars(devices))
    coverage = coverage_figures(devices)
    if coverage:
        parts.append("<h3>Where the board has been in each image</h3>" + gallery(coverage, "small"))
    arrows = arrow_figures(report, inputs.array)
    if arrows:
        words = f"Residual vectors, {arrow_scale(report, inputs.array):g} times enlarged"
        parts.append(f"<h3>{escape(words)}</h3>" + gallery(arrows, "small"))
    if poses:
        parts.append(pose_chart(poses))
    if devices:
        parts.append(plain_numbers(devices))
    return [
        Section(
            anchor="calibration",
            title="Calibration",
            body="".join(parts),
            verdicts=calibration_verdicts(report),
        )
    ]


def calibration_verdicts(report: Mapping[str, Any]) -> tuple[Verdict, ...]:
    """The gate's; of an older report, on the residual, the held-out ratio, and its warnings."""
    gate = gate_verdict(report)
    if gate is not None:
        return (gate,)
    out = []
    rms = number_of(report, "mean_reprojection_px")
    if np.isfinite(rms):
        words = f"mean board residual {number(rms)} px"
        level = level_of(rms, *RESIDUAL_PX)
        out.append(Verdict(level=level, subject="Calibration:", words=words))
    ratio = number_of(mapping_of(report, "held_out"), "ratio")
    if np.isfinite(ratio):
        words = f"held-out ratio {ratio:.2f} (residual on unused poses over used ones)"
        level = level_of(ratio, *RATIO)
        out.append(Verdict(level=level, subject="Calibration:", words=words))
    warnings = words_of(report, "warnings")
    if warnings:
        words = warnings[0] if len(warnings) == 1 else f"{len(warnings)} warnings: {warnings[0]}"
        out.append(Verdict(level="warn", subject="Calibration:", words=words))
    return tuple(out)


def remarks(report: Mapping[str, Any]) -> str:
    """The calibration's own warnings that neither its gate nor a verdict has told, as a list."""
    reasons = rows_of(mapping_of(report, "gate"), "reasons")
    told = {str(reason.get("words")) for reason in reasons}
    told |= {f"{reason.get('device')}: {reason.get('words')}" for reason in reasons}
    lines = [line for line in words_of(report, "warnings") if line not in told]
    if not lines or (gate_verdict(report) is None and len(lines) < 2):
        return ""
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def pose_chart(poses: Sequence[Mapping[str, Any]]) -> str:
    """The mean residual of each board pose over the frames of the take."""
    known = [entry for entry in poses if np.isfinite(number_of(entry, "frame"))]
    line = Series(
        name="mean residual",
        x=[number_of(entry, "frame") for entry in known],
        y=[number_of(entry, "mean_reprojection_px") for entry in known],
    )
    labels = Labels(title="residual by board pose", x="frame of the board take", y="residual, px")
    return figure(line_chart([line], labels, height=150.0), "A peak is a board that moved.")


def calibration_style() -> str:
    """The styles of what only a calibration shows."""
    source = resources.files("tools.report").joinpath("calibration_page.css")
    return f"<style>{source.read_text(encoding='utf-8')}</style>"
