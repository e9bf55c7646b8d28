"""How the devices of a take exposed together: offsets, scatter, spread over time, findings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from capture.ledger import Ledger
from capture.sync_report import set_times
from tools.report.charts import Labels, Series, line_chart
from tools.report.page import Verdict, figure, table, verdict_line
from tools.report.svg import LEVELS, Axis, drawing, element, escape, number, text, ticks

_LEVEL = {"green": "good", "amber": "warn", "red": "bad"}
_BASES = {
    "ptp": "Times are those of clocks that follow one PTP master: every number is true.",
    "host": "The host dated the frames, or read the clocks of devices that run free: its own "
    "delays are in the numbers.",
    "model": "Each device's clock was fitted to the triggers: scatter and jumps show, a constant "
    "offset only as far as readings of the clock tell.",
}
_ROW, _TOP, _WIDTH = 18.0, 10.0, 720.0
_LIMIT_US = 10.0


def sync_verdict(name: str, remarks: Mapping[str, Any]) -> Verdict | None:
    """What the sync report of a take says; None when the take has none."""
    told = _part(remarks, "sync")
    if told.get("colour") not in _LEVEL:
        return None
    words = str(told.get("sentence", ""))
    return Verdict(level=_LEVEL[told["colour"]], subject=f"Sync of {name}:", words=words)


def sync_part(name: str, remarks: Mapping[str, Any], ledger: Ledger) -> str:
    """The sync report of a take as HTML; empty when the take has none.

    Args:
        name: of the take.
        remarks: of its manifest.
        ledger: of the take, for the spread over time.
    """
    verdict = sync_verdict(name, remarks)
    if verdict is None:
        return ""
    told = _part(remarks, "sync")
    parts = [verdict_line(verdict), _findings(told)]
    devices = [one for one in _listed(told, "devices") if isinstance(one, Mapping)]
    if devices:
        parts.append(figure(_offsets(name, devices), _BASES.get(str(told.get("basis")), "")))
    parts.append(_spread(name, ledger))
    if devices:
        parts.append(_numbers(devices))
    return "".join(parts)


def sync_facts(remarks: Mapping[str, Any]) -> dict[str, object]:
    """The sync report in three numbers, for a table of takes."""
    told = _part(remarks, "sync")
    keys = {
        "spread median, us": "spread_median_us",
        "spread 95 %, us": "spread_p95_us",
        "spread max, us": "spread_max_us",
    }
    return {head: v for head, key in keys.items() if math.isfinite(v := _float(told, key))}


def _findings(told: Mapping[str, Any]) -> str:
    items = []
    for one in _listed(told, "findings"):
        if not isinstance(one, Mapping):
            continue
        steps = "".join(element("li", escape(step)) for step in _listed(one, "remedies"))
        sentence = escape(one.get("sentence", ""))
        items.append(element("li", sentence + (element("ol", steps) if steps else "")))
    return element("ul", "".join(items)) if items else ""


def _offsets(name: str, devices: Sequence[Mapping[str, Any]]) -> str:
    """One row a device: offset as a dot, jitter as a thick line, its error as a thin one."""
    left = 20.0 + 7.2 * max(len(str(one.get("device", ""))) for one in devices)
    ends = [_LIMIT_US]
    for one in devices:
        offset, jitter, error = (
            _float(one, k) for k in ("offset_us", "jitter_us", "offset_error_us")
        )
        middle = offset if math.isfinite(offset) else 0.0
        ends += [abs(middle) + v for v in (jitter, error) if math.isfinite(v)]
    reach = 1.1 * max(ends)
    x = Axis(low=-reach, high=reach, start=left, end=_WIDTH - 20.0)
    bottom = _TOP + _ROW * len(devices)
    parts = [
        element(
            "rect", x=x(-_LIMIT_US), y=_TOP - 4, width=x(_LIMIT_US) - x(-_LIMIT_US),
            height=bottom - _TOP + 4, fill="#e4f1ea",
        )
    ]  # fmt: skip
    for value in ticks(-reach, reach, 8):
        at = x(value)
        parts.append(element("line", x1=at, x2=at, y1=_TOP - 4, y2=bottom, class_="grid"))
        parts.append(text(at, bottom + 14, number(value), class_="tick", text_anchor="middle"))
    for row, one in enumerate(devices):
        parts += _row(one, x, _TOP + _ROW * row + 0.5 * _ROW - 3, left)
    words = "offset against the array (dot), jitter (thick), uncertainty (thin), us; later is right"
    middle = (left + x.end) / 2
    parts.append(text(middle, bottom + 30, words, class_="label", text_anchor="middle"))
    return drawing(_WIDTH, bottom + 38, "".join(parts), f"offset and jitter of {name}")


def _row(one: Mapping[str, Any], x: Axis, y: float, left: float) -> list[str]:
    offset, jitter, error = (_float(one, k) for k in ("offset_us", "jitter_us", "offset_error_us"))
    middle = offset if math.isfinite(offset) else 0.0
    parts = [text(left - 8, y + 4, str(one.get("device", "")), class_="tick", text_anchor="end")]
    for size, width in ((error, 1.0), (jitter, 5.0)):
        if math.isfinite(size) and size > 0:
            a, b = x(middle - size), x(middle + size)
            parts.append(
                element("line", x1=a, x2=b, y1=y, y2=y, stroke="#5b6a7a", stroke_width=width)
            )
    if math.isfinite(offset):
        level = "good" if abs(offset) - max(error, 0.0) <= _LIMIT_US else "warn"
        parts.append(element("circle", cx=x(offset), cy=y, r=4.0, fill=LEVELS[level]))
    return parts


def _spread(name: str, ledger: Ledger) -> str:
    times = set_times(ledger)
    if len(times.indices) < 2:
        return ""
    spread = times.spread_us
    line = Series(name="spread", x=times.indices.tolist(), y=spread.tolist())
    labels = Labels(title=f"spread of {name}", x="trigger index", y="spread, us")
    limit = (_LIMIT_US, "green") if spread.max() > 0.3 * _LIMIT_US else None
    chart = line_chart([line], labels, limit=limit, height=120.0)
    return figure(chart, "From the first to the last exposure of each complete frame set.")


def _numbers(devices: Sequence[Mapping[str, Any]]) -> str:
    keys = {
        "offset, us": "offset_us", "+-, us": "offset_error_us", "jitter, us": "jitter_us",
        "residual, us": "residual_us", "drift, ppm": "drift_ppm", "worst, us": "worst_us",
        "at frame": "worst_index",
    }  # fmt: skip
    rows = []
    for one in devices:
        row: list[object] = [str(one.get("device", ""))]
        for key in keys.values():
            value = _float(one, key)
            good = math.isfinite(value) and not (key == "worst_index" and value < 0)
            # To the nanosecond and the thousandth of a millionth: what is below is arithmetic.
            row.append((int(value) if key == "worst_index" else round(value, 3)) if good else "")
        rows.append(row)
    return table(["device", *keys], rows)


def _float(document: Mapping[str, Any], key: str) -> float:
    value = document.get(key)
    good = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if good else float("nan")  # type: ignore[arg-type]


def _listed(document: Mapping[str, Any], key: str) -> list[Any]:
    value = document.get(key)
    return list(value) if isinstance(value, list | tuple) else []


def _part(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = document.get(key)
    return value if isinstance(value, Mapping) else {}
