"""Openings of a mesh, such as eyes and mouth, and the two opposed rims of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from capture.arrays import Floats, Ints, Ints32, check_shape
from capture.errors import ShapeError

_LONGEST_MM = 300.0  # a rim: more is the edge of the mesh, a neck say
_FEWEST = 8  # edges of a rim: fewer is a fault of the mesh


@dataclass(frozen=True, eq=False, kw_only=True)
class Opening:
    """A hole with two corners, as an eye has, and the rims between them.

    Attributes:
        corners: (2,) vertex indices.
        first: (A,) vertices of one rim, from the first corner to the second, corners left out.
        second: (B,) vertices of the other rim, in the same direction.
    """

    corners: Ints
    first: Ints
    second: Ints

    @property
    def rim(self) -> Ints:
        """All vertices around the hole, in their order."""
        return np.concatenate(
            [self.corners[:1], self.first, self.corners[1:], self.second[::-1]]
        ).astype(np.int64)


def find_openings(vertices: Floats, triangles: Ints32) -> list[Opening]:
    """Find the holes of a mesh that are no more than 300 mm around, and their corners.

    The corners are the two vertices of the rim that are farthest apart. The longest rim of each
    connected piece of the mesh is taken for its edge.

    Args:
        vertices: (V, 3) mm, of the neutral.
        triangles: (T, 3).

    Returns:
        Openings, from the longest rim to the shortest.
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    loops = _loops(triangles, len(vertices))
    around = [_length(vertices[loop]) for loop in loops]
    piece = _pieces(triangles, len(vertices))
    edged: set[int] = set()
    out = []
    for n in sorted(range(len(loops)), key=lambda n: (-around[n], int(loops[n].min()))):
        own = int(piece[loops[n][0]])
        if own in edged and len(loops[n]) >= _FEWEST and around[n] <= _LONGEST_MM:
            out.append(split_rim(vertices, loops[n]))
        edged.add(own)
    return out


def _pieces(triangles: Ints32, count: int) -> Ints32:
    """Which connected piece of the mesh each vertex (V,) belongs to."""
    sides = triangles[:, [[0, 1], [1, 2]]].reshape(-1, 2)
    graph = sparse.csr_matrix((np.ones(len(sides)), (sides[:, 0], sides[:, 1])), (count, count))
    _, label = csgraph.connected_components(graph, directed=False)
    return np.asarray(label)


def _loops(triangles: Ints32, count: int) -> list[Ints]:
    """Rims, each as vertices in order; a rim that touches itself is left out."""
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
    keys = sides[:, 0] * count + sides[:, 1]
    alone = sides[~np.isin(keys, sides[:, 1] * count + sides[:, 0])]
    graph = sparse.csr_matrix((np.ones(len(alone)), (alone[:, 0], alone[:, 1])), (count, count))
    _, label = csgraph.connected_components(graph, directed=False)
    follower = np.full(count, -1, dtype=np.int64)
    follower[alone[:, 0]] = alone[:, 1]
    found = []
    for piece in np.unique(label[alone[:, 0]]):
        own = alone[label[alone[:, 0]] == piece]
        if len(np.unique(own[:, 0])) < len(own) or len(np.unique(own[:, 1])) < len(own):
            continue
        loop = [int(own[:, 0].min())]
        while len(loop) < len(own) and follower[loop[-1]] >= 0:
            loop.append(int(follower[loop[-1]]))
        if follower[loop[-1]] == loop[0]:
            found.append(np.array(loop, dtype=np.int64))
    return found


def _length(points: Floats) -> float:
    return float(np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum())


def split_rim(vertices: Floats, rim: Ints) -> Opening:
    """Part a rim at its corners, the two vertices that are farthest apart.

    For a margin that is no hole of the mesh, such as that of lids before modelled sockets.

    Args:
        vertices: (V, 3) mm, of the neutral.
        rim: (N,) vertices in their order around.

    Raises:
        ShapeError: when the rim has fewer than eight vertices.
    """
    check_shape(vertices=(vertices, "V 3"), rim=(rim, "N"))
    if len(rim) < _FEWEST:
        raise ShapeError(f"rim: expected {_FEWEST} vertices or more, found {len(rim)}")
    place = vertices[rim]
    apart = np.linalg.norm(place[:, None] - place[None], axis=2)
    one, two = sorted(int(n) for n in np.unravel_index(int(apart.argmax()), apart.shape))
    back = np.concatenate([rim[two + 1 :], rim[:one]])[::-1]
    return Opening(corners=rim[[one, two]], first=rim[one + 1 : two], second=back)
