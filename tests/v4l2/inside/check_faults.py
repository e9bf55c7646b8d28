"""What a driver may refuse or break, one device at a time."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from capture.devices.v4l2.device import V4l2Device
from capture.errors import DeviceError
from tests.v4l2.inside.conftest import SPEC, Say, events_of, started

Open = Callable[[int], V4l2Device]


@pytest.mark.parametrize(
    ("button", "doing"),
    [
        ("inject_vidioc_reqbufs_error", "asked for memory"),
        ("inject_vidioc_qbuf_error", "queueing a buffer"),
        ("inject_vidioc_streamon_error", "starting to stream"),
    ],
)
def test_a_refused_start_is_said_and_the_next_one_works(
    opened: Open, button: str, doing: str
) -> None:
    device = opened(3)
    device.frames.reserve(16)
    device.trigger.prepare(SPEC)
    device.write_feature(button, True)
    with pytest.raises(DeviceError, match=rf"cam3: /dev/video3: {doing}: "):
        device.acquire.start()
    device.acquire.start()
    assert events_of(device, 5.0, count=3)[0].frame_id == 0


def test_a_buffer_that_cannot_be_queued_is_queued_later(opened: Open, say: Say) -> None:
    device = started(opened(3))
    first = events_of(device, 5.0, count=5)
    device.write_feature("inject_vidioc_qbuf_error", True)
    later = events_of(device, 2.0)
    numbers = [event.frame_id for event in (*first, *later)]
    assert device.health().counters["requeue_failures"] == 1
    assert device.health().connected
    # More frames than the driver has buffers: none of them is stuck.
    assert len(later) > device.health().counters["driver_buffers"] + 10
    say(frames=len(numbers), numbers=numbers[-1] + 1)


def test_a_fatal_error_is_told_and_overcome(opened: Open) -> None:
    device = started(opened(3))
    assert events_of(device, 5.0, count=3)
    device.write_feature("inject_fatal_streaming_error", True)
    time.sleep(0.3)
    events_of(device, 0.2)
    assert events_of(device, 0.5) == []
    assert not device.health().connected
    device.reconnect()
    assert device.health().connected
    assert events_of(device, 5.0, count=3)[0].frame_id == 0


def test_a_disconnected_device_is_silent_and_comes_back_as_it_was(opened: Open) -> None:
    device = opened(3)
    device.write_feature("brightness", 77)
    started(device)
    held = []
    while not held:
        time.sleep(0.005)
        held = list(device.frames.poll())
    picture = device.frames.pixels(held[0]).copy()
    device.write_feature("disconnect", True)
    assert not device.health().connected
    events_of(device, 0.2)
    assert events_of(device, 0.3) == []
    with pytest.raises(DeviceError, match=r"cam3: .*the device is gone"):
        device.read_feature("brightness")
    device.reconnect()
    assert device.read_feature("brightness") == 77
    assert events_of(device, 5.0, count=3)[0].frame_id == 0
    # What was held over the gap is still there.
    assert (device.frames.pixels(held[0]) == picture).all()
    for event in held:
        device.frames.release(event)
    device.write_feature("brightness", 128)


def test_start_stop_and_close_work_again_and_again(opened: Open) -> None:
    device = started(opened(3))
    for _ in range(3):
        assert events_of(device, 5.0, count=2)
        device.acquire.stop()
        device.acquire.stop()
        device.acquire.start()
    device.close()
    device.close()
    assert not device.health().connected
    assert list(device.frames.poll()) == []
    with pytest.raises(DeviceError, match="cam3: "):
        device.acquire.start()
