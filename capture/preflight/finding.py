"""`Finding`: what one check says, in the operator's words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from capture.judgement import Colour, worst_colour


@dataclass(frozen=True)
class Finding:
    """What one check says of one device, or of the array.

    Attributes:
        check: which: "link", "memory", "disk", "device", "network", "roster", "preset", "ptp",
            "sync", "exposure", "focus", "scene", "calibration" or "flash".
        device: its name; empty when it is the array or the host.
        colour: green: well. Amber: recording may begin. Red: it may not.
        sentence: what was found, in plain words.
        remedy: what to do, steps numbered when there are several; empty when green.
    """

    check: str
    device: str
    colour: Colour
    sentence: str
    remedy: str = ""


def worst(findings: Iterable[Finding]) -> Colour:
    """The worst colour; green when there is no finding."""
    return worst_colour(finding.colour for finding in findings)


def ordered(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Red first, green last; in their own order within a colour."""
    return tuple(sorted(findings, key=lambda finding: -finding.colour.badness))


def steps(remedies: Sequence[str]) -> str:
    """Remedies as one text, numbered when there are several."""
    if len(remedies) < 2:
        return "".join(remedies)
    return " ".join(f"{place}. {remedy}" for place, remedy in enumerate(remedies, start=1))
