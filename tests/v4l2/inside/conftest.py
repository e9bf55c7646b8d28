"""What the checks in the guest share."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from capture.devices.protocol import TriggerKind, TriggerSpec
from capture.devices.v4l2 import backend
from capture.devices.v4l2.device import V4l2Device
from capture.frame import FrameEvent

RATE_HZ = 25.0
SPEC = TriggerSpec(kind=TriggerKind.FREE_RUN, period_ns=round(1e9 / RATE_HZ), exposure_us=3000.0)
FIGURES = Path("/share/figures.jsonl")

Say = Callable[..., None]


@pytest.fixture
def say(request: pytest.FixtureRequest) -> Say:
    """Hands figures on to the host, which prints them."""

    def write(**figures: object) -> None:
        with FIGURES.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"check": request.node.name, **figures}) + "\n")

    return write


@pytest.fixture
def opened() -> Iterator[Callable[[int], V4l2Device]]:
    """Opens vivid devices by number and sets them up."""
    devices: list[V4l2Device] = []

    def open_one(number: int) -> V4l2Device:
        device = backend.open(f"/dev/video{number}", f"cam{number}")
        assert isinstance(device, V4l2Device)
        devices.append(device)
        set_up(device)
        return device

    yield open_one
    for device in devices:
        device.close()


def set_up(device: V4l2Device) -> None:
    """320 x 180 px, GREY, white with text, dated at exposure, no faults."""
    for name, value in (
        ("PixelFormat", "GREY"), ("Width", 320), ("Height", 180),
        ("test_pattern", "100% White"), ("osd_text_mode", "All"),
        ("timestamp_source", "Start of Exposure"), ("percentage_of_dropped_buffers", 0),
        ("wrap_sequence_number", False), ("wrap_timestamp", "None"),
    ):  # fmt: skip
        device.write_feature(name, value)


def started(device: V4l2Device, slots: int = 64) -> V4l2Device:
    """The device, streaming."""
    device.frames.reserve(slots)
    device.trigger.prepare(SPEC)
    device.acquire.start()
    return device


def events_of(device: V4l2Device, seconds: float, count: int = 100_000) -> list[FrameEvent]:
    """What arrives in so many seconds, at most so many, each released at once."""
    events: list[FrameEvent] = []
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s and len(events) < count:
        for event in device.frames.poll():
            device.frames.release(event)
            events.append(event)
        time.sleep(0.004)
    return events
