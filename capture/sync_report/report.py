"""`SyncReport`: how well the devices of a take exposed together."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.arrays import Floats
from capture.clock_model import ClockModel
from capture.devices.protocol import ClockSample
from capture.documents import plain_json
from capture.errors import SettingsError
from capture.judgement import Colour, worst_colour
from capture.ledger import Ledger
from capture.sync_report.findings import SyncFacts, SyncFinding, colour_of, find_all
from capture.sync_report.times import (
    SetTimes,
    SyncBasis,
    arrival_period_us,
    delays_us,
    good_frames,
    set_times,
    slope,
)

_NAN = float("nan")
_ADVICE = {
    Colour.GREEN: "",
    Colour.AMBER: " The take can be used.",
    Colour.RED: " Take it again.",
}


@dataclass(frozen=True)
class DeviceSync:
    """How one device exposed, against the median of each complete frame set. NaN: not known.

    Attributes:
        device: its name.
        frames: good frames it has, in complete sets or not.
        offset_us: median; positive: after the others.
        offset_error_us: how wrong that may be: where times are true, by scatter only.
        jitter_us: root mean square about the offset.
        drift_ppm: how much too fast its clock runs: its own against the triggers when it was
            fitted, else how its times run away from the array's.
        residual_us: root mean square about a straight line: jitter without drift.
        worst_index: the trigger index at which it was furthest from its offset; -1 without one.
        worst_us: how far that was.
    """

    device: str
    frames: int
    offset_us: float
    offset_error_us: float
    jitter_us: float
    drift_ppm: float
    residual_us: float
    worst_index: int
    worst_us: float


@dataclass(frozen=True)
class SyncReport:
    """How well a take is synchronized. NaN: not known.

    Attributes:
        basis: what the times are; says which numbers mean what.
        colour: green, amber or red.
        sentence: why, in plain words.
        sets: complete frame sets, of `triggers`.
        triggers: of the take.
        spread_median_us: from the first to the last exposure of a frame set.
        spread_p95_us: 95 of 100 sets are below.
        spread_max_us: the largest.
        worst_index: the trigger index of that; -1 without one.
        period_us: nominal, from trigger to trigger.
        period_measured_us: as measured; by arrivals when clocks were fitted to the triggers.
        period_error_us: standard deviation of that.
        devices: in the ledger's order.
        findings: what is wrong, red first.
    """

    basis: SyncBasis
    colour: Colour
    sentence: str
    sets: int
    triggers: int
    spread_median_us: float
    spread_p95_us: float
    spread_max_us: float
    worst_index: int
    period_us: float
    period_measured_us: float
    period_error_us: float
    devices: tuple[DeviceSync, ...]
    findings: tuple[SyncFinding, ...]

    def document(self) -> dict[str, Any]:
        """The report as plain values for a JSON file; None where a number is not known."""
        plain: dict[str, Any] = plain_json(dataclasses.asdict(self))
        return plain


def sync_report(
    ledger: Ledger,
    clocks: Mapping[str, ClockModel],
    period_ns: int,
    basis: SyncBasis | str,
    readings: Mapping[str, Sequence[ClockSample]] | None = None,
) -> SyncReport:
    """Measure how well the devices of a take exposed together.

    Args:
        ledger: of the take; its `t_ns` are the times.
        clocks: by device name, its clock as fitted to the triggers; used with basis "model" only.
        period_ns: nominal, from trigger to trigger.
        basis: "ptp", "host" or "model": what `t_ns` is, see `SyncBasis`.
        readings: by device name, readings of its clock near the take; with basis "model" they
            bound a constant delay of a device, which cannot be seen otherwise.

    Raises:
        SettingsError: when the period or the basis is none.
    """
    if period_ns < 1:
        raise SettingsError(f"a sync report needs a period above 0, found {period_ns} ns")
    try:
        basis = SyncBasis(basis)
    except ValueError as error:
        known = ", ".join(SyncBasis)
        raise SettingsError(f"basis must be one of {known}, found {basis!r}") from error
    times = set_times(ledger)
    counts = {name: len(good_frames(ledger, name)) for name in ledger.devices}
    if basis == SyncBasis.MODEL:
        offsets = delays_us(clocks, readings or {}, counts, period_ns)
        drifts = {name: model.drift_ppm for name, model in clocks.items() if counts.get(name)}
        measured = arrival_period_us(ledger)
    else:
        offsets = _true_offsets(times)
        drifts, measured = {}, _period_us(times)
    facts = SyncFacts(ledger, times, basis, period_ns / 1000.0, measured, offsets, drifts)
    devices = tuple(_device(facts, name, counts[name]) for name in ledger.devices)
    findings = find_all(facts)
    spread = times.spread_us
    many = len(spread) > 0
    colour = _colour(spread, findings)
    return SyncReport(
        basis=basis,
        colour=colour,
        sentence=_sentence(facts, colour, findings),
        sets=len(spread),
        triggers=ledger.triggers,
        spread_median_us=float(np.median(spread)) if many else _NAN,
        spread_p95_us=float(np.percentile(spread, 95)) if many else _NAN,
        spread_max_us=float(spread.max()) if many else _NAN,
        worst_index=int(times.indices[np.argmax(spread)]) if many else -1,
        period_us=facts.period_us,
        period_measured_us=measured[0],
        period_error_us=measured[1],
        devices=devices,
        findings=findings,
    )


def _true_offsets(times: SetTimes) -> dict[str, tuple[float, float]]:
    if not len(times.indices):
        return {}
    apart = times.apart_us
    medians = np.median(apart, axis=0)
    # A median of n errs by 1.25 / sqrt(n) of the scatter: three times that is next to certain.
    errors = [3.75 * slope(times.indices, one)[2] / np.sqrt(len(apart)) for one in apart.T]
    return {name: (float(medians[c]), float(errors[c])) for c, name in enumerate(times.devices)}


def _period_us(times: SetTimes) -> tuple[float, float]:
    if len(times.indices) < 3:
        return _NAN, _NAN
    rise, sigma, _ = slope(times.indices, np.median(times.us, axis=1))
    return rise, sigma


def _device(facts: SyncFacts, name: str, frames: int) -> DeviceSync:
    offset, error = facts.offsets.get(name, (_NAN, _NAN))
    drift = facts.drifts_ppm.get(name, _NAN)
    if not len(facts.times.indices):
        return DeviceSync(name, frames, offset, error, _NAN, drift, _NAN, -1, _NAN)
    series = facts.times.apart_us[:, facts.times.devices.index(name)]
    away = series - float(np.median(series))
    worst = int(np.argmax(np.abs(away)))
    rise, _, rest = slope(facts.times.indices, series)
    if facts.basis != SyncBasis.MODEL and len(series) >= 3:
        drift = 1e6 * rise / facts.period_us
    return DeviceSync(
        name, frames, offset, error, float(np.sqrt(np.mean(away * away))), drift, rest,
        int(facts.times.indices[worst]), abs(float(away[worst])),
    )  # fmt: skip


def _colour(spread: Floats, findings: Sequence[SyncFinding]) -> Colour:
    colours = {finding.colour for finding in findings}
    colours.add(colour_of(float(spread.max())) if len(spread) else Colour.RED)
    return worst_colour(colours)


def _sentence(facts: SyncFacts, colour: Colour, findings: Sequence[SyncFinding]) -> str:
    spread = facts.times.spread_us
    if not len(spread):
        lead = findings[0].sentence + " " if findings else ""
        return f"{lead}No frame set is complete: how well devices are synchronized is not known."
    largest = float(spread.max())
    if colour == Colour.GREEN:
        count = len(facts.times.devices)
        return f"All {count} devices exposed within {_shown(largest)} us.{_unseen(facts)}"
    own = colour_of(largest)
    if findings and (findings[0].colour == colour or own != colour):
        more = len(findings) - 1
        rest = f" {more} more finding{'s' if more > 1 else ''}." if more else ""
        return f"{findings[0].sentence}{rest}{_ADVICE[colour]}"
    place = int(np.argmax(spread))
    apart = np.abs(facts.times.apart_us[place])
    name = facts.times.devices[int(np.argmax(apart))]
    return (
        f"Devices exposed up to {_shown(largest)} us apart, at worst {name} at frame "
        f"{facts.times.indices[place]}.{_unseen(facts)}{_ADVICE[colour]}"
    )


def _unseen(facts: SyncFacts) -> str:
    """What the basis cannot show, for the operator."""
    if facts.basis == SyncBasis.PTP:
        return ""
    if facts.basis == SyncBasis.HOST:
        return " The host dated the frames: its own delays are in this number."
    errors = [error for _, error in facts.offsets.values()]
    if len(errors) < len(facts.times.devices):
        return " A constant delay of one device cannot be seen without PTP: run the flash check."
    return f" A constant delay of one device is seen only above {_shown(max(errors))} us."


def _shown(us: float) -> str:
    return f"{us:.0f}" if us >= 10 else f"{us:.1f}"
