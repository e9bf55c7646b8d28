"""Real Aravis against fake cameras: finding, settings, packets, and who else may read."""

from __future__ import annotations

import gc
import hashlib
import itertools
import subprocess
import sys
import time

import pytest

from capture.devices.aravis import backend
from capture.devices.capabilities import (
    ActionTriggered,
    Cautioned,
    Featured,
    Latching,
    Monitored,
    PtpClocked,
    Reconnecting,
    SoftwareTriggered,
)
from capture.devices.preset import Preset, apply_preset
from capture.devices.protocol import TriggerKind, TriggerSpec
from capture.errors import DeviceError
from tests.gige.network import Fake, FakeNetwork
from tests.gige.witness import EXPOSURE_US, SIZE, open_watched

pytestmark = pytest.mark.gige

PLAIN = Preset(
    "plain",
    (
        ("PixelFormat", "Mono8"), ("Width", SIZE), ("Height", SIZE), ("GainAuto", "Off"),
        ("GainRaw", 0),
    ),
)  # fmt: skip
FREE = TriggerSpec(kind=TriggerKind.FREE_RUN, period_ns=20_000_000, exposure_us=EXPOSURE_US)


def test_all_are_found_by_serial_number(fakes: FakeNetwork) -> None:
    addresses = [fake.address for fake in fakes.fakes]
    found = [one for one in backend.discover() if one.address in addresses]
    assert [(one.serial, one.address) for one in found] == [
        (fake.serial, fake.address) for fake in fakes.fakes
    ]
    assert {(one.backend, one.model, one.transport) for one in found} == {
        ("aravis", "Aravis Fake", "gige")
    }
    assert all(one.problems == () for one in found)


def test_a_device_is_opened_by_address_serial_number_or_id(fakes: FakeNetwork) -> None:
    fake = fakes.fakes[2]
    for asked in (fake.address, fake.serial, f"Aravis-Fake-{fake.serial}"):
        device = backend.open(asked, "cam03")
        assert (device.info.serial, device.info.address) == (fake.serial, fake.address)
        assert device.info.name == "cam03"
        assert device.info.id_bits == 16
        assert device.info.first_id == 1
        device.close()
    with pytest.raises(DeviceError, match=r"cam99: no device 'LK99' answers; found .*LK01"):
        backend.open("LK99", "cam99")
    with pytest.raises(DeviceError, match=r"cam99: opening 10\.88\.37\.99: it is not there"):
        backend.open("10.88.37.99", "cam99")


def test_it_can_what_a_fake_camera_can_and_claims_no_more(fakes: FakeNetwork) -> None:
    device = backend.open(fakes.fakes[0].address, "cam01")
    try:
        for able in (Featured, Monitored, Reconnecting, SoftwareTriggered):
            assert isinstance(device, able)
        for unable in (Latching, PtpClocked, ActionTriggered):
            assert not isinstance(device, unable)
        assert device.info.triggers == (
            TriggerKind.HARDWARE, TriggerKind.SOFTWARE, TriggerKind.FREE_RUN,
        )  # fmt: skip
        with pytest.raises(DeviceError, match="asked for action triggers, offers hardware"):
            device.prepare(TriggerSpec(kind=TriggerKind.ACTION, period_ns=10**8, exposure_us=1000))
    finally:
        device.close()


def test_a_preset_is_written_in_order_and_what_differs_is_told(fakes: FakeNetwork) -> None:
    device = backend.open(fakes.fakes[0].address, "cam01")
    try:
        assert apply_preset(device, PLAIN) == ()
        assert device.info.layout.shape == (SIZE, SIZE)
        asked = Preset(
            "odd",
            (
                ("PixelFormat", "Mono12Packed"), ("PixelFormat", "Mono16"), ("Width", 3000),
                ("Hight", 100), ("TriggerSource", "Line9"), ("TriggerSource", "Line0"),
                ("AcquisitionFrameRate", 33.0), ("TestBoolean", 1),
            ),
        )  # fmt: skip
        assert [str(one) for one in apply_preset(device, asked)] == [
            "Width: asked for 3000, reads 256 (cam01: asked for Width = 3000, "
            "offers whole numbers, 1 to 2048)",
            "Hight: asked for 100, reads nothing (cam01: no setting 'Hight'; "
            "did you mean 'Height'?)",
            "TestBoolean: asked for 1, reads False (cam01: asked for TestBoolean = 1, "
            "offers true, false)",
        ]
        assert device.info.layout.dtype == "uint16"
        apply_preset(device, PLAIN)
    finally:
        device.close()


def test_a_packed_format_is_refused_naming_what_could_be_taken(fakes: FakeNetwork) -> None:
    device = backend.open(fakes.fakes[0].address, "cam01")
    try:
        with pytest.raises(DeviceError) as caught:
            device.write_feature("PixelFormat", "Mono12p")
        assert str(caught.value) == (
            "cam01: asked for Mono12p, offers BayerBG8, BayerGB8, BayerGR8, BayerRG8, Mono8, RGB8, "
            'Mono16; set PixelFormat = "Mono8" or RGB8, Mono16 in its preset'
        )
        with pytest.raises(DeviceError, match="asked for BayerRG8, which is packed or coloured"):
            device.write_feature("PixelFormat", "BayerRG8")
    finally:
        device.close()


