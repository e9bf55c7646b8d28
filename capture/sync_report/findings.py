"""Detectors of what goes wrong with synchronization: each finding in words, with remedies."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from capture.judgement import Colour
from capture.ledger import Ledger, Oddity
from capture.sync_report.times import (
    SetTimes,
    SyncBasis,
    array_jumps,
    good_frames,
    jump_of,
    slope,
)

GREEN_US, RED_US = 10.0, 1000.0  # lips at 0.5 m/s and 0.15 mm/px move 0.03 px and 3.3 px
DRIFT_PPM = 100.0  # the worst that makers of crystals allow
_JITTER_US = 5.0
_TIMES = 4.0  # so much more than the others is odd
_NEAR = 0.2  # of a period


@dataclass(frozen=True)
class SyncFinding:
    """One thing that is wrong with synchronization.

    Attributes:
        kind: a short name, the same for the same thing in every take.
        devices: which; none when it is the whole array.
        colour: amber or red.
        sentence: what, in plain words.
        remedies: what to do, in order.
    """

    kind: str
    devices: tuple[str, ...]
    colour: Colour
    sentence: str
    remedies: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SyncFacts:
    """What the detectors look at.

    Attributes:
        ledger: of the take.
        times: of its complete frame sets.
        basis: what those times are.
        period_us: nominal, from trigger to trigger.
        measured_us: the period as measured, and its standard deviation.
        offsets: by device, (offset, how wrong it may be) against the array's median, us; a device
            of which nothing is known is not there.
        drifts_ppm: by device, of its own clock.
    """

    ledger: Ledger
    times: SetTimes
    basis: SyncBasis
    period_us: float
    measured_us: tuple[float, float]
    offsets: dict[str, tuple[float, float]]
    drifts_ppm: dict[str, float]


def find_all(facts: SyncFacts) -> tuple[SyncFinding, ...]:
    """Every finding, red before amber; what one finding explains is not told again by another."""
    found: list[SyncFinding] = []
    explained: set[str] = set()
    for detector in _DETECTORS:
        fresh = [f for f in detector(facts) if not f.devices or set(f.devices) - explained]
        found += fresh
        explained.update(name for finding in fresh for name in finding.devices)
    return tuple(sorted(found, key=lambda finding: finding.colour != Colour.RED))


def colour_of(us: float) -> Colour:
    """The colour of so many microseconds between devices."""
    if us <= GREEN_US:
        return Colour.GREEN
    return Colour.RED if us > RED_US else Colour.AMBER


def _array_steps(facts: SyncFacts) -> list[SyncFinding]:
    told: dict[int, int] = {}
    for remark in facts.ledger.remarks:
        if remark.oddity == Oddity.CLOCK_STEP:
            told[remark.trigger_index] = told.get(remark.trigger_index, 0) + 1
    many = [k for k, count in told.items() if count > max(1, len(facts.ledger.devices) // 2)]
    jumps = [] if facts.basis == SyncBasis.MODEL else array_jumps(facts.times, GREEN_US)
    words = [f"after frame {k}" for k in many]
    words += [f"by {_us(jump.size_us)} after frame {jump.index}" for jump in jumps]
    if not words:
        return []
    return [
        SyncFinding(
            "array_step", (), Colour.AMBER,
            f"The clock of the whole array, or its triggers, jumped {_listed(words)}.",
            (
                "Frames of one trigger still belong together: the take can be used where time "
                "from frame to frame does not matter.",
                "With PTP, see whether the grandmaster changed or set its clock: use one fixed "
                "grandmaster that is not steered during a session.",
                "With a trigger generator, see whether it was stopped or set anew.",
            ),
        )
    ]  # fmt: skip


def _device_steps(facts: SyncFacts) -> list[SyncFinding]:
    found = []
    told = {r.device for r in facts.ledger.remarks if r.oddity == Oddity.CLOCK_STEP}
    everyone = len(told) > max(1, len(facts.ledger.devices) // 2)
    for column, name in enumerate(facts.times.devices):
        jump = jump_of(facts.times.indices, facts.times.apart_us[:, column])
        seen = jump is not None and abs(jump.size_us) > GREEN_US
        if seen and jump is not None:
            words = f"by {_us(jump.size_us)} after frame {jump.index}"
            colour = _warning(jump.size_us)
        elif name in told and not everyone:
            words, colour = "during the take", Colour.AMBER
        else:
            continue
        found.append(
            SyncFinding(
                "device_step", (name,), colour, f"The clock of {name} jumped {words}.",
                (
                    "Wait until its PTP is locked again and its offset stays below 1 us for 10 s, "
                    "then take it again.",
                    f"If it comes back, change the cable of {name} and its port; see that every "
                    "switch on the way supports PTP.",
                    f"If it still comes back, switch {name} off and on, and look for newer "
                    "firmware.",
                ),
            )
        )  # fmt: skip
    return found


def _runaways(facts: SyncFacts) -> list[SyncFinding]:
    if facts.basis == SyncBasis.MODEL:
        return []
    found = []
    for column, name in enumerate(facts.times.devices):
        series = facts.times.apart_us[:, column]
        if len(series) < 6:
            continue
        rise, sigma, _ = slope(facts.times.indices, series)
        way = rise * float(facts.times.indices[-1] - facts.times.indices[0])
        if abs(way) > GREEN_US and abs(rise) > 5 * sigma:
            ppm = 1e6 * rise / facts.period_us
            found.append(
                SyncFinding(
                    "runaway", (name,), _warning(way),
                    f"{name} runs away from the others: by {_us(way)} over the take, "
                    f"{ppm:+.1f} parts in a million.",
                    (
                        f"Its clock does not follow the master: see that PTP of {name} is on and "
                        "says slave.",
                        "If it is not triggered by the common line but runs freely, set its "
                        "trigger.",
                    ),
                )
            )  # fmt: skip
    return found


def _periods_late(facts: SyncFacts) -> list[SyncFinding]:
    found = []
    for name, (offset, error) in facts.offsets.items():
        turns = round(offset / facts.period_us)
        near = abs(offset - turns * facts.period_us) <= _NEAR * facts.period_us
        if turns and near and error < _NEAR * facts.period_us:
            count = "one trigger" if abs(turns) == 1 else f"{abs(turns)} triggers"
            side = "late" if turns > 0 else "early"
            found.append(
                SyncFinding(
                    "period_late", (name,), Colour.RED,
                    f"{name} is {count} {side}: its frames lie {offset / 1000:+.2f} ms from the "
                    "others', its images show another instant.",
                    (
                        "Run the flash check: it shows which frame of each device saw the flash.",
                        f"See that {name} has no trigger delay or divider set, and that it is on "
                        "the common trigger line.",
                        "Take it again.",
                    ),
                )
            )  # fmt: skip
    return found + _arrivals_late(facts, {name for finding in found for name in finding.devices})


def _arrivals_late(facts: SyncFacts, known: set[str]) -> list[SyncFinding]:
    """Devices whose frames arrive about whole periods later, after their time, than others' do."""
    lags = {}
    for name in facts.ledger.devices:
        frames = [
            (host - t) / 1000.0 for _, t, host in good_frames(facts.ledger, name) if host >= 0
        ]
        if frames:
            lags[name] = float(np.median(frames))
    if len(lags) < 3:
        return []
    middle = float(np.median(list(lags.values())))
    usual = float(np.median([abs(lag - middle) for lag in lags.values()]))
    found = []
    for name, lag in lags.items():
        turns = round((lag - middle) / facts.period_us)
        rest = abs(lag - middle - turns * facts.period_us)
        if not turns or name in known or max(rest, usual) > _NEAR * facts.period_us:
            continue
        found.append(
            SyncFinding(
                "arrives_late", (name,), Colour.AMBER,
                f"Frames of {name} arrive {(lag - middle) / 1000:+.1f} ms later than those of the "
                "others, about whole triggers: they may be filed under a wrong trigger.",
                (
                    "Run the flash check: it shows which frame of each device saw the flash.",
                    f"See whether {name} adds a delay of its own: another pixel format, image "
                    "processing in the device, a busy link.",
                ),
            )
        )  # fmt: skip
    return found


