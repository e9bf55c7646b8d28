"""A V4L2 device behind a driver that is played: what vivid cannot show."""

from __future__ import annotations

import errno
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from capture.arrays import Image
from capture.devices.capabilities import Latching
from capture.devices.protocol import ClockKind, TriggerKind
from capture.devices.v4l2 import ioctls
from capture.devices.v4l2.device import V4l2Device
from capture.errors import DeviceError
from capture.frame import FrameEvent
from tests.capture.v4l2_driver import (
    ABSOLUTE,
    AUTO,
    PRIORITY,
    SPEC,
    PlayedDriver,
    device_of,
    exposure_controls,
    fourcc,
    started,
)

GREY = bytes(range(128))  # 16 x 8 px


def jpeg(seed: int, width: int = 64, height: int = 48) -> tuple[bytes, Image]:
    rough = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), np.uint8)
    image = cv2.resize(rough, (width, height), interpolation=cv2.INTER_CUBIC)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    return data, np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def polled(device: V4l2Device, count: int) -> list[FrameEvent]:
    events: list[FrameEvent] = []
    end_s = time.monotonic() + 20
    while len(events) < count and time.monotonic() < end_s:
        events += device.frames.poll()
        time.sleep(0.001)
    return events


def test_a_frame_comes_as_the_driver_gives_it() -> None:
    driver = PlayedDriver()
    device = started(driver)
    before = time.monotonic_ns()
    driver.deliver(GREY, sequence=5, seconds=12, microseconds=345)
    (event,) = device.frames.poll()
    assert before <= event.t_host_ns <= time.monotonic_ns()
    assert (event.device, event.frame_id, event.t_dev_ns) == ("cam7", 5, 12_000_345_000)
    assert (event.complete, event.note) == (True, "")
    assert device.frames.pixels(event).tobytes() == GREY
    assert device.health().free == 7
    device.frames.release(event)
    assert device.health().free == 8
    assert device.frames.poll() == []


def test_a_slow_reader_never_starves_the_driver() -> None:
    driver = PlayedDriver()
    device = started(driver, slots=3)
    events = []
    for number in range(40):
        assert driver.deliver(GREY, number)  # there is always a buffer
        events += device.frames.poll()
    assert [event.frame_id for event in events] == [0, 1, 2]
    assert device.health().counters["no_free_slot"] == 37
    device.frames.release(events[0])
    driver.deliver(GREY, 40)
    assert [event.frame_id for event in device.frames.poll()] == [40]


def test_mjpeg_is_decoded_in_order_and_pictures_are_right() -> None:
    driver = PlayedDriver("MJPG", 64, 48)
    driver.image_bytes = 20_000
    device = started(driver, slots=16)
    assert device.info.layout.channels == 1
    truth = []
    for number in range(10):
        data, luma = jpeg(number)
        truth.append(luma)
        assert driver.deliver(data + bytes(64), number)
    events = polled(device, 10)
    assert [event.frame_id for event in events] == list(range(10))
    for event, luma in zip(events, truth, strict=True):
        assert event.complete
        difference = device.frames.pixels(event).astype(int) - luma
        assert np.abs(difference).max() <= 12  # of 255: quality 98, colour at half resolution
        device.frames.release(event)
    device.close()


