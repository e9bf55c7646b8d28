"""Luma of JPEG images as devices send them."""

from __future__ import annotations

from importlib import metadata

import cv2
import numpy as np
import pytest

from capture.errors import InputError
from recon.jpeg import decode_luma


def encoded(colour: bool) -> tuple[bytes, np.ndarray]:
    rough = np.random.default_rng(1).integers(0, 256, (6, 8), np.uint8)
    grey = cv2.resize(rough, (80, 60), interpolation=cv2.INTER_CUBIC)
    image = cv2.merge([grey, grey, grey]) if colour else grey
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes(), grey


def without_tables(data: bytes) -> bytes:
    """As many devices send them: the Huffman tables, which all share, left out."""
    out, at = data[:2], 2
    while True:
        kind, size = data[at + 1], 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if kind == 0xDA:
            return out + data[at:]
        if kind != 0xC4:
            out += data[at : at + size]
        at += size


@pytest.mark.parametrize("colour", [False, True])
def test_luma_is_recovered_with_and_without_tables(colour: bool) -> None:
    data, grey = encoded(colour)
    for each in (data, data + bytes(100), without_tables(data)):
        assert np.abs(decode_luma(each).astype(int) - grey).max() <= 4


def test_what_is_cut_or_no_image_is_refused() -> None:
    data, _ = encoded(False)
    with pytest.raises(InputError, match="without its end"):
        decode_luma(data[:-10])
    with pytest.raises(InputError, match="begins with nothing"):
        decode_luma(b"")
    with pytest.raises(InputError, match="begins with 89 50 4e 47"):
        decode_luma(b"\x89PNG....")
    with pytest.raises(InputError, match="cannot be decoded"):
        decode_luma(b"\xff\xd8 nothing \xff\xd9")


def test_capture_finds_it_by_entry_point() -> None:
    (entry,) = metadata.entry_points(group="likeness.decoders", name="jpeg")
    assert entry.load() is decode_luma
