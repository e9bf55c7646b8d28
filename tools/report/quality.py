"""The quality of tracking, frame by frame: confidence, what the stage reports, errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from capture.arrays import Floats
from tools.report.charts import Labels, Series, line_chart
from tools.report.inputs import ReportInputs, TakeInputs
from tools.report.page import Section, Verdict, facts, figure, folded
from tools.report.svg import escape, number
from track.performance import Performance

_UNITS = ("px", "mm", "ms", "s", "deg")
_FRONT = ("correlation", "ncc", "residual", "reproj", "sample", "views")  # shown before the rest
_OPEN = 4  # curves shown open; the rest is folded away
_GOOD_RMS_MM, _FAIR_RMS_MM = 0.6, 1.2
_GOOD_SEEN, _FAIR_SEEN = 0.35, 0.15  # share of vertices that are followed surely, worst frame


def quality_section(inputs: ReportInputs) -> list[Section]:
    """Per-frame curves of every tracked take, and a verdict on each."""
    parts: list[str] = []
    verdicts: list[Verdict] = []
    for item in inputs.takes:
        if item.performance is None:
            continue
        performance = item.performance
        frames = [float(frame) for frame in performance.frames]
        parts.append(f"<h3>{escape(item.take.name)}</h3>")
        parts.append(facts(_facts(performance)))
        charts = [_confidence_chart(performance, frames)]
        charts += [
            _series_chart(name, frames, values)
            for name, values in per_frame(item.track_report, len(frames)).items()
        ]
        if told_errors(item).size:
            charts.insert(0, _error_chart(item, frames))
        parts += charts[:_OPEN]
        if len(charts) > _OPEN:
            parts.append(folded(f"{len(charts) - _OPEN} more curves", "".join(charts[_OPEN:])))
        verdicts.append(_verdict(item, performance))
    if not parts:
        return []
    body = "".join(parts)
    return [
        Section(anchor="quality", title="Tracking quality", body=body, verdicts=tuple(verdicts))
    ]


def told_errors(item: TakeInputs) -> Floats:
    """Errors (F, N) mm of the vertices whose truth is told at every frame; empty when of none."""
    if item.errors is None or item.errors.track_mm is None:
        return np.zeros((0, 0))
    errors = np.asarray(item.errors.track_mm, dtype=np.float64)
    told: Floats = errors[:, np.isfinite(errors).all(axis=0)]
    return told


def per_frame(report: Mapping[str, Any], count: int) -> dict[str, list[float]]:
    """Every series of a report that has one number a frame, by its path, likely ones first.

    Both `{"ncc": [..F numbers..]}` and `{"frames": [{"ncc": ...}, ..F objects..]}` are found.
    """
    found: dict[str, list[float]] = {}
    for key, value in report.items():
        if isinstance(value, Mapping):
            found |= {f"{key}.{name}": row for name, row in per_frame(value, count).items()}
        elif isinstance(value, list) and len(value) == count and count:
            if all(isinstance(entry, Mapping) for entry in value):
                found |= _columns(value)
            elif all(_is_number(entry) for entry in value):
                found[key] = [_float(entry) for entry in value]
    order = sorted(found, key=_rank)
    return {
        name: found[name]
        for name in order
        if name not in ("frame", "index", "frames") and len(set(found[name])) > 1
    }


def spoken(name: str) -> str:
    """A name of a report as words, its unit behind a comma: `residual_px` is `residual, px`."""
    words = name.replace(".", ", ").split("_")
    if len(words) > 1 and words[-1] in _UNITS:
        return f"{' '.join(words[:-1])}, {words[-1]}"
    return " ".join(words)


def _rank(name: str) -> int:
    lower = name.lower()
    return next((rank for rank, word in enumerate(_FRONT) if word in lower), len(_FRONT))


def _columns(rows: list[Mapping[str, Any]]) -> dict[str, list[float]]:
    keys = [key for key in rows[0] if all(_is_number(row.get(key)) for row in rows)]
    return {key: [_float(row[key]) for row in rows] for key in keys}


def _is_number(value: object) -> bool:
    return value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))


def _float(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _lost(item: TakeInputs) -> list[object]:
    rows = item.track_report.get("frames")
    if not isinstance(rows, list):
        return []
    return [row.get("frame") for row in rows if isinstance(row, Mapping) and row.get("lost")]


def _facts(performance: Performance) -> dict[str, object]:
    own = int((performance.reference < 0).sum())
    return {
        "frames": len(performance.frames),
        "vertices": performance.vertices.shape[1],
        "mean confidence": float(performance.confidence.mean()),
        "frames matched to the neutral": own,
        "frames matched to another": len(performance.frames) - own,
    }


def _confidence_chart(performance: Performance, frames: list[float]) -> str:
    confidence = performance.confidence
    series = [
        Series(name="mean confidence", x=frames, y=confidence.mean(axis=1).tolist()),
        Series(
            name="share of vertices above 0.5", x=frames, y=(confidence > 0.5).mean(axis=1).tolist()
        ),
    ]
    labels = Labels(title="confidence over time", x="frame", y="confidence, share")
    return figure(line_chart(series, labels, height=190.0), "Confidence of the tracked vertices.")


def _series_chart(name: str, frames: list[float], values: list[float]) -> str:
    words = spoken(name)
    labels = Labels(title=words, x="frame", y=words)
    chart = line_chart([Series(name=name, x=frames, y=values)], labels, height=150.0)
    return figure(chart, f"{words[:1].upper()}{words[1:]}, as the tracker reports it.")


def _error_chart(item: TakeInputs, frames: list[float]) -> str:
    errors = told_errors(item)
    series = [
        Series(name="RMS", x=frames, y=np.sqrt((errors**2).mean(axis=1)).tolist()),
        Series(name="95th percentile", x=frames, y=np.percentile(errors, 95, axis=1).tolist()),
    ]
    labels = Labels(title="error against the truth", x="frame", y="error, mm")
    chart = line_chart(series, labels, limit=(_GOOD_RMS_MM, f"goal {_GOOD_RMS_MM} mm RMS"))
    return figure(chart, "Distance of tracked vertices from the simulated truth.")


def _verdict(item: TakeInputs, performance: Performance) -> Verdict:
    subject = f"Tracking of {item.take.name}:"
    lost = _lost(item)
    if lost:
        words = f"{len(lost)} frames were lost, the first of them {lost[0]}"
        return Verdict(level="bad", subject=subject, words=words)
    errors = told_errors(item)
    if errors.size:
        rms = float(np.sqrt((errors**2).mean()))
        last = float(np.sqrt((errors[-1] ** 2).mean()))
        level = "good" if rms <= _GOOD_RMS_MM else "warn" if rms <= _FAIR_RMS_MM else "bad"
        words = (
            f"RMS {number(rms)} mm from the truth over all frames, {number(last)} mm at the last"
        )
        return Verdict(level=level, subject=subject, words=words)
    sure = (performance.confidence > 0.5).mean(axis=1)
    worst = int(sure.argmin())
    level = "good" if sure[worst] >= _GOOD_SEEN else "warn" if sure[worst] >= _FAIR_SEEN else "bad"
    words = (
        f"{100 * float(sure.mean()):.0f} % of vertices followed surely; weakest at frame "
        f"{int(performance.frames[worst])} with {100 * float(sure[worst]):.0f} %"
    )
    return Verdict(level=level, subject=subject, words=words)
