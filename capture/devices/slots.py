"""Memory for frames: slots of one size in shared memory, that a device fills and the host reads."""

from __future__ import annotations

import ctypes
import mmap
import os
import threading
import weakref
from collections import deque

import numpy as np

from capture.arrays import Image
from capture.errors import DeviceError
from capture.frame_header import ImageLayout

_PAGE = mmap.PAGESIZE


class SlotPool:
    """A fixed number of slots, each of one frame; all of it is touched at once, so that no page is
    first asked for while frames arrive.

    A slot is taken, filled, shown, given back. Taking and giving are safe from any thread.
    """

    def __init__(self, count: int, layout: ImageLayout, payload_bytes: int | None = None) -> None:
        """Set the memory aside.

        Args:
            count: how many slots.
            layout: of every frame.
            payload_bytes: what a device writes for each, when that is more than the image.

        Raises:
            DeviceError: when there is not so much memory.
        """
        if count < 1:
            raise DeviceError(f"a pool needs at least one slot, found {count}")
        self.count, self.layout = count, layout
        self.payload_bytes = max(layout.nbytes, payload_bytes or 0)
        self.slot_bytes = -(-self.payload_bytes // _PAGE) * _PAGE
        size = count * self.slot_bytes
        try:
            self.fd = os.memfd_create("likeness-slots")
            # The memory lives as long as its file is open, or a view of it is held.
            weakref.finalize(self, os.close, self.fd)
            os.posix_fallocate(self.fd, 0, size)
            self._memory = mmap.mmap(self.fd, size)
        except OSError as error:
            raise DeviceError(
                f"{count} frames of {layout} need {size / 1e9:.2f} GB of memory: {error.strerror}"
            ) from error
        # A view held by ctypes keeps the map open for as long as a device may write into it.
        self._anchor = ctypes.c_char.from_buffer(self._memory)
        self._start = ctypes.addressof(self._anchor)
        self._bytes = np.frombuffer(self._memory, np.uint8)
        self._bytes[::_PAGE] = 0
        self._free: deque[int] = deque(range(count))
        self._lock = threading.Lock()
        self._taken: set[int] = set()

    @property
    def free(self) -> int:
        """How many slots are free."""
        return len(self._free)

    def take(self) -> int | None:
        """A free slot, or None when all are taken."""
        with self._lock:
            if not self._free:
                return None
            slot = self._free.popleft()
            self._taken.add(slot)
            return slot

    def give(self, slot: int) -> None:
        """Give a slot back.

        Raises:
            DeviceError: when it was not taken.
        """
        with self._lock:
            if slot not in self._taken:
                raise DeviceError(f"slot {slot} was released twice, or never filled")
            self._taken.remove(slot)
            self._free.append(slot)

    def address(self, slot: int) -> int:
        """Where a slot begins in memory, for a driver that writes there itself."""
        return self._start + slot * self.slot_bytes

    def raw(self, slot: int) -> Image:
        """The bytes of a slot, (nbytes,) uint8, as a view."""
        at = slot * self.slot_bytes
        return self._bytes[at : at + self.layout.nbytes]

    def image(self, slot: int) -> Image:
        """The image in a slot, (H, W) or (H, W, 3), as a view."""
        return self.raw(slot).view(self.layout.dtype).reshape(self.layout.shape)
