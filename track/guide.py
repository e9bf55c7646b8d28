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
        image: (H, W) float32; the reference's own where `solid` is 0.
        place: (H, W, 2) float32 px, where each reference pixel's surface point is in the frame;
            NaN off the surface.
        solid: (H, W) uint8, 1 where the point and its four neighbours are in the frame's image
            and not occluded.
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
        level.triangle,
        level.barycentric,
        triangles,
        pixels,
        depth,
        image,
        level.image,
        depths,
        scale,
    )
    return GuidedView(image=warped, place=place, solid=solid)


def _drawn(camera: Camera, vertices: Floats) -> tuple[Floats, Floats]:
    pixels, depth = camera.project(vertices), camera.depths(vertices)
    return pixels, depth


@numba.njit(cache=True, nogil=True)
def _warp(
    ids: Any,
    weights: Any,
    triangles: Any,
    pixels: Any,
    depth: Any,
    image: Any,
    reference: Any,
    occluders: Any,
    scale: float,
) -> tuple[Any, Any, Any]:
    height, width = ids.shape
    rows, columns = image.shape
    out = reference.copy()
    place = np.empty((height, width, 2), np.float32)
    shown = np.zeros((height, width), np.uint8)
    for y in range(height):
        for x in range(width):
            place[y, x, 0] = place[y, x, 1] = np.nan
            if ids[y, x] < 0:
                continue
            corner = triangles[ids[y, x]]
            a, b, c = corner[0], corner[1], corner[2]
            wa = weights[y, x, 0] * depth[a]
            wb = weights[y, x, 1] * depth[b]
            wc = weights[y, x, 2] * depth[c]
            total = wa + wb + wc
            u = (wa * pixels[a, 0] + wb * pixels[b, 0] + wc * pixels[c, 0]) / total
            v = (wa * pixels[a, 1] + wb * pixels[b, 1] + wc * pixels[c, 1]) / total
            if not (1.0 <= u < columns - 2.0 and 1.0 <= v < rows - 2.0):
                continue
            place[y, x, 0], place[y, x, 1] = u, v
            if occluders.size > 0 and _hidden(u / scale, v / scale, total, occluders):
                continue
            out[y, x] = interpolated(image, u, v)
            shown[y, x] = 1
    solid = np.zeros((height, width), np.uint8)
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            across = shown[y, x - 1] & shown[y, x] & shown[y, x + 1]
            solid[y, x] = across & shown[y - 1, x] & shown[y + 1, x]
    return out, place, solid


@numba.njit(cache=True, fastmath={"reassoc", "contract", "nsz"}, forceinline=True)
def interpolated(image: Any, u: float, v: float) -> Any:
    """Catmull-Rom interpolation of the sixteen pixels around (u, v)."""
    left, top = int(u), int(v)
    s, t = np.float32(u - left), np.float32(v - top)
    half, one, two = np.float32(0.5), np.float32(1.0), np.float32(2.0)
    a0 = ((-half * s + one) * s - half) * s
    a2 = ((-(one + half) * s + two) * s + half) * s
    a3 = (half * s - half) * s * s
    a1 = one - a0 - a2 - a3
    b0 = ((-half * t + one) * t - half) * t
    b2 = ((-(one + half) * t + two) * t + half) * t
    b3 = (half * t - half) * t * t
    b1 = one - b0 - b2 - b3
    value = np.float32(0.0)
    for j in range(4):
        row = image[top + j - 1]
        line = a0 * row[left - 1] + a1 * row[left] + a2 * row[left + 1] + a3 * row[left + 2]
        value += (b0 if j == 0 else b1 if j == 1 else b2 if j == 2 else b3) * line
    return value


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