def _groups(facts: SyncFacts) -> list[SyncFinding]:
    known = sorted((offset, error, name) for name, (offset, error) in facts.offsets.items())
    if len(known) < 4:
        return []
    values = np.array([offset for offset, _, _ in known])
    gaps = np.diff(values)
    cut = int(np.argmax(gaps)) + 1
    inner = max(float(np.ptp(values[:cut])), float(np.ptp(values[cut:])))
    error = max(error for _, error, _ in known)
    gap = float(gaps[cut - 1])
    if min(cut, len(known) - cut) < 2 or gap <= max(GREEN_US, 4 * inner, 2 * error):
        return []
    small = known[:cut] if cut <= len(known) - cut else known[cut:]
    side = "before" if cut <= len(known) - cut else "after"
    names = sorted(name for _, _, name in small)
    sentence = f"{_listed(names)} expose {_us(gap)} {side} the others, and agree among themselves."
    remedies = (
        "See what they share: a switch, a trigger cable, a distribution box.",
        "With PTP, see that all devices name the same grandmaster.",
        "See that their exposure time and trigger delay are those of the others.",
    )
    return [SyncFinding("groups", tuple(names), _warning(gap), sentence, remedies)]


def _constant_offsets(facts: SyncFacts) -> list[SyncFinding]:
    found = []
    for name, (offset, error) in facts.offsets.items():
        if abs(offset) - error <= GREEN_US:
            continue
        side = "after" if offset > 0 else "before"
        sure = f" (to within {_us(error)})" if error > 0.1 * abs(offset) else ""
        found.append(
            SyncFinding(
                "offset", (name,), _warning(abs(offset) - error),
                f"{name} exposes {_us(abs(offset))} {side} the others{sure}.",
                (
                    f"See that trigger delay, exposure time and pixel format of {name} are those "
                    "of the others: apply the preset again.",
                    "With PTP, wait until its offset is below 1 us.",
                    "If its model simply differs from the others', set its trigger delay so that "
                    "the middle of the exposures agrees.",
                ),
            )
        )  # fmt: skip
    return found


