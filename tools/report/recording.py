"""The recording of each take: verdict, ledger, synchronization, clocks, image levels."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from capture.calibration_link import calibration_standing, read_link
from capture.judgement import Colour, judge
from capture.ledger import Ledger, read_ledger
from capture.ledger import Verdict as Fate
from capture.take import Take
from tools.report.charts import Labels, bar_chart, matrix_chart
from tools.report.inputs import ReportInputs, TakeInputs
from tools.report.page import Section, Verdict, facts, figure, folded, table
from tools.report.svg import escape
from tools.report.sync import sync_facts, sync_part, sync_verdict

_FATES = {
    Fate.OK: "#9fd3b8",
    Fate.INCOMPLETE: "#e69f00",
    Fate.LOST: "#d55e00",
    Fate.MISSED_TRIGGER: "#7b3294",
    Fate.QUARANTINED: "#cc79a7",
    Fate.MISSING: "#222831",
}
_LEVELS = {Colour.GREEN: "good", Colour.AMBER: "warn", Colour.RED: "bad"}
_LOOKS = 3  # frames looked at for image levels
_STEP = 4  # every fourth pixel of every fourth row is enough for a mean


def capture_section(inputs: ReportInputs) -> list[Section]:
    """Each take's ledger as a matrix of triggers and devices, its sync, its clocks, its levels."""
    verdicts, linked = calibration_link(inputs)
    parts: list[str] = []
    rows: list[dict[str, object]] = []
    for item in inputs.takes:
        path = item.folder / "ledger.csv"
        if not path.is_file():
            continue
        ledger = read_ledger(path)
        verdict = take_verdict(item.take, ledger)
        verdicts.append(verdict)
        remarks = item.take.manifest.remarks
        sync = sync_verdict(item.take.name, remarks)
        if sync is not None and sync.level != "good":
            verdicts.append(sync)
        rows.append({"take": item.take.name} | _facts(item, ledger))
        chart = figure(
            _matrix(item.take.name, ledger),
            "Every trigger of every device has exactly one verdict.",
        )
        chart += sync_part(item.take.name, remarks, ledger)
        devices = _devices(item.take)
        good = verdict.level == "good" and (sync is None or sync.level == "good")
        if good and len(inputs.takes) > 1:
            parts.append(folded(f"{item.take.name}: ledger, sync, levels, clocks", chart + devices))
        else:
            inner = folded("levels and clocks of the devices", devices)
            parts.append(f"<h3>{escape(item.take.name)}</h3>{chart}{inner}")
    if not rows:
        return []
    head = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[row.get(key, "") for key in head] for row in rows]
    body = table(head, cells) + linked + "".join(parts)
    return [Section(anchor="capture", title="Capture", body=body, verdicts=tuple(verdicts))]


def calibration_link(inputs: ReportInputs) -> tuple[list[Verdict], str]:
    """Which calibration the session of the takes uses and how old it was: verdict and HTML."""
    for item in inputs.takes:
        session = item.folder.resolve().parent.parent
        if not (session / "session.json").is_file():
            continue
        link = read_link(session)
        if link is None:
            continue
        began = datetime.fromisoformat(link.linked)
        standing = calibration_standing(session, item.take.device_names, now=began)
        verdict = Verdict(
            level=_LEVELS[standing.colour], subject="Calibration of the session:",
            words=f"{standing.sentence} {standing.remedy}".strip(),
        )  # fmt: skip
        values: dict[str, object] = {
            "calibration": link.id,
            "made": link.made,
            "age when linked, days": link.age_days(began),
            "cameras": len(link.devices),
            "pictures of calibration day": link.has_reference,
            "from": Path(link.source).name,
        }
        told = [] if standing.colour == Colour.GREEN else [verdict]
        return told, f"<h3>Calibration of the session</h3>{facts(values)}"
    return [], ""


