"""Real Aravis against a GigE Vision device of our own: what the transport can and cannot do."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections.abc import Iterator

import pytest

from capture.devices.gvcp import send_action
from capture.devices.protocol import ActionKeys
from tests.gige.camera.pixels import read_stamp, read_stamps
from tests.gige.camera.raw import RawAravis, RawFrame, require_aravis
from tests.gige.camera.running import RunningDevice, free_addresses
from tests.gige.camera.setup import MASTER_EPOCH_NS, Setup
from tests.gige.camera.wire import GVCP_PORT, Reg

pytestmark = pytest.mark.gige

KEYS = ActionKeys(device_key=7, group_key=9, group_mask=0b10)
RATE = {"AcquisitionFrameRate": 50.0}


@pytest.fixture(scope="module", autouse=True)
def _aravis() -> None:
    require_aravis()


@pytest.fixture(scope="module")
def running() -> Iterator[list[RunningDevice]]:
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(RunningDevice(Setup(address=a))) for a in free_addresses(3)]


@pytest.fixture
def devices(running: list[RunningDevice]) -> list[RunningDevice]:
    for number, one in enumerate(running):
        one.renew(serial=f"OWN-{number}")
    return running


@pytest.fixture
def device(devices: list[RunningDevice]) -> RunningDevice:
    return devices[0]


def truthful(frame: RawFrame, bits: int = 8) -> bool:
    stamp = read_stamp(frame.image(bits=bits), bits)
    return stamp is not None and stamp.frame_id == frame.frame_id


def counter(aravis: RawAravis, name: str) -> int:
    return int(aravis.stream.get_info_uint64_by_name(name))


def ready_for(aravis: RawAravis, source: str) -> None:
    aravis.write(TriggerMode="On", TriggerSource=source)
    if source == "Action1":
        aravis.write(
            ActionDeviceKey=KEYS.device_key, ActionGroupKey=KEYS.group_key, ActionGroupMask=0b11
        )
    aravis.start()


def ask(address: str, command: int, body: bytes, patience_s: float = 2.0) -> tuple[int, bytes]:
    """One command from a stranger: status and body of the answer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.settimeout(patience_s)
        port.sendto(
            struct.pack(">BBHHH", 0x42, 1, command, len(body), 77) + body, (address, GVCP_PORT)
        )
        reply = port.recv(2048)
    status, _, _, request = struct.unpack_from(">HHHH", reply)
    assert request == 77
    return status, reply[8:]


def test_devices_are_discovered_over_loopback_by_serial(devices: list[RunningDevice]) -> None:
    aravis = require_aravis()
    aravis.update_device_list()
    found = {  # pairs: another run on this machine may have devices of the same serials
        (aravis.get_device_serial_nbr(k), aravis.get_device_address(k))
        for k in range(aravis.get_n_devices())
    }
    assert found >= {(one.setup.serial, one.address) for one in devices}


def test_frames_prove_their_number_and_trigger(device: RunningDevice) -> None:
    with RawAravis(device.address) as aravis:
        aravis.write(**RATE)
        aravis.start()
        frames = aravis.frames(10)
    deeds = {deed.frame_id: deed for deed in device.deeds()}
    assert [frame.frame_id for frame in frames] == list(range(1, 11))
    for frame in frames:
        stamp, deed = read_stamp(frame.image()), deeds[frame.frame_id]
        assert stamp is not None
        assert (stamp.frame_id, stamp.t_ns) == (frame.frame_id, deed.t_ns)
        assert frame.t_dev_ns == deed.t_dev_ns


@pytest.mark.parametrize(("pixel_format", "bits"), [("Mono12", 12), ("Mono16", 16)])
def test_deep_pixels_and_a_smaller_image(
    device: RunningDevice, pixel_format: str, bits: int
) -> None:
    with RawAravis(device.address) as aravis:
        aravis.write(PixelFormat=pixel_format, Width=64, Height=48, **RATE)
        aravis.start()
        for frame in aravis.frames(2):
            stamp = read_stamp(frame.image(64, 48, bits), bits)
            assert stamp is not None
            assert stamp.frame_id == frame.frame_id


def test_settings_keep_their_bounds_and_are_held_while_streaming(device: RunningDevice) -> None:
    with RawAravis(device.address) as aravis:
        with pytest.raises(Exception, match="invalid-parameter"):
            aravis.write(ExposureTime=5.0)
        aravis.write(ExposureTime=1234.5, Gain=6.0)
        aravis.start()
        with pytest.raises(Exception, match="busy"):
            aravis.write(Width=64)
        assert (aravis.read("ExposureTime"), aravis.read("Gain")) == (1234.5, 6.0)
        device.set(temperature_c=55.5)
        assert aravis.read("DeviceTemperature") == 55.5


