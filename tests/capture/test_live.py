"""Arrays that stream in real time: takes cut out of frames that never stop, whatever goes wrong."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.arrays import Image
from capture.device_watch import DeviceState
from capture.devices.array import DeviceArray
from capture.devices.faults import Fault, FaultKind
from capture.devices.lines import RealTimeLine
from capture.devices.simulated import (
    Stamp,
    StreamingDevice,
    pattern,
    streaming_array,
    streaming_settings,
)
from capture.disk_faults import DiskFault, DiskFaultKind, SimulatedDisk
from capture.errors import DeviceError, SettingsError, TakeError
from capture.frame import FrameEvent
from capture.frame_header import ImageLayout
from capture.judgement import Colour
from capture.ledger import Verdict
from capture.live import LiveArray
from capture.live_take import LiveTake, TakePhase
from capture.recorder import RecordSettings
from capture.session import Session, Shot
from capture.take import Take
from tests.capture.recording import verdicts

LAYOUT = ImageLayout(24, 16, 1, "uint8")
SETTINGS = RecordSettings(rate_hz=100, exposure_us=1000, pre_roll=10, post_roll=5)
SMILE = Shot(slate="smile", kind="expression", frames=20)
REST = Shot(slate="rest", kind="neutral", frames=5000)


def array_of(count: int = 3, seed: int = 0) -> DeviceArray:
    return streaming_array(count, LAYOUT, seed=seed)


def done(take: LiveTake) -> Take:
    assert take.wait(20)
    assert (take.phase, take.error) == (TakePhase.DONE, "")
    assert take.check is not None
    assert take.check.problems == ()
    return Take.open(take.folder)


def check_pixels(take: Take) -> None:
    """Every image is the one that its device exposed at its trigger, by what stands in it."""
    ledger = take.ledger()
    truth: dict[int, int] = {}
    for entry in ledger.entries:
        if entry.verdict == Verdict.OK:
            image = take.image(entry.device, entry.trigger_index)
            stamp = Stamp.read(image)
            assert np.array_equal(image, pattern(LAYOUT, stamp))
            assert stamp.number == entry.frame_id
            truth.setdefault(entry.trigger_index, stamp.t_ns)
            assert stamp.t_ns == truth[entry.trigger_index]
    steps = {truth[k + 1] - truth[k] for k in truth if k + 1 in truth}
    assert steps == {take.manifest.period_ns}


def state(live: LiveArray, name: str) -> DeviceState:
    return next(state for state in live.states() if state.name == name)


def until(condition, timeout_s: float = 10.0) -> None:  # type: ignore[no-untyped-def]
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_take_is_a_window_with_what_was_before_its_key(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "s")
    with LiveArray(array_of(), SETTINGS) as live:
        time.sleep(0.15)
        pressed_ns = time.monotonic_ns()
        take = done(live.record(session, SMILE))
        assert live.trouble == ""
    assert take.manifest.frame_count == 35
    assert take.ledger().counts()[Verdict.OK] == 105
    assert take.manifest.remarks["judgement"]["colour"] == "green"
    check_pixels(take)
    at_key_ns = Stamp.read(take.image("cam00", 10)).t_ns
    assert abs(at_key_ns - pressed_ns) < 60_000_000
    assert session.take("smile").name == "smile_001"
    assert take.manifest.devices[0].sha256
    assert (take.folder / "manifest-sha256.txt").is_file()


def test_takes_may_overlap_and_a_retake_begins_before_the_last_one_is_read_back(
    tmp_path: Path,
) -> None:
    session = Session.create(tmp_path / "s")
    with LiveArray(array_of(), SETTINGS) as live:
        time.sleep(0.12)
        takes = [live.record(session, SMILE) for _ in range(3)]
        opened = [done(take) for take in takes]
    assert [take.name for take in opened] == ["smile_001", "smile_002", "smile_003"]
    for take in opened:
        assert take.ledger().counts()[Verdict.OK] == 105
        check_pixels(take)


def test_faults_while_streaming_are_in_the_ledger_and_move_no_other_frame(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "s")
    array = array_of()
    with LiveArray(array, SETTINGS) as live:
        time.sleep(0.12)
        live_take = live.record(session, Shot(slate="smile", kind="expression", frames=60))
        for kind in (FaultKind.LOSE_FRAME, FaultKind.MISS_TRIGGER, FaultKind.INCOMPLETE):
            time.sleep(0.1)
            array.devices[1].inject(Fault(kind, -1))  # type: ignore[attr-defined]
        take = done(live_take)
    found = sorted(verdicts(take.ledger(), "cam01").values())
    assert found == ["incomplete", "lost", "missed_trigger"]
    assert verdicts(take.ledger(), "cam00") == verdicts(take.ledger(), "cam02") == {}
    check_pixels(take)


def test_a_device_that_dies_is_seen_at_once_and_found_again_without_ending_the_session(
    tmp_path: Path,
) -> None:
    session = Session.create(tmp_path / "s")
    array = array_of()
    with LiveArray(array, SETTINGS) as live:
        time.sleep(0.1)
        live_take = live.record(session, Shot(slate="smile", kind="expression", frames=80))
        time.sleep(0.2)
        array.devices[2].inject(Fault(FaultKind.DEATH, -1))  # type: ignore[attr-defined]
        until(lambda: state(live, "cam02").colour == Colour.RED, 2.0)
        assert "silent" in state(live, "cam02").sentence
        assert state(live, "cam01").colour == Colour.GREEN
        take = done(live_take)
        gone = verdicts(take.ledger(), "cam02")
        assert set(gone.values()) == {"missing"}
        assert sorted(gone) == list(range(min(gone), 95))
        assert take.manifest.remarks["judgement"]["colour"] == "red"
        live.reconnect("cam02")
        until(lambda: state(live, "cam02").colour == Colour.GREEN, 2.0)
        time.sleep(0.15)
        again = done(live.record(session, SMILE))
    assert again.ledger().counts()[Verdict.OK] == 105
    check_pixels(again)


def test_a_take_may_be_ended_early(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "s")
    with LiveArray(array_of(), SETTINGS) as live:
        long = Shot(slate="rest", kind="neutral", frames=5000, hold=(1000, 4000))
        live_take = live.record(session, long)
        time.sleep(0.3)
        live_take.stop()
        take = done(live_take)
    assert 10 < take.manifest.frame_count < 300
    assert set(take.ledger().counts())
    assert take.ledger().counts()[Verdict.MISSING] == 0
    check_pixels(take)


def test_stopping_the_array_keeps_the_take_that_was_running(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "s")
    live = LiveArray(array_of(), SETTINGS)
    live.start()
    take = live.record(session, Shot(slate="rest", kind="neutral", frames=5000))
    time.sleep(0.3)
    live.stop()
    live.stop()
    opened = done(take)
    ledger = opened.ledger()
    assert ledger.triggers > 20
    assert ledger.counts()[Verdict.OK] == 3 * ledger.triggers
    check_pixels(opened)
    with pytest.raises(DeviceError, match="does not stream"):
        live.record(session, SMILE)


def test_an_array_starts_again(tmp_path: Path) -> None:
    live = LiveArray(array_of(), SETTINGS)
    for number in (1, 2):
        with live:
            time.sleep(0.12)
            take = done(live.record(Session.create(tmp_path / "s"), SMILE))
        assert take.name == f"smile_{number:03d}"
        assert take.ledger().counts()[Verdict.OK] == 105


def test_a_burst_is_collated_and_not_written(tmp_path: Path) -> None:
    with LiveArray(array_of(), SETTINGS) as live:
        recording = live.burst(20)
        images = live.latest()
    assert recording.ledger.counts()[Verdict.OK] == 60
    assert sorted(images) == ["cam00", "cam01", "cam02"]
    assert all(np.array_equal(i, pattern(LAYOUT, Stamp.read(i))) for i in images.values())


def test_silent_devices_are_named() -> None:
    faults = {"cam01": [Fault(FaultKind.DEATH, 0)]}
    array = streaming_array(3, LAYOUT, faults=faults)
    live = LiveArray(array, SETTINGS)
    with pytest.raises(DeviceError, match="from cam01; check that hardware triggers"):
        live.start()
    assert not live.running
    with pytest.raises(DeviceError, match="does not stream"):
        live.burst(3)


def test_a_device_that_is_not_there_cannot_be_found_again() -> None:
    with (
        LiveArray(array_of(), SETTINGS) as live,
        pytest.raises(TakeError, match="no device 'cam9'; there are cam00"),
    ):
        live.reconnect("cam9")


def test_the_disk_that_cannot_take_a_take_is_named_and_the_array_goes_on(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "s")
    with LiveArray(array_of(), SETTINGS) as live:
        (tmp_path / "s" / "takes").rmdir()
        (tmp_path / "s" / "takes").write_text("in the way")
        take = live.record(session, SMILE)
        assert take.wait(10)
        assert take.phase == TakePhase.FAILED
        assert "takes" in take.error
        (tmp_path / "s" / "takes").unlink()
        (tmp_path / "s" / "takes").mkdir()
        time.sleep(0.12)
        assert done(live.record(session, SMILE)).ledger().counts()[Verdict.OK] == 105
        time.sleep(1.2)
        assert all(state.taken <= 20 for state in live.states())


class Odd(StreamingDevice):
    """A third party's device with a mistake in it: raises what no device may, where it is told."""

    where = ""

    def poll(self) -> Sequence[FrameEvent]:
        if self.where == "poll":
            raise ValueError("an odd thing")
        return super().poll()

    def pixels(self, event: FrameEvent) -> Image:
        if self.where == "pixels":
            raise ValueError("an odd thing")
        return super().pixels(event)


