"""The tracked surface: what stays the same of it through a take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from capture.arrays import Floats, Ints32
from track.raster import Rasterizer
from track.reference import facing_normals
from track.surface_samples import SurfaceSamples, sample_surface, vertex_rings

_RINGS = 3  # edges within which two triangles count as one piece of surface


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceModel:
    """A mesh, the points on it that are followed, and the skin over it.

    Attributes:
        neutral: (V, 3) vertices at rest, world mm.
        triangles: (T, 3).
        heights_mm: (V,) how far the skin lies over the mesh, along its normals; None: on it.
            What views show is the skin, b + h n; what is solved for is the mesh, b.
        samples: N points that views are matched at.
        near: (V, V) which vertices share an edge, or are one: ones.
        rings: (V, V) which vertices belong to one piece of surface.
        neighbours: (N, N) which samples lie around the same vertices.
        raster: draws the mesh.
    """

    neutral: Floats
    triangles: Ints32
    heights_mm: Floats | None
    samples: SurfaceSamples
    near: sparse.csr_matrix
    rings: sparse.csr_matrix
    neighbours: sparse.csr_matrix
    raster: Rasterizer

    @classmethod
    def of(
        cls, neutral: Floats, triangles: Ints32, spacing_mm: float, heights_mm: Floats | None
    ) -> SurfaceModel:
        """Spread samples over a neutral (V, 3), at most `spacing_mm` apart."""
        samples = sample_surface(neutral, triangles, spacing_mm)
        near = vertex_rings(triangles, len(neutral), 1)
        return cls(
            neutral=neutral,
            triangles=triangles,
            heights_mm=heights_mm,
            samples=samples,
            near=near,
            rings=vertex_rings(triangles, len(neutral), _RINGS),
            neighbours=_neighbour_matrix(samples, near),
            raster=Rasterizer(triangles, len(neutral)),
        )

    def normals(self, vertices: Floats) -> Floats:
        """Vertex normals (V, 3); 0 at a vertex without triangles, which no sample uses."""
        return facing_normals(vertices, self.triangles)

    def skin(self, vertices: Floats) -> Floats:
        """The skin (V, 3) over a mesh: normal displacements ride on its own normals."""
        if self.heights_mm is None:
            return vertices
        lifted: Floats = vertices + self.heights_mm[:, None] * self.normals(vertices)
        return lifted

    def to_vertices(self, values: Floats) -> Floats:
        """Mean (V,) of the samples' values (N,) around each vertex; 0 where there is none."""
        corners, share = self.samples.corners.ravel(), self.samples.barycentric.ravel()
        count = len(self.neutral)
        total = np.bincount(corners, share, minlength=count)
        mixed = np.bincount(corners, share * np.repeat(values, 3), minlength=count)
        mean: Floats = np.divide(mixed, total, out=np.zeros(count), where=total > 0)
        return mean


def _neighbour_matrix(samples: SurfaceSamples, near: sparse.csr_matrix) -> sparse.csr_matrix:
    """Which samples lie around the same vertices, (N, N) csr of ones without the diagonal."""
    rows = np.arange(len(samples))
    own = samples.corners[rows, samples.barycentric.argmax(axis=1)]
    pick = sparse.csr_matrix((np.ones(len(rows)), (rows, own)), (len(rows), near.shape[0]))
    beside = pick @ near @ pick.T
    beside.setdiag(0)
    beside.eliminate_zeros()
    beside.data[:] = 1.0
    return sparse.csr_matrix(beside)
