"""Pixel formats: which are taken, and how one image becomes mono in memory of ours.

Colour formats with a luma plane give that plane: it is what the sensor's channels were mixed to, at
full resolution. Formats of 10 to 16 bits come in words of 16 bits with the value in the lower bits,
as the kernel documents them, and stay so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from capture.arrays import Image
from capture.devices.v4l2 import ioctls
from capture.devices.v4l2.decoders import decoder_problem
from capture.frame_header import ImageLayout

_OUR_NAMES = {"MJPEG": "MJPG"}
_THEIR_NAMES = {theirs: ours for ours, theirs in _OUR_NAMES.items()}


@dataclass(frozen=True)
class PixelFormat:
    """One pixel format.

    Attributes:
        name: its four letters, but MJPEG for what the kernel calls MJPG.
        dtype: of the mono image that it becomes.
        sample_bytes: from pixel to pixel in a row of the source.
        first_byte: of the first pixel's value in its row.
        compressed: whether an image must be decoded.
    """

    name: str
    dtype: str = "uint8"
    sample_bytes: int = 1
    first_byte: int = 0
    compressed: bool = False

    @property
    def fourcc(self) -> int:
        """The kernel's number."""
        letters = _OUR_NAMES.get(self.name, self.name)
        return int.from_bytes(letters.ljust(4).encode("ascii"), "little")


# In the order of preference when a device's present format is not among them.
SUPPORTED: dict[str, PixelFormat] = {
    each.name: each
    for each in (
        PixelFormat("GREY"),
        PixelFormat("Y10", "uint16", 2),
        PixelFormat("Y12", "uint16", 2),
        PixelFormat("Y14", "uint16", 2),
        PixelFormat("Y16", "uint16", 2),
        PixelFormat("YUYV", "uint8", 2),
        PixelFormat("UYVY", "uint8", 2, 1),
        PixelFormat("YVYU", "uint8", 2),
        PixelFormat("VYUY", "uint8", 2, 1),
        PixelFormat("NV12"),
        PixelFormat("NV21"),
        PixelFormat("YU12"),
        PixelFormat("YV12"),
        PixelFormat("MJPEG", compressed=True),
        PixelFormat("JPEG", compressed=True),
    )
}

_REFUSED = {
    "Y10P": "its ten-bit values are packed into five bytes for four pixels; use Y10",
    "Y10B": "its ten-bit values are packed without gaps; use Y10",
    "Y12P": "its twelve-bit values are packed; use Y12",
}
_BIG_ENDIAN = 1 << 31


def fourcc_text(fourcc: int) -> str:
    """The name of a format by the kernel's number; big-endian formats get "-BE"."""
    letters = (fourcc & ~_BIG_ENDIAN).to_bytes(4, "little")
    text = "".join(chr(byte) if 32 <= byte < 127 else "?" for byte in letters).rstrip()
    text = _THEIR_NAMES.get(text, text)
    return f"{text}-BE" if fourcc & _BIG_ENDIAN else text


def refusal(name: str) -> str:
    """Why a pixel format is not taken; empty when it is."""
    if name in SUPPORTED:
        return decoder_problem() if SUPPORTED[name].compressed else ""
    if name.endswith("-BE"):
        return f"its words are big-endian; use {name.removesuffix('-BE')}"
    return _REFUSED.get(name, f"it is none of {', '.join(SUPPORTED)}")


def layout_of(pix: ioctls.PixFormat) -> ImageLayout:
    """The layout of the mono images that a supported format becomes."""
    chosen = SUPPORTED[fourcc_text(pix.pixelformat)]
    return ImageLayout(int(pix.width), int(pix.height), 1, chosen.dtype)


def unpacker(pix: ioctls.PixFormat) -> Callable[[Image, Image], int]:
    """How one image of an uncompressed format is copied out of the driver's buffer.

    Args:
        pix: the format that the driver has set.

    Returns:
        A function of the buffer's used bytes and of the image to fill. It returns how many whole
        rows there were; the rows after them are zero.
    """
    chosen = SUPPORTED[fourcc_text(pix.pixelformat)]
    width, height = int(pix.width), int(pix.height)
    # Some drivers leave the stride 0 or too small; then rows follow each other without a gap.
    stride = max(int(pix.bytesperline), width * chosen.sample_bytes)

    def unpack(source: Image, target: Image) -> int:
        # The last row need not be padded to the stride.
        last = width * chosen.sample_bytes
        rows = min(height, max(0, (source.size - last) // stride + 1))
        view = np.lib.stride_tricks.as_strided(source, (rows, last), (stride, 1), writeable=False)
        if chosen.dtype == "uint16":
            target[:rows] = view.view("<u2")
        else:
            target[:rows] = view[:, chosen.first_byte :: chosen.sample_bytes]
        target[rows:] = 0
        return rows

    return unpack
