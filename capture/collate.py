"""Frames into frame sets: by trigger index on a common clock, never by the order of arrival.

A frame is placed by two steps from the frame of its device before it: that of its number and that
of its time, in trigger periods. Where the two disagree, its arrival is asked too: a frame cannot
arrive before its trigger, and seldom takes much longer than those before it.

=========  ==============  =====================================================================
number     time            what it means
=========  ==============  =====================================================================
1          1               OK
n          n               n - 1 frames LOST in transport or host
1          n               n - 1 triggers MISSED, or the clock jumped: arrival decides
m < n      n               m - 1 lost and n - m missed, in an unknown order
n          1               the numbers jumped (a reset); the frame is kept
< 0        forward         the numbers jumped back (a reset); the frame is kept
< 0        back, a jump    numbers and clock began again; the frame is kept, placed by arrival
n          not near a      the clock jumped; the frame is kept, placed by number and arrival
           whole number
0          any             DUPLICATE: quarantined, even when its time is new
< 0        the same < 0    STALE: quarantined, and so is any frame that was seen before
=========  ==============  =====================================================================
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median

from capture.clock_model import ClockModel, fit_model
from capture.devices.protocol import ClockKind, DeviceInfo
from capture.errors import SettingsError
from capture.frame import FrameEvent
from capture.ledger import Ledger, LedgerEntry, Oddity, Remark, Verdict

_NEAR = 0.2  # of a period: further from a whole number of periods, a clock has jumped
_REMEMBERED = 64
_LAGS = 16  # frames, of which the soonest tells how late frames are when nothing delays them

# What it takes to believe of a frame whose number and time disagree. A trigger is missed more often
# than the host is late, and that more often than a clock or a number jumps; a device that lost its
# clock has likely missed triggers with it. Nothing arrives before it was exposed.
_COST_MISSED, _COST_LATE, _COST_CLOCK, _COST_NUMBER, _COST_EARLY = 1.0, 1.5, 2.0, 2.0, 10.0
_IMPOSSIBLE = _COST_EARLY
_UNFOLLOWED = 3e-4  # how far clocks may part while a device is silent
_NEXT_NUMBERS = 16  # as far ahead, a frame that comes early is no old one
_PACED = 512  # frames after which a device's own pace is better known than the train's


@dataclass(frozen=True)
class TriggerTrain:
    """Triggers at equal steps of time, without end; indices run from 0.

    Attributes:
        start_ns: trigger 0, by the host's clock.
        period_ns: from trigger to trigger.
    """

    start_ns: int
    period_ns: int

    def __post_init__(self) -> None:
        if self.period_ns < 1:
            raise SettingsError(
                f"a trigger train needs a period above 0, found {self.period_ns} ns"
            )

    def time_ns(self, trigger_index: int) -> int:
        """When a trigger is sent, by the host's clock."""
        return self.start_ns + trigger_index * self.period_ns


@dataclass(frozen=True)
class DeviceClock:
    """How the times of one device are read.

    Attributes:
        model: its clock as read before any frame.
        fitted: whether the same triggers as all others expose it, so that its clock can be fitted
            to them; False when the model is to be believed: a synchronized clock, the host's own
            clock, or a device that runs free.
        phase_ns: how much later than the train's triggers it exposes; of devices that run free.
    """

    model: ClockModel
    fitted: bool = True
    phase_ns: int = 0


@dataclass
class _Track:
    """What is known of one device so far."""

    info: DeviceInfo
    clock: DeviceClock
    last: FrameEvent | None = None
    last_index: int = -1
    began: tuple[int, int] | None = None  # trigger and time of the first frame since a jump
    slip_ns: int = 0  # the train's at the latest frame
    lags_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    first_lag_ns: int | None = None  # the shortest of the first lags
    seen: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    placed: dict[int, FrameEvent] = field(default_factory=dict)
    reasons: dict[int, tuple[Verdict, str]] = field(default_factory=dict)
    segments: list[list[int]] = field(
        default_factory=lambda: [[]]
    )  # trigger indices, cut at clock steps

    def cut(self, window: range) -> _Track:
        """What is known of some triggers."""
        return replace(
            self,
            placed={k: self.placed[k] for k in window if k in self.placed},
            reasons={k: self.reasons[k] for k in window if k in self.reasons},
            segments=_cut(self.segments, window),
        )


