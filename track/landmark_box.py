"""The box of a face in an image, and the picture of fixed size that is cut out there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.arrays import Floats, Floats32
from capture.camera import Camera

_SIDE_PX = 240  # of the box in the picture
_MARGIN = 0.25  # of the box, around it
_ROOM = 1.15  # the box over the landmarks' own extent
_SIZE_PX = round(_SIDE_PX * (1.0 + 2.0 * _MARGIN))
_WHITE = 230.0  # where the brightest percentile comes to lie


@dataclass(frozen=True, kw_only=True)
class FaceBox:
    """A square of an image around a face.

    Attributes:
        column: of its middle, px.
        row: likewise.
        side: px.
    """

    column: float
    row: float
    side: float

    @classmethod
    def around(cls, points: Floats) -> FaceBox:
        """The box of a face whose landmarks, at rest, are at pixels (K, 2)."""
        low, high = points.min(axis=0), points.max(axis=0)
        middle = 0.5 * (low + high)
        side = max(_ROOM * float((high - low).max()), 8.0)
        return cls(column=float(middle[0]), row=float(middle[1]), side=side)

    def off(self, share: float, rng: np.random.Generator) -> FaceBox:
        """The box moved and resized at random, by a share of its side (standard deviation)."""
        right, down, wide = (share * rng.normal(size=3)).tolist()
        return FaceBox(
            column=self.column + right * self.side,
            row=self.row + down * self.side,
            side=self.side * (1.0 + wide),
        )

    @property
    def scale(self) -> float:
        """Pixels of the picture for each pixel of the image."""
        return _SIDE_PX / self.side

    @staticmethod
    def inner() -> Floats:
        """The box (left, top, right, bottom) within its own picture, px."""
        edge = _MARGIN * _SIDE_PX
        return np.array([edge, edge, edge + _SIDE_PX, edge + _SIDE_PX])

    def lens(self, camera: Camera) -> Camera:
        """The camera that takes the box's picture."""
        left, top = self._corner()
        return Camera(
            name=camera.name, width=_SIZE_PX, height=_SIZE_PX,
            fx=camera.fx * self.scale, fy=camera.fy * self.scale,
            cx=(camera.cx - left) * self.scale, cy=(camera.cy - top) * self.scale,
            distortion=camera.distortion, camera_from_world=camera.camera_from_world,
        )  # fmt: skip

    def picture(self, image: Floats32) -> Floats32:
        """The box's picture, cut from an image (H, W); averaged where it shrinks."""
        soft = image
        if self.scale < 1.0:
            soft = cv2.GaussianBlur(image, (0, 0), 0.4 / self.scale).astype(np.float32)
        left, top = self._corner()
        affine = np.array([[1.0 / self.scale, 0.0, left], [0.0, 1.0 / self.scale, top]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = (_SIZE_PX, _SIZE_PX)
        cut = cv2.warpAffine(soft, affine, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(cut, dtype=np.float32)

    def whole(self, points: Floats) -> Floats:
        """Pixels (K, 2) of the picture as pixels of the whole image."""
        pixels: Floats = points / self.scale + np.array(self._corner())
        return pixels

    def _corner(self) -> tuple[float, float]:
        reach = (0.5 + _MARGIN) * self.side
        return self.column - reach, self.row - reach


def shades(image: Floats32) -> NDArray[np.uint8]:
    """A picture as 8-bit, its own brightest percentile at 230: trees compare pixels."""
    top = max(float(np.quantile(image[::4, ::4], 0.99)), 1e-6)
    return np.asarray(np.clip(image * (_WHITE / top), 0.0, 255.0), dtype=np.uint8)
