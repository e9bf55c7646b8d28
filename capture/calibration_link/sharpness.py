"""How sharp a device sees what is in the middle of its image, whatever light and noise do.

The measure is the share of fine detail: the square root of the power between 0.15 and 0.30 cycles a
pixel over that between 0.03 and 0.08. A change of exposure or contrast scales both alike. Noise is
not common to two images, so with two the power is that of their cross spectrum, which noise does
not raise; of one image the floor that noise makes is taken off. See docs/preflight.md for how it
compares with the variance of the Laplacian and with Tenengrad, which noise and exposure rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from capture.arrays import Floats, Image
from capture.errors import ShapeError

_TILE = 64
_FINE, _COARSE = (0.15, 0.30), (0.03, 0.08)  # cycles a pixel
_FLOOR = 0.55  # beyond, in the corners of the spectrum, a lens passes nothing
_MIDDLE = (0.5, 0.6)  # of width and height
_FLAT = 1.5  # grey levels of 256: an image with less coarse detail shows nothing to be sharp


def sharpness(images: Sequence[Image]) -> float:
    """The share of fine detail in the middle of the image; NaN when there is nothing to see.

    Args:
        images: one or more of the same device, (H, W) or (H, W, 3), uint8 or uint16; two that were
            taken within a moment give the best measure.

    Raises:
        ShapeError: when there is none, or they differ in size.
    """
    if not images or len({image.shape for image in images}) > 1:
        raise ShapeError("sharpness needs images of one size, at least one")
    # The same frame twice has the same noise twice.
    fresh = [a for a, b in pairwise(images) if not np.array_equal(a, b)] + [images[-1]]
    spectra = [_spectra(face_region(image)) for image in fresh]
    if not len(spectra[0]):
        return float("nan")
    radius = np.hypot(np.fft.fftfreq(_TILE)[:, None], np.fft.fftfreq(_TILE)[None])
    if len(spectra) == 1:
        power = (np.abs(spectra[0]) ** 2).mean(axis=0)
        power = power - float(np.median(power[radius > _FLOOR]))
    else:
        pairs = pairwise(spectra)
        power = np.mean([(a * np.conj(b)).real.mean(axis=0) for a, b in pairs], axis=0)
    fine, coarse = (
        float(power[(radius >= low) & (radius < high)].mean()) for low, high in (_FINE, _COARSE)
    )
    # White noise of so many grey levels has this power in every cell of a windowed spectrum.
    level = (_FLAT / 256.0) ** 2 * float((_window() ** 2).sum())
    if coarse <= level:
        return float("nan")
    return float(np.sqrt(max(fine, 0.0) / coarse))


def face_region(image: Image) -> Image:
    """The middle of an image, where the face is: half of its width, six tenths of its height."""
    height, width = image.shape[:2]
    wide = max(min(width, _TILE), round(width * _MIDDLE[0]))
    high = max(min(height, _TILE), round(height * _MIDDLE[1]))
    top, left = (height - high) // 2, (width - wide) // 2
    return image[top : top + high, left : left + wide]


def full_scale(image: Image) -> float:
    """The largest value that a pixel can have.

    Raises:
        ShapeError: when pixels are not whole numbers.
    """
    if image.dtype.kind != "u":
        raise ShapeError(f"an image of uint8 or uint16 is expected, found {image.dtype}")
    return float(np.iinfo(image.dtype).max)


def _spectra(region: Image) -> np.ndarray[tuple[int, ...], np.dtype[np.complex128]]:
    mono = region if region.ndim == 2 else region.mean(axis=2)
    rows, columns = mono.shape[0] // _TILE, mono.shape[1] // _TILE
    cut = mono[: rows * _TILE, : columns * _TILE] / full_scale(region)
    tiles = cut.reshape(rows, _TILE, columns, _TILE).swapaxes(1, 2).reshape(-1, _TILE, _TILE)
    flat = tiles - tiles.mean(axis=(1, 2), keepdims=True) if len(tiles) else tiles
    return np.fft.fft2(flat * _window())


def _window() -> Floats:
    line = np.hanning(_TILE + 2)[1:-1]
    return np.asarray(line[:, None] * line[None, :])
