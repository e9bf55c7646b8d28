"""Opposed surfaces of a mesh: lips and lids, which may touch and never cross."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape
from recon.mesh import vertex_normals
from track.contact import find_contacts
from track.openings import Opening, find_openings
from track.surface_match import MatchSurface, border_vertices

_REACH = 0.5  # of an opening's width: how far along the surface lips or lids reach from the rim
_BETWEEN_MM = 1.0  # nearer than this to both rims is a corner, of neither side
_FEWEST = 10  # pairs of touching vertices that make two sides
_TOUCHING_MM = 6.0  # along the surface: how far sides reach beyond the vertices that touch
_NORMAL_MM = 2.0  # what a unit of normal difference counts in looking for the opposite surface
_FACING = 0.3  # least cosine between a normal and the reversed normal of the opposite surface
_SIDEWAYS = 0.5  # of the depth: farther beside the surface's edge is past it, not behind it
_DEEPEST_MM = 3.0  # behind by more is behind something else


@dataclass(frozen=True, eq=False, kw_only=True)
class Crossings:
    """N vertices that are behind the surface they should face.

    Attributes:
        vertex: (N,) indices.
        corners: (N, 3) of the triangles that they are behind.
        barycentric: (N, 3) where in those.
        direction: (N, 3) unit normals of that surface.
        depth_mm: (N,) how far behind, beyond what the neutral has itself.
    """

    vertex: Ints
    corners: Ints
    barycentric: Floats
    direction: Floats
    depth_mm: Floats


@dataclass(frozen=True, eq=False, kw_only=True)
class _Half:
    """The vertices of one side, and the triangles of the other that they may not pass.

    `sides` (E, 2) are places in `vertices` that are joined by an edge of the mesh, both ways, and
    `length_mm` (E,) how long it is in the neutral.
    """

    vertices: Ints
    opposite: Ints32
    sides: Ints
    length_mm: Floats

    def supported(self, depth: Floats) -> Bools:
        """Where depths (N,) fall off to the neighbours no faster than the surface is long.

        A vertex far behind something amid neighbours that are not has met the wrong surface.
        """
        reach = np.zeros(len(depth))
        np.maximum.at(reach, self.sides[:, 0], depth[self.sides[:, 1]] + self.length_mm)
        return np.asarray(depth <= reach)


class OpposedSurfaces:
    """Pairs of surfaces of a mesh that face each other, found from the neutral alone.

    Around each opening, an eye or a mouth, those are the surfaces next to its two rims. Where
    skin touches without an opening near by, as lips do before a mouth bag that is part of the
    mesh, they are the two sides of the contact.

    Args:
        neutral: (V, 3) mm.
        triangles: (T, 3).
        margins: openings that are no holes of the mesh, see `track.openings.split_rim`.
    """

    def __init__(self, neutral: Floats, triangles: Ints32, margins: Sequence[Opening] = ()) -> None:
        check_shape(neutral=(neutral, "V 3"), triangles=(triangles, "T 3"))
        graph = _edge_lengths(neutral, triangles)
        openings = [*find_openings(neutral, triangles), *margins]
        labels = [_beside(opening, neutral, graph) for opening in openings]
        taken = np.zeros(len(neutral), dtype=np.bool_)
        for label in labels:
            taken |= label != 0
        labels += _touching(neutral, triangles, graph, taken)
        self._triangles, self._count = triangles, len(neutral)
        inner = ~border_vertices(triangles, len(neutral))  # a rim is an edge, not a surface
        self._halves = [
            half for label in labels for half in _both_halves(label * inner, triangles, graph)
        ]
        normals = np.nan_to_num(vertex_normals(neutral, triangles))
        self._allowed = [_behind(half, neutral, normals, 0.0)[0] for half in self._halves]

    @property
    def vertices(self) -> Ints:
        """The vertices of all sides, ascending."""
        parts = [half.vertices for half in self._halves]
        return np.unique(np.concatenate([*parts, np.zeros(0, np.int64)]))

    def crossings(self, vertices: Floats) -> Crossings:
        """Find the vertices that are behind the surface opposite.

        A vertex is measured against the closest point of the opposite surface that faces it, along
        that surface's normal. What the neutral has of it is allowed.

        Args:
            vertices: (V, 3) mm.
        """
        if vertices.shape != (self._count, 3):
            check_shape(vertices=(vertices, f"{self._count} 3"))
        normals = np.nan_to_num(vertex_normals(vertices, self._triangles))
        return _joined(
            [
                _behind(half, vertices, normals, allowed)[1]
                for half, allowed in zip(self._halves, self._allowed, strict=True)
            ]
        )


def _behind(
    half: _Half, vertices: Floats, normals: Floats, allowed: Floats | float
) -> tuple[Floats, Crossings]:
    """How far a side's vertices are behind the side opposite; those beyond what is allowed."""
    own = half.vertices
    used, place = np.unique(half.opposite, return_inverse=True)
    surface = MatchSurface(
        vertices[used], place.reshape(-1, 3).astype(np.int32), normal_mm=_NORMAL_MM
    )
    met = surface.match(vertices[own], -normals[own])
    depth = np.einsum("nx,nx->n", met.points - vertices[own], met.normals)
    beside = np.sqrt(np.maximum(met.distance_mm**2 - depth**2, 0.0))
    behind = (met.cosine > _FACING) & (depth > 0.0) & (depth < _DEEPEST_MM)
    depth = np.where(behind & (beside < _SIDEWAYS * depth), depth, 0.0)
    depth = np.where(half.supported(depth), depth, 0.0)
    beyond = depth - allowed
    hit = np.flatnonzero(beyond > 0.0)
    return depth, Crossings(
        vertex=own[hit],
        corners=used[met.corners[hit]].astype(np.int64),
        barycentric=met.barycentric[hit],
        direction=met.normals[hit],
        depth_mm=beyond[hit],
    )


