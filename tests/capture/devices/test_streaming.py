"""Devices simulated in real time: what they send proves itself, settings are as awkward as real."""

from __future__ import annotations

import gc
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from capture.devices.array import DeviceArray
from capture.devices.backend import LineOwner, load_backend
from capture.devices.capabilities import PtpReading
from capture.devices.faults import Fault, FaultKind
from capture.devices.lines import RealTimeLine
from capture.devices.preset import Preset, apply_preset
from capture.devices.protocol import TriggerKind, TriggerSpec
from capture.devices.simulated import (
    SimulatedBackend,
    SimulatedSettings,
    Stamp,
    StreamingDevice,
    pattern,
    streaming_array,
)
from capture.errors import DeviceError, SettingsError
from capture.frame import Clock, FrameEvent
from capture.frame_header import ImageLayout

SMALL = ImageLayout(32, 8, 1, "uint8")
PERIOD = 5_000_000
SPEC = TriggerSpec(kind=TriggerKind.HARDWARE, period_ns=PERIOD, exposure_us=1000.0)
QUICK = SimulatedSettings(latency_ms=1.0, latency_jitter_ms=0.0)


def one(
    settings: SimulatedSettings = QUICK, layout: ImageLayout = SMALL
) -> tuple[RealTimeLine, StreamingDevice]:
    line = RealTimeLine()
    device = StreamingDevice("cam00", layout, line, settings)
    device.reserve(16)
    device.prepare(SPEC)
    device.start()
    return line, device


def arrived(device: StreamingDevice, after_s: float = 0.03) -> list[FrameEvent]:
    time.sleep(after_s)
    return list(device.poll())


@pytest.mark.parametrize(
    "layout",
    [SMALL, ImageLayout(7, 300, 1, "uint16"), ImageLayout(20, 5, 3, "uint8")],
)
def test_the_pattern_is_the_formula_and_carries_its_stamp(layout: ImageLayout) -> None:
    stamp = Stamp(0xC0FFEE, 5, 65_533, 123_456_789_012)
    image = pattern(layout, stamp)
    assert ImageLayout.of(image) == layout
    assert Stamp.read(image) == stamp
    for index in ((layout.height - 1, 3), (layout.height - 1, layout.width - 1)):
        for c in range(layout.channels):
            found = image[index] if layout.channels == 1 else image[(*index, c)]
            assert found == (118 * index[1] + 43 * (index[0] + stamp.number) + c) % 251
    with pytest.raises(DeviceError, match="expected an image stamped b'SIM1', found"):
        Stamp.read(np.zeros((8, 8), np.uint8))


def test_every_image_proves_which_device_exposed_it_and_when() -> None:
    array = streaming_array(3, SMALL, seed=5)
    for device in array.devices:
        device.frames.reserve(16)
    array.prepare(PERIOD, 1000.0)
    for device in array.devices:
        device.acquire.start()
    begin = time.monotonic_ns() + PERIOD
    for k in range(6):
        array.line.fire(begin + k * PERIOD)
    time.sleep(0.05)
    crcs = set()
    for device in array.devices:
        events = device.frames.poll()
        assert len(events) == 6
        for k, event in enumerate(events):
            image = device.frames.pixels(event)
            stamp = Stamp.read(image)
            assert (stamp.place, stamp.number) == (k, event.frame_id)
            assert stamp.t_ns == begin + k * PERIOD  # as asked for, however late the thread woke up
            assert np.array_equal(image, pattern(SMALL, stamp))
            assert event.t_host_ns >= stamp.t_ns + 1_000_000
            crcs.add(stamp.device_crc)
            device.frames.release(event)
    assert len(crcs) == 3


def test_an_incomplete_image_keeps_older_pixels() -> None:
    line, device = one()
    device.stop()
    device.reserve(1)
    device.start()
    line.fire(time.monotonic_ns())
    [whole] = arrived(device)
    before = device.pixels(whole).copy()
    device.release(whole)
    device.inject(Fault(FaultKind.INCOMPLETE))
    line.fire(time.monotonic_ns())
    [torn] = arrived(device)
    assert not torn.complete
    assert np.array_equal(device.pixels(torn)[4:], before[4:])
    assert not np.array_equal(device.pixels(torn)[2:4], before[2:4])


def test_a_trigger_during_an_exposure_is_ignored_and_takes_no_number() -> None:
    line, device = one()
    t_ns = time.monotonic_ns()
    for after_ns in (0, 500_000, 1_000_000):
        line.fire(t_ns + after_ns)
    assert [event.frame_id for event in arrived(device)] == [1, 2]
    assert device.health().counters["ignored_triggers"] == 1


