"""The Aravis backend against a GigE Vision device of our own: what the fake device cannot show."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections.abc import Callable, Iterator

import pytest

from capture.devices.aravis import AravisDevice, backend
from capture.devices.capabilities import (
    ActionTriggered,
    Cautioned,
    Featured,
    Latching,
    PtpClocked,
    SoftwareTriggered,
)
from capture.devices.gvcp import send_action
from capture.devices.preset import Preset, apply_preset
from capture.devices.protocol import ActionKeys, TriggerKind, TriggerSpec
from capture.errors import DeviceError
from capture.frame import FrameEvent
from tests.gige.camera.pixels import Stamp, read_stamp
from tests.gige.camera.raw import require_aravis
from tests.gige.camera.running import RunningDevice, free_addresses
from tests.gige.camera.setup import Setup
from tests.gige.camera.wire import GVCP_PORT, Reg

pytestmark = pytest.mark.gige

Open = Callable[..., AravisDevice]
SMALL = {"path_mtu": 1500}  # eleven packets a frame


@pytest.fixture(scope="module")
def running() -> Iterator[RunningDevice]:
    require_aravis()
    with RunningDevice(Setup(address=free_addresses(1)[0])) as made:
        yield made


@pytest.fixture
def own(running: RunningDevice) -> RunningDevice:
    running.renew(**SMALL)
    return running


@pytest.fixture
def opened(own: RunningDevice) -> Iterator[AravisDevice]:
    device = backend.open(own.address, "cam01")
    with contextlib.closing(device):
        yield device


def begin(device: AravisDevice, kind: TriggerKind = TriggerKind.FREE_RUN, **rest: object) -> None:
    """Set up for 50 Hz and start."""
    spec = TriggerSpec(kind=kind, period_ns=20_000_000, exposure_us=1000.0, **rest)  # type: ignore[arg-type]
    device.frames.reserve(40)
    device.trigger.prepare(spec)
    device.acquire.start()


def events_of(
    device: AravisDevice, count: int, patience_s: float = 15.0
) -> list[tuple[FrameEvent, Stamp | None]]:
    """The next so many frames, and what the pixels of each prove; more that came are let go."""
    found: list[tuple[FrameEvent, Stamp | None]] = []
    end = time.monotonic() + patience_s
    while len(found) < count and time.monotonic() < end:
        for event in device.frames.poll():
            found.append((event, read_stamp(device.frames.pixels(event))))
            device.frames.release(event)
        time.sleep(0.002)
    return found[:count]


def true(event: FrameEvent, stamp: Stamp | None) -> bool:
    return stamp is not None and stamp.frame_id == event.frame_id


def until(so: Callable[[], bool], patience_s: float = 15.0) -> bool:
    end = time.monotonic() + patience_s
    while not so() and time.monotonic() < end:
        time.sleep(0.02)
    return so()


def test_it_is_found_with_its_link_and_named_when_another_program_holds_it(
    own: RunningDevice,
) -> None:
    own.renew(serial="OWN-77", link_mbps=5000)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        take = struct.pack(">BBHHHII", 0x42, 1, 0x82, 8, 1, Reg.PRIVILEGE, 2)
        other.settimeout(2)
        other.sendto(take, (own.address, GVCP_PORT))
        assert other.recv(64)[:2] == b"\0\0"
        found = {one.serial: one for one in backend.discover()}["OWN-77"]
    assert (found.address, found.transport, found.link_mbps) == (own.address, "gige", 5000)
    assert found.problems == ("in use by another program; close that program",)


def test_it_says_what_it_is_and_can_do(opened: AravisDevice, own: RunningDevice) -> None:
    info = opened.info
    assert (info.serial, info.model) == (own.setup.serial, "Likeness OwnDevice")
    assert (info.layout.width, info.layout.height, info.id_bits) == (128, 96, 64)
    assert set(info.triggers) == set(TriggerKind)
    for ability in (Featured, Latching, PtpClocked, SoftwareTriggered, ActionTriggered):
        assert isinstance(opened, ability)
    dump = opened.features()
    assert dump.values["DeviceTemperature"] == 41.5
    assert dump.values["DeviceSerialNumber"] == own.setup.serial
    assert "OwnDevice" in dump.description
    assert len(dump.description_sha256) == 64


def test_a_preset_reads_back_or_says_what_the_device_made_of_it(opened: AravisDevice) -> None:
    good = Preset("day", (("PixelFormat", "Mono12"), ("Width", 64), ("Gain", 3.0)))
    assert apply_preset(opened, good) == ()
    assert (opened.info.layout.width, opened.info.layout.dtype) == (64, "uint16")
    bad = Preset("night", (("Gain", 99.0), ("PixelFormat", "Mono10")))
    differences = {one.feature: str(one) for one in apply_preset(opened, bad)}
    assert "reads 3.0" in differences["Gain"]
    assert "Mono8, Mono12, Mono16" in differences["PixelFormat"]


def test_a_device_that_cannot_be_recorded_is_let_go_while_its_error_is_kept(
    own: RunningDevice,
) -> None:
    own.renew(packed=True, **SMALL)
    for _ in range(2):  # the second says the same: the first does not hold it
        with pytest.raises(
            DeviceError,
            match=r"asked for Mono12p, which is packed .*; none that it offers can be taken$",
        ) as caught:
            backend.open(own.address, "cam01")
        kept = caught.value
        assert not own.state().controlled, kept


def test_triggers_that_come_too_fast_for_the_device_are_told(opened: AravisDevice) -> None:
    assert isinstance(opened, Cautioned)
    fast = TriggerSpec(kind=TriggerKind.HARDWARE, period_ns=1_600_000, exposure_us=100.0)
    opened.trigger.prepare(fast)
    assert opened.problems == (
        "triggers come at 625 Hz, and with its present exposure and image size it takes 500 Hz, "
        "so it will miss some; shorten the exposure, make the image smaller, or lower the rate",
    )
    opened.trigger.prepare(TriggerSpec(kind=TriggerKind.HARDWARE, period_ns=10**7, exposure_us=100))
    assert opened.problems == ()


def test_a_dropped_packet_is_recovered_and_noted(opened: AravisDevice, own: RunningDevice) -> None:
    own.plan("drop", after=5, packets=(4,))
    begin(opened)
    frames = events_of(opened, 24)
    assert [event.frame_id for event, _ in frames] == list(range(1, 25))
    assert all(event.complete and true(event, stamp) for event, stamp in frames)
    # A busy machine may make Aravis ask for more, so that other frames are noted as well.
    assert "packets resent" in {event.note for event, _ in frames if event.frame_id == 6}
    assert "" in {event.note for event, _ in frames}
    assert own.state().resent >= 1


def test_at_75_hz_packets_are_asked_for_before_their_frame_is_given_up(
    opened: AravisDevice, own: RunningDevice
) -> None:
    for k in range(30):
        own.plan("drop", after=5 + 4 * k, packets=(4,))
    opened.frames.reserve(40)
    opened.trigger.prepare(
        TriggerSpec(kind=TriggerKind.FREE_RUN, period_ns=10**9 // 75, exposure_us=1000.0)
    )
    opened.acquire.start()
    frames = events_of(opened, 130)
    dropped = [deed.frame_id for deed in own.deeds() if deed.outcome == "dropped"]
    came = [event.frame_id for event, _ in frames if event.complete]
    # With the 20 ms that Aravis waits by itself before it asks, 17 of 30 were recovered.
    assert len(set(dropped) & set(came)) >= 20


@pytest.mark.parametrize("mode", ["silent", "unavailable"])
def test_a_frame_whose_packet_never_comes_is_incomplete(
    opened: AravisDevice, own: RunningDevice, mode: str
) -> None:
    own.set(resend=mode)
    own.plan("drop", after=5, packets=(4,))
    begin(opened)
    frames = events_of(opened, 12)
    assert [event.frame_id for event, _ in frames if not event.complete] == [6]
    assert all(true(event, stamp) for event, stamp in frames if event.complete)
    (note,) = [event.note for event, _ in frames if not event.complete]
    assert note.startswith("incomplete: timeout")


@pytest.mark.parametrize("mode", ["wrong_frame", "wrong_data"])
def test_a_frame_spoilt_by_a_wrong_packet_never_passes_without_a_note(
    opened: AravisDevice, own: RunningDevice, mode: str
) -> None:
    own.set(resend=mode)
    own.plan("drop", after=5, packets=(4,))
    begin(opened)
    frames = events_of(opened, 14)
    spoilt = [event for event, stamp in frames if event.complete and not true(event, stamp)]
    assert spoilt  # Aravis calls it good: the trap is real
    assert all("packets resent" in event.note for event in spoilt)
    assert "" in {event.note for event, _ in frames}


def test_numbers_of_64_bits_pass_65535(opened: AravisDevice, own: RunningDevice) -> None:
    own.set(first_id=65533)
    begin(opened)
    frames = events_of(opened, 6)
    assert [event.frame_id for event, _ in frames] == list(range(65533, 65539))
    assert all(true(event, stamp) for event, stamp in frames)


def test_numbers_of_16_bits_wrap_to_1(opened: AravisDevice, own: RunningDevice) -> None:
    own.set(first_id=65533)
    opened.write_feature("GevGVSPExtendedIDMode", "Off")
    assert (opened.info.id_bits, opened.info.first_id) == (16, 1)
    begin(opened)
    assert [event.frame_id for event, _ in events_of(opened, 6)] == [65533, 65534, 65535, 1, 2, 3]


def test_the_exposure_of_each_frame_comes_from_its_chunk(
    opened: AravisDevice, own: RunningDevice
) -> None:
    opened.write_feature("ChunkModeActive", True)
    begin(opened)
    before = events_of(opened, 3)
    opened.write_feature("ExposureTime", 2500.0)  # while it streams, which `prepare` did not see
    after = events_of(opened, 8)
    assert {event.exposure_us for event, _ in before} == {1000.0}
    assert after[-1][0].exposure_us == 2500.0
    assert all(event.complete and true(event, stamp) for event, stamp in before + after)
    own.set(chunk_type="old")  # the payload type of GigE Vision 1
    (last,) = events_of(opened, 4)[-1:]
    assert last[0].complete
    assert last[0].exposure_us == 2500.0
    assert true(*last)


def test_without_chunks_the_exposure_is_the_one_that_was_written_last(opened: AravisDevice) -> None:
    begin(opened)
    assert events_of(opened, 1)[0][0].exposure_us == 1000.0
    opened.write_feature("ExposureTime", 2500.0)
    assert events_of(opened, 4)[-1][0].exposure_us == 2500.0


def test_the_clock_is_read_between_two_readings_of_the_host(
    opened: AravisDevice, own: RunningDevice
) -> None:
    sample, state = opened.latch(), own.state()
    at_ns = state.now_ns - (state.clock_ns - sample.t_dev_ns)  # by the host, when it was latched
    assert sample.before_ns <= at_ns <= sample.after_ns


def test_a_drifting_clock_shows_in_its_readings(opened: AravisDevice, own: RunningDevice) -> None:
    own.set(drift_ppm=20_000.0)
    first = opened.latch()
    time.sleep(0.3)
    last = opened.latch()
    ran_ns = last.t_dev_ns - first.t_dev_ns
    least, most = last.before_ns - first.after_ns, last.after_ns - first.before_ns
    assert 1.02 * least - 10 <= ran_ns <= 1.02 * most + 10


def test_ptp_is_enabled_once_and_read_with_its_offset(own: RunningDevice) -> None:
    own.renew(ptp_settle_s=0.6, ptp_offset_ns=-420, **SMALL)
    with contextlib.closing(backend.open(own.address, "cam01")) as device:
        assert isinstance(device, PtpClocked)
        assert device.ptp().state == "disabled"
        device.enable_ptp(True)
        began = time.monotonic()
        assert device.ptp().state == "listening"
        while device.ptp().state == "listening" and time.monotonic() < began + 5:
            device.enable_ptp(True)  # a device that listens is not set back
            time.sleep(0.05)
        reading = device.ptp()
        assert (reading.state, reading.offset_ns, reading.locked) == ("slave", -420, True)
        assert reading.grandmaster == f"{own.setup.grandmaster:016x}"
        own.set(offset_ns=90_000)
        assert device.ptp().offset_ns == 90_000
        own.set(ptp_state="Faulty")
        health = device.health()
        assert health.ptp is not None
        assert (health.ptp.state, health.ptp.locked) == ("faulty", False)


def test_a_software_trigger_exposes_once(opened: AravisDevice) -> None:
    begin(opened, TriggerKind.SOFTWARE)
    assert isinstance(opened, SoftwareTriggered)
    opened.fire()
    (frame,) = events_of(opened, 2, patience_s=1.0)  # no second one comes
    assert true(*frame)


def test_an_action_command_exposes_and_is_answered(
    opened: AravisDevice, own: RunningDevice
) -> None:
    keys = ActionKeys(device_key=3, group_key=4, group_mask=1)
    begin(opened, TriggerKind.ACTION, action=keys)
    assert isinstance(opened, ActionTriggered)
    assert send_action([opened.action_address], keys).complete
    (frame,) = events_of(opened, 2, patience_s=1.0)  # no second one comes
    assert true(*frame)
    opened.write_feature("ActionDeviceKey", 99)
    assert send_action([own.address], keys, timeout_s=0.1).silent == (own.address,)


def test_a_device_that_died_says_so_soon_and_comes_back(
    opened: AravisDevice, own: RunningDevice
) -> None:
    begin(opened)
    assert len(events_of(opened, 3)) == 3
    own.set(dead=True)
    began = time.monotonic()
    assert not opened.health().connected
    with pytest.raises(DeviceError, match="cam01"):
        opened.read_feature("Gain")
    assert time.monotonic() - began < 4.5  # Aravis by itself would try for 5 s
    own.ask("reboot", off_s=0.1)
    assert until(lambda: not own.state().off)
    opened.reconnect()
    frames = events_of(opened, 3)
    assert [event.frame_id for event, _ in frames] == [1, 2, 3]
    assert all(event.complete and true(event, stamp) for event, stamp in frames)
    assert opened.health().connected


def test_a_reboot_under_our_hands_is_noticed(opened: AravisDevice, own: RunningDevice) -> None:
    begin(opened)
    assert len(events_of(opened, 3)) == 3
    own.ask("reboot", off_s=0.05)
    assert until(lambda: not own.state().off)
    assert until(lambda: not opened.health().connected)
    opened.reconnect()
    assert [event.frame_id for event, _ in events_of(opened, 2)] == [1, 2]


def test_a_device_that_is_busy_sends_nothing_and_is_connected(
    opened: AravisDevice, own: RunningDevice
) -> None:
    own.set(busy=True)
    begin(opened)
    time.sleep(0.2)
    assert opened.frames.poll() == []
    assert opened.health().connected
    own.set(busy=False)
    assert [event.frame_id for event, _ in events_of(opened, 2)] == [1, 2]
