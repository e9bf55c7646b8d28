"""The exposure times of a take as arrays, and the numbers that can be read off them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from capture.arrays import Floats, Ints
from capture.clock_model import ClockModel
from capture.devices.protocol import ClockSample
from capture.ledger import Ledger, Verdict

_EDGE = 3  # frames that must lie on either side of a step, or it is only an odd frame
_BETTER = 0.4  # of the squares that a line leaves: a step must leave less
_FRESH_NS = 10_000_000_000
_FEWEST = 12  # among fewer frames chance looks like a step


class SyncBasis(StrEnum):
    """What the times of a ledger are, and so what a sync report can show.

    With PTP and HOST every number is true. With MODEL each device's clock was fitted to the same
    triggers, so its mean is zero by construction: scatter and jumps are seen, a constant delay of
    one device only as far as readings of its clock tell, and the trigger period only by arrivals.
    """

    PTP = "ptp"  # the devices' clocks follow one master
    HOST = "host"  # the host dated the frames; its own delays are in the numbers
    MODEL = "model"  # each device's own clock, fitted to the triggers


@dataclass(frozen=True, eq=False)
class SetTimes:
    """Exposure times of the frame sets that every device has a good frame of.

    Attributes:
        devices: names, in the ledger's order.
        indices: (F,) trigger index of each set.
        us: (F, C) microseconds after the earliest of all.
    """

    devices: tuple[str, ...]
    indices: Ints
    us: Floats

    @property
    def spread_us(self) -> Floats:
        """(F,) from the first to the last exposure of each set."""
        return np.asarray(self.us.max(axis=1) - self.us.min(axis=1), np.float64)

    @property
    def apart_us(self) -> Floats:
        """(F, C) each exposure against the median of its set."""
        return self.us - np.median(self.us, axis=1)[:, None]


@dataclass(frozen=True)
class Jump:
    """A place where a series goes on at another level.

    Attributes:
        index: trigger index of the last frame before it.
        size_us: how far it goes.
    """

    index: int
    size_us: float


def set_times(ledger: Ledger) -> SetTimes:
    """The times of the complete frame sets of a ledger; none when it has no times."""
    width = len(ledger.devices)
    kept: list[int] = []
    rows: list[list[int]] = []
    for k in range(ledger.triggers):
        row = ledger.entries[k * width : (k + 1) * width]
        if all(entry.verdict == Verdict.OK and entry.t_ns >= 0 for entry in row):
            kept.append(k)
            rows.append([entry.t_ns for entry in row])
    # Whole nanoseconds since 1970 do not fit a float: the earliest is taken away before converting.
    times = np.array(rows, np.int64).reshape(len(kept), width)
    start = times.min() if len(kept) else 0
    return SetTimes(ledger.devices, np.array(kept, np.int64), (times - start) / 1000.0)


def slope(x: Floats | Ints, y: Floats) -> tuple[float, float, float]:
    """Least-squares slope of y over x, its standard deviation, and the rms of what is left."""
    if len(x) < 3:
        return 0.0, float("inf"), _rms(y - np.mean(y)) if len(y) else 0.0
    away = x - np.mean(x)
    square = float(away @ away)
    rise = float(away @ (y - np.mean(y))) / square
    rest = y - np.mean(y) - rise * away
    sigma = float(np.sqrt(float(rest @ rest) / (len(x) - 2) / square))
    return rise, sigma, _rms(rest)


def jump_of(indices: Ints, series_us: Floats) -> Jump | None:
    """The step that explains a series better than any straight line; None when none does.

    At each place a line with a step is fitted: what the step takes off the squares that the line
    leaves is its projection on the part of the step that no line has.
    """
    count = len(series_us)
    if count < _FEWEST:
        return None
    away = indices - np.mean(indices)
    square = float(away @ away)
    rest = series_us - np.mean(series_us)
    rest = rest - float(away @ rest) / square * away
    right = np.arange(count - _EDGE, _EDGE - 1, -1)  # frames after the step
    beyond = np.cumsum(away[::-1])[right - 1]
    own = right - right**2 / count - beyond**2 / square
    sums = np.cumsum(rest[::-1])[right - 1]
    gain = sums**2 / own
    place = int(np.argmax(gain))
    whole = float(rest @ rest)
    if whole - float(gain[place]) > _BETTER * whole:
        return None
    cut = count - int(right[place])
    return Jump(int(indices[cut - 1]), float(sums[place] / own[place]))


def array_jumps(times: SetTimes, limit_us: float) -> list[Jump]:
    """Jumps of all devices at once: places where the next set comes early or late for good."""
    if len(times.indices) < 4:
        return []
    middle = np.median(times.us, axis=1)
    gaps = np.diff(times.indices)
    steps = np.diff(middle)
    excess = steps - gaps * float(np.median(steps / gaps))
    scatter = float(np.median(np.abs(excess)))
    limit = max(limit_us, 10 * scatter)
    found = []
    for place in np.flatnonzero(np.abs(excess) > limit).tolist():
        # One late trigger is followed by an early one; a jump is not.
        sums = [excess[place] + excess[near] for near in (place - 1, place + 1)
                if 0 <= near < len(excess)]  # fmt: skip
        if all(abs(total) > limit / 2 for total in sums):
            found.append(Jump(int(times.indices[place]), float(excess[place])))
    return found


def arrival_period_us(ledger: Ledger) -> tuple[float, float]:
    """The trigger period by the host's clock, from arrivals, and its standard deviation."""
    found = []
    for name in ledger.devices:
        seen = good_frames(ledger, name)
        arrived = [(k, host) for k, _, host in seen if host >= 0]
        if len(arrived) < 10:
            continue
        first = arrived[0][1]
        rise, sigma, _ = slope(
            np.array([k for k, _ in arrived], np.float64),
            np.array([(host - first) / 1000.0 for _, host in arrived]),
        )
        found.append((rise, sigma))
    if not found:
        return float("nan"), float("nan")
    return float(np.median([rise for rise, _ in found])), float(np.median([s for _, s in found]))


