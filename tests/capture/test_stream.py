"""Streams: windows cut out of frames that never stop, in virtual time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from capture.devices.array import DeviceArray
from capture.devices.faults import Fault, FaultKind
from capture.devices.protocol import ClockKind, TriggerKind
from capture.devices.simulated import SimulatedDevice, SimulatedLine, SimulatedSettings
from capture.errors import DeviceError
from capture.frame import Clock, FrameEvent
from capture.ledger import Verdict
from capture.recorder import RecordSettings
from capture.stream import Stream
from capture.window import HeldFrame
from tests.capture.recording import StampScene, array_of, cameras, stamp, verdicts

SETTINGS = RecordSettings()
PERIOD = SETTINGS.period_ns


class Collected:
    """Takes frames of a window, and their pixels when told."""

    def __init__(self) -> None:
        self.frames: list[HeldFrame] = []

    def __call__(self, frame: HeldFrame) -> None:
        self.frames.append(frame)

    def images(self, first: int) -> dict[tuple[int, str], np.ndarray]:
        """Fetch and give back all frames, by trigger of the window and device."""
        found = {}
        for frame in self.frames:
            event = frame.event
            key = (frame.header(first).trigger_index, event.device)
            assert key not in found
            found[key] = frame.device.frames.pixels(event)
            frame.done()
        return found


def advance(stream: Stream, triggers: int) -> None:
    for _ in range(triggers):
        stream.fire()
        stream.pump()


def finish(stream: Stream) -> None:
    """Let the last frames arrive, then stop."""
    stream.array.line.wait(stream.array.line.now_ns() + 10 * PERIOD)
    stream.pump()
    stream.stop()


def unreleased(array: DeviceArray) -> int:
    return sum(len(device._exposed) for device in array.devices)  # type: ignore[attr-defined]


def test_windows_of_one_stream_hold_the_frames_of_their_triggers() -> None:
    array = array_of(3, faults={"cam01": [Fault(FaultKind.LOSE_FRAME, 25)]})
    stream = Stream(array, SETTINGS, ring_frames=10)
    stream.start()
    advance(stream, 20)
    early, late = Collected(), Collected()
    first = stream.open(stream.next_index, 10, early)
    advance(stream, 6)
    second = stream.open(stream.next_index - 6, 12, late)  # six of them out of the ring
    advance(stream, 20)
    assert first.recording is not None
    assert second.recording is not None
    for window, kept, gone in ((first, early, {5: "lost"}), (second, late, {5: "lost"})):
        assert window.first == 20
        assert verdicts(window.recording.ledger, "cam01") == gone
        images = kept.images(window.first)
        assert len(images) == 3 * window.count - 1
        for (k, name), image in images.items():
            time = window.recording.train.time_ns(k)
            assert np.array_equal(image, stamp(cameras(3).by_name(name), time))
    finish(stream)
    assert unreleased(array) == 0


def test_the_ring_holds_no_more_than_it_is_told() -> None:
    array = array_of(2)
    stream = Stream(array, SETTINGS, ring_frames=7)
    stream.start()
    advance(stream, 50)
    array.line.wait(array.line.now_ns() + 10 * PERIOD)
    stream.pump()
    assert unreleased(array) == 14
    latest = stream.latest()
    assert {name: f.trigger_index for name, f in latest.items()} == {"cam00": 49, "cam01": 49}
    stream.stop()
    assert unreleased(array) == 2  # those still shared by whoever asked for the latest
    for frame in latest.values():
        frame.done()
    assert unreleased(array) == 0


def test_a_frame_that_is_still_being_written_is_held_though_the_ring_is_through_with_it() -> None:
    array = array_of(1)
    stream = Stream(array, SETTINGS, ring_frames=1)
    stream.start()
    kept = Collected()
    window = stream.open(5, 4, kept)
    advance(stream, 40)
    assert window.closed.is_set()
    assert len(kept.images(5)) == 4
    finish(stream)
    assert unreleased(array) == 0


def test_what_is_over_is_forgotten() -> None:
    stream = Stream(array_of(2), SETTINGS, ring_frames=4)
    stream.start()
    advance(stream, 3000)
    tracks = stream._collator._tracks.values()  # type: ignore[union-attr]
    assert all(len(track.placed) < 600 for track in tracks)
    window = stream.open(stream.next_index, 5, lambda frame: frame.done())
    advance(stream, 10)
    assert window.recording is not None
    assert window.recording.ledger.counts()[Verdict.OK] == 10


def test_what_is_over_is_forgotten_though_a_device_died_and_its_last_frames_are_in_the_ring() -> (
    None
):
    faults = [Fault(FaultKind.MISS_TRIGGER, k) for k in range(300, 1500)]
    array = array_of(2, faults={"cam01": faults})
    stream = Stream(array, SETTINGS, ring_frames=4)
    stream.start()
    advance(stream, 1200)
    assert stream.latest()["cam01"].trigger_index == 299
    tracks = stream._collator._tracks.values()  # type: ignore[union-attr]
    assert all(len(track.placed) < 600 for track in tracks)


def test_windows_that_are_open_when_the_array_stops_end_with_what_was_sent() -> None:
    stream = Stream(array_of(2), SETTINGS)
    stream.start()
    window = stream.open(0, 500, lambda frame: frame.done())
    advance(stream, 20)
    stream.stop()
    assert window.closed.is_set()
    assert window.recording is not None
    assert window.recording.ledger.triggers == 20
    with pytest.raises(DeviceError, match="does not stream any more"):
        stream.open(20, 5, lambda frame: frame.done())


class OutOfReach(SimulatedDevice):
    """Cannot be asked for frames while `why` is not empty."""

    why = ""

    def poll(self) -> Sequence[FrameEvent]:
        if self.why:
            raise DeviceError(self.why)
        return super().poll()


def test_a_device_that_cannot_be_asked_for_frames_is_told_of_and_the_others_go_on() -> None:
    line = SimulatedLine()
    array = DeviceArray(
        tuple(OutOfReach(c, StampScene(), line, SimulatedSettings()) for c in cameras(2)), line
    )
    stream = Stream(array, SETTINGS)
    stream.start()
    window = stream.open(0, 20, lambda frame: frame.done())
    advance(stream, 10)
    array.devices[1].why = "cam01: unplugged"  # type: ignore[attr-defined]
    advance(stream, 40)
    assert stream.counts["cam01"].trouble == "cam01: unplugged"
    assert window.recording is not None
    assert verdicts(window.recording.ledger, "cam00") == {}
    assert set(verdicts(window.recording.ledger, "cam01").values()) == {"missing"}
    array.devices[1].why = ""  # type: ignore[attr-defined]
    advance(stream, 3)
    assert stream.counts["cam01"].trouble == ""


def test_a_window_may_end_early_and_keeps_what_was_exposed() -> None:
    stream = Stream(array_of(2), SETTINGS)
    stream.start()
    kept = Collected()
    window = stream.open(stream.next_index, 500, kept)
    advance(stream, 20)
    stream.shorten(window)
    advance(stream, 10)
    assert window.recording is not None
    assert window.recording.ledger.triggers == 20
    assert window.recording.ledger.counts()[Verdict.OK] == 40
    assert set(kept.images(window.first)) >= {(k, "cam00") for k in range(20)}


def test_a_silent_device_does_not_keep_a_window_open() -> None:
    faults = [Fault(FaultKind.MISS_TRIGGER, k) for k in range(10, 400)]
    stream = Stream(array_of(2, faults={"cam01": faults}), SETTINGS)
    stream.start()
    window = stream.open(5, 20, lambda frame: frame.done())
    advance(stream, 60)
    assert window.recording is not None
    assert verdicts(window.recording.ledger, "cam01") == dict.fromkeys(range(5, 20), "missing")
    assert verdicts(window.recording.ledger, "cam00") == {}


def test_triggers_that_a_stalled_host_sends_late_are_waited_for() -> None:
    array = array_of(2)
    stream = Stream(array, SETTINGS)
    stream.start()
    advance(stream, 5)
    window = stream.open(5, 10, lambda frame: frame.done())
    # Half a second passes in which nothing is sent; then all that is overdue is sent at once, while
    # the stream has just looked what has arrived.
    late_ns = array.line.now_ns() + 500_000_000
    poll = array.devices[0].poll  # type: ignore[attr-defined]

    def stalled() -> object:
        array.devices[0].poll = poll  # type: ignore[attr-defined]
        arrived = poll()
        for _ in range(10 + 2 * SETTINGS.edge_triggers):
            stream._fired += 1
        return arrived

    array.devices[0].poll = stalled  # type: ignore[attr-defined]
    array.line.wait(late_ns)
    stream.pump()
    assert not window.closed.is_set()
    stream._fired -= 10 + 2 * SETTINGS.edge_triggers
    advance(stream, 10 + 2 * SETTINGS.edge_triggers)
    array.line.wait(late_ns + 500_000_000)
    stream.pump()
    assert window.recording is not None
    assert window.recording.ledger.counts()[Verdict.OK] == 20


class OutsideLine(SimulatedLine):
    """A generator that nobody asks: an edge every `period_ns` from `begin_ns` on."""

    def __init__(self, begin_ns: int, period_ns: int) -> None:
        super().__init__()
        self.fires = False
        self._next_ns, self._period_ns = begin_ns, period_ns

    def wait(self, t_ns: int) -> None:
        while self._next_ns <= t_ns:
            super().fire(self._next_ns)
            self._next_ns += self._period_ns
        super().wait(t_ns)


class SeveralLines:
    """Devices that run free: each has a line of its own."""

    fires = False

    def __init__(self, lines: list[OutsideLine]) -> None:
        self.lines = lines

    def now_ns(self) -> int:
        return self.lines[0].now_ns()

    def wait(self, t_ns: int) -> None:
        for line in self.lines:
            line.wait(t_ns)

    def fire(self, t_ns: int) -> None:
        raise AssertionError("nobody may fire this line")


def run(stream: Stream, seconds: float) -> None:
    line = stream.array.line
    for _ in range(round(seconds * 500)):
        line.wait(line.now_ns() + 2_000_000)
        stream.pump()


def wired(line: OutsideLine, seed: int, count: int = 3) -> tuple[SimulatedDevice, ...]:
    rng = np.random.default_rng(seed)
    made = []
    for camera in cameras(count):
        clock = Clock(
            offset_ns=int(rng.integers(10**11)), drift_ppm=float(rng.uniform(-40, 40)),
            jitter_ns=1000.0,
        )  # fmt: skip
        settings = SimulatedSettings(
            clock=clock, latency_ms=float(rng.uniform(3, 9)), seed=int(rng.integers(1000)),
            first_id=int(rng.integers(1, 60_000)),
        )  # fmt: skip
        made.append(SimulatedDevice(camera, StampScene(), line, settings))
    return tuple(made)


def test_frames_of_triggers_that_were_never_made_out_are_given_back() -> None:
    line = OutsideLine(5_000_000_000, PERIOD)
    array = DeviceArray(wired(line, 1), line)
    stream = Stream(array, SETTINGS)
    line.wait(5_000_000_000 - PERIOD)
    stream.start()
    line.wait(5_000_000_000 + 2 * PERIOD)  # fewer frames than are looked at
    stream.pump()
    assert not stream.ready
    stream.stop()
    line.wait(5_000_000_000 + 20 * PERIOD)
    for device in array.devices:  # those that had not arrived were never handed over
        for event in device.frames.poll():
            device.frames.release(event)
    assert unreleased(array) == 0


def test_a_window_opens_now_though_the_generator_runs_at_another_pace() -> None:
    line = OutsideLine(5_000_000_000, round(PERIOD * 1.0008))
    stream = Stream(DeviceArray(wired(line, 1), line), SETTINGS)
    stream.start()
    run(stream, 60)  # 48 ms of slip
    asked_ns = line.now_ns()
    window = stream.open(stream.next_index, 20, lambda frame: frame.done())
    run(stream, 1)
    assert window.recording is not None
    assert window.recording.ledger.counts()[Verdict.OK] == 60
    first = min(e.t_host_ns for e in window.recording.ledger.entries)
    assert -PERIOD < first - asked_ns < 3 * PERIOD


def test_a_device_found_again_is_filed_with_the_others_though_the_generator_has_slipped() -> None:
    line = OutsideLine(5_000_000_000, round(PERIOD * 1.0008))
    array = DeviceArray(wired(line, 1), line)
    stream = Stream(array, SETTINGS)
    stream.start()
    run(stream, 60)  # 3.6 periods of slip
    found = array.devices[1]
    stream.restart("cam01", [found.latch() for _ in range(4)])  # type: ignore[attr-defined]
    run(stream, 1)
    window = stream.open(stream.next_index, 20, lambda frame: frame.done())
    run(stream, 1)
    assert window.recording is not None
    ledger = window.recording.ledger
    assert ledger.counts()[Verdict.OK] == 60
    for k in range(20):  # latencies are 3 to 9 ms
        arrivals = [ledger.entry(k, name).t_host_ns for name in ledger.devices]
        assert max(arrivals) - min(arrivals) < 7_000_000


@pytest.mark.parametrize("seed", range(4))
def test_triggers_of_a_generator_are_made_out_and_no_frame_is_misplaced(seed: int) -> None:
    period = round(PERIOD * (1 + (seed - 2) * 1e-4))  # its clock is off as well
    line = OutsideLine(5_000_000_000 + 777_777 * seed, period)
    stream = Stream(DeviceArray(wired(line, seed), line), SETTINGS, ring_frames=4)
    stream.start()
    run(stream, 8)
    assert stream.ready
    assert stream.basis == "model"
    window = stream.open(stream.next_index - 2, 200, lambda frame: frame.done())
    run(stream, 4)
    assert window.recording is not None
    assert window.recording.ledger.counts()[Verdict.OK] == 600
    assert window.recording.ledger.remarks == ()
    for k in (0, 199):  # the train is where the generator is, though their periods differ
        frame = window.first + k
        true = 5_000_000_000 + 777_777 * seed
        found = window.recording.train.time_ns(k) - true
        assert abs(found - round(found / period) * period) < 2_000_000, frame


@pytest.mark.parametrize("clock", [ClockKind.HOST, ClockKind.OWN])
def test_devices_that_run_free_at_their_own_pace_are_numbered_anew_between_takes(
    clock: ClockKind,
) -> None:
    paces = (1.0, 1.0003, 0.9998, 1.00005)
    lines = [OutsideLine(5_000_000_000 + PERIOD * k // 5, round(PERIOD * pace))
             for k, pace in enumerate(paces)]  # fmt: skip
    devices = tuple(
        SimulatedDevice(camera, StampScene(), line, SimulatedSettings())
        for camera, line in zip(cameras(4), lines, strict=True)
    )
    for device in devices:
        device.info = replace(device.info, triggers=(TriggerKind.FREE_RUN,), clock=clock)
    stream = Stream(DeviceArray(devices, SeveralLines(lines), TriggerKind.FREE_RUN), SETTINGS, 4)
    stream.start()
    newest = -1
    for _ in range(6):
        run(stream, 30)  # the fastest and the slowest part by more than a period
        first = max(stream.next_index - 4, stream.first_index)
        window = stream.open(first, 40, lambda frame: frame.done())
        run(stream, 1)
        assert window.recording is not None
        ledger = window.recording.ledger
        assert ledger.counts()[Verdict.OK] == 160
        assert ledger.remarks == ()
        for k in range(40):
            times = [ledger.entry(k, name).t_host_ns for name in ledger.devices]
            assert max(times) - min(times) < 2 * PERIOD
        assert window.first > newest
        newest = window.last
    assert stream.first_index > 0
    assert all(count.last_index < 6 * 31 * 76 for count in stream.counts.values())


def test_devices_that_run_free_keep_their_phase_and_show_their_spread() -> None:
    lines = [OutsideLine(5_000_000_000 + PERIOD * k // 4, PERIOD) for k in range(4)]
    devices = tuple(
        SimulatedDevice(camera, StampScene(), line, SimulatedSettings())
        for camera, line in zip(cameras(4), lines, strict=True)
    )
    for device in devices:
        device.info = replace(device.info, triggers=(TriggerKind.FREE_RUN,), clock=ClockKind.HOST)
    array = DeviceArray(devices, SeveralLines(lines), TriggerKind.FREE_RUN)
    stream = Stream(array, SETTINGS)
    stream.start()
    run(stream, 6)
    window = stream.open(stream.next_index, 50, lambda frame: frame.done())
    run(stream, 1)
    assert stream.basis == "host"
    assert window.recording is not None
    ledger = window.recording.ledger
    assert ledger.counts()[Verdict.OK] == 200
    assert ledger.remarks == ()
    spreads = [
        max(t) - min(t)
        for t in ([ledger.entry(k, name).t_ns for name in ledger.devices] for k in range(50))
    ]
    assert min(spreads) > 0.7 * PERIOD
