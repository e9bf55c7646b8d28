"""Closest points between two surfaces that also look the same way (position and normal)."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape
from recon.mesh import vertex_normals


@dataclass(frozen=True, eq=False, kw_only=True)
class Matches:
    """What each of N query points met on a surface.

    Attributes:
        corners: (N, 3) vertices of the triangle met.
        barycentric: (N, 3) where in it.
        points: (N, 3) the points met, mm.
        normals: (N, 3) unit normals of the surface there.
        distance_mm: (N,) from the query point.
        cosine: (N,) between the two normals.
        usable: (N,) whether the whole triangle met may be used.
    """

    corners: Ints
    barycentric: Floats
    points: Floats
    normals: Floats
    distance_mm: Floats
    cosine: Floats
    usable: Bools


class MatchSurface:
    """A triangle mesh that can be asked for its closest points in position and normal."""

    def __init__(
        self,
        vertices: Floats,
        triangles: Ints32,
        *,
        normal_mm: float,
        usable: Bools | None = None,
        tree_size: int | None = None,
    ) -> None:
        """Build the search tree.

        Args:
            vertices: (V, 3) mm.
            triangles: (T, 3).
            normal_mm: how many mm a unit of normal difference counts in the search.
            usable: (V,) vertices that may be met and used; None for all.
            tree_size: search among about this many vertices only: coarser and faster.
        """
        check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
        normals = vertex_normals(vertices, triangles)
        dead = ~np.isfinite(normals[:, 0])
        self._vertices = vertices
        self._triangles = triangles.astype(np.int64)
        self._normals = np.where(dead[:, None], 0.0, normals)
        self._usable = ~dead if usable is None else usable & ~dead
        self._normal_mm = normal_mm
        self._first, self._around = _incident(len(vertices), self._triangles)
        self._alive = np.flatnonzero(~dead)
        if tree_size is not None and tree_size < len(self._alive):
            kept = np.random.default_rng(0).choice(len(self._alive), tree_size, replace=False)
            self._alive = self._alive[np.sort(kept)]
        self._tree = cKDTree(self._features(vertices, self._normals)[self._alive])

    def match(self, points: Floats, normals: Floats) -> Matches:
        """The closest surface point of each query (N, 3), judged by position and unit normal.

        The vertex nearest in (position, normal_mm * normal) is found, then the exact closest point
        on the triangles around it.
        """
        check_shape(points=(points, "N 3"), normals=(normals, "N 3"))
        _, nearest = self._tree.query(self._features(points, normals))
        face, weights = _closest_around(
            points, self._alive[nearest], self._vertices, self._triangles, self._first, self._around
        )
        corners = self._triangles[face]
        found = np.einsum("nk,nkx->nx", weights, self._vertices[corners])
        normal = np.einsum("nk,nkx->nx", weights, self._normals[corners])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        return Matches(
            corners=corners,
            barycentric=weights,
            points=found,
            normals=normal,
            distance_mm=np.linalg.norm(found - points, axis=1),
            cosine=np.einsum("nx,nx->n", normal, normals),
            usable=self._usable[corners].all(axis=1),
        )

    def _features(self, points: Floats, normals: Floats) -> Floats:
        return np.concatenate([points, self._normal_mm * normals], axis=1)


def border_vertices(triangles: Ints32, count: int) -> Bools:
    """Which of `count` vertices lie on an open border: an edge of one triangle alone."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
    keys, uses = np.unique(sides[:, 0] * count + sides[:, 1], return_counts=True)
    open_sides = keys[uses == 1]
    found = np.zeros(count, dtype=np.bool_)
    found[open_sides // count] = True
    found[open_sides % count] = True
    return found


def near_border(vertices: Floats, triangles: Ints32, margin_mm: float) -> Bools:
    """Which vertices (V,) lie within margin_mm of an open border."""
    border = border_vertices(triangles, len(vertices))
    if not border.any():
        return border
    distance, _ = cKDTree(vertices[border]).query(vertices, distance_upper_bound=margin_mm)
    return np.asarray(distance <= margin_mm)


def _incident(count: int, triangles: Ints) -> tuple[Ints, Ints]:
    """The triangles around each vertex, as starts (V + 1,) into a list."""
    faces = np.repeat(np.arange(len(triangles)), 3)
    table = sparse.csr_matrix((faces + 1, (triangles.ravel(), faces)), (count, len(triangles)))
    return table.indptr.astype(np.int64), table.indices.astype(np.int64)


@numba.njit(cache=True)
def _closest_around(
    points: Floats, nearest: Ints, vertices: Floats, triangles: Ints, first: Ints, around: Ints
) -> tuple[Ints, Floats]:
    """The triangle around vertex nearest[n] that is closest to points[n], and where on it."""
    face = np.zeros(len(points), dtype=np.int64)
    weights = np.zeros((len(points), 3))
    for n in range(len(points)):
        best = np.inf
        for slot in range(first[nearest[n]], first[nearest[n] + 1]):
            a, b, c = triangles[around[slot]]
            d1, d2, bb, bc, cc = 0.0, 0.0, 0.0, 0.0, 0.0
            for axis in range(3):
                origin = vertices[a, axis]
                ab, ac = vertices[b, axis] - origin, vertices[c, axis] - origin
                ap = points[n, axis] - origin
                d1 += ab * ap
                d2 += ac * ap
                bb += ab * ab
                bc += ab * ac
                cc += ac * ac
            v, w = _on_triangle(d1, d2, bb, bc, cc)
            square = 0.0
            for axis in range(3):
                met = (1.0 - v - w) * vertices[a, axis] + v * vertices[b, axis]
                square += (points[n, axis] - met - w * vertices[c, axis]) ** 2
            if square < best:
                best = square
                face[n] = around[slot]
                weights[n, 0], weights[n, 1], weights[n, 2] = 1.0 - v - w, v, w
    return face, weights


@numba.njit(cache=True)
def _on_triangle(d1: float, d2: float, bb: float, bc: float, cc: float) -> tuple[float, float]:
    """Weights of b and c at the point of triangle abc closest to p; abc may be a line or a point.

    Args:
        d1: (b - a) . (p - a), and d2 (c - a) . (p - a).
        d2: see d1.
        bb: (b - a) . (b - a), bc (b - a) . (c - a), cc (c - a) . (c - a).
        bc: see bb.
        cc: see bb.

    References:
        Ericson 2005, "Real-time collision detection", Sec. 5.1.5.
    """
    d3, d4, d5, d6 = d1 - bb, d2 - bc, d1 - bc, d2 - cc
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return d1 / (d1 - d3) if d1 > d3 else 0.0, 0.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, d2 / (d2 - d6) if d2 > d6 else 0.0
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        span = (d4 - d3) + (d5 - d6)
        w = (d4 - d3) / span if span > 0.0 else 0.0
        return 1.0 - w, w
    total = va + vb + vc
    if total <= 0.0:
        return 0.0, 0.0
    return vb / total, vc / total
