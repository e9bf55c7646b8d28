"""PNG files: every kind that fits is read, and damage of any kind is named."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.errors import TakeError
from capture.mcap import ImageLayout
from recon.png import check_png, decode_png
from tests.capture.refusals import refusal

NAME = Path("cam00/0000.png")


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(header: tuple[int, ...], rows: bytes, *extra: bytes) -> bytes:
    parts = [chunk(b"IHDR", struct.pack(">IIBBBBB", *header)), *extra]
    parts += [chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def encoded(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", image)[1])


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3), (1, 1)])
def test_what_opencv_writes_is_read_back(dtype: str, shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype=dtype)
    data = encoded(image[:, :, ::-1] if image.ndim == 3 else image)
    assert check_png(data, NAME) == ImageLayout.of(image)
    assert np.array_equal(decode_png(data, NAME), image)


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (8, 8), (9, 17)])
def test_an_interlaced_file_needs_the_rows_of_all_seven_passes(size: tuple[int, int]) -> None:
    width, height = size
    across = [(0, 8), (4, 8), (0, 4), (2, 4), (0, 2), (1, 2), (0, 1)]
    down = [(0, 8), (0, 8), (4, 8), (0, 4), (2, 4), (0, 2), (1, 2)]
    rows = b""
    for (left, right), (top, bottom) in zip(across, down, strict=True):
        columns, lines = len(range(left, width, right)), len(range(top, height, bottom))
        rows += bytes(lines * (1 + columns)) if columns else b""
    whole = png((width, height, 8, 0, 0, 0, 1), rows)
    assert check_png(whole, NAME) == ImageLayout(width, height, 1, "uint8")
    assert decode_png(whole, NAME).shape == (height, width)
    with pytest.raises(TakeError, match=r"truncated: .* bytes of pixel rows"):
        check_png(png((width, height, 8, 0, 0, 0, 1), rows[:-1]), NAME)


def test_a_palette_becomes_rgb() -> None:
    palette = chunk(b"PLTE", bytes([255, 0, 0, 0, 0, 255]))
    data = png((4, 1, 2, 3, 0, 0, 0), bytes([0, 0b00_01_01_00]), palette)
    assert check_png(data, NAME) == ImageLayout(4, 1, 3, "uint8")
    red, blue = [255, 0, 0], [0, 0, 255]
    assert decode_png(data, NAME).tolist() == [[red, blue, blue, red]]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (png((8, 1, 1, 0, 0, 0, 0), b"\0\0"), "1 bits a sample; expected 8 or 16"),
        (png((2, 1, 8, 4, 0, 0, 0), bytes(5)), "has transparency"),
        (png((2, 1, 8, 0, 0, 0, 0), bytes(3), chunk(b"tRNS", b"\0\0")), "has transparency"),
        (png((0, 1, 8, 0, 0, 0, 0), b""), "size must be at least 1 x 1 px, found 0 x 1"),
        (png((1 << 20, 1 << 20, 8, 0, 0, 0, 0), b""), "beyond what is read"),
        (png((2, 1, 8, 0, 0, 0, 0), b"\0\0"), "truncated: 2 bytes of pixel rows, expected 3"),
        (b"\xff\xd8\xff\xe0 a JPEG", "expected a PNG file, found other bytes"),
        (b"\x89PNG\r\n\x1a\n" + chunk(b"IEND", b""), "no image header"),
    ],
)
def test_what_is_not_read_is_refused_by_name(data: bytes, words: str) -> None:
    with pytest.raises(TakeError, match=words) as caught:
        check_png(data, NAME)
    assert "cam00/0000.png" in str(caught.value)


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_no_damage_passes(data: st.DataObject) -> None:
    image = np.random.default_rng(0).integers(0, 255, (6, 9), dtype=np.uint8)
    whole = bytearray(encoded(image))
    if data.draw(st.booleans()):
        damaged = bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    else:
        whole[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
        damaged = bytes(whole)
    assert "cam00/0000.png" in refusal(lambda: check_png(damaged, NAME))
