"""The gate of a calibration in big words, its reasons, and the key numbers with what is asked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from recon.calibration.gate_levels import GateSettings
from tools.report.calibration_keys import count_of, mapping_of, number_of, rows_of
from tools.report.page import Verdict, facts
from tools.report.svg import MICRO, escape, number

ASKED = GateSettings()
_MEAN_LENGTH = 1.25  # mean length of a residual over its deviation per coordinate, normal noise
RESIDUAL_PX = (_MEAN_LENGTH * ASKED.good_noise_px, _MEAN_LENGTH * ASKED.usable_noise_px)
RATIO = (ASKED.good_ratio, ASKED.usable_ratio)
SPLIT_PX = (ASKED.good_split_px, ASKED.usable_split_px)
_SCALE = (ASKED.good_scale, ASKED.usable_scale)
_LEVELS = {"good": "good", "usable": "warn", "bad": "bad"}
_MARKS = {"good": "✓", "warn": "!", "bad": "✗", "none": ""}


def level_of(value: float, good: float, fair: float) -> str:
    """ "good", "warn" or "bad" of a value that should be small; "none" where it is not known."""
    if not np.isfinite(value):
        return "none"
    return "good" if value <= good else "warn" if value <= fair else "bad"


def asked_um(report: Mapping[str, Any]) -> tuple[float, float]:
    """What is good and what is usable of the uncertainty over the face volume, um."""
    return ASKED.volume_levels_um(number_of(mapping_of(report, "volume"), "pixel_mm"))


def gate_verdict(report: Mapping[str, Any]) -> Verdict | None:
    """The gate's verdict as one line; None when the report has no gate."""
    gate = mapping_of(report, "gate")
    if not gate:
        return None
    words = str(gate.get("headline") or gate.get("verdict") or "no words")
    return Verdict(level=_gate_level(gate), subject="Calibration:", words=words)


def gate_box(report: Mapping[str, Any]) -> str:
    """The gate in big words with its reasons, for the top of a page; empty when there is none."""
    gate, verdict = mapping_of(report, "gate"), gate_verdict(report)
    if verdict is None:
        return ""
    asked = "" if "more pose" in verdict.words else _poses(gate)
    return (
        f'<div class="summary {verdict.level}" id="gate"><p class="big {verdict.level}">'
        f"{_MARKS[verdict.level]} {escape(verdict.words)}</p>{asked}{gate_reasons(report)}</div>"
    )


def gate_reasons(report: Mapping[str, Any]) -> str:
    """Why the gate says so: a list with the names of devices and how many more poses they want."""
    rows = []
    for reason in rows_of(mapping_of(report, "gate"), "reasons"):
        level = "bad" if reason.get("level") == "bad" else "warn"
        name, more = reason.get("device"), count_of(reason, "more_poses")
        words = str(reason.get("words") or "")
        told = "" if name is None else f"<b>{escape(name)}</b>: "
        if name is not None and words.startswith(f"{name}"):
            told, words = f"<b>{escape(name)}</b>", words[len(str(name)) :]
        asked = f" <em>{_more(more)}</em>" if more > 0 and "more pose" not in words else ""
        rows.append(f'<li class="{level}">{told}{escape(words)}{asked}</li>')
    return f'<ul class="reasons">{"".join(rows)}</ul>' if rows else ""


def gate_marks(report: Mapping[str, Any]) -> dict[str, str]:
    """The worst level, "warn" or "bad", that the gate gives each device it names."""
    marks: dict[str, str] = {}
    for reason in rows_of(mapping_of(report, "gate"), "reasons"):
        name = reason.get("device")
        if name is not None and marks.get(str(name)) != "bad":
            marks[str(name)] = "bad" if reason.get("level") == "bad" else "warn"
    return marks


def key_numbers(report: Mapping[str, Any]) -> str:
    """The numbers that decide, each with what is asked and how it stands, as a table."""
    rows = "".join(
        f'<tr><th scope="row">{escape(what)}</th><td class="found">{escape(found)}</td>'
        f'<td class="asked">{escape(asked)}</td><td class="mark {level}">{_MARKS[level]}</td>'
        f"<td>{escape(words)}</td></tr>"
        for what, found, asked, level, words in _rows(report)
    )
    if not rows:
        return ""
    head = "".join(f'<th scope="col">{cell}</th>' for cell in ("", "found", "asked", "", ""))
    return f'<div class="scroll"><table class="keys"><tr>{head}</tr>{rows}</table></div>'


