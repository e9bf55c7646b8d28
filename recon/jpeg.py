"""The luma of JPEG images, as devices send them; capture finds this by entry point."""

from __future__ import annotations

import cv2
import numpy as np

from capture.arrays import Image
from capture.errors import InputError

_START, _END = b"\xff\xd8", b"\xff\xd9"


def decode_luma(data: bytes) -> Image:
    """The luma of one JPEG image.

    A decoder fills what is cut off with grey and says nothing, so the end is asked for here.

    Args:
        data: one image; zeros may follow it, as drivers pad.

    Returns:
        (H, W) uint8.

    Raises:
        InputError: when it is no JPEG image, or not a whole one.
    """
    whole = data.rstrip(b"\0")
    if not whole.startswith(_START):
        raise InputError(f"not a JPEG image: it begins with {whole[:4].hex(' ') or 'nothing'}")
    if not whole.endswith(_END):
        raise InputError(f"a JPEG image of {len(whole)} bytes without its end")
    image = cv2.imdecode(np.frombuffer(whole, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise InputError(f"a JPEG image of {len(whole)} bytes that cannot be decoded")
    return np.asarray(image)
