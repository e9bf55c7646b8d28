"""A device behind a kernel driver: streams into the driver's buffers, each copied once into a slot.

The buffer goes back to the driver in the same call, so that a slow writer never starves it: when no
slot is free the frame is dropped, and its number leaves the gap that the ledger finds.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Sequence

from capture.arrays import Image
from capture.devices.capabilities import FeatureDump, FeatureValue, Health
from capture.devices.protocol import (
    ClockKind,
    ClockSample,
    DeviceInfo,
    TriggerKind,
    TriggerSpec,
    WholeDevice,
)
from capture.devices.slots import SlotPool
from capture.devices.v4l2 import ioctls
from capture.devices.v4l2.buffers import DriverBuffers, clock_flags
from capture.devices.v4l2.discovery import NodeIdentity, find_path, identify
from capture.devices.v4l2.exposure import set_exposure
from capture.devices.v4l2.features import FeatureTable
from capture.devices.v4l2.fill import Copying, Decoding, filler
from capture.devices.v4l2.formats import fourcc_text, layout_of
from capture.devices.v4l2.node import Node, open_node, said
from capture.devices.v4l2.stream_settings import (
    present_format,
    set_format,
    set_period,
    usable_format,
)
from capture.errors import DeviceError
from capture.frame import FrameEvent

_DRIVER_BUFFERS = 12  # 160 ms at 75 Hz: as long as the thread that polls may be held up


class V4l2Device(WholeDevice):
    """One device. It is its own trigger, acquire and frame logic.

    The kernel knows no command that exposes one frame and no common name for a trigger input, so
    these devices run freely. Frame numbers and times are handed on as the driver gives them.
    """

    def __init__(self, node: Node, name: str, identity: NodeIdentity, clock: ClockKind) -> None:
        """Take over an open node; see `open_device`.

        Args:
            node: open for capture.
            name: that the device shall have in the array.
            identity: by which it is known again.
            clock: whose clock dates its frames.
        """
        self._node, self._name, self._identity, self._clock = node, name, identity, clock
        self._pix = usable_format(node)
        self._features = FeatureTable(node)
        self._control = threading.RLock()  # one control call at a time: a driver may take seconds
        self._lock = threading.RLock()  # of what `poll` uses, never held while the driver is asked
        self._reserved = 0
        self._pool: SlotPool | None = None
        self._buffers: DriverBuffers | None = None
        self._fill: Copying | Decoding | None = None
        self._carried: list[FrameEvent] = []
        self._spec: TriggerSpec | None = None
        self._exposure_us = -1.0
        self._lost = ""  # why the device is gone; empty while it is there
        self._counters: Counter[str] = Counter()

    @property
    def info(self) -> DeviceInfo:
        """What the device says of itself; the layout is that of the format now set."""
        return DeviceInfo(
            name=self._name,
            serial=self._identity.serial,
            model=self._identity.model,
            layout=layout_of(self._pix),
            id_bits=32,
            triggers=(TriggerKind.FREE_RUN,),
            first_id=0,
            clock=self._clock,
            transport="v4l2",
            address=self._node.path,
            link_mbps=self._identity.link_mbps,
        )

    def prepare(self, spec: TriggerSpec) -> None:
        """Set the rate, and the exposure time where the device has a control for it.

        Raises:
            DeviceError: when it offers another rate or range, or cannot be triggered that way.
        """
        if spec.kind is not TriggerKind.FREE_RUN:
            raise DeviceError(
                f"{self._name}: asked for {spec.kind} triggers, offers {TriggerKind.FREE_RUN}"
            )
        with self._named():
            if self._buffers is None:
                set_period(self._node, spec.period_ns)
            elif self._spec is None or spec.period_ns != self._spec.period_ns:
                raise DeviceError("its rate cannot be changed while it streams; stop it first")
            self._exposure_us = set_exposure(self._node, spec.exposure_us)
            self._spec = spec

    def reserve(self, frames: int) -> None:
        """Set memory aside for so many frames that are not yet released.

        Raises:
            DeviceError: when there is not so much, or frames of earlier memory are still out.
        """
        with self._control, self._lock:
            if self._buffers is None:
                self._discard()
            if self._pool is not None and self._pool.free < self._pool.count:
                out = self._pool.count - self._pool.free
                raise DeviceError(f"{self._name}: {out} frames are not released yet")
            if self._buffers is not None:
                raise DeviceError(f"{self._name}: it streams; stop it before memory is set aside")
            self._reserved = frames
            self._pool = SlotPool(frames, layout_of(self._pix))

    def start(self) -> None:
        """Begin to stream.

        Raises:
            DeviceError: when it was not prepared, or the driver refuses.
        """
        with self._named():
            if self._spec is None or not self._reserved:
                raise DeviceError("started before it was prepared and memory was reserved")
            if self._buffers is not None:
                return
            with self._lock:
                self._discard()
            if self._pool is None or self._pool.layout != layout_of(self._pix):
                self.reserve(self._reserved)
            self._begin()

    def stop(self) -> None:
        """Cease to stream. What has arrived can still be fetched."""
        with self._control:
            with self._lock:
                self._drain()
                buffers, self._buffers = self._buffers, None
            if buffers is not None:
                buffers.free()
            if self._fill is not None:
                self._fill.close()

    def poll(self) -> Sequence[FrameEvent]:
        """The frames that have arrived since the last call; none when the device is gone."""
        with self._lock:
            self._drain()
            ready = self._arrived()
            self._counters["frames"] += len(ready)
            return ready

    def pixels(self, event: FrameEvent) -> Image:
        """A view of the slot that holds the frame, good until `release`."""
        return self._slots().image(event.slot)

    def release(self, event: FrameEvent) -> None:
        """Give the frame's slot back."""
        self._slots().give(event.slot)

    def read_feature(self, name: str) -> FeatureValue:
        """The value of a setting: PixelFormat, Width, Height, AcquisitionFrameRate or a control.

        Raises:
            DeviceError: when there is none of that name, or the device does not answer.
        """
        with self._named():
            return self._features.read(name)

    def write_feature(self, name: str, value: FeatureValue) -> None:
        """Set one.

        Raises:
            DeviceError: saying what the device offers, when it does not take the value.
        """
        with self._named():
            self._features.write(name, value)
            if self._buffers is None:  # while it streams, its format stays as it is
                self._pix = present_format(self._node)

    def features(self) -> FeatureDump:
        """All settings, with what the driver says of each."""
        with self._named():
            return self._features.dump()

    def health(self) -> Health:
        """How it fares; counters are the device's own and no frame counts."""
        if not self._lost:
            self._ask_for_life()
        with self._lock:
            counters = dict(self._counters)
            if self._buffers is not None:
                counters["requeue_failures"] = self._buffers.requeue_failures
                counters["driver_buffers"] = self._buffers.count
            free = self._pool.free if self._pool is not None else -1
            return Health(connected=not self._lost, counters=counters, free=free)

    def reconnect(self) -> None:
        """Find the device again by its identity, set it up as it was, and start it.

        Raises:
            DeviceError: when it is not there, or is not as it was.
        """
        with self._named():
            if self._spec is None or self._pool is None:
                raise DeviceError("cannot be reconnected before it was prepared")
            self.stop()
            with self._lock:
                self._carried = self._arrived()
            self._node.close()
            wanted = self._pix
            self._node, capability = open_node(find_path(self._identity.serial))
            self._identity = identify(self._node.path, capability)
            self._pix = set_format(
                self._node, fourcc_text(wanted.pixelformat), wanted.width, wanted.height
            )
            if layout_of(self._pix) != self._pool.layout:
                raise DeviceError(
                    f"came back with images of {layout_of(self._pix)}, had {self._pool.layout}"
                )
            self._features.return_to(self._node)
            self.prepare(self._spec)
            self._counters["reconnects"] += 1
            self._begin()

    def close(self) -> None:
        """Stop, and give the device back."""
        with self._control:
            self.stop()
            with self._lock:
                self._discard()
            self._node.close()
            self._lost = self._lost or "closed"

    def _begin(self) -> None:
        fill = filler(self._pix, self._slots())  # first: it is refused without a decoder
        buffers = DriverBuffers(self._node, _DRIVER_BUFFERS)
        buffers.start()
        with self._lock:
            self._fill, self._buffers, self._lost = fill, buffers, ""

    def _arrived(self) -> list[FrameEvent]:
        """Frames whose slots are filled, those first that came before the device was lost."""
        carried, self._carried = self._carried, []
        return carried + (self._fill.ready() if self._fill is not None else [])

    def _discard(self) -> None:
        """Give back the slots of frames that nobody polled before the device was stopped."""
        for event in self._arrived():
            self._slots().give(event.slot)

    def _drain(self) -> None:
        """Copy what the driver has filled, and give each buffer back at once."""
        buffers, fill, pool = self._buffers, self._fill, self._pool
        if buffers is None or fill is None or pool is None or self._lost:
            return
        for _ in range(buffers.count):  # never more than a turn, or a fast device would hold us
            try:
                taken = buffers.take()
            except OSError as error:
                self._lost = said(error)
                return
            if taken is None:
                return
            buffer, source = taken
            arrived_ns = time.monotonic_ns()
            slot = pool.take()
            if slot is None:
                self._counters["no_free_slot"] += 1
            else:
                fill.add(self._event(buffer, arrived_ns, slot), source)
            del source
            buffers.give(int(buffer.index))

    def _event(self, buffer: ioctls.Buffer, arrived_ns: int, slot: int) -> FrameEvent:
        flagged = bool(buffer.flags & ioctls.FLAG_ERROR)
        self._counters["error_flags"] += flagged
        return FrameEvent(
            self._name,
            int(buffer.sequence),
            _signed_64(int(buffer.seconds) * 10**9 + int(buffer.microseconds) * 1000),
            arrived_ns,
            slot,
            self._exposure_us,
            not flagged,
            "the driver flagged an error" if flagged else "",
        )

    def _slots(self) -> SlotPool:
        if self._pool is None:
            raise DeviceError(f"{self._name}: no memory was reserved")
        return self._pool

    def _ask_for_life(self) -> None:
        try:
            self._node.call(ioctls.QUERYCAP, ioctls.Capability())
        except OSError as error:
            self._lost = said(error)

    def _named(self) -> _Named:
        return _Named(self._name, self._control)


