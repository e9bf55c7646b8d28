"""Closest points on the part of a surface that may be met: own component, own side of a slit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape
from recon.mesh import vertex_normals
from track.surface_match import MatchSurface, border_vertices

_ON_EDGE = 1e-6  # share of corners off the border, below which a point lies on the border


@dataclass(frozen=True, eq=False, kw_only=True)
class Met:
    """What each of N query points met; those that met nothing are infinitely far.

    Attributes:
        corners: (N, 3) vertices of the triangle met.
        barycentric: (N, 3) where in it.
        points: (N, 3) the points met, mm.
        distance_mm: (N,) from the query point.
        cosine: (N,) between the two normals.
        on_border: (N,) whether the point lies on an open border of the surface.
    """

    corners: Ints
    barycentric: Floats
    points: Floats
    distance_mm: Floats
    cosine: Floats
    on_border: Bools


class SidedSurface:
    """A mesh whose vertices carry labels, asked for points that a query's labels admit.

    The first label is a component's number and must be equal. Each of the others tells a side of a
    slit, 1 or -1, and must not be the opposite; 0 goes with either.
    """

    def __init__(self, triangles: Ints32, labels: Ints) -> None:
        """Take triangles (T, 3) and labels (V, 1 + slits)."""
        check_shape(triangles=(triangles, "T 3"), labels=(labels, "V *"))
        self._triangles = triangles
        self._labels = labels
        self._border = border_vertices(triangles, len(labels))

    @property
    def border(self) -> Bools:
        """(V,) vertices on an open border."""
        return self._border

    def match(
        self,
        vertices: Floats,
        queries: tuple[Floats, Floats, Ints],
        *,
        normal_mm: float,
        reach_mm: float,
        usable: Bools | None = None,
    ) -> Met:
        """The closest surface point of each query, judged by position and normal.

        Args:
            vertices: (V, 3) where the surface is, mm.
            queries: points (N, 3) mm, unit normals (N, 3) and labels (N, 1 + slits).
            normal_mm: how many mm a unit of normal difference counts in the search.
            reach_mm: what is further away need not be found.
            usable: (V,) vertices whose triangles may be met; None for all.
        """
        points, normals, labels = queries
        check_shape(vertices=(vertices, "V 3"), surface=(self._labels, "V L"))
        check_shape(points=(points, "N 3"), normals=(normals, "N 3"), labels=(labels, "N *"))
        met = _nothing(len(points))
        may = np.ones(len(vertices), dtype=np.bool_) if usable is None else usable
        kinds, kind = np.unique(labels, axis=0, return_inverse=True)
        for number, wanted in enumerate(kinds):
            asked = np.flatnonzero(kind.ravel() == number)
            admitted = may & (self._labels[:, 0] == wanted[0])
            admitted &= (self._labels[:, 1:] * wanted[1:] >= 0).all(axis=1)
            part = self._triangles[admitted[self._triangles].all(axis=1)]
            part = _near(part, vertices, points[asked], reach_mm)
            if len(part) == 0 or not np.isfinite(vertex_normals(vertices, part)).any():
                continue
            self._fill(met, asked, (vertices, part), (points, normals), normal_mm)
        return met

    def _fill(
        self,
        met: Met,
        asked: Ints,
        part: tuple[Floats, Ints32],
        queries: tuple[Floats, Floats],
        normal_mm: float,
    ) -> None:
        found = MatchSurface(*part, normal_mm=normal_mm).match(queries[0][asked], queries[1][asked])
        met.corners[asked] = found.corners
        met.barycentric[asked] = found.barycentric
        met.points[asked] = found.points
        met.distance_mm[asked] = found.distance_mm
        met.cosine[asked] = found.cosine
        inner = (found.barycentric * ~self._border[found.corners]).sum(axis=1)
        met.on_border[asked] = inner < _ON_EDGE


def _nothing(count: int) -> Met:
    return Met(
        corners=np.zeros((count, 3), dtype=np.int64),
        barycentric=np.tile([1.0, 0.0, 0.0], (count, 1)),
        points=np.zeros((count, 3)),
        distance_mm=np.full(count, np.inf),
        cosine=np.full(count, -1.0),
        on_border=np.zeros(count, dtype=np.bool_),
    )


def _near(triangles: Ints32, vertices: Floats, points: Floats, reach_mm: float) -> Ints32:
    """Triangles that touch the box of the points, widened by the reach."""
    low, high = points.min(axis=0) - reach_mm, points.max(axis=0) + reach_mm
    corner = vertices[triangles]
    inside = (corner.max(axis=1) >= low).all(axis=1) & (corner.min(axis=1) <= high).all(axis=1)
    return np.ascontiguousarray(triangles[inside])
