"""Decoders of compressed images: found by entry point, since this floor has no image library.

A decoder is a function from the bytes of one JPEG image to an (H, W) uint8 image of its luma. It
raises `InputError` when the bytes are no whole image. The full toolkit registers one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import metadata
from typing import cast

from capture.arrays import Image
from capture.errors import DeviceError

DECODER_GROUP = "likeness.decoders"

Decoder = Callable[[bytes], Image]

_ABSENT = (
    f"it needs a decoder named 'jpeg' in the entry points {DECODER_GROUP}, which comes with the "
    "whole toolkit: pip install likeness; or choose an uncompressed format"
)


@cache
def jpeg_decoder() -> Decoder:
    """The decoder of JPEG images.

    Raises:
        DeviceError: when none is installed.
    """
    for entry in metadata.entry_points(group=DECODER_GROUP, name="jpeg"):
        try:
            return cast(Decoder, entry.load())
        except ImportError as error:
            raise DeviceError(
                f"MJPEG: the decoder {entry.value} cannot be loaded: {error}"
            ) from error
    raise DeviceError(f"MJPEG: {_ABSENT}")


def decoder_problem() -> str:
    """Why JPEG images cannot be decoded here; empty when they can. Loads nothing."""
    return "" if metadata.entry_points(group=DECODER_GROUP, name="jpeg") else _ABSENT
