"""Images as the matchers want them: one channel, float32, linear 0..1, at full depth."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from capture.arrays import Bools, Floats, Floats32, Image
from capture.errors import ShapeError

# Equal weights for the two outer channels: RGB and BGR give the same grey.
_OUTER, _MIDDLE = np.float32(0.25), np.float32(0.5)
_WHITES = (1023, 4095, 16383, 65535)  # of 16-bit files with fewer bits in them
_SOLID_PX = 11
NEAR_WHITE = 0.985  # of white, from which a value may be where a sensor or a converter saturates


def mono(image: Image) -> Floats32:
    """One linear grey channel in 0..1, no bit of depth thrown away.

    Args:
        image: (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), uint8, uint16 or float already in 0..1. Of
            colour, the middle channel (green) counts half and the outer two a quarter each, so that
            RGB and BGR agree; a fourth channel (alpha) is ignored.

    Returns:
        (H, W) float32.

    Raises:
        ShapeError: naming the shape or the type found.
    """
    image = np.asarray(image)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (1, 3, 4)):
        raise ShapeError(f"image: expected (H W), (H W 1), (H W 3) or (H W 4), found {image.shape}")
    if image.dtype == np.uint8 or image.dtype == np.uint16:
        scale = np.float32(1.0 / np.iinfo(image.dtype).max)
    elif np.issubdtype(image.dtype, np.floating):
        scale = np.float32(1.0)
    else:
        raise ShapeError(f"image: expected uint8, uint16 or float in 0..1, found {image.dtype}")
    values = image.astype(np.float32)
    if values.ndim == 3:
        if values.shape[2] == 1:
            values = values[:, :, 0]
        else:
            values = _OUTER * (values[:, :, 0] + values[:, :, 2]) + _MIDDLE * values[:, :, 1]
    grey: Floats32 = np.ascontiguousarray(values * scale, dtype=np.float32)
    return grey


def brightest(image: Image) -> Image:
    """The brightest of the colour channels (H, W) of an image, of whatever type; alpha is none."""
    return image if image.ndim == 2 else image[:, :, :3].max(axis=2)


def white(image: Image) -> float:
    """The value of white of an image: that of the fewest bits that hold it, 1 for floats."""
    if image.dtype == np.uint8:
        return 255.0
    if image.dtype == np.uint16:
        return float(next(value for value in _WHITES if image.max() <= value))
    return 1.0


def clipped(image: Image) -> Bools | None:
    """Where an image shows no skin but white: solid highlights, a rim of one pixel included.

    A highlight is solid where a disc of eleven pixels fits in. Smaller specks are left in: what
    lies between them is skin, whose pores on white say more than a mask with holes would leave.
    The rim is what demosaicing, sharpening and blur have mixed with what is lost.

    Args:
        image: as `mono` takes it.

    Returns:
        (H, W): True where any colour channel is at the greatest value of the image, which must be
        about white: a dark image has such a value too. None when that is so nowhere.
    """
    top = brightest(image)
    greatest = top.max()
    if greatest < NEAR_WHITE * white(top):
        return None
    mask = (top >= greatest).astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_SOLID_PX, _SOLID_PX))
    core = cv2.erode(mask, disc, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    if not core.any():
        return None
    solid = cv2.dilate(cv2.dilate(core, disc), np.ones((3, 3), np.uint8))
    return np.asarray(solid, dtype=np.bool_)


def noise_sigma(image: Floats32) -> float:
    """Standard deviation of the noise of a grey image (H, W), robust to its texture.

    The median over the image of the absolute response of a mask that is blind to constant and
    linear shading; 0 for images narrower than three pixels.

    References:
        J. Immerkaer, Fast noise variance estimation, CVIU 64(2), 1996: the mask; the median in
        place of the mean, because a face carries texture.
    """
    if min(image.shape) < 3:
        return 0.0
    wide = image[:, :-2] - 2.0 * image[:, 1:-1] + image[:, 2:]
    response = wide[:-2] - 2.0 * wide[1:-1] + wide[2:]
    return float(np.median(np.abs(response)) / (0.6745 * 6.0))


def bilinear(plane: NDArray[Any], column: Floats, row: Floats) -> Floats:
    """Bilinear values (N,) of a plane (H, W); NaN outside, or where a neighbour is NaN."""
    inside = (
        (column >= 0) & (row >= 0) & (column <= plane.shape[1] - 1) & (row <= plane.shape[0] - 1)
    )
    out = np.full(len(column), np.nan)
    at = np.stack([row[inside], column[inside]])
    out[inside] = ndimage.map_coordinates(plane, at, order=1, output=np.float64, prefilter=False)
    return out