def odd_array() -> DeviceArray:
    line = RealTimeLine()
    made = [Odd(f"cam{k:02d}", LAYOUT, line, streaming_settings(k)) for k in range(3)]
    return DeviceArray(tuple(made), line)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_error_that_nobody_foresaw_ends_the_stream_and_keeps_the_take(tmp_path: Path) -> None:
    array = odd_array()
    live = LiveArray(array, SETTINGS)
    live.start()
    take = live.record(Session.create(tmp_path / "s"), REST)
    time.sleep(0.3)
    array.devices[1].where = "poll"  # type: ignore[attr-defined]
    opened = done(take)
    assert 10 < opened.manifest.frame_count < 1000
    assert "ValueError('an odd thing')" in live.trouble
    assert not live.running
    with pytest.raises(DeviceError, match="an odd thing"):
        live.record(Session.open(tmp_path / "s"), SMILE)
    array.devices[1].where = ""  # type: ignore[attr-defined]
    live.start()  # takes it up again, as the operator does
    time.sleep(0.15)
    assert done(live.record(Session.open(tmp_path / "s"), SMILE)).ledger().counts()["ok"] == 105  # type: ignore[index]
    live.stop()


def test_an_error_that_nobody_foresaw_ends_one_frame_and_not_the_lane(tmp_path: Path) -> None:
    array = odd_array()
    with LiveArray(array, replace(SETTINGS, pre_roll=0)) as live:
        session = Session.create(tmp_path / "s")
        take = live.record(session, replace(SMILE, frames=40))
        array.devices[1].where = "pixels"  # type: ignore[attr-defined]
        taken = done(take)
        array.devices[1].where = ""  # type: ignore[attr-defined]
        assert done(live.record(session, SMILE)).ledger().counts()[Verdict.OK] == 75
    ledger = taken.ledger()
    gone = verdicts(ledger, "cam01")
    assert verdicts(ledger, "cam00") == verdicts(ledger, "cam02") == {}
    assert set(gone.values()) == {"lost"}
    assert ledger.entry(max(gone), "cam01").note == "not written: ValueError('an odd thing')"
    assert "of cam01 could not be written" in taken.manifest.remarks["judgement"]["sentence"]
    check_pixels(taken)