def test_a_second_program_is_refused(device: RunningDevice) -> None:
    with RawAravis(device.address) as first:
        with RawAravis(device.address) as second:
            assert not second.device.is_controller()
            with pytest.raises(Exception, match="access-denied"):
                second.write(Gain=1.0)
        first.write(Gain=1.0)
    assert not device.state().controlled


def test_a_silent_program_loses_the_device(device: RunningDevice) -> None:
    take = struct.pack(">II", Reg.PRIVILEGE, 2)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.sendto(struct.pack(">BBHHH", 0x42, 1, 0x82, 8, 1) + take, (device.address, GVCP_PORT))
        short = struct.pack(">II", Reg.HEARTBEAT, 250)
        port.sendto(struct.pack(">BBHHH", 0x42, 1, 0x82, 8, 2) + short, (device.address, GVCP_PORT))
        port.settimeout(2)
        assert [struct.unpack_from(">H", port.recv(64))[0] for _ in range(2)] == [0, 0]
        assert device.state().controlled
        assert ask(device.address, 0x82, take)[0] == 0x8006
        end = time.monotonic() + 5
        while device.state().controlled and time.monotonic() < end:
            time.sleep(0.02)
    assert not device.state().controlled


def test_the_largest_packet_that_passes_is_found(device: RunningDevice) -> None:
    with RawAravis(device.address) as aravis:
        for mtu in (9000, 4000, 1500):
            device.set(path_mtu=mtu)
            assert mtu - 4 <= aravis.device.auto_packet_size() <= mtu
        aravis.write(**RATE)
        aravis.start()
        assert all(truthful(frame) for frame in aravis.frames(3))


@pytest.mark.parametrize("packet", [0, 4, 10])  # the leader, pixels, the trailer
def test_a_dropped_packet_is_asked_for_and_comes(device: RunningDevice, packet: int) -> None:
    with RawAravis(device.address) as aravis:
        aravis.write(**RATE)
        device.plan("drop", after=2, packets=(packet,))
        aravis.start()
        frames = aravis.frames(5)
        assert [frame.frame_id for frame in frames] == [1, 2, 3, 4, 5]
        assert all(frame.good and truthful(frame) for frame in frames)
        assert counter(aravis, "n_resent_packets") >= 1  # more on a busy machine
    assert [deed.outcome for deed in device.deeds()][:5] == [
        "sent",
        "sent",
        "dropped",
        "sent",
        "sent",
    ]


@pytest.mark.parametrize("mode", ["silent", "unavailable"])
def test_a_packet_that_never_comes_leaves_one_bad_frame(device: RunningDevice, mode: str) -> None:
    with RawAravis(device.address) as aravis:
        aravis.write(**RATE)
        device.set(resend=mode)
        device.plan("drop", after=2, packets=(4,))
        aravis.start()
        frames = aravis.frames(6)
        assert 3 in [frame.frame_id for frame in frames if not frame.good]
        assert all(truthful(frame) for frame in frames if frame.good)
        assert counter(aravis, "n_resent_packets") == 0


def test_a_mislabelled_packet_spoils_a_frame_that_aravis_calls_good(device: RunningDevice) -> None:
    """Aravis issue 311: the next frame takes the packet, and drops its own as a duplicate."""
    with RawAravis(device.address) as aravis:
        aravis.write(**RATE)
        device.set(resend="wrong_frame")
        device.plan("drop", after=2, packets=(4,))
        aravis.start()
        frames = aravis.frames(20)
        assert 3 in [frame.frame_id for frame in frames if not frame.good]
        spoilt = [frame for frame in frames if frame.good and not truthful(frame)]
        assert spoilt
        rows = {stamp.frame_id for stamp in read_stamps(spoilt[0].image()) if stamp}
        assert rows == {3, spoilt[0].frame_id}
        # The counter of resent packets does not see it; those of requests and of duplicates do.
        assert counter(aravis, "n_resent_packets") == 0
        assert counter(aravis, "n_resend_requests") >= 1
        assert counter(aravis, "n_duplicated_packets") >= 1


