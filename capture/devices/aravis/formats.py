"""Which pixel formats a device may send, and how its images are then laid out."""

from __future__ import annotations

from collections.abc import Sequence

from capture.errors import DeviceError
from capture.frame_header import ImageLayout

# By the standard's name (PFNC): channels and type. Packed formats would have to be unpacked, pixel
# by pixel, on the way to memory: a device that offers them offers one of these too.
_KNOWN = {
    "Mono8": (1, "uint8"),
    "Mono10": (1, "uint16"),
    "Mono12": (1, "uint16"),
    "Mono14": (1, "uint16"),
    "Mono16": (1, "uint16"),
    "RGB8": (3, "uint8"),
    "RGB8Packed": (3, "uint8"),  # its name before 2012
}


def is_known(pixel_format: str) -> bool:
    """Whether images of this format can be taken as they are."""
    return pixel_format in _KNOWN


def check_format(name: str, asked: str, offered: Sequence[str]) -> None:
    """Refuse a pixel format that cannot be taken as it is.

    Args:
        name: of the device.
        asked: the format.
        offered: by the device.

    Raises:
        DeviceError: saying which could be taken.
    """
    if asked in offered and is_known(asked):
        return
    fit = [one for one in offered if is_known(one)]
    offers = f"offers {', '.join(offered) or 'none'}"
    if asked in offered:
        offers = "which is packed or coloured and not unpacked here"
    advice = "none that it offers can be taken"
    if fit:
        others = f" or {', '.join(fit[1:])}" if fit[1:] else ""
        advice = f'set PixelFormat = "{fit[0]}"{others} in its preset'
    raise DeviceError(f"{name}: asked for {asked}, {offers}; {advice}")


def layout_of(pixel_format: str, width: int, height: int) -> ImageLayout:
    """The layout of images of a known format."""
    channels, dtype = _KNOWN[pixel_format]
    return ImageLayout(width, height, channels, dtype)
