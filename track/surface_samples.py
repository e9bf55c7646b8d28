"""Points spread over a mesh once, so that every view measures the same pieces of skin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from capture.arrays import Floats, Ints32, check_shape
from capture.errors import ShapeError


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceSamples:
    """Points fixed to a mesh by barycentric coordinates.

    Attributes:
        triangle: (N,) int32 the triangle each lies in.
        corners: (N, 3) int32 its vertices.
        barycentric: (N, 3) float64 weights of the corners, sum 1.
    """

    triangle: Ints32
    corners: Ints32
    barycentric: Floats

    def __len__(self) -> int:
        return len(self.triangle)

    def points(self, vertices: Floats) -> Floats:
        """The samples (N, 3) on a mesh with vertices (V, 3), mm."""
        placed: Floats = np.einsum("nk,nkx->nx", self.barycentric, vertices[self.corners])
        return placed

    def select(self, chosen: Ints32) -> SurfaceSamples:
        """The samples with the given indices."""
        return SurfaceSamples(
            triangle=self.triangle[chosen],
            corners=self.corners[chosen],
            barycentric=self.barycentric[chosen],
        )


def sample_surface(vertices: Floats, triangles: Ints32, spacing_mm: float) -> SurfaceSamples:
    """Every used vertex, and points inside triangles that are wider than the spacing.

    A triangle of area A gets the inner points of a barycentric lattice of n steps a side with
    n = round(sqrt(2 A) / spacing), so that triangles narrower than the spacing get none or one.

    Args:
        vertices: (V, 3) mm.
        triangles: (T, 3).
        spacing_mm: wanted distance between neighbours, > 0.

    Returns:
        The vertices' samples first, in vertex order, then those inside triangles.

    Raises:
        ShapeError: when the spacing is not above 0.
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    if not spacing_mm > 0:
        raise ShapeError(f"spacing_mm: expected above 0, found {spacing_mm}")
    used, first = np.unique(triangles.ravel()[::-1], return_index=True)
    place = triangles.size - 1 - first  # the last mention of each vertex
    inner_triangle, inner_weights = _inside(vertices, triangles, spacing_mm)
    triangle = np.concatenate([place // 3, inner_triangle]).astype(np.int32)
    weights = np.concatenate([np.eye(3)[place % 3], inner_weights])
    if len(used) == 0:
        raise ShapeError("triangles: expected at least one")
    return SurfaceSamples(
        triangle=triangle, corners=triangles[triangle].astype(np.int32), barycentric=weights
    )


def vertex_rings(triangles: Ints32, vertex_count: int, rings: int) -> sparse.csr_matrix:
    """Which vertices are within `rings` edges of each other, (V, V) csr with sorted indices."""
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    ones = np.ones(len(pairs), dtype=np.int32)
    edges = sparse.csr_matrix((ones, (pairs[:, 0], pairs[:, 1])), (vertex_count, vertex_count))
    step = edges + edges.T + sparse.identity(vertex_count, dtype=np.int32, format="csr")
    step.data[:] = 1
    reach = step
    for _ in range(rings - 1):
        reach = reach @ step
        reach.data[:] = 1
    reach.sort_indices()
    return sparse.csr_matrix(reach)


def _inside(vertices: Floats, triangles: Ints32, spacing: float) -> tuple[Ints32, Floats]:
    corner = vertices[triangles]
    double = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    steps = np.rint(np.sqrt(double) / spacing).astype(np.int64)
    owners, weights = [np.empty(0, np.int64)], [np.empty((0, 3))]
    for count in np.unique(steps[steps >= 2]):
        lattice = _lattice(int(count))
        chosen = np.flatnonzero(steps == count)
        owners.append(np.repeat(chosen, len(lattice)))
        weights.append(np.tile(lattice, (len(chosen), 1)))
    return np.concatenate(owners).astype(np.int32), np.concatenate(weights)


def _lattice(steps: int) -> Floats:
    """Centres of the upright cells of a triangle cut into steps^2 cells, without the corners'."""
    i, j = np.mgrid[0:steps, 0:steps]
    keep = i + j < steps
    a, b = (i[keep] + 1 / 3) / steps, (j[keep] + 1 / 3) / steps
    return np.column_stack([a, b, 1 - a - b])
