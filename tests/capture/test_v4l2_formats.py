"""Pixel formats against literal loops, their names, and why others are refused."""

from __future__ import annotations

import numpy as np
import pytest

from capture.arrays import Image
from capture.devices.v4l2 import decoders, ioctls
from capture.devices.v4l2.formats import SUPPORTED, fourcc_text, layout_of, refusal, unpacker

WIDTH, HEIGHT = 6, 5


def pix_of(name: str, stride: int) -> ioctls.PixFormat:
    return ioctls.PixFormat(
        width=WIDTH, height=HEIGHT, pixelformat=SUPPORTED[name].fourcc, bytesperline=stride
    )


def literal(name: str, data: bytes, stride: int) -> list[list[int]]:
    """Pixel by pixel, from the kernel's description of each format."""
    out = []
    for y in range(HEIGHT):
        row = []
        for x in range(WIDTH):
            at = y * stride
            if name in ("Y10", "Y12", "Y14", "Y16"):
                row.append(data[at + 2 * x] + 256 * data[at + 2 * x + 1])
            elif name in ("YUYV", "YVYU"):
                row.append(data[at + 2 * x])
            elif name in ("UYVY", "VYUY"):
                row.append(data[at + 2 * x + 1])
            else:
                row.append(data[at + x])
        out.append(row)
    return out


@pytest.mark.parametrize("pad", [0, 1, 7])
@pytest.mark.parametrize("name", [n for n, each in SUPPORTED.items() if not each.compressed])
def test_each_format_is_read_as_the_kernel_describes_it(name: str, pad: int) -> None:
    stride = WIDTH * SUPPORTED[name].sample_bytes + pad
    data = np.random.default_rng(3).integers(0, 256, stride * HEIGHT * 2, np.uint8)
    pix = pix_of(name, stride)
    target: Image = np.full((HEIGHT, WIDTH), 9, layout_of(pix).dtype)
    assert unpacker(pix)(data, target) == HEIGHT
    assert target.tolist() == literal(name, data.tobytes(), stride)


def test_a_driver_that_gives_no_stride_has_rows_without_gaps() -> None:
    data = np.arange(WIDTH * HEIGHT, dtype=np.uint8)
    target: Image = np.zeros((HEIGHT, WIDTH), np.uint8)
    assert unpacker(pix_of("GREY", 0))(data, target) == HEIGHT
    assert target.ravel().tolist() == list(range(WIDTH * HEIGHT))


@pytest.mark.parametrize("used", [0, 1, WIDTH - 1, WIDTH, 3 * 8 + 5, 3 * 8 + 6, 4 * 8 + WIDTH, 80])
def test_only_whole_rows_are_taken_and_the_rest_is_zero(used: int) -> None:
    stride = 8
    data = np.full(80, 200, np.uint8)[:used]
    target: Image = np.full((HEIGHT, WIDTH), 9, np.uint8)
    rows = unpacker(pix_of("GREY", stride))(data, target)
    whole = sum(y * stride + WIDTH <= used for y in range(HEIGHT))
    assert rows == whole
    assert (target[:rows] == 200).all()
    assert not target[rows:].any()


def test_formats_have_their_names() -> None:
    for name, each in SUPPORTED.items():
        assert fourcc_text(each.fourcc) == name
    assert fourcc_text(int.from_bytes(b"MJPG", "little")) == "MJPEG"
    assert fourcc_text(int.from_bytes(b"Y16 ", "little") | 1 << 31) == "Y16-BE"
    assert fourcc_text(0xFFFFFFFF) == "???\x7f-BE".replace("\x7f", "?")
    assert fourcc_text(0) == "????"


def test_others_are_refused_in_words() -> None:
    assert refusal("GREY") == ""
    assert "packed" in refusal("Y10P")
    assert refusal("Y16-BE") == "its words are big-endian; use Y16"
    assert refusal("H264").startswith("it is none of GREY, Y10, Y12")


def test_without_a_decoder_mjpeg_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    assert refusal("MJPEG") == ""
    monkeypatch.setattr(decoders, "DECODER_GROUP", "likeness.none")
    assert "needs a decoder named 'jpeg'" in refusal("MJPEG")
