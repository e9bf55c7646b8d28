"""What goes with every frame: its header of 64 bytes, and the layout of its pixels."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from capture.arrays import Image
from capture.crc import crc32
from capture.errors import TakeError

HEADER_BYTES = 64
_FRAME = struct.Struct("<4sHHqQqqdII8x")
_MARK = b"LKF1"
_LARGEST_PX = 1 << 28  # 16384 x 16384: a header can claim any size

HEADER_TEXT = """\
A message is a header of 64 bytes and then the pixels. All numbers are little endian.
offset type     name
 0     char[4]  mark           "LKF1"
 4     uint16   header_bytes   64
 6     uint16   device_index   place of the device in the take's list
 8     int64    trigger_index  which trigger of the take exposed this frame
16     uint64   frame_id       the number that the device gave the frame
24     int64    t_dev_ns       start of exposure by the device's own clock; -1 unknown
32     int64    t_host_ns      arrival by the host's clock; -1 unknown
40     float64  exposure_us    -1 unknown
48     uint32   status         0 complete, 1 incomplete
52     uint32   pixel_crc      CRC-32 (zlib) of the pixels
56     uint8[8] zero
64     pixels   rows from the top, columns from the left, channels innermost (RGB when there are 3);
                width, height, channels and dtype stand in the channel's metadata
"""


@dataclass(frozen=True)
class ImageLayout:
    """The size and pixel type that all frames of one device share.

    Attributes:
        width: columns, px.
        height: rows, px.
        channels: 1 for mono, 3 for RGB.
        dtype: "uint8" or "uint16".
    """

    width: int
    height: int
    channels: int
    dtype: str

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise TakeError(
                f"image size must be at least 1 x 1 px, found {self.width} x {self.height}"
            )
        if self.width * self.height > _LARGEST_PX:
            raise TakeError(
                f"{self.width} x {self.height} px is beyond what is read ({_LARGEST_PX} px)"
            )
        if self.channels not in (1, 3):
            raise TakeError(f"channels must be 1 (mono) or 3 (RGB), found {self.channels}")
        if self.dtype not in ("uint8", "uint16"):
            raise TakeError(f"pixel type must be uint8 or uint16, found {self.dtype!r}")

    @classmethod
    def of(cls, image: Image) -> ImageLayout:
        """The layout of an (H, W) or (H, W, 3) uint8 or uint16 image.

        Raises:
            TakeError: when it is another array.
        """
        if image.ndim not in (2, 3):
            raise TakeError(f"an image must be (H, W) or (H, W, 3), found shape {image.shape}")
        channels = 1 if image.ndim == 2 else int(image.shape[2])
        return cls(int(image.shape[1]), int(image.shape[0]), channels, image.dtype.name)

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W) or (H, W, 3)."""
        flat = (self.height, self.width)
        return flat if self.channels == 1 else (*flat, self.channels)

    @property
    def nbytes(self) -> int:
        """Bytes of one frame's pixels."""
        return self.width * self.height * self.channels * np.dtype(self.dtype).itemsize

    def __str__(self) -> str:
        kind = "mono" if self.channels == 1 else "RGB"
        return f"{self.width} x {self.height} {kind} {self.dtype}"


def raw_pixels(image: Image) -> memoryview:
    """The bytes of an image as they stand on disk; a view of it, if it lies so in memory."""
    little = np.ascontiguousarray(image, dtype=image.dtype.newbyteorder("<"))
    return little.data.cast("B")


def pixel_crc(image: Image) -> int:
    """The CRC-32 of an image's bytes as they stand on disk, as a header holds it."""
    return crc32(raw_pixels(image))


@dataclass(frozen=True)
class FrameHeader:
    """What is known of one frame; the schema text of the file describes each field.

    Attributes:
        trigger_index: which trigger of the take exposed this frame.
        device_index: place of the device in the take's list.
        frame_id: the number the device gave the frame.
        t_dev_ns: start of exposure by the device's own clock; -1 unknown.
        t_host_ns: arrival by the host's clock; -1 unknown.
        exposure_us: exposure time; -1 unknown.
        status: 0 complete, 1 incomplete.
        pixel_crc: CRC-32 of the pixels; the writer fills it in.
    """

    trigger_index: int
    device_index: int = 0
    frame_id: int = 0
    t_dev_ns: int = -1
    t_host_ns: int = -1
    exposure_us: float = -1.0
    status: int = 0
    pixel_crc: int = 0

    def pack(self) -> bytes:
        """The 64 bytes."""
        return _FRAME.pack(
            _MARK, HEADER_BYTES, self.device_index, self.trigger_index, self.frame_id,
            self.t_dev_ns, self.t_host_ns, self.exposure_us, self.status, self.pixel_crc,
        )  # fmt: skip

    @classmethod
    def unpack(cls, data: bytes) -> FrameHeader:
        """From 64 bytes.

        Raises:
            TakeError: when they are not such a header.
        """
        if len(data) != HEADER_BYTES:
            raise TakeError(f"a frame header is {HEADER_BYTES} bytes, found {len(data)}")
        mark, size, device, trigger, frame_id, t_dev, t_host, exposure, status, crc = _FRAME.unpack(
            data
        )
        if mark != _MARK or size != HEADER_BYTES:
            raise TakeError(f"expected a frame header marked {_MARK!r}, found {mark!r}")
        return cls(trigger, device, frame_id, t_dev, t_host, exposure, status, crc)
