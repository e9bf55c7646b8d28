"""`RealTimeDevice`: a device that is played by the host's clock, as if a driver stood behind it.

Frames arrive a while after they were exposed, in memory that was reserved; when none is free they
are lost, and numbered. What there is to see, and when, comes from a `Source`: see
`capture.devices.simulated` and `capture.devices.replay`.

No thread runs. What would have happened by now is caught up with at each call, under a lock; pixels
are written by whoever polls, the copy of one frame each.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Protocol

from capture.arrays import Image
from capture.devices.capabilities import Health
from capture.devices.faults import Exposure, Fault, FaultBook
from capture.devices.lines import RealTimeLine
from capture.devices.protocol import ClockSample, DeviceInfo, TriggerKind, TriggerSpec, WholeDevice
from capture.devices.slots import SlotPool
from capture.errors import DeviceError
from capture.frame import FrameEvent

_UNRESERVED = 16  # frames of memory when nobody asked for any
_NEVER = 1 << 63
_UNDERWAY = 256  # frames between exposure and arrival, at most


class Source(Protocol):
    """What a played device has to send."""

    def begin(self, t_ns: int, spec: TriggerSpec) -> None:
        """The device is started at the true time `t_ns`."""

    def exposure(self, edge: int, t_ns: int) -> Exposure | None:
        """What trigger number `edge` since the start exposes; None when it exposes nothing."""

    def lag_ns(self, exposure: Exposure) -> int:
        """How long after the start of an exposure its frame arrives."""

    def fill(self, exposure: Exposure, into: Image) -> str:
        """Write the bytes of the image into memory, (nbytes,) uint8; parts of an incomplete one.

        Returns:
            Why the image is not whole although the exposure is; empty otherwise.
        """

    def free_period_ns(self, period_ns: int) -> int:
        """The true time from trigger to trigger of a device that runs freely."""

    def clock_ns(self, t_ns: int) -> int:
        """What the device's clock shows at the true time `t_ns`."""

    def reboot_ns(self, t_ns: int) -> int:
        """How far the clock is set back by a reboot at the true time `t_ns`."""


