"""PNG files, checked to their last byte, because decoders forgive a cut file in silence."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

from capture.arrays import Image
from capture.errors import TakeError
from capture.frame_header import ImageLayout

_MAGIC = b"\x89PNG\r\n\x1a\n"
_MONO, _RGB, _PALETTE = 0, 2, 3
_SAMPLES = {_MONO: 1, _RGB: 3, _PALETTE: 1}
_ADAM7 = (
    (0, 0, 8, 8),
    (4, 0, 8, 8),
    (0, 4, 4, 8),
    (2, 0, 4, 4),
    (0, 2, 2, 4),
    (1, 0, 2, 2),
    (0, 1, 1, 2),
)


def check_png(data: bytes, path: Path) -> ImageLayout:
    """Check that a PNG file is whole: every chunk's CRC, the end mark, and all rows of pixels.

    Args:
        data: the file's bytes.
        path: the name to use in messages.

    Returns:
        The layout its pixels will have: 8- or 16-bit, mono or RGB; a palette becomes RGB.

    Raises:
        TakeError: naming the file and what does not fit.

    References:
        W3C, Portable Network Graphics Specification, section 5 (chunks) and 8 (interlacing).
    """
    if not data.startswith(_MAGIC):
        raise TakeError(
            f"{path}: expected a PNG file, found {'an empty file' if not data else 'other bytes'}"
        )
    header, packed, seen = b"", [], set()
    at = len(_MAGIC)
    while True:
        if at + 12 > len(data):
            raise TakeError(
                f"{path}: truncated: the file ends at byte {len(data)} before its end mark"
            )
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data):
            raise TakeError(f"{path}: truncated: {len(data)} bytes, chunk {kind!r} needs {end}")
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise TakeError(f"{path}: damaged: chunk {kind!r} at byte {at} has a wrong CRC")
        seen.add(kind)
        if kind == b"IHDR":
            header = data[at + 8 : end - 4]
        elif kind == b"IDAT":
            packed.append(data[at + 8 : end - 4])
        elif kind == b"IEND":
            break
        at = end
    if len(header) != 13:
        raise TakeError(f"{path}: damaged: no image header")
    layout = _layout(header, b"tRNS" in seen, path)
    _check_rows(header, b"".join(packed), path)
    return layout


def decode_png(data: bytes, path: Path) -> Image:
    """The pixels of a checked PNG file: (H, W) mono or (H, W, 3) RGB, uint8 or uint16."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise TakeError(f"{path}: damaged: its pixels cannot be decoded")
    decoded: Image = np.ascontiguousarray(image[:, :, ::-1]) if image.ndim == 3 else image
    return decoded


def _layout(header: bytes, transparent: bool, path: Path) -> ImageLayout:
    width, height, depth, colour = struct.unpack_from(">IIBB", header)
    if colour not in _SAMPLES or transparent:
        raise TakeError(
            f"{path}: has transparency; expected mono or colour without an alpha channel"
        )
    if depth not in (8, 16) and colour != _PALETTE:
        raise TakeError(f"{path}: {depth} bits a sample; expected 8 or 16")
    dtype = "uint16" if depth == 16 else "uint8"
    try:
        return ImageLayout(width, height, 1 if colour == _MONO else 3, dtype)
    except TakeError as error:
        raise TakeError(f"{path}: {error}") from error


def _check_rows(header: bytes, packed: bytes, path: Path) -> None:
    width, height, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", header)
    bits = depth * _SAMPLES[colour]
    passes = _ADAM7 if interlace else ((0, 0, 1, 1),)
    expected = 0
    for left, top, across, down in passes:
        columns, rows = -(-(width - left) // across), -(-(height - top) // down)
        if columns > 0 and rows > 0:
            expected += rows * (1 + (columns * bits + 7) // 8)
    try:
        found = len(zlib.decompressobj().decompress(packed, expected + 1))
    except zlib.error as error:
        raise TakeError(f"{path}: damaged: its pixels cannot be unpacked: {error}") from error
    if found < expected:
        raise TakeError(f"{path}: truncated: {found} bytes of pixel rows, expected {expected}")
