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
from dataclasses import dataclass, field
from statistics import median

from capture.clock_model import ClockModel, fit_model
from capture.devices.protocol import DeviceInfo
from capture.errors import SettingsError
from capture.frame import FrameEvent
from capture.ledger import Ledger, LedgerEntry, Oddity, Remark, Verdict

_NEAR = 0.2  # of a period: further from a whole number of periods, a clock has jumped
_REMEMBERED = 64

# What it takes to believe of a frame whose number and time disagree. A trigger is missed more often
# than the host is late, and that more often than a clock or a number jumps; a device that lost its
# clock has likely missed triggers with it. Nothing arrives before it was exposed.
_COST_MISSED, _COST_LATE, _COST_CLOCK, _COST_NUMBER, _COST_EARLY = 1.0, 1.5, 2.0, 2.0, 10.0
_IMPOSSIBLE = _COST_EARLY


@dataclass(frozen=True)
class TriggerTrain:
    """The triggers of a take.

    Attributes:
        start_ns: trigger 0, by the host's clock.
        period_ns: from trigger to trigger.
        count: how many belong to the take; post-roll is from `count` on.
        pre_roll: how many are sent before trigger 0.
    """

    start_ns: int
    period_ns: int
    count: int
    pre_roll: int = 0

    def __post_init__(self) -> None:
        if self.period_ns < 1 or self.count < 1:
            raise SettingsError(
                f"a trigger train needs a period and a count above 0, "
                f"found {self.period_ns} ns, {self.count}"
            )

    def time_ns(self, trigger_index: int) -> int:
        """When a trigger is sent, by the host's clock."""
        return self.start_ns + trigger_index * self.period_ns

    def owns(self, trigger_index: int) -> bool:
        """Whether a trigger belongs to the take."""
        return 0 <= trigger_index < self.count


@dataclass(frozen=True)
class Placement:
    """Where a frame belongs.

    Attributes:
        trigger_index: its trigger; for a quarantined frame, the one it came after.
        wanted: whether it belongs to the take: not quarantined, not pre-roll or post-roll.
    """

    trigger_index: int
    wanted: bool


@dataclass
class _Track:
    """What is known of one device so far."""

    info: DeviceInfo
    model: ClockModel
    last: FrameEvent | None = None
    last_index: int = -1
    aside: FrameEvent | None = (
        None  # a quarantined frame never seen before: a reset, if others follow
    )
    lags_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    seen: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    placed: dict[int, FrameEvent] = field(default_factory=dict)
    reasons: dict[int, tuple[Verdict, str]] = field(default_factory=dict)
    segments: list[list[int]] = field(
        default_factory=lambda: [[]]
    )  # trigger indices, cut at clock steps