def _signed_64(t_ns: int) -> int:
    """A time as files hold it: a driver may claim any, and its jump is told by the ledger."""
    return (t_ns + (1 << 63)) % (1 << 64) - (1 << 63)


class HostClockedDevice(V4l2Device):
    """A device whose driver dates its frames by the host's monotonic clock."""

    def latch(self) -> ClockSample:
        """The host's clock, which is the device's."""
        now = time.monotonic_ns()
        return ClockSample(now, now, now)


class _Named:
    """Holds the lock of control calls, and puts the device's name before what went wrong."""

    def __init__(self, name: str, lock: threading.RLock) -> None:
        self._name, self._lock = name, lock

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._lock.release()
        if isinstance(error, DeviceError) and not str(error).startswith(f"{self._name}: "):
            raise DeviceError(f"{self._name}: {error}") from error


def open_device(address: str, name: str) -> V4l2Device:
    """Open the device at a node, or of a serial or bus address.

    Raises:
        DeviceError: when it is not there, is of another kind, offers no format that is taken, or
            another program streams from it.
    """
    node, capability = open_node(find_path(address))
    try:
        return device_on(node, name, identify(node.path, capability))
    except DeviceError:
        node.close()
        raise


def device_on(node: Node, name: str, identity: NodeIdentity) -> V4l2Device:
    """The device behind an open node.

    Raises:
        DeviceError: when it offers no format that is taken, or another program streams from it.
    """
    source = clock_flags(node) & ioctls.FLAG_TIMESTAMP_MASK
    if source == ioctls.FLAG_TIMESTAMP_MONOTONIC:
        return HostClockedDevice(node, name, identity, ClockKind.HOST)
    return V4l2Device(node, name, identity, ClockKind.OWN)
