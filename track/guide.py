"""The guide: each view warped into the reference by the motion field of the registered mesh.

What is left between the reference image and the warped one is only what the mesh does not yet
know, so windows need no affine model of their own and the search is short. The field is that of
`Rasterizer.render(..., moved_vertices)`; it is interpolated here from the reference's ids and
barycentrics, which do not change through a take, so the neutral is rasterized once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from capture.arrays import Floats, Floats32, Ints32
from capture.camera import Camera
from track.reference import ReferenceLevel


@dataclass(frozen=True, eq=False, kw_only=True)
class GuidedView:
    """A frame's image brought into the reference image of its view.

    Attributes:
        image: (H, W) float32; 0 where `solid` is 0.
        place: (H, W, 2) float32 px, where each reference pixel's surface point is in the frame;
            NaN off the surface.
        solid: (H, W) uint8, 1 where the point is in the frame's image and not occluded.
    """

    image: Floats32
    place: Floats32
    solid: NDArray[np.uint8]


def guided_view(
    level: ReferenceLevel,
    triangles: Ints32,
    vertices: Floats,
    image: Floats32,
    occluders: tuple[Floats32, float] | None = None,
) -> GuidedView:
    """Warp a frame's image into the reference by the motion field of the mesh.

    Args:
        level: the view's reference.
        triangles: (T, 3).
        vertices: (V, 3) world mm: the mesh in the frame.
        image: (H, W) the frame's image at the level.
        occluders: a depth map (h, w) of the mesh in the frame, NaN where empty, of a camera whose
            pixels are `scale` times as coarse; and that scale. None: nothing is occluded.

    Returns:
        The warped view, by Catmull-Rom interpolation.

    References:
        Ma et al. 2016, section 2.1; Keys 1981, "Cubic convolution interpolation", a = -1/2.
    """
    pixels, depth = _drawn(level.camera, vertices)
    depths, scale = occluders if occluders is not None else (np.zeros((0, 0), np.float32), 1.0)
    warped, place, solid = _warp(
        level.triangle, level.barycentric, triangles, pixels, depth, image, depths, scale
    )
    return GuidedView(image=warped, place=place, solid=solid)


def _drawn(camera: Camera, vertices: Floats) -> tuple[Floats, Floats]:
    pixels, depth = camera.project(vertices), camera.depths(vertices)
    return pixels, depth


@numba.njit(cache=True, inline="always")
def _cubic(t: float) -> tuple[float, float, float, float]:
    """Catmull-Rom weights of the four neighbours at fraction t."""
    return (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


@numba.njit(cache=True, parallel=True)
def _warp(
    ids: Any,
    weights: Any,
    triangles: Any,
    pixels: Any,
    depth: Any,
    image: Any,
    occluders: Any,
    scale: float,
) -> tuple[Any, Any, Any]:
    height, width = ids.shape
    rows, columns = image.shape
    out = np.zeros((height, width), np.float32)
    place = np.full((height, width, 2), np.nan, np.float32)
    solid = np.zeros((height, width), np.uint8)
    for y in numba.prange(height):
        for x in range(width):
            if ids[y, x] < 0:
                continue
            u = v = total = 0.0
            for k in range(3):
                corner = triangles[ids[y, x], k]
                share = weights[y, x, k] * depth[corner]
                u += share * pixels[corner, 0]
                v += share * pixels[corner, 1]
                total += share
            u, v = u / total, v / total
            if not (1.0 <= u < columns - 2.0 and 1.0 <= v < rows - 2.0):
                continue
            place[y, x, 0], place[y, x, 1] = u, v
            if occluders.size > 0 and _hidden(u / scale, v / scale, total, occluders):
                continue
            left, top = int(u), int(v)
            a = _cubic(u - left)
            b = _cubic(v - top)
            value = 0.0
            for j in range(4):
                line = 0.0
                for i in range(4):
                    line += a[i] * image[top + j - 1, left + i - 1]
                value += b[j] * line
            out[y, x] = value
            solid[y, x] = 1
    return out, place, solid


@numba.njit(cache=True)
def _hidden(u: float, v: float, depth: float, occluders: Any) -> bool:
    """Whether the surface drawn at (u, v) lies well in front of `depth`.

    The deepest of the four pixels around decides, so that a slanted surface never hides itself.
    """
    left, top = int(np.floor(u)), int(np.floor(v))
    deepest = -np.inf
    for j in range(2):
        for i in range(2):
            row, column = top + j, left + i
            if 0 <= row < occluders.shape[0] and 0 <= column < occluders.shape[1]:
                here = occluders[row, column]
                if np.isnan(here):
                    return False
                deepest = max(deepest, here)
    return depth > deepest + 1.5
