"""A bench on which any device runs: opened by backend and address, triggered as it can be."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from capture.arrays import Image
from capture.devices.backend import LineOwner, load_backend
from capture.devices.capabilities import SoftwareTriggered
from capture.devices.faults import Faulty
from capture.devices.protocol import Device, TriggerKind, TriggerLine, TriggerSpec
from capture.errors import DeviceError
from capture.frame import FrameEvent
from capture.recorder import RecordSettings
from capture.session import Session, Shot, record_take
from tests.capture.recording import array_of

PLAYED_HZ = 250.0
WAIT_S = 15.0  # for frames that must come: generous, as machines are shared


def recorded_take(folder: Path, frames: int = 40) -> Path:
    """A take of two devices, without faults."""
    settings = RecordSettings(rate_hz=PLAYED_HZ, exposure_us=1000.0)
    shot = Shot(slate="played", kind="neutral", frames=frames)
    return record_take(Session.create(folder), shot, array_of(2), settings).folder


class Bench:
    """A device and what triggers it. Use it in a `with` block."""

    def __init__(self, backend: str, address: str, rate_hz: float, kind: TriggerKind) -> None:
        self.backend = load_backend(backend)
        self.device: Device = self.backend.open(address, "cam00")
        self.line: TriggerLine | None = None
        if isinstance(self.backend, LineOwner):
            self.line = self.backend.line()
        self.kind, self.period_ns = kind, round(1e9 / rate_hz)
        self._next_ns = 0

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self.device.close()

    @property
    def played(self) -> bool:
        """Whether the device does exactly what is asked of it: only then can numbers be exact."""
        return isinstance(self.device, Faulty)

    @property
    def unable(self) -> str:
        """Why the device cannot be triggered so; empty when it can."""
        offered = self.device.info.triggers
        if self.kind not in offered:
            return f"it offers {', '.join(offered)}, not {self.kind}"
        if self.kind == TriggerKind.HARDWARE and self.line is None:
            return "nothing here can send an edge on its wire"
        if self.kind == TriggerKind.SOFTWARE and not isinstance(self.device, SoftwareTriggered):
            return "it offers software triggers, and cannot be told to expose"
        return ""

    def spec(self) -> TriggerSpec:
        exposure_us = min(2000.0, self.period_ns / 4000)
        return TriggerSpec(kind=self.kind, period_ns=self.period_ns, exposure_us=exposure_us)

    def ready(self, frames: int = 0) -> None:
        """Reserve, prepare, start; of a played device every frame must be there, so a second's."""
        self.device.frames.reserve(frames or (round(PLAYED_HZ) if self.played else 16))
        self.device.trigger.prepare(self.spec())
        self.device.acquire.start()
        self._next_ns = 0

    def step(self) -> list[FrameEvent]:
        """Send a trigger when one is due and ours to send; then poll."""
        now = time.monotonic_ns()
        if self.kind != TriggerKind.FREE_RUN and now >= self._next_ns:
            self._next_ns = max(self._next_ns + self.period_ns, now)
            if self.kind == TriggerKind.SOFTWARE:
                assert isinstance(self.device, SoftwareTriggered)
                self.device.fire()
            else:
                assert self.line is not None
                self.line.fire(now)
        events = list(self.device.frames.poll())
        if not events:
            time.sleep(0.001)
        return events

    def collect(self, count: int) -> list[FrameEvent]:
        """So many frames or a few more, not released."""
        events: list[FrameEvent] = []
        deadline = time.monotonic() + WAIT_S
        while len(events) < count:
            if time.monotonic() > deadline:
                raise AssertionError(
                    f"expected {count} frames within {WAIT_S:.0f} s, {len(events)} came"
                )
            events += self.step()
        return events

    def listen(self, periods: float) -> list[FrameEvent]:
        """What comes within so many periods, not released."""
        events: list[FrameEvent] = []
        end = time.monotonic_ns() + round(periods * self.period_ns)
        while time.monotonic_ns() < end:
            events += self.step()
        return events

    def release(self, events: list[FrameEvent]) -> None:
        for event in events:
            self.device.frames.release(event)

    def copies(self, events: list[FrameEvent]) -> list[Image]:
        """Copies of the images as they are now."""
        return [np.array(self.device.frames.pixels(event)) for event in events]


def refusal(work: Callable[[], object]) -> str:
    """What a device says when it refuses."""
    try:
        work()
    except DeviceError as error:
        return str(error)
    raise AssertionError("expected a DeviceError")
