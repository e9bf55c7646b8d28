"""Which vertices of a mesh are seen from given points."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats, Ints, Ints32, check_shape
from recon.mesh import vertex_normals
from recon.surface import SurfaceQuery

_COSINE = 0.3  # a vertex turned further away than 72 degrees is not seen
_LIFT = 2e-3  # of the mean side: rays start this far above the surface


def count_views(vertices: Floats, triangles: Ints32, eyes: Floats) -> Ints:
    """Count from how many eyes each vertex is seen, front-facing and unoccluded by the mesh.

    Args:
        vertices: (V, 3) mm.
        triangles: (T, 3), counter-clockwise from outside.
        eyes: (C, 3) view points, mm.

    Returns:
        (V,) counts; 0 for vertices that no triangle uses.
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"), eyes=(eyes, "C 3"))
    normals = vertex_normals(vertices, triangles)
    side = np.linalg.norm(vertices[triangles[:, 0]] - vertices[triangles[:, 1]], axis=1).mean()
    lifted = vertices + _LIFT * side * np.nan_to_num(normals)
    surface = SurfaceQuery(vertices, triangles)
    seen = np.zeros(len(vertices), dtype=np.int64)
    for eye in eyes:
        towards = eye - vertices
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
        facing = np.flatnonzero(np.einsum("vx,vx->v", normals, towards) > _COSINE)
        seen[facing] += ~surface.occluded(lifted[facing], eye, margin_mm=float(_LIFT * side))
    return seen


def around(vertices: Floats) -> Floats:
    """26 eyes (26, 3) on a sphere well outside the mesh: together they see its outer skin."""
    grid = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 3)
    outward = grid[np.any(grid != 0, axis=1)].astype(np.float64)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    eyes: Floats = 0.5 * (low + high) + 4.0 * float(np.linalg.norm(high - low)) * outward
    return eyes
