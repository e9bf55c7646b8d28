"""The page of a drift check: what has moved, by how much, against which limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tools.report.charts import Labels, bar_chart
from tools.report.page import Section, Verdict, facts, figure, folded, table, write_page
from tools.report.svg import escape

_LEVELS = {"still": "good", "moved": "bad", "lens": "bad", "unchecked": "none"}
_HEAD = {
    "device": "name", "verdict": "verdict", "poses": "views", "corners": "corners",
    "shift um": "shift_um", "sigma um": "shift_sigma_um", "turn mdeg": "turn_mdeg",
    "sigma mdeg": "turn_sigma_mdeg", "in the image px": "effect_px", "significance": "significance",
    "focal change px": "focal_change_px", "sigma px": "focal_sigma_px", "noise px": "sigma_px",
    "residual before px": "before_px", "after px": "after_px",
}  # fmt: skip


def write_drift_page(document: Mapping[str, Any], out: Path) -> Path:
    """Write the page of a drift check.

    Args:
        document: `DriftReport.document()`, with the names of the take and the cameras.
        out: the file.
    """
    lead = f"{document.get('take', '')} against {document.get('cameras', '')}"
    sections = [_verdict(document), _motions(document["devices"], document["limits"])]
    write_page("Drift check", f'<p class="lead">{escape(lead)}</p>', sections, Path(out))
    return Path(out)


def _verdict(document: Mapping[str, Any]) -> Section:
    level = "good" if document["verdict"] == "still" else "bad"
    first, *rest = document["words"]
    verdicts = [Verdict(level=level, subject="Array:", words=first)]
    verdicts += [Verdict(level="warn", subject="Array:", words=line) for line in rest]
    after = document.get("after")
    body = ""
    if after is not None:
        solved = ", ".join(after["resolved"]) or "nothing"
        body += f"<p>{escape(f'Solved anew: {solved}. Then: ' + after['headline'])}</p>"
    numbers = {
        "board poses": document["poses"],
        "noise of a corner, px": document["sigma_px"],
        "scatter over noise": document["inflation"],
        "growth, parts in a million": document["growth_ppm"],
        "sigma of it": document["growth_sigma_ppm"],
    }
    return Section(
        anchor="verdict",
        title="Verdict",
        body=body + facts(numbers),
        verdicts=tuple(verdicts),
    )


def _motions(devices: Sequence[Mapping[str, Any]], limits: Mapping[str, float]) -> Section:
    names = [str(device["name"]) for device in devices]
    levels = [_LEVELS[device["verdict"]] for device in devices]
    parts = []
    for key, title, axis, words in (
        ("effect_px", "motion in the image", "rms displacement of the corners by the motion, px",
         "How far the motion of a device displaces what it sees. A device counts as moved when it "
         "passes this limit and the next."),
        ("significance", "significance", "distance of the motion from none, in its deviations",
         "Noise alone gives 1 to 4."),
    ):  # fmt: skip
        limit = float(limits[key])
        chart = bar_chart(
            names, _column(devices, key), Labels(title=title, x=axis), levels=levels,
            limit=(limit, f"{limit:g}"),
        )  # fmt: skip
        parts.append(figure(chart, words))
    for key, title, axis in (
        ("shift", "shift by device", "shift of the centre, um"),
        ("turn", "turn by device", "turn, mdeg"),
    ):
        unit = "um" if key == "shift" else "mdeg"
        chart = bar_chart(
            names, _column(devices, f"{key}_{unit}"), Labels(title=title, x=axis), levels=levels,
            marks=_column(devices, f"{key}_sigma_{unit}"),
        )  # fmt: skip
        parts.append(
            figure(
                chart,
                "Ticks: one standard deviation. A shift and a turn that look alike in the image "
                "are told apart badly; both may be large where the image hardly moves.",
            )
        )
    rows = [[device[key] for key in _HEAD.values()] for device in devices]
    parts.append(folded("numbers by device", table(list(_HEAD), rows)))
    return Section(anchor="devices", title="Devices", body="".join(parts))


def _column(devices: Sequence[Mapping[str, Any]], key: str) -> list[float]:
    return [float("nan") if device[key] is None else float(device[key]) for device in devices]