class Collator:
    """Places the frames of all devices and gives every (trigger, device) pair its verdict."""

    def __init__(
        self, devices: Sequence[DeviceInfo], train: TriggerTrain, models: Mapping[str, ClockModel]
    ) -> None:
        """Begin a take.

        Args:
            devices: in the take's order.
            train: the triggers.
            models: by device name, its clock as it was read before the take.
        """
        self.train = train
        self._tracks = {info.name: _Track(info, models[info.name]) for info in devices}
        self._remarks: list[Remark] = []

    def add(self, event: FrameEvent) -> Placement:
        """Place one frame; the frames of one device must come in the order they arrived."""
        track = self._tracks[event.device]
        index = (
            self._first(track, event)
            if track.last is None
            else self._next(track, track.last, event)
        )
        if index is None:
            return Placement(track.last_index, wanted=False)
        track.last, track.last_index = event, index
        track.lags_ns.append(event.t_host_ns - self.train.time_ns(index))
        track.seen.append((event.frame_id, event.t_dev_ns))
        track.segments[-1].append(index)
        track.placed[index] = event
        return Placement(index, wanted=self.train.owns(index))

    def settled(self, trigger_index: int) -> bool:
        """Whether every device has a frame at or after this trigger."""
        return all(track.last_index >= trigger_index for track in self._tracks.values())

    def close(self) -> Ledger:
        """The ledger; pairs of which nothing was heard get the verdict MISSING."""
        names = tuple(self._tracks)
        common = {name: self._common_times(track) for name, track in self._tracks.items()}
        entries = tuple(
            self._entry(self._tracks[name], k, common[name])
            for k in range(self.train.count)
            for name in names
        )
        return Ledger(names, self.train.count, entries, tuple(self._remarks))

    def clocks(self) -> dict[str, ClockModel]:
        """Each device's clock as fitted to the trigger train; before any frame, as it was read."""
        return {
            name: self._fit(track, max(track.segments, key=len))
            for name, track in self._tracks.items()
        }

    def _first(self, track: _Track, event: FrameEvent) -> int:
        phase = (track.model.to_host(event.t_dev_ns) - self.train.start_ns) / self.train.period_ns
        newest = (event.t_host_ns - self.train.start_ns) // self.train.period_ns
        index = round(phase)
        if abs(phase - index) <= _NEAR and -self.train.pre_roll <= index <= newest:
            return index
        self._remark(track, Oddity.CLOCK_STEP, event)
        return max(newest, -self.train.pre_roll)

    def _next(self, track: _Track, last: FrameEvent, event: FrameEvent) -> int | None:
        ids = _id_step(last.frame_id, event.frame_id, track.info.id_bits)
        step = (event.t_dev_ns - last.t_dev_ns) / self.train.period_ns
        near = abs(step - round(step)) <= _NEAR
        again = (event.frame_id, event.t_dev_ns) in track.seen or (near and round(step) == ids < 0)
        if ids == 0 or again:
            self._remark(track, Oddity.DUPLICATE if ids == 0 else Oddity.STALE, event)
            if near and step > 0.5:
                track.reasons[track.last_index + round(step)] = (Verdict.QUARANTINED, "")
            return None
        by_time = track.last_index + round(step) if near and step > 0.5 else None
        by_id = track.last_index + ids if ids >= 1 else None
        agreed = by_time is not None and by_time == by_id
        index = by_time if agreed else self._weigh(track, event, by_time, by_id)
        if index is None:
            self._remark(track, Oddity.STALE, event)
            return None
        if index != by_time:
            self._remark(track, Oddity.CLOCK_STEP, event)
            track.segments.append([])
        if by_id is None or by_id > index:
            self._remark(track, Oddity.ID_RESET, event)
        self._explain_gap(track, index, by_id)
        return index

    def _weigh(
        self, track: _Track, event: FrameEvent, by_time: int | None, by_id: int | None
    ) -> int | None:
        """The likeliest index of a frame whose number and time disagree; None when none is."""
        period = self.train.period_ns
        usual = median(track.lags_ns)
        by_arrival = round((event.t_host_ns - self.train.start_ns - usual) / period)
        best, least = None, _IMPOSSIBLE
        for index in (by_time, by_id, by_arrival):
            if index is None or index <= track.last_index:
                continue
            late = (event.t_host_ns - self.train.time_ns(index) - usual) / period
            cost = _COST_EARLY if late < -0.5 else _COST_LATE if late > 0.5 else 0.0
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

    def _remark(self, track: _Track, oddity: Oddity, event: FrameEvent) -> None:
        index = max(track.last_index, -1)
        self._remarks.append(Remark(track.info.name, oddity, index, event.frame_id))

    def _fit(self, track: _Track, segment: Sequence[int]) -> ClockModel:
        if not segment:
            return track.model
        return fit_model(
            [track.placed[k].t_dev_ns for k in segment], [self.train.time_ns(k) for k in segment]
        )

    def _common_times(self, track: _Track) -> dict[int, int]:
        times: dict[int, int] = {}
        for segment in track.segments:
            if segment:
                model = self._fit(track, segment)
                times.update({k: model.to_host(track.placed[k].t_dev_ns) for k in segment})
        return times

    def _entry(self, track: _Track, k: int, common: Mapping[int, int]) -> LedgerEntry:
        name = track.info.name
        if k not in track.placed:
            verdict, note = track.reasons.get(k, (Verdict.MISSING, ""))
            return LedgerEntry(k, name, verdict, note=note)
        event = track.placed[k]
        verdict = Verdict.OK if event.complete else Verdict.INCOMPLETE
        return LedgerEntry(
            k, name, verdict, event.frame_id, event.t_dev_ns, event.t_host_ns, common[k]
        )


def _id_step(last: int, now: int, bits: int) -> int:
    """The step, the shorter way round, of a number that counts 1 .. 2^bits - 1 and wraps to 1."""
    modulus = (1 << bits) - 1
    step = (now - last) % modulus
    return step - modulus if step > modulus // 2 else step