def good_frames(ledger: Ledger, device: str) -> list[tuple[int, int, int]]:
    """(trigger index, time on the common clock ns, arrival ns) of a device's good frames."""
    column = ledger.devices.index(device)
    entries = ledger.entries[column :: len(ledger.devices)]
    return [
        (entry.trigger_index, entry.t_ns, entry.t_host_ns)
        for entry in entries
        if entry.verdict == Verdict.OK and entry.t_ns >= 0
    ]


def delay_bounds_us(
    model: ClockModel, readings: Sequence[ClockSample], frames: int, period_ns: int
) -> tuple[float, float]:
    """How long after the triggers a device exposes: at least and at most, us.

    The model was fitted to the triggers; a reading says what the clock showed between two instants
    of the host. Each reading bounds the delay, and all bounds hold at once.

    Args:
        model: the device's clock, fitted to the triggers.
        readings: of the same clock; at least one.
        frames: how many the model was fitted to.
        period_ns: of the triggers.

    References:
        Marzullo and Owicki 1983, Maintaining the time in a distributed system: intersection of
        intervals.
    """
    bounds = []
    count = max(frames, 2)
    # Clocks wander with temperature: what was read long before says little.
    by_age = sorted(readings, key=lambda sample: abs(sample.before_ns - model.host_ns))
    reach = max(_FRESH_NS, count * period_ns)
    fresh = [one for one in by_age if abs(one.before_ns - model.host_ns) <= reach]
    for sample in fresh or by_age[:8]:
        told = model.to_host(sample.t_dev_ns)
        # A line is the less to be trusted the further one goes from the frames it was fitted to.
        far = abs(told - model.host_ns) / (count * period_ns)
        sigma = model.jitter_ns * (1.0 + (1.0 + math.sqrt(12.0) * far) / math.sqrt(count))
        bounds.append((sample.before_ns - told - 3 * sigma, sample.after_ns - told + 3 * sigma))
    low, high = max(b[0] for b in bounds), min(b[1] for b in bounds)
    if low > high:  # the clock jumped between them
        low, high = min(b[0] for b in bounds), max(b[1] for b in bounds)
    return low / 1000.0, high / 1000.0


def delays_us(
    clocks: Mapping[str, ClockModel],
    readings: Mapping[str, Sequence[ClockSample]],
    frames: Mapping[str, int],
    period_ns: int,
) -> dict[str, tuple[float, float]]:
    """By device, its delay against the array's median and how wrong that may be, us."""
    found = {
        name: delay_bounds_us(clocks[name], seen, frames[name], period_ns)
        for name, seen in readings.items()
        if seen and name in clocks and frames.get(name)
    }
    if not found:
        return {}
    least = float(np.median([low for low, _ in found.values()]))
    most = float(np.median([high for _, high in found.values()]))
    return {
        name: ((low + high - least - most) / 2, (high - low + most - least) / 2)
        for name, (low, high) in found.items()
    }


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values * values))) if len(values) else 0.0
