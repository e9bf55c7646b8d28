"""A backend as a third party would write it, no longer than the contract asks: frames that count.

`test_third_party.py` installs it by an entry point and holds it to the contract of all devices.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from capture.arrays import Image
from capture.devices.backend import FoundDevice
from capture.devices.protocol import ClockKind, DeviceInfo, TriggerKind, TriggerSpec, WholeDevice
from capture.devices.slots import SlotPool
from capture.errors import DeviceError
from capture.frame import FrameEvent
from capture.frame_header import ImageLayout


class CountingDevice(WholeDevice):
    """Runs freely, each image filled with its frame number; its own trigger, acquire and frames."""

    def __init__(self, address: str, name: str) -> None:
        self.info = DeviceInfo(
            name=name, serial=address, model="Example counter", transport="example",
            layout=ImageLayout(32, 24, 1, "uint8"), triggers=(TriggerKind.FREE_RUN,),
            id_bits=32, first_id=0, clock=ClockKind.HOST,
        )  # fmt: skip
        self._spec: TriggerSpec | None = None
        self._pool: SlotPool | None = None
        self._number, self._due_ns = 0, 0  # of the next frame; it is never due while stopped

    def prepare(self, spec: TriggerSpec) -> None:
        if spec.kind not in self.info.triggers:
            offers = ", ".join(self.info.triggers)
            raise DeviceError(f"{self.info.name}: asked for {spec.kind} triggers, offers {offers}")
        self._spec = spec

    def reserve(self, frames: int) -> None:
        self._pool = SlotPool(frames, self.info.layout)

    def start(self) -> None:
        if self._spec is None or self._pool is None:
            raise DeviceError(f"{self.info.name}: started before it was prepared")
        self._due_ns = time.monotonic_ns() + self._spec.period_ns

    def stop(self) -> None:
        self._due_ns = 0

    def poll(self) -> Sequence[FrameEvent]:
        events: list[FrameEvent] = []
        while self._spec and self._pool and 0 < self._due_ns <= (now_ns := time.monotonic_ns()):
            slot = self._pool.take()  # None: all memory is taken, and this frame is lost
            if slot is not None:
                self._pool.image(slot)[:] = self._number % 256
                event = FrameEvent(self.info.name, self._number, self._due_ns, now_ns, slot)
                events.append(event)
            self._number, self._due_ns = self._number + 1, self._due_ns + self._spec.period_ns
        return events

    def pixels(self, event: FrameEvent) -> Image:
        return self._slots().image(event.slot)

    def release(self, event: FrameEvent) -> None:
        self._slots().give(event.slot)

    def close(self) -> None:
        self.stop()

    def _slots(self) -> SlotPool:
        if self._pool is None:
            raise DeviceError(f"{self.info.name}: no memory was reserved")
        return self._pool


class CountingBackend:
    """Opens any address."""

    name = "counting"

    def discover(self) -> tuple[FoundDevice, ...]:
        return (
            FoundDevice(
                backend=self.name, address="c1", serial="c1", model="Example counter",
                transport="example",
            ),
        )  # fmt: skip

    def open(self, address: str, name: str) -> CountingDevice:
        return CountingDevice(address, name)


backend = CountingBackend()
