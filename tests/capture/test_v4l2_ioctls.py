"""The kernel's structures: their sizes and request numbers on x86-64, as its headers give them."""

from __future__ import annotations

import ctypes

import pytest

from capture.devices.v4l2 import ioctls


@pytest.mark.parametrize(
    ("structure", "size"),
    [
        (ioctls.Capability, 104), (ioctls.FormatDescription, 64), (ioctls.PixFormat, 48),
        (ioctls.Format, 208), (ioctls.RequestBuffers, 20), (ioctls.Buffer, 88),
        (ioctls.StreamParm, 204), (ioctls.FrameInterval, 52), (ioctls.ControlQuery, 232),
        (ioctls.MenuQuery, 44), (ioctls.Control, 20), (ioctls.Controls, 32),
    ],
)  # fmt: skip
def test_structures_have_the_kernels_sizes(structure: type[ctypes.Structure], size: int) -> None:
    assert ctypes.sizeof(structure) == size


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("QUERYCAP", 0x80685600), ("ENUM_FMT", 0xC0405602), ("G_FMT", 0xC0D05604),
        ("S_FMT", 0xC0D05605), ("TRY_FMT", 0xC0D05640), ("REQBUFS", 0xC0145608),
        ("QUERYBUF", 0xC0585609),
        ("QBUF", 0xC058560F), ("DQBUF", 0xC0585611), ("STREAMON", 0x40045612),
        ("STREAMOFF", 0x40045613), ("G_PARM", 0xC0CC5615), ("S_PARM", 0xC0CC5616),
        ("QUERYMENU", 0xC02C5625), ("G_EXT_CTRLS", 0xC0205647), ("S_EXT_CTRLS", 0xC0205648),
        ("ENUM_FRAMEINTERVALS", 0xC034564B), ("QUERY_EXT_CTRL", 0xC0E85667),
    ],
)  # fmt: skip
def test_requests_have_the_kernels_numbers(name: str, number: int) -> None:
    assert getattr(ioctls, name) == number


@pytest.mark.parametrize(
    ("structure", "field", "offset"),
    [
        (ioctls.Buffer, "seconds", 24), (ioctls.Buffer, "sequence", 56),
        (ioctls.Buffer, "m", 64), (ioctls.Buffer, "length", 72),
        (ioctls.Format, "fmt", 8), (ioctls.Control, "u", 12), (ioctls.Controls, "controls", 24),
        (ioctls.ControlQuery, "minimum", 40), (ioctls.StreamParm, "timeperframe", 12),
    ],
)  # fmt: skip
def test_fields_stand_where_the_kernel_has_them(
    structure: type[ctypes.Structure], field: str, offset: int
) -> None:
    assert getattr(structure, field).offset == offset