def test_a_wrong_content_spoils_a_frame_that_aravis_calls_good(device: RunningDevice) -> None:
    with RawAravis(device.address) as aravis:
        aravis.write(**RATE)
        device.set(resend="wrong_data")
        device.plan("drop", after=2, packets=(4,))
        aravis.start()
        frames = aravis.frames(5)
        assert all(frame.good for frame in frames)
        assert 3 in [frame.frame_id for frame in frames if not truthful(frame)]
        assert counter(aravis, "n_resent_packets") >= 1


@pytest.mark.parametrize(
    ("mode", "ids"), [("Off", [65534, 65535, 1, 2]), ("On", [65534, 65535, 65536, 65537])]
)
def test_numbers_of_16_bits_wrap_to_1_and_of_64_bits_do_not(
    device: RunningDevice, mode: str, ids: list[int]
) -> None:
    device.renew(first_id=65534)
    with RawAravis(device.address) as aravis:
        aravis.write(GevGVSPExtendedIDMode=mode, **RATE)
        device.plan("drop", after=2, packets=(4,))
        aravis.start()
        frames = aravis.frames(4)
        assert [frame.frame_id for frame in frames] == ids
        assert all(frame.good and truthful(frame) for frame in frames)
    assert device.state().resent >= 1


@pytest.mark.parametrize("kind", ["new", "old"])
def test_chunks_say_when_how_long_and_which(device: RunningDevice, kind: str) -> None:
    with RawAravis(device.address) as aravis:
        device.set(chunk_type=kind)
        aravis.write(ChunkModeActive=True, ExposureTime=2345.5, **RATE)
        aravis.start()
        parser = aravis.device.create_chunk_parser()
        for frame in aravis.frames(3):
            assert truthful(frame)
            assert parser.get_float_value(frame.buffer, "ChunkExposureTime") == 2345.5
            assert parser.get_integer_value(frame.buffer, "ChunkTimestamp") == frame.t_dev_ns
            assert parser.get_integer_value(frame.buffer, "ChunkFrameID") == frame.frame_id


def test_the_clock_can_be_latched_stepped_and_set_back(device: RunningDevice) -> None:
    with RawAravis(device.address) as aravis:

        def latched() -> int:
            aravis.run("GevTimestampControlLatch")
            return int(aravis.read("GevTimestampValue"))

        first = latched()
        device.ask("step_clock", by_ns=10**12)
        assert latched() > first + 10**12
        aravis.run("GevTimestampControlReset")
        assert latched() < 10**10
        aravis.run("TimestampLatch")
        assert aravis.read("TimestampLatchValue") < 10**10
        assert aravis.read("GevTimestampTickFrequency") == 10**9


def test_a_clock_listens_then_follows_its_master(device: RunningDevice) -> None:
    device.renew(ptp_offset_ns=-350, ptp_settle_s=0.4)
    with RawAravis(device.address) as aravis:
        assert aravis.read("GevIEEE1588Status") == "Disabled"
        aravis.write(PtpEnable=True)
        assert aravis.read("GevIEEE1588Status") == "Listening"
        end = time.monotonic() + 5
        while aravis.read("GevIEEE1588Status") != "Slave" and time.monotonic() < end:
            time.sleep(0.02)
        aravis.run("PtpDataSetLatch")
        assert aravis.read("PtpStatus") == "Slave"
        assert aravis.read("PtpOffsetFromMaster") == -350
        assert aravis.read("PtpGrandmasterClockID") == device.setup.grandmaster
        before_ns = time.monotonic_ns()
        aravis.run("TimestampLatch")
        master_ns = aravis.read("TimestampLatchValue") + 350 - MASTER_EPOCH_NS
        assert before_ns <= master_ns <= time.monotonic_ns()


