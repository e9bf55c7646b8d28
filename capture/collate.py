"""Frames into frame sets: by trigger index on a common clock, never by the order of arrival.

A frame is placed by two steps from the frame of its device before it: that of its number and that
of its time, in trigger periods. Where the two disagree, the one whose arrival is the more usual is
right: a frame cannot arrive before its trigger, and seldom takes much longer than the others.

=========  ==============  =====================================================================
number     time            what it means
=========  ==============  =====================================================================
1          1               OK
n          n               n - 1 frames LOST in transport or host
1          n               n - 1 triggers MISSED, or the clock jumped: arrival decides
m < n      n               m - 1 lost and n - m missed, in an unknown order
n          1               the numbers jumped (a reset); the frame is kept
< 0        forward         the numbers jumped back (a reset); the frame is kept
0          any             DUPLICATE: quarantined
< 0        back            STALE: quarantined
n          not near a      the clock jumped; the frame is kept, placed by its number
           whole number
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


@dataclass(frozen=True)
class TriggerTrain:
    """The triggers of a take.

    Attributes:
        start_ns: trigger 0, by the host's clock.
        period_ns: from trigger to trigger.
        count: how many belong to the take; pre-roll is before 0, post-roll from `count` on.
    """

    start_ns: int
    period_ns: int
    count: int

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
        index = round(phase)
        if abs(phase - index) > _NEAR:
            self._remark(track, Oddity.CLOCK_STEP, event)
        return index

    def _next(self, track: _Track, last: FrameEvent, event: FrameEvent) -> int | None:
        ids = _id_step(last.frame_id, event.frame_id, track.info.id_bits)
        periods, near = self._time_step(last, event)
        by_time = track.last_index + periods if near and periods >= 1 else None
        by_id = track.last_index + ids if ids >= 1 else None
        if ids == 0 or (by_time is None and by_id is None):
            return self._quarantine(track, event, ids)
        track.aside = None
        choices = [index for index in (by_time, by_id) if index is not None]
        usual = median(track.lags_ns)
        index = min(choices, key=lambda k: abs(event.t_host_ns - self.train.time_ns(k) - usual))
        if index != by_time:
            self._remark(track, Oddity.CLOCK_STEP, event)
            track.segments.append([])
        if index != by_id and (by_id is None or by_id > index):
            self._remark(track, Oddity.ID_RESET, event)
        self._explain_gap(track, index, by_id)
        return index

    def _quarantine(self, track: _Track, event: FrameEvent, ids: int) -> int | None:
        known = (event.frame_id, event.t_dev_ns) in track.seen
        before, track.aside = track.aside, None if known else event
        if before is not None and not known:
            periods, near = self._time_step(before, event)
            together = _id_step(before.frame_id, event.frame_id, track.info.id_bits)
            index = self._index_of_arrival(track, event)
            if near and periods == together >= 1 and index > track.last_index:
                # Two new frames in step with one another: the device began again.
                self._remark(track, Oddity.ID_RESET, event)
                self._remark(track, Oddity.CLOCK_STEP, event)
                track.segments.append([])
                self._explain_gap(track, index, None)
                return index
        self._remark(track, Oddity.DUPLICATE if ids == 0 else Oddity.STALE, event)
        return None

    def _explain_gap(self, track: _Track, index: int, by_id: int | None) -> None:
        gap = range(track.last_index + 1, index)
        lost = len(gap) if by_id is None or by_id > index else by_id - track.last_index - 1
        note = "lost and missed in an unknown order" if 0 < lost < len(gap) else ""
        for place, k in enumerate(gap):
            track.reasons[k] = (Verdict.LOST if place < lost else Verdict.MISSED_TRIGGER, note)

    def _index_of_arrival(self, track: _Track, event: FrameEvent) -> int:
        since = event.t_host_ns - self.train.start_ns - median(track.lags_ns)
        return round(since / self.train.period_ns)

    def _time_step(self, last: FrameEvent, event: FrameEvent) -> tuple[int, bool]:
        step = (event.t_dev_ns - last.t_dev_ns) / self.train.period_ns
        return round(step), abs(step - round(step)) <= _NEAR

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