def take_verdict(take: Take, ledger: Ledger) -> Verdict:
    """The operator's verdict that the recorder gave, or that the ledger gives."""
    subject = f"Capture of {take.name}:"
    told = take.manifest.remarks.get("judgement")
    if isinstance(told, Mapping) and told.get("colour") in list(Colour):
        level = _LEVELS[Colour(told["colour"])]
        return Verdict(level=level, subject=subject, words=str(told.get("sentence", "")))
    judgement = judge(ledger)
    return Verdict(level=_LEVELS[judgement.colour], subject=subject, words=judgement.sentence)


def image_levels(take: Take) -> dict[str, tuple[float, float]]:
    """By device, the mean level and the saturated share of a few frames, both 0..1."""
    frames = take.frames
    picked = sorted({frames[0], frames[len(frames) // 2], frames[-1]})[:_LOOKS]
    out = {}
    for device in take.device_names:
        seen = [
            take.image(device, frame)[::_STEP, ::_STEP]
            for frame in picked
            if take.present(device, frame)
        ]
        if seen:
            white = float(np.iinfo(seen[0].dtype).max)
            pixels = np.stack(seen) / white
            out[device] = (float(pixels.mean()), float((pixels >= 0.999).mean()))
    return out


def _matrix(name: str, ledger: Ledger) -> str:
    words = {fate: fate.value.replace("_", " ") for fate in Fate}
    rows = [
        [words[ledger.entry(k, device).verdict] for k in range(ledger.triggers)]
        for device in ledger.devices
    ]
    labels = Labels(title=f"ledger of {name}", x="trigger index")
    colours = {words[fate]: colour for fate, colour in _FATES.items()}
    return matrix_chart(ledger.devices, rows, colours, labels)


def _facts(item: TakeInputs, ledger: Ledger) -> dict[str, object]:
    manifest = item.take.manifest
    values: dict[str, object] = {"devices": len(ledger.devices), "triggers": ledger.triggers}
    if manifest.period_ns:
        values["rate, frames/s"] = 1e9 / manifest.period_ns
    exposure = _part(manifest.remarks, "settings").get("exposure_us")
    if exposure is not None:
        values["exposure, us"] = exposure
    spread = _part(manifest.remarks, "judgement").get("spread_ns")
    sync = sync_facts(manifest.remarks)
    if sync:
        values |= sync
    elif isinstance(spread, int) and spread >= 0:
        values["spread, us"] = spread / 1000.0
    for fate, count in ledger.counts().items():
        if count:
            values[f"{fate.value.replace('_', ' ')}"] = count
    if ledger.remarks:
        values["oddities"] = len(ledger.remarks)
    return values


def _devices(take: Take) -> str:
    levels = image_levels(take)
    names = list(levels)
    means = [levels[name][0] for name in names]
    labels = Labels(title="image levels", x="mean level, share of full scale")
    middle = float(np.median(means)) if means else float("nan")
    chart = bar_chart(names, means, labels, limit=(middle, "median") if means else None)
    clocks = _part(take.manifest.remarks, "clocks")
    head = ["device", "level / median", "saturated, %"]
    head += ["clock offset, s", "clock drift, ppm", "clock jitter, us"] if clocks else []
    rows: list[list[object]] = []
    for name in names:
        mean, saturated = levels[name]
        row: list[object] = [name, mean / middle if middle > 0 else 0.0, 100.0 * saturated]
        if clocks:
            clock = _part(clocks, name)
            row += [
                _scaled(clock.get("offset_ns"), 1e-9),
                _scaled(clock.get("drift_ppm"), 1.0),
                _scaled(clock.get("jitter_ns"), 1e-3),
            ]
        rows.append(row)
    return chart + table(head, rows)


def _scaled(value: object, factor: float) -> object:
    good = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) * factor if good else ""  # type: ignore[arg-type]


def _part(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = document.get(key)
    return value if isinstance(value, Mapping) else {}