class Collator:
    """Places the frames of all devices and gives every (trigger, device) pair its verdict.

    It goes on for as long as the array streams; takes are ledgers of a part of it. What is older
    than `forget` says is dropped, so that memory does not grow.

    Attributes:
        train: the triggers.
        slip_ns: how much later than the train says they come by now; see `follow`.
    """

    def __init__(
        self, devices: Sequence[DeviceInfo], train: TriggerTrain, clocks: Mapping[str, DeviceClock]
    ) -> None:
        """Begin.

        Args:
            devices: in the array's order.
            train: the triggers.
            clocks: by device name, how its times are read.
        """
        self.train = train
        self.slip_ns = 0
        self._tracks = {info.name: _Track(info, clocks[info.name]) for info in devices}
        self._remarks: list[Remark] = []

    def add(self, event: FrameEvent) -> int | None:
        """Place one frame; the frames of one device must come in the order they arrived.

        Returns:
            The trigger that exposed it; None when it is quarantined.
        """
        track = self._tracks[event.device]
        index = (
            self._first(track, event)
            if track.last is None
            else self._next(track, track.last, event)
        )
        if index is None:
            return None
        track.last, track.last_index, track.slip_ns = event, index, self.slip_ns
        if track.began is None:
            track.began = index, event.t_dev_ns
        track.lags_ns.append(event.t_host_ns - self.train.time_ns(index))
        if track.first_lag_ns is None and len(track.lags_ns) == _LAGS:
            track.first_lag_ns = min(track.lags_ns)
        track.seen.append((event.frame_id, event.t_dev_ns))
        track.segments[-1].append(index)
        track.placed[index] = event
        return index

    def restart(self, device: str, clock: DeviceClock) -> None:
        """Take a device up anew that was lost and found again: its next frame is a first one."""
        track = self._tracks[device]
        track.clock, track.last, track.began = clock, None, None
        track.lags_ns.clear()
        track.seen.clear()
        track.segments.append([])

    def trust(self, device: str, clock: DeviceClock) -> None:
        """Read a device's times anew from now on; its frames stay where they are."""
        self._tracks[device].clock = clock

    def follow(self) -> None:
        """Follow a generator whose period is not quite the train's.

        Frames then come later and later by the host's clock, or earlier, in all devices alike. Over
        an hour a hundred millionths make a third of a second.
        """
        if slips := self._slips_ns():
            self.slip_ns = round(median(slips))

    def parted(self) -> float:
        """How many periods devices that run free have parted since their first frames."""
        slips = self._slips_ns()
        return (max(slips) - min(slips)) / self.train.period_ns if slips else 0.0

    def train_from(self, trigger_index: int) -> TriggerTrain:
        """The train as it runs by now, counted from one of its triggers."""
        return TriggerTrain(self.train.time_ns(trigger_index) + self.slip_ns, self.train.period_ns)

    def index_at(self, t_ns: int) -> int:
        """The latest trigger at or before a time of the host's clock; negative before the first."""
        return (t_ns - self.train.start_ns - self.slip_ns) // self.train.period_ns

    def last_index(self, device: str) -> int:
        """The trigger of a device's latest frame; -1 before any."""
        return self._tracks[device].last_index

    def settled(self, trigger_index: int) -> bool:
        """Whether every device has a frame at or after this trigger."""
        return all(track.last_index >= trigger_index for track in self._tracks.values())

    def ledger(self, first: int, count: int) -> Ledger:
        """The verdicts of `count` triggers from `first` on, counted from 0.

        Pairs of which nothing was heard get the verdict MISSING.
        """
        names = tuple(self._tracks)
        window = range(first, first + count)
        common = {name: self._common_times(track, window) for name, track in self._tracks.items()}
        entries = tuple(
            self._entry(self._tracks[name], k, first, common[name])
            for k in window
            for name in names
        )
        remarks = tuple(
            replace(remark, trigger_index=remark.trigger_index - first)
            for remark in self._remarks
            if remark.trigger_index in window
        )
        return Ledger(names, count, entries, remarks)

    def cut(self, first: int, count: int) -> Collator:
        """A copy that knows these triggers alone: what is asked of it holds up no frame."""
        window = range(first, first + count)
        part = Collator([], self.train, {})
        part.slip_ns = self.slip_ns
        part._tracks = {name: track.cut(window) for name, track in self._tracks.items()}
        part._remarks = [remark for remark in self._remarks if remark.trigger_index in window]
        return part

    def clocks(self, first: int, count: int) -> dict[str, ClockModel]:
        """Each device's clock over these triggers; without frames, as it was read."""
        window = range(first, first + count)
        return {
            name: self._fit(track, max(_cut(track.segments, window), key=len, default=[]))
            for name, track in self._tracks.items()
        }

    def forget(self, before: int) -> None:
        """Drop what is known of triggers before this one."""
        for track in self._tracks.values():
            track.placed = {k: event for k, event in track.placed.items() if k >= before}
            track.reasons = {k: reason for k, reason in track.reasons.items() if k >= before}
            kept = [[k for k in part if k >= before] for part in track.segments]
            track.segments = [part for part in kept[:-1] if part] + kept[-1:]
        self._remarks = [remark for remark in self._remarks if remark.trigger_index >= before]

    def _slips_ns(self) -> list[int]:
        """Of each device known well enough, how much later its frames come than at first."""
        return [
            min(track.lags_ns) - track.first_lag_ns
            for track in self._tracks.values()
            if track.first_lag_ns is not None and track.lags_ns
        ]

    def _first(self, track: _Track, event: FrameEvent) -> int:
        period = self.train.period_ns
        start = self.train.start_ns + self.slip_ns + track.clock.phase_ns
        phase = (track.clock.model.to_host(event.t_dev_ns) - start) / period
        newest = (event.t_host_ns - start) // period
        lowest = track.last_index + 1
        index = round(phase)
        if abs(phase - index) <= _NEAR and lowest <= index <= newest:
            return index
        index = max(newest, lowest)
        self._remark(track, Oddity.CLOCK_STEP, event, index)
        return index

    def _next(self, track: _Track, last: FrameEvent, event: FrameEvent) -> int | None:
        ids = _id_step(last.frame_id, event.frame_id, track.info)
        step = (event.t_dev_ns - last.t_dev_ns) / self._pace_ns(track, last)
        near = abs(step - round(step)) <= _NEAR
        again = (event.frame_id, event.t_dev_ns) in track.seen or (near and round(step) == ids < 0)
        if ids == 0 or again:
            oddity = Oddity.DUPLICATE if ids == 0 else Oddity.STALE
            self._remark(track, oddity, event, track.last_index)
            if near and step > 0.5:
                track.reasons[track.last_index + round(step)] = (Verdict.QUARANTINED, "")
            return None
        by_time = track.last_index + round(step) if near and step > 0.5 else None
        by_id = track.last_index + ids if ids >= 1 else None
        # Within half a period, a time that is off says nothing against the number: drivers that
        # date frames themselves do so late when the host is busy.
        agreed = by_id is not None and step > 0.5 and abs(step - ids) < 0.5
        index = by_id if agreed else self._weigh(track, event, by_time, by_id)
        if index is None:
            self._remark(track, Oddity.STALE, event, track.last_index)
            return None
        # The host's own clock does not step by parts of a period: its driver was late.
        if index != by_time and not (agreed and track.info.clock == ClockKind.HOST):
            self._remark(track, Oddity.CLOCK_STEP, event, index)
            track.segments.append([])
            track.began = None
        if by_id is None or by_id > index:
            self._remark(track, Oddity.ID_RESET, event, index)
        self._explain_gap(track, index, by_id)
        return index

    def _pace_ns(self, track: _Track, last: FrameEvent) -> float:
        """From trigger to trigger by the device's clock, as it was since its clock last jumped.

        The generator and the device's clock are each off by some millionths, and a device may be
        silent for an hour.
        """
        period = self.train.period_ns
        if track.began is None or track.last_index - track.began[0] < _PACED:
            return period
        pace = (last.t_dev_ns - track.began[1]) / (track.last_index - track.began[0])
        return pace if abs(pace - period) < 0.002 * period else period

    def _weigh(
        self, track: _Track, event: FrameEvent, by_time: int | None, by_id: int | None
    ) -> int | None:
        """The likeliest index of a frame whose number and time disagree; None when none is."""
        period, slipped = self.train.period_ns, self.slip_ns - track.slip_ns
        usual, soonest = median(track.lags_ns) + slipped, min(track.lags_ns) + slipped
        by_arrival = round((event.t_host_ns - self.train.start_ns - usual) / period)
        best, least = None, _IMPOSSIBLE
        if by_id is not None and by_id - track.last_index <= _NEXT_NUMBERS:
            # One of the next numbers is a new frame: the host may have been late until now.
            by_arrival, least = max(by_arrival, track.last_index + 1), float("inf")
        for index in (by_time, by_id, by_arrival):
            if index is None or index <= track.last_index:
                continue
            lag = event.t_host_ns - self.train.time_ns(index)
            most = 0.5 + _UNFOLLOWED * (index - track.last_index)
            # A busy host is late by turns: early is what comes sooner than any frame before.
            early, late = (soonest - lag) / period > most, (lag - usual) / period > most
            cost = _COST_EARLY if early else _COST_LATE if late else 0.0
            cost += 0.0 if index == by_time else _COST_CLOCK
            if by_id is None or by_id > index:
                cost += _COST_NUMBER
            elif by_id < index:
                cost += _COST_MISSED
            if cost < least:
                best, least = index, cost
        return best

    def _explain_gap(self, track: _Track, index: int, by_id: int | None) -> None:
        gap = range(track.last_index + 1, index)
        lost = len(gap) if by_id is None or by_id > index else by_id - track.last_index - 1
        note = "lost and missed in an unknown order" if 0 < lost < len(gap) else ""
        for place, k in enumerate(gap):
            verdict = Verdict.LOST if place < lost else Verdict.MISSED_TRIGGER
            track.reasons.setdefault(k, (verdict, note))

    def _remark(self, track: _Track, oddity: Oddity, event: FrameEvent, index: int) -> None:
        self._remarks.append(Remark(track.info.name, oddity, index, event.frame_id))

    def _fit(self, track: _Track, segment: Sequence[int]) -> ClockModel:
        if not segment or not track.clock.fitted:
            return track.clock.model
        start = self.train_from(0)
        return fit_model(
            [track.placed[k].t_dev_ns for k in segment], [start.time_ns(k) for k in segment]
        )

    def _common_times(self, track: _Track, window: range) -> dict[int, int]:
        times: dict[int, int] = {}
        for segment in _cut(track.segments, window):
            model = self._fit(track, segment)
            times.update({k: model.to_host(track.placed[k].t_dev_ns) for k in segment})
        return times

    def _entry(self, track: _Track, k: int, first: int, common: Mapping[int, int]) -> LedgerEntry:
        name = track.info.name
        if k not in track.placed:
            verdict, note = track.reasons.get(k, (Verdict.MISSING, ""))
            return LedgerEntry(k - first, name, verdict, note=note)
        event = track.placed[k]
        verdict = Verdict.OK if event.complete else Verdict.INCOMPLETE
        return LedgerEntry(
            k - first, name, verdict, event.frame_id, event.t_dev_ns, event.t_host_ns, common[k],
            event.note,
        )  # fmt: skip


def _cut(segments: Sequence[Sequence[int]], window: range) -> list[list[int]]:
    """The parts of the segments that lie in a window; empty ones are left out."""
    parts = ([k for k in part if k in window] for part in segments)
    return [part for part in parts if part]


def _id_step(last: int, now: int, info: DeviceInfo) -> int:
    """The step, the shorter way round, of a number that counts up and wraps to its first."""
    modulus = (1 << info.id_bits) - info.first_id
    step = (now - last) % modulus
    return step - modulus if step > modulus // 2 else step
