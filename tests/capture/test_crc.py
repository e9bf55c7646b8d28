"""Joined CRCs are those of the joined bytes."""

from __future__ import annotations

import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.crc import Crc32Joiner


@given(st.binary(max_size=100), st.binary(max_size=300))
def test_joining_equals_computing(front: bytes, back: bytes) -> None:
    joined = Crc32Joiner(len(back)).join(zlib.crc32(front), zlib.crc32(back))
    assert joined == zlib.crc32(front + back)


@pytest.mark.parametrize("size", [1, 4095, 1 << 20, 4_194_304])
def test_long_parts_join_too(size: int) -> None:
    back = bytes(range(256)) * (size // 256 + 1)
    back = back[:size]
    joined = Crc32Joiner(size).join(zlib.crc32(b"header"), zlib.crc32(back))
    assert joined == zlib.crc32(b"header" + back)