def _joined(parts: list[Crossings]) -> Crossings:
    if not parts:
        return Crossings(
            vertex=np.zeros(0, np.int64), corners=np.zeros((0, 3), np.int64),
            barycentric=np.zeros((0, 3)), direction=np.zeros((0, 3)), depth_mm=np.zeros(0),
        )  # fmt: skip
    return Crossings(
        vertex=np.concatenate([part.vertex for part in parts]),
        corners=np.concatenate([part.corners for part in parts]),
        barycentric=np.concatenate([part.barycentric for part in parts]),
        direction=np.concatenate([part.direction for part in parts]),
        depth_mm=np.concatenate([part.depth_mm for part in parts]),
    )


def _edge_lengths(vertices: Floats, triangles: Ints32) -> sparse.csr_matrix:
    """Edges of the mesh, (V, V) symmetric, mm."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    sides = np.unique(sides, axis=0)
    length = np.linalg.norm(vertices[sides[:, 0]] - vertices[sides[:, 1]], axis=1)
    length = np.maximum(length, 1e-9)  # an edge of length 0 would be none
    half = sparse.csr_matrix((length, (sides[:, 0], sides[:, 1])), (len(vertices),) * 2)
    return sparse.csr_matrix(half + half.T)


def _beside(opening: Opening, vertices: Floats, graph: sparse.csr_matrix) -> Ints:
    """Which side (V,) of an opening each vertex is on: 1, -1, or 0 for neither."""
    ends = vertices[opening.corners]
    reach = _REACH * float(np.linalg.norm(ends[0] - ends[1]))
    return nearer_seeds((opening.first, opening.second), reach, graph)


def nearer_seeds(
    seeds: tuple[Ints, Ints], reach_mm: float, graph: sparse.csr_array | sparse.csr_matrix
) -> Ints:
    """1 and -1 where the first or the second seeds are nearer along the mesh, within reach."""
    label = np.zeros(graph.shape[0], dtype=np.int64)
    if min(map(len, seeds)) == 0:
        return label
    limit = reach_mm + 2.0 * _BETWEEN_MM
    one, two = (csgraph.dijkstra(graph, indices=seed, min_only=True, limit=limit) for seed in seeds)
    label[(one < reach_mm) & (one < two - _BETWEEN_MM)] = 1
    label[(two < reach_mm) & (two < one - _BETWEEN_MM)] = -1
    return label


def _touching(
    vertices: Floats, triangles: Ints32, graph: sparse.csr_matrix, taken: Bools
) -> list[Ints]:
    """The sides (V,) of each contact that lies at no opening."""
    pairs = find_contacts(vertices, triangles).pairs
    pairs = pairs[~taken[pairs].any(axis=1)]
    if len(pairs) == 0:
        return []
    used, place = np.unique(pairs, return_inverse=True)
    place = place.reshape(-1, 2)
    shape = (len(used), len(used))
    opposite = sparse.csr_matrix((np.ones(len(place)), (place[:, 0], place[:, 1])), shape)
    opposite = opposite + opposite.T
    beside = graph[used][:, used] > 0
    _, piece = csgraph.connected_components(opposite + beside, directed=False)
    out = []
    for one in np.unique(piece[place[:, 0]]):
        inside = np.flatnonzero(piece == one)
        if opposite[inside][:, inside].nnz < 2 * _FEWEST:
            continue
        sign = _two_sides(opposite[inside][:, inside], beside[inside][:, inside])
        seeds = used[inside[sign > 0]], used[inside[sign < 0]]
        out.append(nearer_seeds(seeds, _TOUCHING_MM, graph))
    return out


def _two_sides(opposite: sparse.csr_matrix, beside: sparse.csr_matrix) -> Floats:
    """Numbers (N,) whose signs tell two sides: neighbours share one, opposites differ.

    References:
        Kunegis et al. 2010, "Spectral analysis of signed graphs": the eigenvector of the signed
        Laplacian's least eigenvalue.
    """
    far, near = opposite.toarray() > 0, beside.toarray() > 0
    links = near.astype(np.float64) - far
    signed = np.diag(np.abs(links).sum(axis=1)) - links
    vector = np.linalg.eigh(signed)[1][:, 0]
    leading = vector[np.abs(vector).argmax()]
    sides: Floats = vector * np.sign(leading)
    return sides


def _both_halves(label: Ints, triangles: Ints32, graph: sparse.csr_matrix) -> list[_Half]:
    """The two halves of a pair of sides; none when a side has no triangle."""
    sides = [triangles[(label[triangles] == sign).all(axis=1)] for sign in (1, -1)]
    if min(map(len, sides)) == 0:
        return []
    out = []
    for own, opposite in (sides, sides[::-1]):
        used = np.unique(own).astype(np.int64)
        edges = sparse.coo_matrix(graph[used][:, used])
        pairs = np.stack([edges.row, edges.col], axis=1).astype(np.int64)
        half = _Half(vertices=used, opposite=opposite, sides=pairs, length_mm=edges.data)
        out.append(half)
    return out
