"""Discovery, formats, controls and refusals, with real drivers behind real nodes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from capture.devices.capabilities import Featured, Latching, Monitored, Reconnecting
from capture.devices.preset import Preset, apply_preset
from capture.devices.protocol import ClockKind, TriggerKind
from capture.devices.v4l2 import backend
from capture.devices.v4l2.device import V4l2Device
from capture.errors import DeviceError
from tests.v4l2.inside.conftest import SPEC, Say, events_of, started
from tests.v4l2.inside.osd import learn_digits, number_in

Open = Callable[[int], V4l2Device]


def test_all_nodes_are_found_with_their_troubles() -> None:
    found = backend.discover()
    assert [each.address for each in found] == [f"/dev/video{n}" for n in range(5)]
    assert [each.serial for each in found] == [f"platform:vivid-00{n}" for n in range(5)]
    assert {(each.model, each.transport) for each in found} == {("vivid", "v4l2")}
    assert all(not each.problems for each in found[:4])
    assert "multi-planar" in found[4].problems[0]


def test_a_device_that_streams_is_found_in_use(opened: Open) -> None:
    started(opened(1))
    assert backend.discover()[1].problems == ("in use by another program",)
    with pytest.raises(DeviceError, match=r"/dev/video1: it is in use by another program"):
        backend.open("/dev/video1", "second")


def test_it_opens_by_node_serial_and_bus_and_says_what_it_is() -> None:
    for address in ("/dev/video2", "platform:vivid-002"):
        device = backend.open(address, "cam")
        info = device.info
        device.close()
        assert (info.serial, info.address) == ("platform:vivid-002", "/dev/video2")
        assert (info.clock, info.first_id, info.id_bits) == (ClockKind.HOST, 0, 32)
        assert info.triggers == (TriggerKind.FREE_RUN,)
    with pytest.raises(DeviceError, match=r"no video device 'usb-9'; found: platform:vivid-000"):
        backend.open("usb-9", "cam")
    with pytest.raises(DeviceError, match=r"/dev/video4: .*multi-planar"):
        backend.open("/dev/video4", "cam")
    with pytest.raises(DeviceError, match=r"/dev/null: not a video device"):
        backend.open("/dev/null", "cam")


def test_it_can_what_it_says(opened: Open) -> None:
    device = opened(0)
    for capability in (Latching, Featured, Monitored, Reconnecting):
        assert isinstance(device, capability)
    sample = device.latch()  # type: ignore[attr-defined]
    assert sample.before_ns <= sample.t_dev_ns <= sample.after_ns


@pytest.mark.parametrize(
    ("name", "white"),
    [("GREY", 255), ("Y10", 1023), ("Y12", 4095), ("Y16", 65535), ("YUYV", 255), ("UYVY", 255),
     ("YVYU", 255), ("VYUY", 255), ("NV12", 255), ("NV21", 255), ("YU12", 255), ("YV12", 255)],
)  # fmt: skip
def test_every_format_gives_the_same_picture(opened: Open, name: str, white: int) -> None:
    device = opened(0)
    device.write_feature("test_pattern", "Gray Ramp")
    device.write_feature("osd_text_mode", "None")
    pictures = {}
    for each in ("GREY", name):
        device.write_feature("PixelFormat", each)
        assert device.read_feature("PixelFormat") == each
        started(device, 8)
        events = []
        while not events:
            time.sleep(0.005)
            events = list(device.frames.poll())
        pictures[each] = device.frames.pixels(events[0]).astype(float)
        sixteen = each == name and white > 255
        assert device.info.layout.dtype == ("uint16" if sixteen else "uint8")
        for event in events:
            device.frames.release(event)
        device.stop()
    scaled = pictures[name] * 255 / white
    assert np.ptp(pictures["GREY"][90]) > 100
    # GREY and luma are full and limited range of the same ramp: they agree but for a line.
    slope, offset = np.polyfit(pictures["GREY"][90], scaled[90], 1)
    assert 0.8 < slope < 1.25
    assert np.abs(slope * pictures["GREY"] + offset - scaled).max() < 4.0


def test_a_format_that_is_not_taken_is_refused_with_those_that_are(opened: Open) -> None:
    device = opened(0)
    with pytest.raises(DeviceError, match=r"RGB3: it is none of GREY.*usable here: YUYV"):
        device.write_feature("PixelFormat", "RGB3")
    with pytest.raises(DeviceError, match=r"Y16-BE: its words are big-endian; use Y16"):
        device.write_feature("PixelFormat", "Y16-BE")
    with pytest.raises(DeviceError, match=r"Y14: the device does not offer it"):
        device.write_feature("PixelFormat", "Y14")
    assert device.read_feature("PixelFormat") == "GREY"


def test_controls_are_read_written_and_listed(opened: Open) -> None:
    device = opened(0)
    preset = Preset(
        "all kinds",
        (("brightness", 100), ("horizontal_flip", True), ("menu", "Menu Item 4"),
         ("integer_menu", 21), ("integer_64_bits", -(1 << 40)), ("string", "abcd"),
         ("bitmask", 0x80002000), ("Width", 640), ("Height", 360), ("AcquisitionFrameRate", 15.0)),
    )  # fmt: skip
    assert apply_preset(device, preset) == ()
    assert device.info.layout.width == 640
    dump = device.features()
    assert dump.values["string"] == "abcd"
    assert dump.values["integer_menu"] == 21
    table = json.loads(dump.description)
    assert "RGB3" in table["pixel_formats"]
    assert table["controls"]["brightness"]["maximum"] == 255
    assert table["controls"]["menu"]["menu"] == {
        "1": "Menu Item 1", "3": "Menu Item 3", "4": "Menu Item 4",
    }  # fmt: skip
    assert "compound" in dump.unread["area"]
    apply_preset(device, Preset("back", (("brightness", 128), ("horizontal_flip", False))))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("brightness", 256, r"brightness: asked for 256, offers 0 to 255"),
        ("brightness", "high", r"brightness: asked for 'high', offers 0 to 255"),
        ("menu", "Menu Item 2", r"offers 'Menu Item 1', 'Menu Item 3', 'Menu Item 4'"),
        ("integer_menu", 4, r"offers 2, 3, 5, 8, 13, 21, 42"),
        ("boolean", 2, r"boolean: asked for 2, offers true or false"),
        ("string", "abcde", r"offers texts of 2 to 4 bytes"),
        ("area", 1, r"area: a compound setting cannot be written here"),
        ("read_only_integer_32_bits", 1, r"can only be read"),
        ("brightnes", 1, r"no setting 'brightnes'; did you mean 'brightness'\?"),
        ("Width", 500, r"Width: asked for 500, the device sets \d+ x \d+ px"),
        ("AcquisitionFrameRate", 75.0, r"AcquisitionFrameRate: .*75\.000 Hz, sets 60\.000 Hz"),
        ("Width", -3, r"Width: asked for -3, expected a number in 0\.\.65535"),
    ],
)
def test_a_wrong_setting_is_refused_in_words(
    opened: Open, name: str, value: int | str, message: str
) -> None:
    with pytest.raises(DeviceError, match="cam0: .*" + message):
        opened(0).write_feature(name, value)


def test_another_rate_than_asked_is_refused_with_those_on_offer(opened: Open) -> None:
    device = opened(0)
    with pytest.raises(DeviceError, match=r"asked for 21\.277 Hz, sets .*offers 1, 2, 4, 5.* Hz"):
        device.prepare(replace(SPEC, period_ns=47_000_000))
    with pytest.raises(DeviceError, match=r"asked for hardware triggers, offers free_run"):
        device.prepare(replace(SPEC, kind=TriggerKind.HARDWARE))


def test_numbers_times_and_pictures_agree(opened: Open, say: Say) -> None:
    device = started(opened(0))
    digits = learn_digits(device)
    device.stop()
    started(device)
    lags, seen = [], 0
    last = -1
    while seen < 50:
        time.sleep(0.005)
        for event in device.frames.poll():
            assert number_in(device.frames.pixels(event), digits) == event.frame_id
            assert event.complete
            assert event.frame_id >= last
            last = event.frame_id
            lags.append((event.t_host_ns - event.t_dev_ns) / 1e6)
            device.frames.release(event)
            seen += 1
    assert min(lags) > -1.0
    say(pictures=seen, numbers=last + 1, lag_ms=[round(min(lags), 1), round(max(lags), 1)])


def test_frames_without_memory_are_dropped_and_show_as_gaps(opened: Open, say: Say) -> None:
    device = started(opened(0), slots=4)
    held = []
    while len(held) < 4:
        time.sleep(0.005)
        held += device.frames.poll()
    assert events_of(device, 1.2) == []
    health = device.health()
    assert health.connected
    assert health.free == 0
    dropped = health.counters["no_free_slot"]
    assert dropped >= 20
    for event in held:
        device.frames.release(event)
    later = events_of(device, 5.0, count=1)[0]
    assert later.frame_id - held[-1].frame_id - 1 >= dropped
    say(dropped=dropped, gap=later.frame_id - held[-1].frame_id - 1)