def test_memory_comes_back_when_devices_are_gone() -> None:
    open_files = Path("/proc/self/fd")
    before = len(list(open_files.iterdir()))
    for _ in range(5):
        _, device = one()
        device.close()
        del device
    gc.collect()
    assert len(list(open_files.iterdir())) <= before + 1


def test_a_view_outlives_the_device_that_filled_it() -> None:
    line, device = one()
    line.fire(time.monotonic_ns())
    [event] = arrived(device)
    view = device.pixels(event)
    copy = view.copy()
    device.close()
    device.release(event)
    del device, line
    gc.collect()
    assert np.array_equal(view, copy)


def test_a_generator_on_the_wire_needs_nobody_to_fire() -> None:
    line = RealTimeLine(generator_ns=PERIOD)
    assert not line.fires
    devices = [StreamingDevice(f"cam{i:02d}", SMALL, line, QUICK) for i in range(2)]
    for device in devices:
        device.reserve(64)
        device.prepare(SPEC)
        device.start()
    line.fire(time.monotonic_ns() + 6 * PERIOD)  # waits, and sends nothing
    seen = [[Stamp.read(device.pixels(e)).t_ns for e in arrived(device)] for device in devices]
    assert len(seen[0]) >= 5
    assert all(t_ns % PERIOD == 0 for t_ns in seen[0])
    common = set(seen[0]) & set(seen[1])
    assert len(common) >= 5


def test_a_free_run_keeps_the_time_of_the_devices_own_clock() -> None:
    settings = replace(QUICK, clock=Clock(drift_ppm=1000.0))
    _, device = one(settings)
    device.stop()
    device.prepare(replace(SPEC, kind=TriggerKind.FREE_RUN))
    device.start()
    events = arrived(device, 0.05)
    true = [Stamp.read(device.pixels(event)).t_ns for event in events]
    assert all(b - a == pytest.approx(PERIOD - 5000, abs=10) for a, b in pairwise(true))
    dated = [event.t_dev_ns for event in events]
    assert all(b - a == pytest.approx(PERIOD, abs=10) for a, b in pairwise(dated))


def test_presets_meet_order_ranges_and_rounding() -> None:
    _, device = one()  # prepared for a hardware trigger: TriggerMode is On
    wrong = Preset("wrong order", (("TriggerSource", "Line1"), ("TriggerMode", "Off")))
    [difference] = apply_preset(device, wrong)
    assert "TriggerSource cannot be set while TriggerMode is On" in str(difference)
    right = Preset("right order", (("TriggerMode", "Off"), ("TriggerSource", "Line1")))
    assert apply_preset(device, right) == ()
    [rounded] = apply_preset(device, Preset("gain", (("Gain", 1.234),)))
    assert rounded.found == pytest.approx(1.2)
    [refused] = apply_preset(device, Preset("gain", (("Gain", 48.0),)))
    assert "Gain: asked for 48.0, offers 0 to 24 in steps of 0.1" in refused.why
    with pytest.raises(DeviceError, match="Width cannot be set; it is 32"):
        device.write_feature("Width", 64)
    with pytest.raises(DeviceError, match="no feature 'Gian'; did you mean 'Gain'"):
        device.read_feature("Gian")
    with pytest.raises(DeviceError, match="asked for 'Line7', offers Line0, Line1, Software"):
        device.prepare(replace(SPEC, source="Line7"))


def test_an_exposure_time_that_is_set_while_it_streams_counts_from_the_next_frame() -> None:
    line, device = one()
    line.fire(time.monotonic_ns())
    device.write_feature("ExposureTime", 2000.0)
    line.fire(time.monotonic_ns() + 2_000_000)
    assert [event.exposure_us for event in arrived(device)] == [1000.0, 2000.0]