def test_a_dump_holds_every_setting_and_the_hash_of_their_description(fakes: FakeNetwork) -> None:
    device = backend.open(fakes.fakes[0].address, "cam01")
    try:
        dump = device.features()
        assert dump.values["DeviceVendorName"] == "Aravis"
        assert dump.values["SensorWidth"] == 2048
        assert dump.values["PixelFormat"] in ("Mono8", "Mono16")
        assert dump.unread == {}
        assert dump.description.startswith("<?xml")
        assert dump.description.rstrip().endswith("</RegisterDescription>")
        digest = hashlib.sha256(dump.description.encode()).hexdigest()
        assert dump.description_sha256 == digest
    finally:
        device.close()


def test_packets_are_as_long_as_the_network_takes_and_that_is_read_back(
    fakes: FakeNetwork,
) -> None:
    device = backend.open(fakes.fakes[0].address, "cam01")
    try:
        device.reserve(8)
        device.prepare(FREE)
        device.start()
        assert device.read_feature("GevSCPSPacketSize") == 9000
        assert device.health().counters["packet_bytes"] == 9000
        device.stop()
        device.write_feature("GevSCPSPacketSize", 1500)  # asked for: it is not negotiated away
        device.start()
        assert device.health().counters["packet_bytes"] == 1500
        assert isinstance(device, Cautioned)
        assert device.problems == ()
    finally:
        device.close()


def test_a_device_in_use_is_said_to_be(fakes: FakeNetwork) -> None:
    ours, theirs = fakes.fakes[0], fakes.fakes[1]
    code = (
        "import sys\nfrom capture.devices.aravis import backend\n"
        "held = backend.open(sys.argv[1], 'x')\nprint('open', flush=True)\nsys.stdin.read()"
    )
    device = backend.open(ours.address, "cam01")
    with subprocess.Popen(
        [sys.executable, "-c", code, theirs.address],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as other:  # fmt: skip
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == "open\n"
            with pytest.raises(DeviceError, match=r"cam02: .* is in use by another program"):
                backend.open(theirs.address, "cam02")
            with pytest.raises(DeviceError, match="already open in this program as cam01"):
                backend.open(ours.address, "cam02")
            problems = {one.address: one.problems for one in backend.discover()}
            assert problems[theirs.address] == ("in use by another program; close that program",)
            assert problems[ours.address] == ()
        finally:
            other.kill()
            device.close()


def test_a_device_left_waiting_for_a_trigger_runs_free_when_it_is_told_to(
    fakes: FakeNetwork,
) -> None:
    fake = fakes.fakes[3]
    device = backend.open(fake.address, "cam04")
    device.prepare(TriggerSpec(kind=TriggerKind.SOFTWARE, period_ns=10**8, exposure_us=EXPOSURE_US))
    assert device.read_feature("TriggerMode") == "On"
    device.close()
    device, seen = open_watched(fake.address, "cam04")
    try:
        assert device.read_feature("TriggerMode") == "On"  # it keeps what it was left in
        apply_preset(device, PLAIN)
        device.reserve(8)
        device.prepare(FREE)
        device.start()
        _listen(device, lambda: len(seen.proven) >= 5)
        assert len(seen.proven) >= 5
        assert seen.wrong == []
    finally:
        device.close()


def test_no_frame_of_another_device_is_taken_for_one_of_its_own(fakes: FakeNetwork) -> None:
    """Aravis's packet socket takes in the other's frames when a stream starts beside it."""
    (first, seen), (second, _) = (
        open_watched(fake.address, name)
        for fake, name in zip(fakes.fakes, ("cam01", "cam02"), strict=False)
    )
    try:
        for device in (first, second):
            apply_preset(device, PLAIN)
            device.reserve(16)
            device.prepare(FREE)
        second.start()
        _listen(second, lambda: True)
        for _ in range(25):
            first.start()
            before = len(seen.proven)
            _listen(first, lambda before=before: len(seen.proven) >= before + 3, second)
            first.stop()
        numbers = [event.frame_id for event in seen.events]
        steps = [(b - a) % 65_535 for a, b in itertools.pairwise(numbers)]
        assert all(1 <= step < 40 for step in steps)
        assert seen.wrong == []
        assert len(seen.proven) >= 75
    finally:
        first.close()
        second.close()


def test_a_device_that_is_dropped_while_it_streams_lets_go_of_all(fakes: FakeNetwork) -> None:
    for _ in range(2):
        device, seen = open_watched(fakes.fakes[4].address, "cam05")
        device.reserve(12)
        device.prepare(FREE)
        device.start()
        _listen(device, lambda seen=seen: len(seen.events) >= 3)
        del device
        gc.collect()


def _listen(device: object, enough: object, *others: object) -> None:
    """Poll and release until there is enough, 15 s at most."""
    deadline = time.monotonic() + 15.0
    while time.monotonic() < deadline:
        for one in (device, *others):
            for event in one.poll():  # type: ignore[attr-defined]
                one.release(event)  # type: ignore[attr-defined]
        if enough():  # type: ignore[operator]
            return
        time.sleep(0.002)


def test_a_fake_is_named_by_its_number() -> None:
    assert (Fake(7).serial, Fake(7).address) == ("LK07", "10.88.37.17")
