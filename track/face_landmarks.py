"""Landmarks of a face in an image: the 68-point layout, and what every detector of them offers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from capture.arrays import Floats, Image, Ints, check_shape


def _numbered(stem: str, count: int) -> list[str]:
    return [f"{stem}_{index}" for index in range(count)]


LANDMARK_NAMES: tuple[str, ...] = (
    *_numbered("jaw", 17),
    *_numbered("brow_right", 5),
    *_numbered("brow_left", 5),
    *_numbered("nose_bridge", 4),
    *_numbered("nose_base", 5),
    *_numbered("lids_right", 6),
    *_numbered("lids_left", 6),
    *_numbered("lip_outer", 12),
    *_numbered("lip_inner", 8),
)
"""The layout of Multi-PIE and iBUG 300-W, right and left being the actor's.

The jaw goes from his right ear over the chin (8) to his left ear, brows from right to left, the
bridge of the nose downwards, lids from the corner at the image's left over the upper lid to the
lower one, the outer lip from his right corner (0) over the upper lip to the left one (6), the inner
lip likewise (0 and 4 are its corners).
"""

LANDMARKS = len(LANDMARK_NAMES)


def surface_landmarks() -> Ints:
    """Indices (51,) of the landmarks that are the same piece of skin in every view.

    The 17 of the jaw are not: a detector sets them on the silhouette, which wanders over the skin
    as the head turns.

    References:
        Saragih et al. 2011 and 300-W, whose 51-point protocol drops the same 17.
    """
    return np.arange(17, LANDMARKS, dtype=np.int64)


@dataclass(frozen=True, eq=False, kw_only=True)
class Detection:
    """The landmarks of one face in one image.

    Attributes:
        pixels: (68, 2) column and row, px, integers at pixel centres; NaN where not detected.
        sigma_px: (68,) how far off each is expected to be, one standard deviation a coordinate.
    """

    pixels: Floats
    sigma_px: Floats

    def __post_init__(self) -> None:
        check_shape(
            pixels=(self.pixels, f"{LANDMARKS} 2"), sigma_px=(self.sigma_px, f"{LANDMARKS}")
        )


@dataclass(frozen=True, kw_only=True)
class Missed:
    """No face was found in an image.

    Attributes:
        reason: why, in a few words.
    """

    reason: str


class LandmarkDetector(Protocol):
    """Anything that finds the 68 landmarks in an image."""

    def detect(self, image: Image, view: str) -> Detection | Missed:
        """Find the landmarks of the one face in an image.

        Args:
            image: (H, W) mono or (H, W, 3) RGB, uint8 or uint16.
            view: the camera's name, for detectors that know the views.
        """
        ...