def test_devices_that_follow_ptp_show_the_same_time_but_for_their_offsets() -> None:
    array = streaming_array(2, SMALL, seed=2)
    a, b = array.devices
    assert isinstance(a, StreamingDevice)
    assert isinstance(b, StreamingDevice)
    for device in (a, b):
        device.enable_ptp(True)
        assert device.ptp().locked
    a.set_ptp(PtpReading("slave", 0, "gm"))
    b.set_ptp(PtpReading("slave", 250_000_000, "gm"))
    x, y = a.latch(), b.latch()
    apart = (y.t_dev_ns - y.before_ns) - (x.t_dev_ns - x.before_ns)
    assert apart == pytest.approx(250_000_000, abs=100)
    assert a.health().ptp == PtpReading("slave", 0, "gm")
    b.prepare(SPEC)
    b.start()
    b.inject(Fault(FaultKind.DEATH))
    array.line.fire(time.monotonic_ns())
    b.reconnect()
    z = b.latch()
    assert z.t_dev_ns - z.before_ns == pytest.approx(y.t_dev_ns - y.before_ns, abs=100)
    b.set_ptp(PtpReading("listening"))
    assert not b.ptp().locked
    b.enable_ptp(False)
    assert b.ptp().state == "disabled"


def test_addresses_say_what_a_device_is() -> None:
    backend = SimulatedBackend()
    usual = backend.open("7", "cam00")
    assert (usual.info.serial, usual.info.layout) == ("SIM-0007", ImageLayout(256, 256, 1, "uint8"))
    assert backend.open("SIM-0007", "cam01").info.serial == "SIM-0007"
    device = backend.open("64x48?seed=3&channels=3&dtype=uint16&id_bits=24&wraps_to=0", "cam02")
    assert device.info.layout == ImageLayout(64, 48, 3, "uint16")
    assert (device.info.id_bits, device.info.first_id) == (24, 0)
    assert backend.open(device.info.address, "cam03").info.serial == device.info.serial
    found = backend.discover()
    assert len({one.serial for one in found}) == 16
    assert backend.open(found[3].address, "cam04").info.serial == found[3].serial
    assert isinstance(load_backend("sim"), LineOwner)


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("big", "expected a number, or WIDTHxHEIGHT"),
        ("64x48?sede=3", "unknown key 'sede'; did you mean 'seed'"),
        ("64x48?seed=x", "seed: expected a number, found 'x'"),
        ("64x48?id_bits=4", r"id_bits must lie in 8\.\.64, found 4"),
        ("4x4", "images need at least 64 bytes for their stamp"),
        ("64x48?dtype=float", "pixel type must be uint8 or uint16"),
    ],
)
def test_addresses_that_cannot_be_are_refused(address: str, words: str) -> None:
    with pytest.raises(DeviceError, match=f"cam00: simulated device '.*{words}"):
        SimulatedBackend().open(address, "cam00")


def test_arrays_of_two_backend_objects_stay_apart_and_closed_devices_hear_nothing() -> None:
    backends = [SimulatedBackend(), SimulatedBackend()]
    devices = [backend.open("32x8?latency_ms=1", "cam00") for backend in backends]
    gone = backends[0].open("32x8?latency_ms=1", "cam01")
    arrays = [DeviceArray((d,), b.line()) for d, b in zip(devices, backends, strict=True)]
    for device in (*devices, gone):
        device.prepare(SPEC)
        device.start()
    gone.close()
    arrays[0].line.fire(time.monotonic_ns())
    assert [len(arrived(device)) for device in (*devices, gone)] == [1, 0, 0]


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(SettingsError, match="faults of unknown devices: cam9; there are cam00"):
        streaming_array(1, SMALL, faults={"cam9": [Fault(FaultKind.STALE)]})
    line = RealTimeLine()
    device = StreamingDevice("cam00", SMALL, line, QUICK)
    with pytest.raises(DeviceError, match="cam00: started before it was prepared"):
        device.start()
    with pytest.raises(DeviceError, match="cam00: was never prepared"):
        device.reconnect()
    device.prepare(SPEC)
    with pytest.raises(DeviceError, match="cam00: a software trigger needs a device that is"):
        device.fire()
    device.start()
    with pytest.raises(DeviceError, match="memory is reserved before the device is started"):
        device.reserve(3)
    line.fire(time.monotonic_ns())
    [event] = arrived(device)
    device.release(event)
    with pytest.raises(DeviceError, match="frame 1 was released, or is of another device"):
        device.release(event)
    with pytest.raises(DeviceError, match="a generator needs a period above 0"):
        RealTimeLine(0)


def test_what_devices_refuse_is_told_with_the_name_of_each_once() -> None:
    array = streaming_array(2, SMALL)
    with pytest.raises(DeviceError) as caught:
        array.each("not started", lambda device: device.acquire.start())
    assert str(caught.value) == (
        "2 of 2 devices not started:\n  - cam00: started before it was prepared\n"
        "  - cam01: started before it was prepared"
    )