def _drifts(facts: SyncFacts) -> list[SyncFinding]:
    return [
        SyncFinding(
            "drift", (name,), Colour.AMBER,
            f"The clock of {name} runs {ppm:+.0f} parts in a million off; "
            f"up to {DRIFT_PPM:.0f} is usual.",
            (
                "Times are corrected for it: the take can be used.",
                f"See that the timestamp frequency that {name} reports is right.",
                f"If it grows from day to day, let {name} warm up, or have it seen to.",
            ),
        )
        for name, ppm in facts.drifts_ppm.items()
        if abs(ppm) > DRIFT_PPM
    ]  # fmt: skip


def _jitters(facts: SyncFacts) -> list[SyncFinding]:
    if len(facts.times.indices) < 6 or len(facts.times.devices) < 3:
        return []
    apart = facts.times.apart_us
    rest = {
        n: slope(facts.times.indices, apart[:, c])[2] for c, n in enumerate(facts.times.devices)
    }
    usual = float(np.median(list(rest.values())))
    found = []
    for column, name in enumerate(facts.times.devices):
        series = apart[:, column] - np.median(apart[:, column])
        typical = 1.4826 * float(np.median(np.abs(series)))
        odd = np.flatnonzero(np.abs(series) > max(GREEN_US, 8 * typical, 8 * usual))
        if 0 < len(odd) <= max(1, len(series) // 20):
            worst = int(odd[np.argmax(np.abs(series[odd]))])
            index = int(facts.times.indices[worst])
            size = abs(float(series[worst]))
            many = f"{len(odd)} frames" if len(odd) > 1 else "1 frame"
            words = f"{many} of {name} lie up to {_us(size)} from their place, worst frame {index}."
            found.append(_jitter(name, "odd_frames", size, words))
        elif rest[name] > max(_JITTER_US, _TIMES * usual):
            words = (
                f"The times of {name} scatter by {_us(rest[name])}, "
                f"those of the others by {_us(usual)}."
            )
            found.append(_jitter(name, "jitter", rest[name], words))
    return found


def _jitter(name: str, kind: str, size_us: float, words: str) -> SyncFinding:
    return SyncFinding(
        kind, (name,), _warning(size_us), words,
        (
            f"See the trigger cable of {name}: length, ends, a loose plug, a missing ground.",
            f"See that {name} takes its time stamp at the start of the exposure and not when the "
            "image is sent.",
            "If the host dates the frames, close other programs on it.",
        ),
    )  # fmt: skip


def _ticks(facts: SyncFacts) -> list[SyncFinding]:
    """Devices whose clocks tick too coarsely to tell."""
    found = []
    for column, name in enumerate(facts.ledger.devices):
        times = [e.t_dev_ns for e in facts.ledger.entries[column :: len(facts.ledger.devices)]]
        known = [t for t in times if t >= 0]
        tick = math.gcd(*np.diff(known).tolist()) if len(known) > 10 else 0
        if 1000 * GREEN_US <= tick < 250 * facts.period_us:
            found.append(
                SyncFinding(
                    "coarse_clock", (name,), Colour.AMBER,
                    f"The clock of {name} ticks in steps of {_us(tick / 1000)}: its times tell no "
                    "more.",
                    (f"Look for a setting or firmware of {name} with finer time stamps.",),
                )
            )  # fmt: skip
    return found


def _wrong_period(facts: SyncFacts) -> list[SyncFinding]:
    measured, sigma = facts.measured_us
    off = measured - facts.period_us
    ppm = 1e6 * off / facts.period_us
    if not (abs(ppm) > DRIFT_PPM and abs(off) > 5 * sigma) or _array_steps(facts):
        return []  # a jump of all clocks looks like another rate
    return [
        SyncFinding(
            "period", (), Colour.AMBER,
            f"Triggers come every {measured:.2f} us, not every {facts.period_us:.2f} us: "
            f"{1e6 / measured:.3f} Hz instead of {1e6 / facts.period_us:.3f} Hz.",
            (
                "See the rate that the trigger generator is set to.",
                "See that no device limits the rate: its exposure and readout must fit the period.",
                "Frames of one trigger still belong together: the take can be used.",
            ),
        )
    ]  # fmt: skip


def _silent(facts: SyncFacts) -> list[SyncFinding]:
    return [
        SyncFinding(
            "silent", (name,), Colour.RED, f"{name} has no good frame in the take.",
            (
                f"See that {name} is powered and linked, and that it is armed.",
                "See that it gets triggers: its trigger source must be the line that is wired.",
                f"Connect {name} again from the device list.",
            ),
        )
        for name in facts.ledger.devices
        if not good_frames(facts.ledger, name)
    ]  # fmt: skip


def _warning(us: float) -> Colour:
    return Colour.RED if abs(us) > RED_US else Colour.AMBER


def _us(us: float) -> str:
    """Microseconds, or milliseconds from one on."""
    size = abs(us)
    if size >= 1000:
        return f"{size / 1000:.2f} ms"
    return f"{size:.0f} us" if size >= 10 else f"{size:.1f} us"


def _listed(words: Sequence[str]) -> str:
    shown = list(words[:6]) + ([f"{len(words) - 6} more"] if len(words) > 6 else [])
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"


# In the order of what explains what: a jump explains scatter, a late device its offset.
_DETECTORS: tuple[Callable[[SyncFacts], list[SyncFinding]], ...] = (
    _silent, _array_steps, _periods_late, _device_steps, _runaways, _groups, _constant_offsets,
    _ticks, _jitters, _drifts, _wrong_period,
)  # fmt: skip