def test_edges_are_answered_ignored_while_busy_or_lost(device: RunningDevice) -> None:
    with RawAravis(device.address) as aravis:
        ready_for(aravis, "Line0")
        start_ns, period_ns = time.monotonic_ns() + 50_000_000, 20_000_000
        device.plan("ignore", after=2)
        device.plan("lose", after=4)  # of the frames: the sixth edge
        device.ask("train", source="Line0", first_ns=start_ns, period_ns=period_ns, count=8)
        frames = aravis.frames(6)
        stamps = [read_stamp(frame.image()) for frame in frames]
    assert [frame.frame_id for frame in frames] == [1, 2, 3, 4, 6, 7]
    assert [(s.t_ns - start_ns) // period_ns for s in stamps if s] == [0, 1, 3, 4, 6, 7]
    outcomes = [deed.outcome for deed in device.deeds()]
    assert outcomes == ["sent", "sent", "ignored", "sent", "sent", "lost", "sent", "sent"]


def test_a_trigger_within_an_exposure_is_ignored(device: RunningDevice) -> None:
    with RawAravis(device.address) as aravis:
        aravis.write(ExposureTime=200_000.0)
        ready_for(aravis, "Software")
        aravis.run("TriggerSoftware")
        aravis.run("TriggerSoftware")
        assert [frame.frame_id for frame in aravis.frames(1)] == [1]
    assert [deed.outcome for deed in device.deeds()] == ["sent", "busy"]


def test_an_action_command_fires_those_it_is_meant_for_and_names_the_others(
    devices: list[RunningDevice],
) -> None:
    first, second, other = (one.address for one in devices)
    with RawAravis(first) as a, RawAravis(second) as b, RawAravis(other) as c:
        for aravis in (a, b, c):
            ready_for(aravis, "Action1")
        c.write(ActionDeviceKey=8)
        result = send_action([first, second, other], KEYS)
        assert result.answered == (first, second)
        assert result.silent == (other,)
        assert str(result) == f"action command: no answer from {other}"
        assert [len(one.frames(1)) for one in (a, b)] == [1, 1]
        wrong_mask = ActionKeys(device_key=7, group_key=9, group_mask=0b100)
        assert send_action([first], wrong_mask, timeout_s=0.1).silent == (first,)
    assert [len(one.deeds()) for one in devices] == [1, 1, 0]


def test_a_lost_acknowledgement_is_not_a_lost_trigger(device: RunningDevice) -> None:
    with RawAravis(device.address) as aravis:
        ready_for(aravis, "Action1")
        device.set(mute_actions=1)
        assert send_action([device.address], KEYS, timeout_s=0.1).silent == (device.address,)
        assert len(aravis.frames(1)) == 1


def test_a_scheduled_action_exposes_at_its_time_by_the_common_clock(
    devices: list[RunningDevice],
) -> None:
    pair = devices[:2]
    for k, one in enumerate(pair):
        one.renew(ptp_settle_s=0.0, ptp_offset_ns=500 * k)
    addresses = [one.address for one in pair]
    with RawAravis(addresses[0]) as a, RawAravis(addresses[1]) as b:
        for aravis in (a, b):
            ready_for(aravis, "Action1")
        early = send_action(addresses, KEYS, at_ns=10**18)
        assert early.refused == dict.fromkeys(addresses, "has no synchronized clock")
        for aravis in (a, b):
            aravis.write(PtpEnable=True)
        at_ns = time.monotonic_ns() + MASTER_EPOCH_NS + 400_000_000
        assert send_action(addresses, KEYS, at_ns=at_ns).complete
        assert pair[0].state().waiting_actions == 1
        frames = [aravis.frames(1)[0] for aravis in (a, b)]
        assert [frame.t_dev_ns for frame in frames] == [at_ns, at_ns]
        stamps = [read_stamp(frame.image()) for frame in frames]
        true_ns = [stamp.t_ns for stamp in stamps if stamp]
        assert true_ns == [at_ns - MASTER_EPOCH_NS - 500 * k for k in range(2)]
        late = send_action(addresses, KEYS, at_ns=at_ns)
        assert late.refused == dict.fromkeys(addresses, "got the command after its time")


def test_a_reboot_forgets_numbers_clock_and_settings(device: RunningDevice) -> None:
    with RawAravis(device.address) as aravis:
        aravis.write(ExposureTime=3000.0, **RATE)
        aravis.start()
        assert len(aravis.frames(3)) == 3
        before = device.state()
        device.ask("reboot", off_s=0.1)
        assert device.state().off
        end = time.monotonic() + 5
        while device.state().off and time.monotonic() < end:
            time.sleep(0.02)
        after = device.state()
    assert after.clock_ns < before.clock_ns
    assert not after.acquiring
    with RawAravis(device.address) as aravis:
        assert aravis.read("ExposureTime") == 1000.0
        aravis.start()
        assert aravis.frames(1)[0].frame_id == 1


def test_a_dead_device_answers_nothing(device: RunningDevice) -> None:
    device.set(dead=True)
    with pytest.raises(TimeoutError):
        ask(device.address, 0x80, struct.pack(">I", Reg.PRIVILEGE), 0.3)
    device.set(dead=False)
    assert ask(device.address, 0x80, struct.pack(">I", Reg.PRIVILEGE)) == (0, bytes(4))
