"""What the images hold: every row proves from which device, frame and trigger it is.

Each pixel carries one byte: in Mono8 as it is, in Mono12 as its upper eight bits, in Mono16 as its
upper byte. The bytes of a row::

    0..1    mark of the device            6..13   number of the frame, as on the wire
    2..3    row                           14..21  true time of the trigger: the host's monotonic
    4..5    0x5A, 0xC3                            clock, ns
    22..    (column + row + number of the frame) mod 256

All numbers are big-endian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FORMATS = {"Mono8": (0x01080001, 8), "Mono12": (0x01100005, 12), "Mono16": (0x01100007, 16)}
_HEAD = 22


@dataclass(frozen=True)
class Stamp:
    """What an image proves of itself.

    Attributes:
        device: mark of the device.
        frame_id: number of the frame.
        t_ns: true time of the trigger.
    """

    device: int
    frame_id: int
    t_ns: int


def draw(stamp: Stamp, width: int, height: int, bits: int) -> bytes:
    """The pixels of an image, as they are sent: little-endian when they have more than 8 bits."""
    rows = np.empty((height, width), np.uint8)
    head = stamp.frame_id.to_bytes(8, "big") + stamp.t_ns.to_bytes(8, "big", signed=True)
    y, x = np.arange(height), np.arange(width)
    rows[:] = (x[None, :] + y[:, None] + stamp.frame_id) & 0xFF
    rows[:, 0], rows[:, 1] = stamp.device >> 8, stamp.device & 0xFF
    rows[:, 2], rows[:, 3] = y >> 8, y & 0xFF
    rows[:, 4], rows[:, 5] = 0x5A, 0xC3
    rows[:, 6:_HEAD] = np.frombuffer(head, np.uint8)
    if bits == 8:
        return rows.tobytes()
    return (rows.astype("<u2") << (bits - 8)).tobytes()


def read_stamps(image: NDArray[np.generic], bits: int = 8) -> list[Stamp | None]:
    """What each row proves; None for one that no device draws, or that stands elsewhere."""
    rows = image.astype(np.uint16) >> (bits - 8)
    found: list[Stamp | None] = []
    for y, row in enumerate(rows.astype(np.uint8)):
        head = row[:_HEAD].tobytes()
        stamp = Stamp(
            int.from_bytes(head[:2], "big"),
            int.from_bytes(head[6:14], "big"),
            int.from_bytes(head[14:22], "big", signed=True),
        )
        body = (np.arange(_HEAD, len(row)) + y + (stamp.frame_id & 0xFF)) & 0xFF
        whole = head[4:6] == b"\x5a\xc3" and int.from_bytes(head[2:4], "big") == y
        found.append(stamp if whole and bool((row[_HEAD:] == body).all()) else None)
    return found


def read_stamp(image: NDArray[np.generic], bits: int = 8) -> Stamp | None:
    """What the whole image proves; None when a single row is not of the same frame."""
    stamps = set(read_stamps(image, bits))
    return stamps.pop() if len(stamps) == 1 else None