class RealTimeDevice(WholeDevice):
    """A played device: its own trigger, acquire and frames."""

    def __init__(
        self, info: DeviceInfo, source: Source, line: RealTimeLine, faults: Sequence[Fault] = ()
    ) -> None:
        """Connect a device to its line.

        Args:
            info: what it says of itself.
            source: what it sends.
            line: the wire for hardware triggers.
            faults: what goes wrong after every start.
        """
        self.info = info
        self._source, self._line = source, line
        self._book = FaultBook(info.id_bits, info.first_id, tuple(faults))
        self._lock = threading.Lock()
        self._spec: TriggerSpec | None = None
        self._running = self._closed = False
        self._reserved, self._pool = 0, SlotPool(1, info.layout)
        self._held: dict[int, tuple[SlotPool, int]] = {}
        self._handle = 0
        self._underway: deque[tuple[int, Exposure]] = deque()
        self._busy_until_ns = self._arrival_ns = 0
        self._next_ns = self._wake_ns = _NEVER  # of the next trigger by itself; of the next news
        self._counters = {"overruns": 0, "ignored_triggers": 0}
        line.connect(self)

    def prepare(self, spec: TriggerSpec) -> None:
        """Set the device up for a kind of trigger."""
        self._answer()
        if spec.kind not in self.info.triggers:
            raise DeviceError(
                f"asked for {spec.kind} triggers, offers {', '.join(self.info.triggers)}"
            )
        self._spec = spec

    def reserve(self, frames: int) -> None:
        """Set memory aside; frames that are still held keep theirs until they are released."""
        if self._running:
            raise DeviceError(f"{self.info.name}: memory is reserved before the device is started")
        self._pool = SlotPool(1, self.info.layout)  # before, so that the old one's memory is free
        self._pool, self._reserved = SlotPool(frames, self.info.layout), frames

    def start(self) -> None:
        """Begin to answer triggers; they are counted from 0 again."""
        self._answer()
        if self._spec is None:
            raise DeviceError(f"{self.info.name}: started before it was prepared")
        if self._pool.count != self._reserved:
            self.reserve(self._reserved or _UNRESERVED)
        with self._lock:
            now = time.monotonic_ns()
            self._running, self._busy_until_ns = True, 0
            self._underway.clear()
            self._book.begin()
            self._source.begin(now, self._spec)
            self._next_ns = self._first_ns(now, self._spec)
            self._wake_ns = self._next_wake_ns()

    def stop(self) -> None:
        """Cease to answer triggers; what was exposed still arrives."""
        with self._lock:
            self._catch_up(time.monotonic_ns())
            self._running, self._next_ns = False, _NEVER
            self._wake_ns = self._next_wake_ns()

    def close(self) -> None:
        """Stop, and leave the line; frames that are still held stay until they are released."""
        self.stop()
        with self._lock:
            self._closed, self._wake_ns = True, _NEVER
            self._underway.clear()
        self._pool = SlotPool(1, self.info.layout)
        self._line.disconnect(self)

    def reconnect(self) -> None:
        """Come back after a death or after `close`; a device that had died begins anew."""
        if self._spec is None:
            raise DeviceError(f"{self.info.name}: was never prepared; prepare and start it")
        with self._lock:
            self._running = self._closed = False
            self._book.revive(self._source.reboot_ns(time.monotonic_ns()))
        self._line.connect(self)
        self.prepare(self._spec)
        self.start()

    def inject(self, fault: Fault) -> None:
        """Let something go wrong, at the next trigger unless the fault names another."""
        with self._lock:
            self._catch_up(time.monotonic_ns())
            self._book.inject(fault)

    def latch(self) -> ClockSample:
        """Read the device's clock."""
        self._answer()
        with self._lock:
            before = time.monotonic_ns()
            t_dev = self._book.clock_ns(before, self._source.clock_ns(before))
            return ClockSample(t_dev, before, time.monotonic_ns())

    def health(self) -> Health:
        """How it fares."""
        return Health(
            connected=not (self._closed or self._book.dead),
            counters=dict(self._counters),
            free=self._pool.free,
        )

    def fire(self) -> None:
        """Expose now; a device that is exposing ignores it."""
        self._answer()
        if self._spec is None or self._spec.kind != TriggerKind.SOFTWARE or not self._running:
            raise DeviceError(
                f"{self.info.name}: a software trigger needs a device that is prepared for "
                "software triggers and started"
            )
        with self._lock:
            self._trigger(time.monotonic_ns())

    def edge(self, t_ns: int) -> None:
        """An edge on the line at the true time `t_ns`."""
        with self._lock:
            if self._running and self._spec and self._spec.kind == TriggerKind.HARDWARE:
                self._trigger(t_ns)

    def poll(self) -> Sequence[FrameEvent]:
        """The frames that have arrived by now."""
        now = time.monotonic_ns()
        if now < self._wake_ns:  # most calls end here
            return ()
        with self._lock:
            self._catch_up(now)
            due = []
            while self._underway and self._underway[0][0] <= now:
                due.append(self._underway.popleft())
            self._wake_ns = self._next_wake_ns()
        events, pool = [], self._pool
        for arrival_ns, exposure in due:
            slot = pool.take()
            if slot is None:
                self._counters["overruns"] += 1
                continue
            damage = self._source.fill(exposure, pool.raw(slot))
            self._handle += 1
            self._held[self._handle] = (pool, slot)
            events.append(
                FrameEvent(
                    self.info.name, exposure.number, exposure.t_dev_ns, arrival_ns, self._handle,
                    exposure.exposure_us, exposure.complete and not damage, damage,
                )
            )  # fmt: skip
        return events

    def pixels(self, event: FrameEvent) -> Image:
        """A view of the frame's memory."""
        pool, slot = self._slot(event, self._held.get(event.slot))
        return pool.image(slot)

    def release(self, event: FrameEvent) -> None:
        """Give the frame's memory back."""
        pool, slot = self._slot(event, self._held.pop(event.slot, None))
        pool.give(slot)

    def _slot(self, event: FrameEvent, held: tuple[SlotPool, int] | None) -> tuple[SlotPool, int]:
        if held is None:
            raise DeviceError(
                f"{self.info.name}: frame {event.frame_id} was released, or is of another device"
            )
        return held

    def _answer(self) -> None:
        if self._closed or self._book.dead:
            word = "is closed" if self._closed else "does not answer"
            raise DeviceError(f"{self.info.name}: {word}; reconnect it")

    def _first_ns(self, now_ns: int, spec: TriggerSpec) -> int:
        """The next trigger that comes by itself."""
        if spec.kind == TriggerKind.FREE_RUN:
            return now_ns
        generator = self._line.generator_ns
        if spec.kind == TriggerKind.HARDWARE and generator is not None:
            return (now_ns // generator + 1) * generator
        return _NEVER

    def _next_wake_ns(self) -> int:
        return min(self._next_ns, self._underway[0][0] if self._underway else _NEVER)

    def _catch_up(self, now_ns: int) -> None:
        if now_ns < self._next_ns or self._spec is None:
            return
        if self._spec.kind == TriggerKind.FREE_RUN:
            period = self._source.free_period_ns(self._spec.period_ns)
        else:
            period = self._line.generator_ns or self._spec.period_ns
        while self._next_ns <= now_ns:
            self._trigger(self._next_ns)
            self._next_ns += period

    def _trigger(self, t_ns: int) -> None:
        if t_ns < self._busy_until_ns:
            self._counters["ignored_triggers"] += 1
            return
        would = self._source.exposure(self._book.edge, t_ns)
        outcome = self._book.trigger(t_ns, would)
        if would is None or not outcome.exposed:
            return
        self._busy_until_ns = t_ns + round(1000 * would.exposure_us)
        arrival_ns = t_ns + self._source.lag_ns(would)
        for exposure in outcome.sent:
            # Frames of one device arrive in the order it sent them, whatever the jitter.
            self._arrival_ns = max(arrival_ns, self._arrival_ns + 1)
            if len(self._underway) >= self._reserved + _UNDERWAY:
                self._counters["overruns"] += 1
            else:
                self._underway.append((self._arrival_ns, exposure))
                self._wake_ns = min(self._wake_ns, self._arrival_ns)
