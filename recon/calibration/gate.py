"""The verdict on a calibration: whether to use it, what is wrong, what to do, worst first.

Pure: a report in, a verdict out, so that an archived `report.json` can be judged again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from recon.calibration.gate_array import array_findings, volume_findings
from recon.calibration.gate_devices import fault_findings, lack_findings
from recon.calibration.gate_levels import BAD, Finding, GateSettings, number_at, plural

__all__ = ["GateSettings", "judge_calibration"]


def judge_calibration(
    report: Mapping[str, Any], settings: GateSettings | None = None
) -> dict[str, Any]:
    """Judge a calibration by its report.

    Args:
        report: as `recon.calibration.report` makes it, or read from `report.json`; what an older
            report does not hold counts as not checked.
        settings: the levels.

    Returns:
        For JSON: `verdict` ("good", "usable", "bad"); `headline`, one sentence; `reasons`, worst
        first, each with `level` ("warn", "bad"), `device` (null for several or all), `words` and
        `more_poses` (null when poses are not what is missing); `more_poses`: about how many poses
        of the board, waved as before, make the calibration good.
    """
    settings = settings or GateSettings()
    faults, faulty = fault_findings(report, settings)
    spoiled = any(one.level == BAD for one in faults)
    whole = array_findings(report, settings, faulty, spoiled)
    lacks, lacking = lack_findings(report, settings, faulty, spoiled)
    places = volume_findings(report, settings)
    findings = sorted(
        faults + whole + lacks + places,
        key=lambda one: (one.level != BAD, one.rank, -(one.more_poses or 0)),
    )
    array_wide = max((one.more_poses or 0 for one in whole), default=0)
    in_places = sum(one.more_poses or 0 for one in places)
    more = min(max(array_wide, in_places, lacking), settings.most_poses)
    verdict = "good" if not findings else "usable"
    if any(one.level == BAD for one in findings):
        verdict = "bad"
    return {
        "verdict": verdict,
        "headline": _headline(verdict, findings, more, report),
        "reasons": _reasons(findings, settings.most_reasons),
        "more_poses": more,
    }


def _headline(
    verdict: str, findings: Sequence[Finding], more: int, report: Mapping[str, Any]
) -> str:
    if verdict == "good":
        rms = number_at(report, "uncertainty", "rms_um")
        return f"Good: the calibration leaves {rms:.2g} um of error over the face volume."
    poses = f"; about {plural(more, 'more pose')} of the board should mend it" if more else ""
    if verdict == "usable":
        return f"Usable, not yet good: {plural(len(findings), 'remark')}{poses}."
    grave = [one for one in findings if one.level == BAD]
    words = grave[0].words.rsplit(": ", 1)[0]  # without the advice
    rest = f", and {plural(len(grave) - 1, 'other grave reason')}" if len(grave) > 1 else ""
    start = (
        "Not good enough" if all(one.more_poses for one in grave) else "Do not use these cameras"
    )
    return f"{start}: {words}{rest}{poses}."


def _reasons(findings: Sequence[Finding], most: int) -> list[dict[str, Any]]:
    told = list(findings)
    if len(told) > most:
        rest = told[most - 1 :]
        words = f"and {len(rest)} lesser reasons: mend these first, then calibrate again"
        told = [*told[: most - 1], Finding(level=rest[0].level, rank=9, words=words)]
    return [
        {
            "level": one.level,
            "device": one.device,
            "words": one.words,
            "more_poses": one.more_poses,
        }
        for one in told
    ]
