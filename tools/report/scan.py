"""The page of a take's scans: what to worry about, then each frame in pictures and numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.camera import CameraArray
from capture.take import Take
from recon.point_file import read_points
from recon.surface import Scan, read_ply
from tools.report.charts import Labels, Series, bar_chart, line_chart
from tools.report.inputs import json_object
from tools.report.page import Section, Verdict, facts, figure, folded, table, write_page
from tools.report.scan_charts import coverage_matrix, reason_bars
from tools.report.scan_pictures import depth_thumbnails, scan_pictures
from tools.report.scan_remarks import gathered, warnings_told
from tools.report.svg import escape, number

_SHOWN = 6  # frames with pictures
_TOLD = 12  # warnings in words
_FACTS = {
    "vertices": "vertices",
    "points": "points",
    "agreement_median_mm": "agreement of pairs, median mm",
    "agreement_p95_mm": "agreement of pairs, 95 % mm",
    "footprint_mm": "a pixel covers, mm",
    "matched_share": "share of textured pixels matched",
    "support_median": "pairs behind a point, median",
    "lone_share": "points that one pair alone saw, share",
    "unconfirmed_share": "matched pixels off the scan, share",
}
_PAIRS = ("left", "right", "angle, degrees", "share matched")
_COLUMNS = {
    "name": "device",
    "pairs": "pairs",
    "matched_share": "matched",
    "unconfirmed_share": "off the scan",
    "covered_share": "skin covered",
    "deviation_px": "off the others, px",
    "deviation_mm": "as depth, mm",
    "sharpness": "sharpness",
    "clipped_share": "clipped skin",
    "gain": "brightness",
}


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """A frame on disk: its surface and what was said of it."""

    frame: int
    path: Path
    told: Mapping[str, Any]

    @property
    def warnings(self) -> list[str]:
        """Sentences; none when the scan is older than they are."""
        return warnings_told(self.told)

    def surface(self) -> Scan:
        """The mesh, or the points when there is none."""
        points = self.path.name.startswith("points_")
        return read_points(self.path) if points else read_ply(self.path)


def write_scan_report(take: Take, frames: Sequence[int], out: Path) -> list[str]:
    """Write the page of some frames of a take as one HTML file that needs nothing else.

    Args:
        take: with cameras and the products of `likeness recon`.
        frames: what was asked for; those without a scan are named.
        out: the file.

    Returns:
        The warnings at the top of the page.
    """
    cameras = take.cameras()
    found = [entry for frame in frames if (entry := _found(take, frame)) is not None]
    absent = sorted(set(frames) - {entry.frame for entry in found})
    warnings = _gathered(found)
    verdicts = [
        Verdict(level="bad", subject=f"Frame {frame}:", words="no scan was made of it")
        for frame in absent[:_TOLD]
    ]
    verdicts += [Verdict(level="warn", subject="", words=words) for words in warnings[:_TOLD]]
    if len(warnings) > _TOLD:
        words = f"{len(warnings) - _TOLD} more: see the frames"
        verdicts.append(Verdict(level="warn", subject="", words=words))
    if found and not verdicts:
        verdicts.append(_praise(found))
    sections = [
        Section(
            anchor="frames", title="All frames", body=_overview(found), verdicts=tuple(verdicts)
        )
    ]
    shown = _worth_seeing(found)
    sections += [_section(entry, cameras) for entry in shown]
    lead = (
        f'<p class="lead">{len(found)} of {len(frames)} frames, {len(cameras)} cameras'
        f"{f'; {len(shown)} frames are shown in full' if len(shown) < len(found) else ''}</p>"
    )
    write_page(f"Scans of {take.name}", lead, sections, out)
    return warnings


def _found(take: Take, frame: int) -> _Frame | None:
    folder = take.products / "recon"
    paths = [folder / f"{kind}_{frame:04d}.ply" for kind in ("frame", "points")]
    there = [path for path in paths if path.is_file()]
    if not there:
        return None
    newest = max(there, key=lambda path: path.stat().st_mtime_ns)
    return _Frame(frame=frame, path=newest, told=json_object(newest.with_suffix(".json")))


def _gathered(frames: Sequence[_Frame]) -> list[str]:
    """Warnings of all frames; those alike but for their numbers are one, with the frames named."""
    remarks = gathered({entry.frame: entry.warnings for entry in frames})
    if len(frames) == 1:
        return [remark.words for remark in remarks]
    return [f"{remark.words} ({_frames_in_words(remark.frames)})" for remark in remarks]


def _frames_in_words(frames: Sequence[int]) -> str:
    if len(frames) == 1:
        return f"frame {frames[0]}"
    if len(frames) <= 4:
        return f"frames {', '.join(map(str, frames))}"
    return f"{len(frames)} frames, the first of them {frames[0]}"


def _praise(frames: Sequence[_Frame]) -> Verdict:
    values = [entry.told.get("agreement_median_mm") for entry in frames]
    known = [float(value) for value in values if isinstance(value, (int, float))]
    words = (
        f"pairs of views agree to {number(float(np.median(known)))} mm (median); no device stands "
        "out"
        if known
        else "no warnings"
    )
    return Verdict(level="good", subject="Scans:", words=words)


def _worth_seeing(frames: Sequence[_Frame]) -> list[_Frame]:
    """At most a few frames in order: half those with the most warnings, the rest spread out."""
    if len(frames) <= _SHOWN:
        return list(frames)
    worst = sorted(frames, key=lambda entry: -len(entry.warnings))[: _SHOWN // 2]
    places = np.rint(np.linspace(0, len(frames) - 1, _SHOWN - len(worst))).astype(int)
    chosen = {entry.frame for entry in worst if entry.warnings} | {frames[p].frame for p in places}
    return [entry for entry in frames if entry.frame in chosen]


def _overview(frames: Sequence[_Frame]) -> str:
    if not frames:
        return "<p>Nothing was reconstructed.</p>"
    rows = [
        [
            entry.frame,
            *(_value(entry.told, key) for key in _FACTS),
            ", ".join(entry.told.get("missing", [])) or "none",
            len(entry.warnings),
        ]
        for entry in frames
    ]
    whole = table(["frame", *_FACTS.values(), "missing devices", "warnings"], rows)
    if len(frames) < 3:
        return whole
    x = [float(entry.frame) for entry in frames]
    charts = [
        _curve(x, frames, "agreement of pairs, mm", ("agreement_median_mm", "agreement_p95_mm")),
        _curve(x, frames, "share of textured pixels matched", ("matched_share",)),
        _curve(x, frames, "points", ("points",)),
    ]
    return "".join(charts) + folded("every frame in numbers", whole)


def _curve(x: Sequence[float], frames: Sequence[_Frame], words: str, keys: Sequence[str]) -> str:
    series = [
        Series(name=_FACTS[key], x=x, y=[_number(entry.told.get(key)) for entry in frames])
        for key in keys
    ]
    chart = line_chart(series, Labels(title=words, x="frame", y=words), height=150.0)
    return figure(chart, f"{words[:1].upper()}{words[1:]}, over the frames.")


def _section(entry: _Frame, cameras: CameraArray) -> Section:
    told, surface = entry.told, entry.surface()
    missing = [str(name) for name in told.get("missing", [])]
    names = [camera.name for camera in cameras if camera.name not in missing]
    values: dict[str, object] = {words: _value(told, key) for key, words in _FACTS.items()}
    values["missing devices"] = ", ".join(missing) or "none"
    parts = [facts(values), scan_pictures(surface, cameras)]
    parts.append(_cameras_table(told))
    pairs = [pair for pair in told.get("pairs", []) if isinstance(pair, Mapping)]
    if pairs:
        caption = "Share of each pair's crop that was matched, percent; red matched nothing."
        parts.append(figure(coverage_matrix(names, pairs), caption))
        head = ["left", "right", "angle_deg", "coverage"]
        rows = [[_value(pair, key) for key in head] for pair in pairs]
        parts.append(folded(f"{len(pairs)} pairs with their angles", table(_PAIRS, rows)))
    reasons = [counts for counts in told.get("pair_reasons", []) if isinstance(counts, Mapping)]
    if pairs and reasons:
        caption = "What became of the pixels of each device's pairs; the number is what matched."
        parts.append(figure(reason_bars(names, pairs, reasons), caption))
    parts.append(_rejected(told))
    thumbs = depth_thumbnails(surface, cameras)
    if thumbs:
        parts.append(f"<h3>Depth in each view</h3>{thumbs}")
    parts.append(_seconds(told))
    verdicts = tuple(Verdict(level="warn", subject="", words=words) for words in entry.warnings)
    body = "".join(parts)
    if verdicts:  # the summary at the top has them already, gathered over the frames
        lines = "".join(f"<li>{escape(verdict.words)}</li>" for verdict in verdicts)
        body = f"<ul>{lines}</ul>{body}"
    return Section(anchor=f"frame-{entry.frame:04d}", title=f"Frame {entry.frame}", body=body)


def _cameras_table(told: Mapping[str, Any]) -> str:
    rows = [row for row in told.get("cameras_report", []) if isinstance(row, Mapping)]
    if not rows:
        return ""
    cells = [
        [
            *(_value(row, key) for key in _COLUMNS),
            "; ".join(str(words) for words in row.get("warnings", [])),
        ]
        for row in rows
    ]
    return table([*_COLUMNS.values(), "remarks"], cells)


def _rejected(told: Mapping[str, Any]) -> str:
    """Why points of single pairs are not in the scan; empty when nothing was said of it."""
    rejected = told.get("rejected")
    if not isinstance(rejected, Mapping) or not rejected:
        return ""
    names = [str(name).replace("_", " ") for name in rejected]
    values = [_number(value) for value in rejected.values()]
    labels = Labels(title="points not taken into the scan", x="points of single pairs")
    chart = bar_chart(names, values, labels)
    return figure(chart, "Points of single pairs that were not taken into the scan, by reason.")


def _seconds(told: Mapping[str, Any]) -> str:
    seconds = told.get("seconds")
    if not isinstance(seconds, Mapping) or not seconds:
        return ""
    labels = Labels(title="seconds by step", x="seconds of wall clock")
    values = [_number(value) for value in seconds.values()]
    return figure(bar_chart([str(name) for name in seconds], values, labels), "Time by step.")


def _value(told: Mapping[str, Any], key: str) -> object:
    value = told.get(key)
    return "" if value is None else value


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else float("nan")
