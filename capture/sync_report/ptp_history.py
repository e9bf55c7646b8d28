"""What became of synchronized clocks during a take, from readings before, during and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

from capture.devices.capabilities import PtpReading

PTP_STEP_NS = 10_000


def ptp_changes_told(
    history: Sequence[Mapping[str, PtpReading]], step_ns: int = PTP_STEP_NS
) -> dict[str, str]:
    """By device, one sentence on what changed; a device whose clock was never on is left out.

    Args:
        history: readings by device name, in order: before, any during, after.
        step_ns: a step of an offset beyond this is told.
    """
    told = {}
    for name in dict.fromkeys(name for readings in history for name in readings):
        seen = [readings[name] for readings in history if name in readings]
        if all(one.state == "disabled" for one in seen):
            continue
        lost = next((one for one in seen if not one.locked), None)
        offsets = [one.offset_ns for one in seen if one.offset_ns is not None]
        widest = max((b - a for a, b in pairwise(offsets)), key=abs, default=0)
        masters = list(dict.fromkeys(one.grandmaster for one in seen if one.grandmaster))
        if lost is not None:
            told[name] = f"The clock of {name} was not locked during the take: {lost.state}."
        elif abs(widest) > step_ns:
            told[name] = f"The clock of {name} stepped by {widest / 1000:+.0f} us during the take."
        elif len(masters) > 1:
            told[name] = f"{name} changed its grandmaster during the take: {' to '.join(masters)}."
    return told
