"""CRC-32 of a joined block from those of its parts, so that pixels are read once and not twice."""

from __future__ import annotations

_POLYNOMIAL = 0xEDB88320  # of zlib's CRC-32, bits reversed
_ONE = 1 << 31  # the polynomial 1, bits reversed


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