def other_numbers(report: Mapping[str, Any]) -> str:
    """Counts and the board's shape as a list of facts."""
    used, rejected = count_of(report, "corners_used"), count_of(report, "corners_rejected")
    told: dict[str, object] = {}
    if used + rejected:
        told["corners used"] = used
        told["corners rejected"] = f"{rejected} ({100 * rejected / (used + rejected):.2f} %)"
    board, world = mapping_of(report, "board"), mapping_of(report, "world")
    numbers = {
        "board poses used": number_of(report, "poses_used"),
        "rms per coordinate, px": number_of(report, "rms_per_coordinate_px"),
        "noise of a corner, px": number_of(report, "robust_sigma_px"),
        "bow of the board, mm": number_of(board, "bow_mm"),
        "width over height of its squares": number_of(board, "width_over_height"),
    }
    told |= {name: value for name, value in numbers.items() if np.isfinite(value)}
    if world.get("origin") is not None:
        told["origin of the world"] = str(world["origin"])
    return facts(told) if told else ""


def _rows(report: Mapping[str, Any]) -> list[tuple[str, str, str, str, str]]:
    """What, found, asked, level, words of each key number that the report has."""
    held, halves = mapping_of(report, "held_out"), mapping_of(report, "split_half")
    known = mapping_of(report, "uncertainty")
    rows = [
        _row(
            "mean reprojection", number_of(report, "mean_reprojection_px"), "px",
            RESIDUAL_PX, "how far the solved corners lie from those seen",
        ),
        _row(
            "held-out ratio", number_of(held, "ratio"), "", RATIO,
            "residual of poses left out of a solve over that of those in it", held.get("remark"),
        ),
        _row(
            "split-half, 95 %", number_of(halves, "p95_px"), "px", SPLIT_PX,
            "how far calibrations from one half of the poses and the other differ",
            halves.get("remark"),
        ),
        _row(
            "triangulation uncertainty", number_of(known, "rms_um"), MICRO, asked_um(report),
            _uncertain(known),
        ),
    ]  # fmt: skip
    return [row for row in [*rows, _scale_bar(report)] if row is not None]


def _row(
    what: str, value: float, unit: str, limits: tuple[float, float], words: str,
    remark: object = None,
) -> tuple[str, str, str, str, str] | None:  # fmt: skip
    asked = f"≤ {number(limits[0])} {unit}".rstrip()
    if np.isfinite(value):
        shown = f"{value:.3f}" if not unit else number(value)
        return what, f"{shown} {unit}".rstrip(), asked, level_of(value, *limits), words
    return (what, "not checked", asked, "none", str(remark)) if remark else None


def _uncertain(known: Mapping[str, Any]) -> str:
    parts = ["rms over the face volume, of the calibration alone"]
    p95, noisy = number_of(known, "p95_um"), number_of(known, "rms_with_noise_um")
    if np.isfinite(p95):
        parts.append(f"95 % under {number(p95)} {MICRO}")
    if np.isfinite(noisy):
        parts.append(f"{number(noisy)} {MICRO} with the noise of one image each")
    return "; ".join(parts)


def _scale_bar(report: Mapping[str, Any]) -> tuple[str, str, str, str, str] | None:
    bar = mapping_of(report, "scale_bar")
    length, measured = number_of(bar, "length_mm"), number_of(bar, "measured_mm")
    if not length > 0 or not np.isfinite(measured):
        return None
    off, sigma = measured / length - 1.0, number_of(bar, "sigma_mm")
    found = f"{measured:.3f} mm"
    if np.isfinite(sigma):
        found = f"{measured:.3f} ± {sigma:.3f} mm"
    words = f"the bar is {length:g} mm long; {100 * off:+.3f} % off"
    frames = count_of(bar, "frames")
    if frames:
        words += f", measured in {frames} frames"
    asked = f"{length:g} mm ± {100 * _SCALE[0]:g} %"
    return "scale bar", found, asked, level_of(abs(off), *_SCALE), words


def _poses(gate: Mapping[str, Any]) -> str:
    more = count_of(gate, "more_poses")
    return f"<p>Asked for: {_more(more)} of the board.</p>" if more > 0 else ""


def _more(count: int) -> str:
    return "1 more pose" if count == 1 else f"{count} more poses"


def _gate_level(gate: Mapping[str, Any]) -> str:
    return _LEVELS.get(str(gate.get("verdict")), "none")
