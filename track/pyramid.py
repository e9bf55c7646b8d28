"""Image pyramids, and the camera that belongs to each of their levels."""

from __future__ import annotations

import math

import cv2
import numpy as np

from capture.arrays import Floats32, check_shape
from capture.camera import Camera
from capture.errors import ShapeError


def level_count(width: int, height: int, coarsest_px: int = 160) -> int:
    """How many levels bring the longer side of an image nearest to `coarsest_px`, at least 1."""
    return 1 + max(0, round(math.log2(max(width, height) / coarsest_px)))


def image_pyramid(image: Floats32, levels: int) -> list[Floats32]:
    """Gaussian pyramid: level l has every second pixel of level l - 1, smoothed.

    Args:
        image: (H, W) float32 mono.
        levels: how many, the image itself included.

    Returns:
        `levels` images; pixel (r, c) of level l lies on pixel (2^l r, 2^l c) of the image.

    References:
        Burt and Adelson 1983, "The Laplacian pyramid as a compact image code"; the 5-tap kernel.
    """
    check_shape(image=(image, "H W"))
    if levels < 1:
        raise ShapeError(f"levels: expected at least 1, found {levels}")
    out: list[Floats32] = [np.ascontiguousarray(image, dtype=np.float32)]
    for _ in range(levels - 1):
        out.append(np.asarray(cv2.pyrDown(out[-1]), dtype=np.float32))
    return out


def camera_at_level(camera: Camera, level: int) -> Camera:
    """The camera whose image is level `level` of this camera's pyramid.

    Pixel centres are integers at every level and pixel 0 stays on pixel 0, so focal lengths and
    principal point are divided by 2^level; the distortion, in normalised units, is the same.
    """
    scale = 2**level
    width, height = camera.width, camera.height
    for _ in range(level):
        width, height = (width + 1) // 2, (height + 1) // 2
    return Camera(
        name=camera.name, width=width, height=height, fx=camera.fx / scale, fy=camera.fy / scale,
        cx=camera.cx / scale, cy=camera.cy / scale, distortion=camera.distortion,
        camera_from_world=camera.camera_from_world,
    )  # fmt: skip
