"""CRC-32: fast where the isal package is there, and of a joined block from those of its parts."""

from __future__ import annotations

import functools
import importlib
import zlib
from collections.abc import Callable
from typing import Any

_POLYNOMIAL = 0xEDB88320  # of zlib's CRC-32, bits reversed
_ONE = 1 << 31  # the polynomial 1, bits reversed


def crc32(data: Any, value: int = 0) -> int:
    """CRC-32 as zlib computes it, of anything that gives its bytes as one block.

    Args:
        data: bytes, a memoryview, a contiguous array.
        value: the CRC of what came before.
    """
    return _fastest()(data, value)


def crc_engine() -> str:
    """Which library computes CRCs: "isal" where it is installed, else "zlib"."""
    return "zlib" if _fastest() is zlib.crc32 else "isal"


class Crc32Joiner:
    """Joins CRCs of a front part of any length and a back part of one fixed length."""

    def __init__(self, back_bytes: int) -> None:
        """Precompute the effect of appending `back_bytes` zero bytes."""
        self._shift = _ONE
        square, power = 1 << 30, 8 * back_bytes  # x, and how often it is multiplied in
        while power:
            if power & 1:
                self._shift = _multiply(square, self._shift)
            square, power = _multiply(square, square), power >> 1

    def join(self, front: int, back: int) -> int:
        """The CRC of front and back together, of the CRC of each."""
        return _multiply(self._shift, front) ^ back


@functools.cache
def _fastest() -> Callable[[Any, int], int]:
    try:
        engine: Callable[[Any, int], int] = importlib.import_module("isal.isal_zlib").crc32
    except ImportError:
        return zlib.crc32
    return engine


def _multiply(a: int, b: int) -> int:
    """Product of two polynomials over GF(2), modulo CRC-32's.

    References:
        zlib's crc32_combine (Mark Adler), from which the bit order is taken.
    """
    product, bit = 0, _ONE
    while bit:
        if a & bit:
            product ^= b
        bit >>= 1
        b = b >> 1 ^ _POLYNOMIAL if b & 1 else b >> 1
    return product
