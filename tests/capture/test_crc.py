"""Joined CRCs are those of the joined bytes."""

from __future__ import annotations

import sys
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture import crc
from capture.crc import Crc32Joiner, crc32, crc_engine


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


@given(st.binary(max_size=300), st.integers(0, 2**32 - 1))
def test_the_fast_way_equals_zlib(data: bytes, value: int) -> None:
    assert crc32(data, value) == zlib.crc32(data, value)
    assert crc32(memoryview(data)) == zlib.crc32(data)
    assert crc_engine() in ("isal", "zlib")


def test_without_isal_zlib_does_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "isal.isal_zlib", None)  # as if it were not installed
    crc._fastest.cache_clear()
    try:
        assert crc_engine() == "zlib"
        assert crc32(b"pixels") == zlib.crc32(b"pixels")
    finally:
        crc._fastest.cache_clear()
