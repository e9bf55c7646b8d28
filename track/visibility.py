"""Which vertices of a mesh are seen from given points: a depth buffer on the processor."""

from __future__ import annotations

import numba
import numpy as np

from capture.arrays import Floats, Ints, Ints32, check_shape
from recon.mesh import vertex_normals

_COSINE = 0.3  # a vertex turned further away than 72 degrees is not seen
_PIXEL_SHARE = 1.0 / 320.0  # pixel of the buffer over the diagonal of the mesh
_SLACK_PIXELS = 3.0  # a vertex this far behind the front is still the front


def count_views(vertices: Floats, triangles: Ints32, eyes: Floats) -> Ints:
    """Count from how many eyes each vertex is seen, front-facing and unoccluded by the mesh.

    Args:
        vertices: (V, 3) mm.
        triangles: (T, 3), counter-clockwise from outside.
        eyes: (C, 3) view points, mm; each looks at the middle of the mesh.

    Returns:
        (V,) counts; 0 for vertices that no triangle uses.
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"), eyes=(eyes, "C 3"))
    normals = vertex_normals(vertices, triangles)
    low, high = vertices[triangles].min(axis=(0, 1)), vertices[triangles].max(axis=(0, 1))
    middle = 0.5 * (low + high)
    pixel = float(np.linalg.norm(high - low)) * _PIXEL_SHARE
    seen = np.zeros(len(vertices), dtype=np.int64)
    for eye in eyes:
        towards = eye - vertices
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
        facing = np.einsum("vx,vx->v", normals, towards) > _COSINE
        seen += facing & (_behind(vertices, triangles, eye, middle, pixel) < _SLACK_PIXELS * pixel)
    return seen


def around(vertices: Floats) -> Floats:
    """26 eyes (26, 3) on a sphere well outside the mesh: together they see its outer skin."""
    grid = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 3)
    outward = grid[np.any(grid != 0, axis=1)].astype(np.float64)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    eyes: Floats = 0.5 * (low + high) + 4.0 * float(np.linalg.norm(high - low)) * outward
    return eyes


def _behind(
    vertices: Floats, triangles: Ints32, eye: Floats, middle: Floats, pixel: float
) -> Floats:
    """How far (V,) each vertex lies behind the first surface on its line of sight, mm."""
    forward = middle - eye
    away = float(np.linalg.norm(forward))
    forward = forward / away
    side = np.cross(forward, np.eye(3)[int(np.argmin(np.abs(forward)))])
    side /= np.linalg.norm(side)
    local = (vertices - eye) @ np.stack([side, np.cross(forward, side), forward], axis=1)
    depth = np.maximum(local[:, 2], 1e-3 * away)
    flat = local[:, :2] * (away / depth)[:, None] / pixel
    flat -= flat[triangles].min(axis=(0, 1)) - 2.0
    size = np.ceil(np.clip(flat[triangles].max(axis=(0, 1)), 1.0, 4000.0)).astype(np.int64) + 3
    front = _depth_buffer(flat, depth, triangles, int(size[0]), int(size[1]))
    column = np.clip(np.rint(flat[:, 0]).astype(np.int64), 0, size[0] - 1)
    row = np.clip(np.rint(flat[:, 1]).astype(np.int64), 0, size[1] - 1)
    gap: Floats = depth - front[row, column]
    return gap


@numba.njit(cache=True)
def _depth_buffer(
    flat: Floats, depth: Floats, triangles: Ints32, width: int, height: int
) -> Floats:
    """The nearest depth (height, width) at each pixel centre; infinity where nothing is."""
    front = np.full((height, width), np.inf)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay = flat[a, 0], flat[a, 1]
        bx, by = flat[b, 0] - ax, flat[b, 1] - ay
        cx, cy = flat[c, 0] - ax, flat[c, 1] - ay
        area = bx * cy - by * cx
        if area == 0.0:
            continue
        left = int(np.ceil(max(min(ax, ax + bx, ax + cx), 0.0)))
        right = int(np.floor(min(max(ax, ax + bx, ax + cx), width - 1.0)))
        top = int(np.ceil(max(min(ay, ay + by, ay + cy), 0.0)))
        bottom = int(np.floor(min(max(ay, ay + by, ay + cy), height - 1.0)))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                px, py = column - ax, row - ay
                v = (px * cy - py * cx) / area
                w = (bx * py - by * px) / area
                if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
                    z = depth[a] + v * (depth[b] - depth[a]) + w * (depth[c] - depth[a])
                    front[row, column] = min(front[row, column], z)
    return front
