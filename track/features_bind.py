"""Keypoints bound to the surface that they show, and the surface cut into patches of them."""

from __future__ import annotations

from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from capture.arrays import Floats, Ints, Ints32, check_shape
from capture.camera import Camera
from track.raster import RasterBuffers
from track.surface_samples import SurfaceSamples

_JUMP_MM = 1.0  # between the depths of neighbouring pixels, beyond what a slant explains
_SLANT = 4.0  # mm of depth per mm across, of the most slanted skin that is looked at
_INSIDE = 1e-9  # barycentric coordinates this far below 0 still count as inside
_ROUNDS = 8

Region = NDArray[np.uint8]


def inner_skin(
    camera: Camera,
    buffers: RasterBuffers,
    mesh: tuple[Floats, Ints32],
    min_cosine: float,
    margin_px: int,
) -> Region:
    """Where a view shows skin, turned to it, away from silhouettes and jumps of depth.

    Args:
        camera: the view.
        buffers: the mesh rasterized into it.
        mesh: vertices (V, 3) world mm and triangles (T, 3).
        min_cosine: least cosine between a triangle's normal and the direction to the camera.
        margin_px: distance kept from the skin's edges.

    Returns:
        (H, W) uint8, 1 on such skin.
    """
    vertices, triangles = mesh
    corner = vertices[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    towards = camera.centre - corner.mean(axis=1)
    size = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
    facing = np.einsum("tx,tx->t", normal, towards) > min_cosine * size
    shown = buffers.triangle >= 0
    depth = np.where(shown, buffers.depth, np.float32(0.0))
    slack = _JUMP_MM + _SLANT * float(np.median(depth[shown])) / camera.fx if shown.any() else 0.0
    edge = ~shown
    for axis in (0, 1):
        jump = np.abs(np.diff(depth, axis=axis)) > slack
        low, high = ((slice(None), slice(0, -1)), (slice(None), slice(1, None)))
        first, second = (low, high) if axis == 1 else (low[::-1], high[::-1])
        edge[first] |= jump
        edge[second] |= jump
    side = 2 * margin_px + 1
    near = cv2.dilate(edge.astype(np.uint8), np.ones((side, side), np.uint8))
    inner: Region = np.asarray((near == 0) & facing[buffers.triangle], dtype=np.uint8)
    return inner


def bind_pixels(
    pixels: Floats, camera: Camera, buffers: RasterBuffers, mesh: tuple[Floats, Ints32]
) -> SurfaceSamples:
    """Find the points of the surface that pixels show, to a fraction of a pixel.

    The buffers tell which triangles lie around a pixel; its ray is met with each in float64.

    Args:
        pixels: (K, 2) px.
        camera: the view.
        buffers: the mesh rasterized into it.
        mesh: vertices (V, 3) world mm and triangles (T, 3).

    Returns:
        K samples; `triangle` is -1 where the ray meets none.

    References:
        Moller and Trumbore 1997, "Fast, minimum storage ray-triangle intersection".
    """
    check_shape(pixels=(pixels, "K 2"))
    vertices, triangles = mesh
    rays = camera.rays(pixels)
    near = np.rint(pixels).astype(np.int64)
    found, weights = _meet(near, rays, camera.centre, buffers.triangle, vertices, triangles)
    corners = np.where(found[:, None] >= 0, triangles[found], 0).astype(np.int32)
    return SurfaceSamples(triangle=found, corners=corners, barycentric=weights)


def surface_patches(vertices: Floats, triangles: Ints32, spacing_mm: float) -> tuple[Ints32, Ints]:
    """Cut a surface into patches around vertices, by distance along its edges.

    The two lips of a closed mouth never share a patch.

    Args:
        vertices: (V, 3) mm.
        triangles: (T, 3).
        spacing_mm: wanted distance between the patches' centres.

    Returns:
        The centres, (P,) vertex indices, and the patch (V,) of each vertex; -1 for a vertex that
        no triangle uses.
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    length = np.maximum(np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1), 1e-6)
    graph = sparse.csr_matrix((length, (ends[:, 0], ends[:, 1])), (len(vertices),) * 2)
    open_ones = np.unique(triangles)
    centres = np.zeros(0, np.int64)
    away, _, owner = np.full(len(vertices), np.inf), 0, np.full(len(vertices), -1)
    for _ in range(_ROUNDS):
        left = open_ones[away[open_ones] > 1.5 * spacing_mm]
        if len(left) == 0:
            break
        centres = np.concatenate([centres, left[_thinned(vertices[left], spacing_mm)]])
        away, _, owner = csgraph.dijkstra(
            graph, directed=False, indices=centres, min_only=True, return_predecessors=True
        )
    place = np.full(len(vertices) + 1, -1, np.int64)
    place[centres] = np.arange(len(centres))
    owner = np.where(np.isfinite(away), owner, len(vertices))
    return centres.astype(np.int32), place[owner]


def at_vertices(chosen: Ints32, triangles: Ints32) -> SurfaceSamples:
    """Vertices (P,) that triangles use, as points of the surface."""
    used, first = np.unique(triangles.ravel(), return_index=True)
    place = first[np.searchsorted(used, chosen)]
    triangle = (place // 3).astype(np.int32)
    return SurfaceSamples(
        triangle=triangle,
        corners=triangles[triangle].astype(np.int32),
        barycentric=np.eye(3)[place % 3],
    )


def _thinned(points: Floats, spacing: float) -> Ints:
    """Indices of points at least `spacing` apart, the first ones first."""
    pairs = cKDTree(points).query_ball_point(points, spacing)
    free = np.ones(len(points), np.bool_)
    kept = []
    for n in range(len(points)):
        if free[n]:
            kept.append(n)
            free[pairs[n]] = False
    return np.array(kept, np.int64)


@numba.njit(cache=True, nogil=True)
def _meet(
    near: Any, rays: Any, eye: Any, ids: Any, vertices: Any, triangles: Any
) -> tuple[Any, Any]:
    height, width = ids.shape
    found = np.full(len(near), -1, np.int32)
    weights = np.zeros((len(near), 3))
    for n in range(len(near)):
        nearest = np.inf
        for j in range(-1, 2):
            for i in range(-1, 2):
                x, y = near[n, 0] + i, near[n, 1] + j
                if not (0 <= x < width and 0 <= y < height) or ids[y, x] < 0:
                    continue
                t = ids[y, x]
                a = vertices[triangles[t, 0]]
                one, two = vertices[triangles[t, 1]] - a, vertices[triangles[t, 2]] - a
                across = np.cross(rays[n], two)
                area = np.dot(one, across)
                if area == 0.0:
                    continue
                away = eye - a
                u = np.dot(away, across) / area
                other = np.cross(away, one)
                v = np.dot(rays[n], other) / area
                depth = np.dot(two, other) / area
                if min(u, v, 1.0 - u - v) < -_INSIDE or depth >= nearest:
                    continue
                nearest = depth
                found[n] = t
                weights[n, 0], weights[n, 1], weights[n, 2] = 1.0 - u - v, u, v
    return found, weights
