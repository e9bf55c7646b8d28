"""What devices see that are simulated in real time: a pattern that proves which frame it is.

Pixel (x, y) of channel c in the frame numbered `id` is (118 x + 43 y + c + 43 id) mod 251. Over the
first 32 bytes stands a `Stamp`: which device, which exposure, which number, and when, truly. Grey
values are spread evenly over every part of an image, so that a preflight sees a steady light, and
none is white.
"""

from __future__ import annotations

import functools
import struct
import zlib
from dataclasses import dataclass

import numpy as np

from capture.arrays import Image
from capture.errors import DeviceError
from capture.frame_header import ImageLayout

STAMP_BYTES = 32

_STAMP = struct.Struct("<4sIqqq")
_MARK = b"SIM1"
_ACROSS, _DOWN, _MODULUS = 118, 43, 251


@dataclass(frozen=True)
class Stamp:
    """What stands in the first bytes of a simulated image, whatever the device says of it.

    Attributes:
        device_crc: CRC-32 of the device's name.
        place: which of the device's triggers since its start, from 0.
        number: the frame's number as it was sent.
        t_ns: true time of the exposure, by the host's clock.
    """

    device_crc: int
    place: int
    number: int
    t_ns: int

    @classmethod
    def read(cls, image: Image) -> Stamp:
        """The stamp of an image.

        Raises:
            DeviceError: when it carries none.
        """
        front = np.ascontiguousarray(image).reshape(-1).view(np.uint8)[:STAMP_BYTES].tobytes()
        if len(front) < STAMP_BYTES or front[:4] != _MARK:
            raise DeviceError(f"expected an image stamped {_MARK!r}, found {front[:4]!r}")
        return cls(*_STAMP.unpack(front)[1:])

    def pack(self) -> bytes:
        """The 32 bytes."""
        return _STAMP.pack(_MARK, self.device_crc, self.place, self.number, self.t_ns)


def device_crc(name: str) -> int:
    """By which a stamp names a device."""
    return zlib.crc32(name.encode())


def pattern(layout: ImageLayout, stamp: Stamp) -> Image:
    """The image that a simulated device sends, (H, W) or (H, W, 3).

    Args:
        layout: of the image.
        stamp: that it carries.
    """
    image = np.empty(layout.shape, layout.dtype)
    PatternWriter(layout).write(stamp, image.reshape(-1).view(np.uint8))
    return image


class PatternWriter:
    """Writes images into memory: one copy each, nothing is computed."""

    def __init__(self, layout: ImageLayout) -> None:
        """Hold the rows that images of that layout are cut from."""
        self._strip = _strip(layout)
        self._row_bytes = layout.nbytes // layout.height

    def write(self, stamp: Stamp, into: Image) -> None:
        """Write an image, or its first part.

        Args:
            stamp: that it carries.
            into: (n,) uint8, at least as long as a stamp.
        """
        start = (stamp.number % _MODULUS) * self._row_bytes
        into[:] = self._strip[start : start + len(into)]
        into[:STAMP_BYTES] = np.frombuffer(stamp.pack(), np.uint8)


@functools.lru_cache(maxsize=8)
def _strip(layout: ImageLayout) -> Image:
    """The rows of all images, as bytes; each image begins somewhere in it."""
    row = _ACROSS * np.arange(layout.width)[:, None] + np.arange(layout.channels)
    rows = _DOWN * np.arange(layout.height + _MODULUS)[:, None, None] + row
    return (rows % _MODULUS).astype(layout.dtype).reshape(-1).view(np.uint8)