def test_an_array_that_is_stopped_while_the_files_of_a_take_are_still_being_made(
    tmp_path: Path,
) -> None:
    """A slow disk: its frames wait in memory, and the lanes must outlive that."""
    live = LiveArray(array_of(), SETTINGS)
    live.start()
    time.sleep(0.12)
    session = Session.create(tmp_path / "s")
    takes = [live.record(session, SMILE) for _ in range(3)]
    live.stop()
    for take in takes:
        assert done(take).ledger().triggers >= 1


def test_a_disk_that_is_full_ends_no_take_and_what_was_written_stays(small_disk: Path) -> None:
    """What devices are set to is written while there is room; then frames take all of it."""
    array = streaming_array(3, ImageLayout(128, 128, 1, "uint8"))
    with LiveArray(array, SETTINGS) as live:
        until(lambda: all(live.health().values()) and len(live.health()) == 3)
        time.sleep(0.1)
        session = Session.create(small_disk / "s")
        take = done(live.record(session, replace(SMILE, frames=80)))
        assert live.trouble == ""
        assert live.running
    ledger = take.ledger()
    counts = ledger.counts()
    assert counts[Verdict.OK] > 20
    assert counts[Verdict.OK] + counts[Verdict.LOST] == 3 * 95
    notes = {entry.note for entry in ledger.entries if entry.verdict == Verdict.LOST}
    assert all("cannot be written: No space left on device" in note for note in notes)
    for name in take.device_names:
        there = {header.trigger_index for header in take.reader(name).headers}
        ok = {k for k in range(95) if ledger.entry(k, name).verdict == Verdict.OK}
        assert there == ok
    assert sorted(path.name for path in (take.folder / "features").glob("*.json")) == [
        "cam00.json", "cam01.json", "cam02.json",
    ]  # fmt: skip


def test_a_disk_that_is_slow_full_or_tears_costs_the_frames_it_hits_and_no_more(
    tmp_path: Path,
) -> None:
    session, disk = Session.create(tmp_path / "s"), SimulatedDisk()
    with LiveArray(array_of(), SETTINGS, disk) as live:
        time.sleep(0.15)
        live_take = live.record(session, Shot(slate="smile", kind="expression", frames=60))
        until(lambda: live_take.fraction > 0.3)
        disk.inject(DiskFault(DiskFaultKind.SLOW, seconds=0.3))
        disk.inject(DiskFault(DiskFaultKind.FULL, "cam01", writes=4))
        disk.inject(DiskFault(DiskFaultKind.TORN, "cam02"))
        take = done(live_take)
    ledger = take.ledger()
    notes = {
        name: [e.note for e in ledger.entries if e.device == name and e.verdict == Verdict.LOST]
        for name in ledger.devices
    }
    assert [len(notes[name]) for name in ("cam00", "cam01", "cam02")] == [0, 4, 1]
    assert all("No space left" in note for note in notes["cam01"])
    assert "Input/output error" in notes["cam02"][0]
    assert ledger.counts()[Verdict.OK] == 3 * ledger.triggers - 5
    assert take.manifest.remarks["judgement"]["colour"] == "red"
    check_pixels(take)


def test_a_disk_fault_of_no_writes_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"found 0 and 0\.0"):
        DiskFault(DiskFaultKind.FULL, writes=0)
