"""Skin that touches skin in a template, as closed lips do, and should touch when registered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from capture.arrays import Floats, Ints, Ints32, check_shape
from recon.mesh import vertex_normals

_REACH_MM = 1.5
_COSINE = -0.1  # of the normals of two vertices that face each other
_EDGES = 8.0  # along the mesh: what is nearer than this is a crease, no contact


@dataclass(frozen=True, eq=False, kw_only=True)
class Contacts:
    """Pairs of vertices that touch.

    Attributes:
        pairs: (N, 2) vertex indices.
        gaps: (N, 3) from the first to the second where they touch, mm.
    """

    pairs: Ints
    gaps: Floats

    def targets(self, vertices: Floats) -> Floats:
        """Where both vertices (N, 2, 3) of each pair should go to touch, about their middle, mm."""
        first, second = vertices[self.pairs[:, 0]], vertices[self.pairs[:, 1]]
        excess = 0.5 * (second - first - self.gaps)
        return np.stack([first + excess, second - excess], axis=1)


def find_contacts(vertices: Floats, triangles: Ints32) -> Contacts:
    """Find vertices that face each other within 1.5 mm and are no neighbours along the mesh.

    Each vertex is paired with its nearest such partner. Closed lips and closed lids give pairs;
    a parted mouth, a nostril or a crease give none.

    Args:
        vertices: (V, 3) mm.
        triangles: (T, 3).
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    normals = np.nan_to_num(vertex_normals(vertices, triangles))
    near = cKDTree(vertices).query_pairs(_REACH_MM, output_type="ndarray").astype(np.int64)
    facing = np.einsum("nx,nx->n", normals[near[:, 0]], normals[near[:, 1]]) < _COSINE
    near = near[facing]
    none = Contacts(pairs=np.zeros((0, 2), dtype=np.int64), gaps=np.zeros((0, 3)))
    if len(near) == 0:
        return none
    near = near[_far_along(near, triangles, len(vertices))]
    if len(near) == 0:
        return none
    both = np.concatenate([near, near[:, ::-1]])
    distance = np.linalg.norm(vertices[both[:, 0]] - vertices[both[:, 1]], axis=1)
    both = both[np.lexsort((both[:, 1], distance, both[:, 0]))]
    _, nearest = np.unique(both[:, 0], return_index=True)
    pairs = np.unique(np.sort(both[nearest], axis=1), axis=0)
    return Contacts(pairs=pairs, gaps=vertices[pairs[:, 1]] - vertices[pairs[:, 0]])


def _far_along(
    pairs: Ints, triangles: Ints32, count: int
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges = sparse.csr_matrix((np.ones(len(sides)), (sides[:, 0], sides[:, 1])), (count, count))
    sources, place = np.unique(pairs[:, 0], return_inverse=True)
    steps = csgraph.dijkstra(edges, directed=False, indices=sources, unweighted=True, limit=_EDGES)
    return np.asarray(~np.isfinite(steps[place, pairs[:, 1]]))
