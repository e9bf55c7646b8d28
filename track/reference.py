"""What each view showed of the neutral: samples, windows on one piece of surface, references.

A window never crosses an occlusion boundary: it is the flood of its centre pixel over
neighbouring pixels whose triangles are joined within a few edges of the mesh. So the two lips
of a closed mouth, or a nostril and the cheek behind it, never share a window.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from capture.arrays import Bools, Floats, Floats32, Ints32, check_shape
from capture.camera import Camera
from recon.mesh import vertex_normals
from track.raster import RasterBuffers
from track.surface_samples import SurfaceSamples

Masks = NDArray[np.uint8]
_DEPTH_GAP_MM = 2.0  # a sample deeper than the surface shown at its pixel is hidden


@dataclass(frozen=True, eq=False, kw_only=True)
class ReferenceLevel:
    """One view's reference at one pyramid level.

    Attributes:
        camera: the camera of the level.
        image: (H, W) float32 mono.
        gradient: (2, H, W) float32 derivative by column and by row, per px.
        triangle: (H, W) int32 of the neutral; -1 where there is none.
        barycentric: (H, W, 3) float32.
        samples: (M,) int32 indices of the samples that this view sees.
        centres: (M, 2) int32 column and row of the pixel nearest to each.
        windows: (M, S, S) uint8, 1 on the pixels that belong to the sample's piece of surface.
    """

    camera: Camera
    image: Floats32
    gradient: Floats32
    triangle: Ints32
    barycentric: Floats32
    samples: Ints32
    centres: Ints32
    windows: Masks

    @cached_property
    def at_edge(self) -> Bools:
        """Which samples (M,) have a window that the edge of their piece of surface cuts."""
        edge: Bools = np.asarray(self.windows.min(axis=(1, 2)) == 0)
        return edge


def visible_samples(
    samples: SurfaceSamples,
    vertices: Floats,
    normals: Floats,
    camera: Camera,
    buffers: RasterBuffers,
    min_cosine: float,
) -> Ints32:
    """The samples that a view shows: in the image, in front, and turned to the camera.

    Args:
        samples: N points of the surface.
        vertices: (V, 3) mm.
        normals: (V, 3) unit; NaN counts as turned away.
        camera: the view.
        buffers: the mesh rasterized into it.
        min_cosine: least cosine between the normal and the direction to the camera.

    Returns:
        (M,) int32 indices, ascending.
    """
    check_shape(vertices=(vertices, "V 3"), normals=(normals, "V 3"))
    points = samples.points(vertices)
    pixels = camera.project(points)
    towards = camera.centre - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    normal = samples.points(normals)
    cosine = np.einsum("nx,nx->n", normal, towards) / np.linalg.norm(normal, axis=1)
    nearest = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.int64)
    inside = (nearest >= 0).all(axis=1)
    inside &= (nearest[:, 0] < camera.width) & (nearest[:, 1] < camera.height)
    column, row = np.where(inside[:, None], nearest, 0).T
    gap = camera.depths(points) - buffers.depth[row, column]
    slope = 1.0 / np.maximum(cosine, 0.2)  # depth changes faster where the surface is turned away
    shown = inside & (cosine > min_cosine) & (gap < _DEPTH_GAP_MM * slope)
    shown &= buffers.triangle[row, column] >= 0
    return np.flatnonzero(shown).astype(np.int32)


def reference_level(
    camera: Camera,
    image: Floats32,
    buffers: RasterBuffers,
    pixels: Floats,
    chosen: Ints32,
    surface: tuple[Ints32, Ints32, sparse.csr_matrix],
    half: int,
) -> ReferenceLevel:
    """Build a view's reference at one level.

    Args:
        camera: the camera of the level.
        image: (H, W) the reference image of the level.
        buffers: the neutral rasterized into `camera`.
        pixels: (M, 2) where the chosen samples are in it, px.
        chosen: (M,) their indices.
        surface: the mesh's triangles (T, 3), the samples' triangles (M,), and the vertex rings.
        half: windows have 2 half + 1 pixels a side.
    """
    triangles, own, rings = surface
    check_shape(pixels=(pixels, "M 2"), chosen=(chosen, "M"), own=(own, "M"))
    centres = np.rint(pixels).astype(np.int32)
    right, down = _joints(buffers.triangle, triangles, rings.indptr, rings.indices)
    windows = _flood(centres, right, down, half)
    _drop_strangers(windows, centres, buffers.triangle, triangles, own, rings.indptr, rings.indices)
    rows, columns = np.gradient(image)
    return ReferenceLevel(
        camera=camera,
        image=image,
        gradient=np.stack([columns, rows]).astype(np.float32),
        triangle=buffers.triangle,
        barycentric=buffers.barycentric,
        samples=chosen,
        centres=centres,
        windows=windows,
    )


def facing_normals(vertices: Floats, triangles: Ints32) -> Floats:
    """Vertex normals (V, 3); 0 at a vertex without triangles, which no sample uses."""
    return np.nan_to_num(vertex_normals(vertices, triangles))


@numba.njit(cache=True)
def _joined(a: int, b: int, triangles: Any, starts: Any, others: Any) -> bool:
    """Whether triangles a and b lie within the rings of each other."""
    if a == b:
        return True
    one, two = triangles[a, 0], triangles[b, 0]
    low, high = starts[one], starts[one + 1]
    while low < high:
        middle = (low + high) // 2
        if others[middle] < two:
            low = middle + 1
        else:
            high = middle
    return low < starts[one + 1] and others[low] == two  # type: ignore[no-any-return]


@numba.njit(cache=True, nogil=True)
def _joints(ids: Any, triangles: Any, starts: Any, others: Any) -> tuple[Masks, Masks]:
    """Whether each pixel is joined to its right and to its lower neighbour."""
    height, width = ids.shape
    right = np.zeros((height, width), np.uint8)
    down = np.zeros((height, width), np.uint8)
    for y in range(height):
        for x in range(width):
            if ids[y, x] < 0:
                continue
            if x + 1 < width and ids[y, x + 1] >= 0:
                right[y, x] = _joined(ids[y, x], ids[y, x + 1], triangles, starts, others)
            if y + 1 < height and ids[y + 1, x] >= 0:
                down[y, x] = _joined(ids[y, x], ids[y + 1, x], triangles, starts, others)
    return right, down


@numba.njit(cache=True, nogil=True)
def _flood(centres: Any, right: Any, down: Any, half: int) -> Masks:
    """Pixels of each window that are joined to its centre inside the window."""
    height, width = right.shape
    side = 2 * half + 1
    out = np.zeros((len(centres), side, side), np.uint8)
    for n in range(len(centres)):
        left, top = centres[n, 0] - half, centres[n, 1] - half
        stack = np.empty((side * side, 2), np.int32)
        stack[0, 0], stack[0, 1] = half, half
        count = 1
        if not (0 <= left + half < width and 0 <= top + half < height):
            continue
        out[n, half, half] = 1
        while count > 0:
            count -= 1
            x, y = stack[count, 0], stack[count, 1]
            for step in range(4):
                u, v = x + (step == 0) - (step == 1), y + (step == 2) - (step == 3)
                if u < 0 or v < 0 or u >= side or v >= side or out[n, v, u] == 1:
                    continue
                if not (0 <= left + u < width and 0 <= top + v < height):
                    continue
                low_x, low_y = min(x, u) + left, min(y, v) + top
                joint = right[low_y, low_x] if step < 2 else down[low_y, low_x]
                if joint == 1:
                    out[n, v, u] = 1
                    stack[count, 0], stack[count, 1] = u, v
                    count += 1
    return out


@numba.njit(cache=True, nogil=True)
def _drop_strangers(
    windows: Any, centres: Any, ids: Any, triangles: Any, own: Any, starts: Any, others: Any
) -> None:
    """Empty the windows whose centre pixel shows another piece of surface than the sample's."""
    height, width = ids.shape
    for n in range(len(centres)):
        x, y = centres[n]
        known = 0 <= x < width and 0 <= y < height and ids[y, x] >= 0
        if not known or not _joined(ids[y, x], own[n], triangles, starts, others):
            windows[n] = 0
