"""Replay: a take comes out of a device as it went in, and through a recording as the same take."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.devices.array import DeviceArray
from capture.devices.faults import Fault, FaultKind
from capture.devices.protocol import TriggerKind, TriggerSpec
from capture.devices.replay import ReplayBackend, ReplayDevice
from capture.errors import DeviceError
from capture.frame import FrameEvent
from capture.recorder import RecordSettings
from capture.session import Session, Shot, record_take
from capture.stream import Stream
from capture.take import Take
from tests.capture.recording import array_of, verdicts

RATE_HZ = 250.0
PERIOD = round(1e9 / RATE_HZ)
COUNT = 20
SETTINGS = RecordSettings(rate_hz=RATE_HZ, exposure_us=1000.0, keep_incomplete=True)
SPEC = TriggerSpec(kind=TriggerKind.FREE_RUN, period_ns=PERIOD, exposure_us=1000.0)
EDGE = SETTINGS.edge_triggers


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Take:
    """A take in which one device loses, misses and tears frames, and its clock jumps."""
    faults = {
        "cam01": [
            Fault(FaultKind.LOSE_FRAME, EDGE + 5),
            Fault(FaultKind.MISS_TRIGGER, EDGE + 8),
            Fault(FaultKind.INCOMPLETE, EDGE + 11),
            Fault(FaultKind.CLOCK_STEP, EDGE + 14, 10**9),
        ]
    }
    session = Session.create(tmp_path_factory.mktemp("replay") / "session")
    shot = Shot(slate="played", kind="neutral", frames=COUNT)
    return record_take(session, shot, array_of(2, 3, faults), SETTINGS)


def opened(take: Take, device: str = "cam01", loop: str = "") -> ReplayDevice:
    made = ReplayBackend().open(f"{take.folder}#{device}{loop}", "cam07")
    made.reserve(4 * COUNT)
    return made


def ran_freely(device: ReplayDevice, frames: int) -> list[FrameEvent]:
    device.prepare(SPEC)
    device.start()
    events: list[FrameEvent] = []
    end = time.monotonic() + 10.0
    while len(events) < frames and time.monotonic() < end:
        events += device.poll()
        time.sleep(0.002)
    return events


def test_numbers_times_gaps_and_pixels_are_those_of_the_recording(recorded: Take) -> None:
    headers = recorded.reader("cam01").headers
    assert {h.trigger_index for h in headers} == set(range(COUNT)) - {5, 8}
    device = opened(recorded)
    events = ran_freely(device, len(headers))
    assert [(e.frame_id, e.t_dev_ns, e.exposure_us, e.complete) for e in events] == [
        (h.frame_id, h.t_dev_ns, h.exposure_us, h.status == 0) for h in headers
    ]
    for place, event in enumerate(events):
        image = recorded.reader("cam01").read(place)
        assert np.array_equal(device.pixels(event), image)
    first, lag = events[0].t_host_ns, headers[0].t_host_ns
    assert [e.t_host_ns - first for e in events] == [h.t_host_ns - lag for h in headers]
    time.sleep(0.05)
    assert list(device.poll()) == []  # it is over


def test_a_loop_has_no_seam(recorded: Take) -> None:
    device = opened(recorded, "cam00", "?loop=1")
    events = ran_freely(device, 3 * COUNT)
    ids = [event.frame_id for event in events]
    assert ids == [(ids[0] + k - 1) % 65535 + 1 for k in range(len(ids))]
    steps = np.diff([event.t_dev_ns for event in events])
    assert np.all(np.abs(steps - PERIOD) < 20_000)
    assert np.array_equal(device.pixels(events[0]), device.pixels(events[COUNT]))


@pytest.mark.parametrize("period_ns", [PERIOD, PERIOD // 2, 3 * PERIOD])
def test_a_recording_of_a_replay_has_the_same_ledger_at_any_rate(
    recorded: Take, period_ns: int
) -> None:
    backend = ReplayBackend()
    devices = tuple(backend.open(f"{recorded.folder}#{n}", n) for n in recorded.device_names)
    settings = replace(SETTINGS, rate_hz=1e9 / period_ns, exposure_us=1000.0)
    stream = Stream(DeviceArray(devices, backend.line()), settings)
    stream.start()
    window = stream.open(0, COUNT, lambda frame: frame.done())
    for _ in range(COUNT + EDGE):
        stream.fire()
        stream.pump()
    while window.recording is None:
        backend.line().wait(backend.line().now_ns() + period_ns)
        stream.pump()
    stream.stop()
    for name in recorded.device_names:
        assert verdicts(window.recording.ledger, name) == verdicts(recorded.ledger(), name)
    assert [r.oddity for r in window.recording.ledger.remarks] == [
        r.oddity for r in recorded.ledger().remarks
    ]


def test_faults_come_on_top(recorded: Take) -> None:
    device = opened(recorded)
    device.inject(Fault(FaultKind.LOSE_FRAME, 2))
    device.inject(Fault(FaultKind.INCOMPLETE, 3))
    events = ran_freely(device, COUNT - 3)
    headers = [h for h in recorded.reader("cam01").headers if h.trigger_index != 2]
    assert [event.frame_id for event in events] == [h.frame_id for h in headers]
    assert [e.complete for e in events] == [h.status == 0 and h.trigger_index != 3 for h in headers]


def test_a_damaged_frame_is_played_as_incomplete_saying_so(recorded: Take, tmp_path: Path) -> None:
    folder = tmp_path / "take"
    (folder / "frames").mkdir(parents=True)
    for path in recorded.folder.rglob("*"):
        if path.is_file():
            target = folder / path.relative_to(recorded.folder)
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(path.read_bytes())
    file = folder / "frames" / "cam00.mcap"
    data = bytearray(file.read_bytes())
    at = data.index(recorded.reader("cam00").read(4).tobytes())
    data[at + 100] ^= 1
    file.write_bytes(data)
    events = ran_freely(opened(Take.open(folder), "cam00"), COUNT)
    assert [k for k, event in enumerate(events) if not event.complete] == [4]
    assert events[4].note.startswith("damaged in the recording: ")


def test_what_cannot_be_played_is_refused(recorded: Take, tmp_path: Path) -> None:
    backend = ReplayBackend()
    assert backend.discover() == ()
    with pytest.raises(DeviceError, match="cam07: expected TAKE_FOLDER#DEVICE or "):
        backend.open(str(recorded.folder), "cam07")
    with pytest.raises(DeviceError, match=r"cam07: .*no device 'cam9'; it has cam00, cam01"):
        backend.open(f"{recorded.folder}#cam9", "cam07")
    with pytest.raises(DeviceError, match=r"cam07: .*no such folder"):
        backend.open(f"{tmp_path / 'none'}#cam00", "cam07")
    slow = TriggerSpec(kind=TriggerKind.FREE_RUN, period_ns=2 * PERIOD, exposure_us=1000.0)
    with pytest.raises(DeviceError, match="asked for 125 Hz, the take was recorded at 250 Hz"):
        opened(recorded).prepare(slow)
