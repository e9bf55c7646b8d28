"""Points near a mesh as base point plus height along the interpolated normal.

A matched point need not lie on the tracking mesh: the mesh is coarser than the skin and its
registration is not perfect. Written as a displacement along the interpolated normal, the point
keeps its height when the mesh moves, and the mesh is not dragged onto it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from scipy.spatial import cKDTree

from capture.arrays import Floats, Ints32, check_finite, check_shape
from recon.mesh import vertex_normals

_STEPS = 20
_DONE = 1e-12
_SLACK = 1e-9  # barycentric coordinates this far below 0 still count as inside
_NEAREST = 3  # vertices around a point whose triangles are tried


@dataclass(frozen=True, eq=False, kw_only=True)
class Displacements:
    """N points bound to a mesh.

    Attributes:
        triangle: (N,) int32 holding triangle of each base point; -1 where there is none.
        corners: (N, 3) int32 its vertices; 0 where there is none.
        barycentric: (N, 3) alpha, beta, gamma of the base point; NaN where there is none.
        height_mm: (N,) h, along the unit interpolated normal; NaN where there is none.
    """

    triangle: Ints32
    corners: Ints32
    barycentric: Floats
    height_mm: Floats

    def normals(self, vertices: Floats, triangles: Ints32) -> Floats:
        """Unit interpolated normals (N, 3) at the base points of a mesh (V, 3)."""
        at_vertices = np.nan_to_num(vertex_normals(vertices, triangles))
        mixed = np.einsum("nk,nkx->nx", self.barycentric, at_vertices[self.corners])
        unit: Floats = mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
        return unit


def bind_points(points: Floats, vertices: Floats, triangles: Ints32) -> Displacements:
    """Find each point's base point: where the interpolated normal passes through the point.

    Solves u = b(alpha, beta) + h n(alpha, beta) by Newton's method in every triangle around the
    three nearest vertices and keeps the solution inside a triangle with the least |h|.

    Args:
        points: (N, 3) mm.
        vertices: (V, 3) mm.
        triangles: (T, 3).

    Returns:
        The displacements; a point that no such triangle's normals pass through (beyond a border
        of the mesh, or farther out than the surface curves) has triangle -1 and NaN.

    References:
        Kobbelt, Vorsatz and Seidel 1999, "Multiresolution hierarchies on unstructured triangle
        meshes", section 4; Ma et al. 2016, section 2.2: the root of (u - b) x n = 0.
    """
    check_shape(points=(points, "N 3"), vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    check_finite(points=points, vertices=vertices)
    normals = np.nan_to_num(vertex_normals(vertices, triangles))
    used = np.unique(triangles)
    _, nearest = cKDTree(vertices[used]).query(points, k=min(_NEAREST, len(used)))
    nearby = used[np.asarray(nearest).reshape(len(points), -1)]
    order = np.argsort(triangles.ravel(), kind="stable")
    starts = np.searchsorted(triangles.ravel()[order], np.arange(len(vertices) + 1))
    owner, weights, height = _bind(
        points, vertices, normals, triangles, nearby, starts, (order // 3).astype(np.int32)
    )
    corners = np.where(owner[:, None] >= 0, triangles[owner], 0).astype(np.int32)
    return Displacements(triangle=owner, corners=corners, barycentric=weights, height_mm=height)


@numba.njit(cache=True, nogil=True)
def _bind(
    points: Any, vertices: Any, normals: Any, triangles: Any, nearby: Any, starts: Any, around: Any
) -> tuple[Any, Any, Any]:
    count = len(points)
    owner = np.full(count, -1, np.int32)
    weights = np.full((count, 3), np.nan)
    height = np.full(count, np.nan)
    for n in range(count):
        for vertex in nearby[n]:
            for place in range(starts[vertex], starts[vertex + 1]):
                t = around[place]
                a, b, h = _root(points[n], vertices[triangles[t]], normals[triangles[t]])
                inside = a >= -_SLACK and b >= -_SLACK and a + b <= 1.0 + _SLACK
                if inside and (owner[n] < 0 or abs(h) < abs(height[n])):
                    owner[n], height[n] = t, h
                    weights[n, 0], weights[n, 1], weights[n, 2] = a, b, 1.0 - a - b
    return owner, weights, height


@numba.njit(cache=True, nogil=True)
def _root(point: Any, corner: Any, normal: Any) -> tuple[float, float, float]:
    """alpha, beta and the height along the unit normal; NaN when Newton does not get there.

    The unknown is the height k along the unnormalised interpolated normal m: then the equations
    are bilinear, and h = k |m|.
    """
    a = b = 1.0 / 3.0
    k = 0.0
    matrix = np.empty((3, 3))
    miss = np.empty(3)
    for _ in range(_STEPS):
        c = 1.0 - a - b
        size = 0.0
        for x in range(3):
            m = a * normal[0, x] + b * normal[1, x] + c * normal[2, x]
            base = a * corner[0, x] + b * corner[1, x] + c * corner[2, x]
            miss[x] = point[x] - base - k * m
            matrix[x, 0] = corner[0, x] - corner[2, x] + k * (normal[0, x] - normal[2, x])
            matrix[x, 1] = corner[1, x] - corner[2, x] + k * (normal[1, x] - normal[2, x])
            matrix[x, 2] = m
            size = max(size, abs(miss[x]))
        if size < _DONE:
            break
        volume = _determinant(matrix[:, 0], matrix[:, 1], matrix[:, 2])
        if abs(volume) < 1e-12:
            return np.nan, np.nan, np.nan
        a += _determinant(miss, matrix[:, 1], matrix[:, 2]) / volume
        b += _determinant(matrix[:, 0], miss, matrix[:, 2]) / volume
        k += _determinant(matrix[:, 0], matrix[:, 1], miss) / volume
    if not size < 1e-6:
        return np.nan, np.nan, np.nan
    square = 0.0
    for x in range(3):
        square += (a * normal[0, x] + b * normal[1, x] + (1.0 - a - b) * normal[2, x]) ** 2
    return a, b, k * np.sqrt(square)


@numba.njit(cache=True, nogil=True)
def _determinant(u: Any, v: Any, w: Any) -> float:
    return (  # type: ignore[no-any-return]
        u[0] * (v[1] * w[2] - v[2] * w[1])
        - u[1] * (v[0] * w[2] - v[2] * w[0])
        + u[2] * (v[0] * w[1] - v[1] * w[0])
    )
