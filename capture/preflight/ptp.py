"""The PTP gate: recording begins only when every clock follows the same master closely.

A device is only ever read here. One that is listening for a master is on its way to being locked;
switching its PTP off and on would throw it back.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from capture.devices.capabilities import PtpClocked, PtpReading
from capture.errors import DeviceError
from capture.judgement import Colour
from capture.preflight.finding import Finding, steps
from capture.progress import Progress, silent
from capture.sync_report import PTP_STEP_NS, ptp_changes_told

OFFSET_NS = 1000
_FAILED = "no answer"
_REMEDIES = {
    "disabled": ("Apply the preset, which switches PTP on.",),
    "listening": (
        "Leave it alone: it is looking for a master. If it stays so for a minute, see that a "
        "grandmaster runs and that the switch lets PTP through.",
    ),
    _FAILED: ("See its cable and power, then connect it again.",),
}
_ANY = ("See that every switch on the way supports PTP, and that there is one grandmaster.",)


@dataclass(frozen=True, kw_only=True)
class PtpGate:
    """When clocks count as locked.

    Attributes:
        offset_ns: the largest offset from the master.
        hold_s: for how long it must stay below.
        deadline_s: how long to wait for that in all.
        pause_s: from reading to reading.
    """

    offset_ns: int = OFFSET_NS
    hold_s: float = 10.0
    deadline_s: float = 60.0
    pause_s: float = 0.5


@dataclass(frozen=True)
class Watch:
    """A clock to wait by; tests bring their own."""

    now_s: Callable[[], float] = time.monotonic
    sleep_s: Callable[[float], None] = time.sleep


def read_ptp(devices: Mapping[str, PtpClocked]) -> dict[str, PtpReading]:
    """What every device says of its clock; one that does not answer says "no answer"."""
    readings = {}
    for name, device in devices.items():
        try:
            readings[name] = device.ptp()
        except DeviceError:
            readings[name] = PtpReading(_FAILED)
    return readings


def ptp_findings(
    devices: Mapping[str, PtpClocked],
    gate: PtpGate,
    *,
    needed: bool = False,
    progress: Progress = silent,
    watch: Watch | None = None,
) -> list[Finding]:
    """The gate, where PTP is in use; an array of which every clock has it off needs none.

    Args:
        devices: those with PTP, by name.
        gate: when they count as locked.
        needed: whether triggers are sent by PTP time, so that it must be on.
        progress: told after every reading.
        watch: the clock to wait by.
    """
    readings = read_ptp(devices)
    if needed or any(reading.state not in ("disabled", _FAILED) for reading in readings.values()):
        return wait_for_lock(devices, gate, progress=progress, watch=watch)
    if not devices:
        return []
    return [
        Finding(
            "ptp", "", Colour.GREEN,
            "PTP is switched off: clocks are fitted to the triggers, which the flash check proves.",
        )
    ]  # fmt: skip


def wait_for_lock(
    devices: Mapping[str, PtpClocked],
    gate: PtpGate | None = None,
    *,
    progress: Progress = silent,
    watch: Watch | None = None,
) -> list[Finding]:
    """Wait until every clock is locked and stays so, or the deadline passes.

    Args:
        devices: those with PTP, by name.
        gate: when they count as locked.
        progress: told after every reading: tenths of a second of good time, of those wanted.
        watch: the clock to wait by.
    """
    if not devices:
        return []
    gate = gate if gate is not None else PtpGate()
    watch = watch if watch is not None else Watch()
    begun = watch.now_s()
    since: float | None = None
    while True:
        readings = read_ptp(devices)
        now = watch.now_s()
        problems = lock_problems(readings, gate.offset_ns)
        since = None if problems else now if since is None else since
        good = 0.0 if since is None else now - since
        progress(round(10 * min(good, gate.hold_s)), round(10 * gate.hold_s), "clocks locked")
        if since is not None and good >= gate.hold_s:
            return [Finding("ptp", "", Colour.GREEN, _locked(readings, gate))]
        if now - begun >= gate.deadline_s:
            break
        watch.sleep_s(gate.pause_s)
    if problems:
        return problems
    words = (
        f"Clocks have been locked for {good:.0f} s only, {gate.hold_s:.0f} s are wanted, after "
        f"{gate.deadline_s:.0f} s of waiting."
    )
    return [Finding("ptp", "", Colour.AMBER, words, "Run the preflight again.")]


def lock_problems(readings: Mapping[str, PtpReading], offset_ns: int = OFFSET_NS) -> list[Finding]:
    """What keeps an array from being locked; empty when it is."""
    found = []
    for name, reading in readings.items():
        if not reading.locked:
            remedies = _REMEDIES.get(reading.state, _ANY)
            words = f"The clock of {name} is not locked: {reading.state}."
            found.append(Finding("ptp", name, Colour.RED, words, steps(remedies)))
        elif reading.offset_ns is not None and abs(reading.offset_ns) >= offset_ns:
            words = (
                f"The clock of {name} is {reading.offset_ns / 1000:+.1f} us from its master; "
                f"less than {offset_ns / 1000:g} us is wanted."
            )
            remedy = steps(("Wait: it settles within a minute.", *_ANY))
            found.append(Finding("ptp", name, Colour.RED, words, remedy))
    return found + _masters(readings)


def ptp_changes(
    history: Sequence[Mapping[str, PtpReading]], step_ns: int = PTP_STEP_NS
) -> list[Finding]:
    """What changed between readings around and during a take.

    Args:
        history: readings in order: before, any during, after.
        step_ns: a step of an offset beyond this flags the take.
    """
    remedy = steps(("See the sync report of the take.", "Wait for lock before the next."))
    return [
        Finding("ptp", name, Colour.AMBER, words, remedy)
        for name, words in ptp_changes_told(history, step_ns).items()
    ]


def _masters(readings: Mapping[str, PtpReading]) -> list[Finding]:
    groups: dict[str, list[str]] = {}
    for name, reading in readings.items():
        if reading.locked and reading.grandmaster:
            groups.setdefault(reading.grandmaster, []).append(name)
    if len(groups) < 2:
        return []
    rare = min(groups, key=lambda key: len(groups[key]))
    usual = max(groups, key=lambda key: len(groups[key]))
    names = groups[rare]
    words = (
        f"{', '.join(names)} follow{'s' if len(names) == 1 else ''} grandmaster {rare}, the others "
        f"{usual}: {len(groups)} clocks are in charge."
    )
    remedy = steps(
        ("See that all devices are in one network.", "Switch PTP off on every clock but one.")
    )
    return [Finding("ptp", names[0] if len(names) == 1 else "", Colour.RED, words, remedy)]


def _locked(readings: Mapping[str, PtpReading], gate: PtpGate) -> str:
    offsets = [abs(r.offset_ns) for r in readings.values() if r.offset_ns is not None]
    worst = f", at most {max(offsets)} ns off" if offsets else ""
    return f"{len(readings)} clocks have been locked for {gate.hold_s:g} s{worst}."