@pytest.mark.parametrize(
    ("damage", "note"),
    [
        (lambda data: data[: len(data) // 2], "without its end"),
        (lambda data: b"", "begins with nothing"),
        (lambda data: b"\x00\x01" + data, "begins with 00 01 ff d8"),
        (lambda data: jpeg(1, 32, 32)[0], r"the image is (32, 32), expected (48, 64)"),
    ],
)
def test_a_damaged_mjpeg_image_is_incomplete_and_black(damage: object, note: str) -> None:
    driver = PlayedDriver("MJPG", 64, 48)
    driver.image_bytes = 20_000
    device = started(driver)
    driver.deliver(damage(jpeg(0)[0]), 0)  # type: ignore[operator]
    (event,) = polled(device, 1)
    assert not event.complete
    assert note in event.note
    assert not device.frames.pixels(event).any()
    device.close()


def test_what_is_being_decoded_at_the_stop_can_still_be_fetched() -> None:
    driver = PlayedDriver("MJPG", 64, 48)
    driver.image_bytes = 20_000
    device = started(driver)
    for number in range(4):
        driver.deliver(jpeg(number)[0], number)
    device.acquire.stop()
    assert [event.frame_id for event in device.frames.poll()] == [0, 1, 2, 3]


def test_a_flagged_and_a_short_image_are_incomplete() -> None:
    driver = PlayedDriver()
    device = started(driver)
    driver.deliver(GREY, 0, flags=ioctls.FLAG_ERROR)
    driver.deliver(GREY[:40], 1)
    flagged, short = device.frames.poll()
    assert (flagged.complete, flagged.note) == (False, "the driver flagged an error")
    assert (short.complete, short.note) == (False, "2 of 8 rows arrived")
    assert device.health().counters["error_flags"] == 1


def test_times_are_handed_on_raw_whatever_they_are() -> None:
    driver = PlayedDriver()
    device = started(driver)
    for number, seconds in enumerate((50, 40, -3, 1 << 62)):
        driver.deliver(GREY, number, seconds=seconds)
    times = [event.t_dev_ns for event in device.frames.poll()]
    assert times[:3] == [50 * 10**9, 40 * 10**9, -3 * 10**9]
    assert -(1 << 63) <= times[3] < 1 << 63


def test_whose_clock_it_is_follows_the_drivers_flag() -> None:
    assert device_of(PlayedDriver()).info.clock == ClockKind.HOST
    assert isinstance(device_of(PlayedDriver()), Latching)
    for flags in (0, 0x4000):
        driver = PlayedDriver()
        driver.timestamp_flags = flags
        device = device_of(driver)
        assert device.info.clock == ClockKind.OWN
        assert not isinstance(device, Latching)


def test_exposure_is_made_manual_and_read_back() -> None:
    driver = PlayedDriver()
    driver.controls = exposure_controls()
    device = started(driver)
    assert driver.control(AUTO).value == 1
    assert driver.control(PRIORITY).value == 0
    assert driver.control(ABSOLUTE).value == 50
    driver.deliver(GREY, 0)
    assert device.frames.poll()[0].exposure_us == 5000.0
    with pytest.raises(DeviceError, match=r"exposure of 150 us, offers 300 to 204700 us"):
        device.trigger.prepare(replace(SPEC, exposure_us=150.0))


def test_a_control_that_another_rules_says_so() -> None:
    driver = PlayedDriver()
    driver.controls = exposure_controls()
    device = device_of(driver)
    with pytest.raises(DeviceError, match="cam7: exposure_time_absolute: has no effect now"):
        device.write_feature("exposure_time_absolute", 40)
    device.write_feature("auto_exposure", "Manual Mode")
    device.write_feature("exposure_time_absolute", 40)
    assert device.read_feature("exposure_time_absolute") == 40


def test_another_rate_or_trigger_is_refused() -> None:
    device = device_of(PlayedDriver())
    with pytest.raises(DeviceError, match=r"asked for 75\.000 Hz, sets 30\.000 Hz.*25, 30 Hz"):
        device.trigger.prepare(replace(SPEC, period_ns=13_333_333))
    with pytest.raises(DeviceError, match=r"cam7: asked for action triggers, offers free_run"):
        device.trigger.prepare(replace(SPEC, kind=TriggerKind.ACTION))
    driver = PlayedDriver()
    driver.rates = ((1001, 30_000),)
    with pytest.raises(DeviceError, match=r"asked for 30\.000 Hz, sets 29\.970 Hz"):
        device_of(driver).trigger.prepare(replace(SPEC, period_ns=33_333_333))


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.ENODEV, "the device is gone"), (errno.EIO, "the driver reports a fatal error")],
)
def test_a_device_that_is_gone_is_silent(number: int, words: str) -> None:
    driver = PlayedDriver()
    device = started(driver)
    driver.deliver(GREY, 0)
    (event,) = device.frames.poll()
    driver.broken = number
    assert list(device.frames.poll()) == []
    assert not device.health().connected
    with pytest.raises(DeviceError, match=f"cam7: .*{words}"):
        device.read_feature("Width")
    assert device.frames.pixels(event).tobytes() == GREY
    device.frames.release(event)
    device.acquire.stop()
    device.close()
    device.close()


def test_a_format_that_nobody_knows_never_raises() -> None:
    driver = PlayedDriver("XYZ1", formats=(0xFFFFFFFF, 0, fourcc("XYZ1"), fourcc("YUYV")))
    device = device_of(driver)
    assert device.read_feature("PixelFormat") == "YUYV"
    assert '"????"' in device.features().description
    with pytest.raises(DeviceError, match="no pixel format that is taken: H264: it is none of"):
        device_of(PlayedDriver("H264"))


def test_the_format_is_written_and_the_layout_follows() -> None:
    driver = PlayedDriver("GREY", formats=(fourcc("GREY"), fourcc("Y12")))
    device = started(driver)
    with pytest.raises(DeviceError, match="it is streaming, here or in another program"):
        device.write_feature("PixelFormat", "Y12")
    device.acquire.stop()
    device.write_feature("PixelFormat", "Y12")
    assert device.info.layout.dtype == "uint16"
    device.acquire.start()
    driver.deliver(GREY + GREY, 0)
    (event,) = device.frames.poll()
    assert device.frames.pixels(event)[0, 0] == 0x0100


def test_a_size_that_is_not_offered_changes_nothing() -> None:
    device = device_of(PlayedDriver())
    with pytest.raises(DeviceError, match="Width: asked for 1000, the device sets 640 x"):
        device.write_feature("Width", 1000)
    with pytest.raises(
        DeviceError, match=r"Width: asked for 1000000000000000.0, expected a number in 0"
    ):
        device.write_feature("Width", 1e15)
    assert device.read_feature("Width") == 16
    device.write_feature("Height", 32)
    assert (device.info.layout.width, device.info.layout.height) == (16, 32)


def test_it_must_be_prepared_and_is_started_once() -> None:
    device = device_of(PlayedDriver())
    with pytest.raises(DeviceError, match="cam7: started before it was prepared"):
        device.acquire.start()
    device.trigger.prepare(SPEC)
    device.frames.reserve(4)
    device.acquire.start()
    device.acquire.start()
    with pytest.raises(DeviceError, match="it streams; stop it before memory is set aside"):
        device.frames.reserve(4)
    with pytest.raises(DeviceError, match="its rate cannot be changed while it streams"):
        device.trigger.prepare(replace(SPEC, period_ns=33_333_333))


def test_frames_that_are_out_keep_their_memory() -> None:
    driver = PlayedDriver()
    device = started(driver)
    driver.deliver(GREY, 0)
    driver.deliver(GREY, 1)
    first, second = device.frames.poll()
    device.acquire.stop()
    with pytest.raises(DeviceError, match="2 frames are not released yet"):
        device.frames.reserve(20)
    device.frames.release(first)
    device.frames.release(second)
    device.frames.reserve(20)
    assert device.health().free == 20
    with pytest.raises(DeviceError, match="released twice"):
        device.frames.release(second)
