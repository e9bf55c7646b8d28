"""From a driver's buffer to a slot of ours: copied at once, or decoded in threads of the device."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

from capture.arrays import Image
from capture.devices.slots import SlotPool
from capture.devices.v4l2 import ioctls
from capture.devices.v4l2.decoders import jpeg_decoder
from capture.devices.v4l2.formats import SUPPORTED, fourcc_text, unpacker
from capture.errors import LikenessError
from capture.frame import FrameEvent

_THREADS = 2  # one image is decoded while the next arrives


class Copying:
    """Fills slots from uncompressed images."""

    def __init__(self, pix: ioctls.PixFormat, pool: SlotPool) -> None:
        self._unpack, self._pool = unpacker(pix), pool
        self._ready: list[FrameEvent] = []

    def add(self, event: FrameEvent, source: Image) -> None:
        """Copy one image; the driver's buffer is free when this returns."""
        rows = self._unpack(source, self._pool.image(event.slot))
        height = self._pool.layout.height
        if rows < height:
            event = incomplete(event, f"{rows} of {height} rows arrived")
        self._ready.append(event)

    def ready(self) -> list[FrameEvent]:
        """The frames whose slots are filled, in order of arrival."""
        ready, self._ready = self._ready, []
        return ready

    def close(self) -> None:
        """Nothing to end."""


class Decoding:
    """Fills slots from compressed images; `add` keeps the bytes and returns at once."""

    def __init__(self, pool: SlotPool) -> None:
        self._decode, self._pool = jpeg_decoder(), pool
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="v4l2-decode")
        self._pending: deque[Future[FrameEvent]] = deque()

    def add(self, event: FrameEvent, source: Image) -> None:
        """Have one image decoded; the driver's buffer is free when this returns."""
        self._pending.append(self._threads.submit(self._fill, event, source.tobytes()))

    def ready(self) -> list[FrameEvent]:
        """The frames whose slots are filled, in order of arrival."""
        ready = []
        while self._pending and self._pending[0].done():
            ready.append(self._pending.popleft().result())
        return ready

    def close(self) -> None:
        """Finish what was begun; it can still be fetched."""
        self._threads.shutdown(wait=True)

    def _fill(self, event: FrameEvent, data: bytes) -> FrameEvent:
        target = self._pool.image(event.slot)
        try:
            image = self._decode(data)
        except LikenessError as error:
            target[:] = 0
            return incomplete(event, f"the image could not be decoded: {error}")
        if image.shape != target.shape or image.dtype != target.dtype:
            target[:] = 0
            return incomplete(event, f"the image is {image.shape}, expected {target.shape}")
        target[:] = image
        return event


def filler(pix: ioctls.PixFormat, pool: SlotPool) -> Copying | Decoding:
    """What fills slots from images of a format.

    Raises:
        DeviceError: when it is compressed and there is no decoder.
    """
    compressed = SUPPORTED[fourcc_text(pix.pixelformat)].compressed
    return Decoding(pool) if compressed else Copying(pix, pool)


def incomplete(event: FrameEvent, why: str) -> FrameEvent:
    """The event, marked as not good, with the reason."""
    note = f"{event.note}; {why}" if event.note else why
    return replace(event, complete=False, note=note)
