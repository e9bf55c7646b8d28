"""Edges of a mesh whose ends are bound to far places of another, and their repair."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape
from rig.slits import edge_lengths
from track.surface_match import MatchSurface

_FACTOR = 3.0  # of an edge's own length: places further apart along the surface tear it
_SLACK = 2.0  # of the surface's edges there: ways along edges are longer than the surface's
_BALL = 512  # vertices looked at in the search for one edge


@dataclass(frozen=True, eq=False, kw_only=True)
class Bindings:
    """Places of a surface to which vertices of another mesh are bound.

    Attributes:
        corners: (U, 3) vertices of the surface's triangle.
        barycentric: (U, 3) where in it.
        bound: (U,) whether the vertex has a place at all.
    """

    corners: Ints
    barycentric: Floats
    bound: Bools


class TornEdges:
    """Tells torn edges of a mesh bound to a surface, and binds their ends anew.

    An edge is torn when its ends' places are further apart along the surface than 3 times the
    edge's length and two edges of the surface. Lips that touch are near in space and far along the
    surface: an upper lip that was bound to the lower one shows so.
    """

    def __init__(self, surface: tuple[Floats, Ints32], mesh: tuple[Floats, Ints32]) -> None:
        """Take vertices and triangles of the surface (V, 3), (T, 3) and the mesh, both in mm.

        The surface is the deformed one, that lies on the mesh.
        """
        check_shape(surface=(surface[0], "V 3"), mesh=(mesh[0], "U 3"))
        self._surface, self._mesh = surface, mesh
        self._graph = edge_lengths(*surface)
        own = sparse.coo_array(edge_lengths(*mesh))
        upper = own.row < own.col
        self._edges = np.stack([own.row, own.col], axis=1)[upper].astype(np.int64)
        self._lengths = own.data[upper]
        degree = np.maximum(np.diff(self._graph.indptr), 1)
        mean = np.asarray(self._graph.sum(axis=1)).ravel() / degree
        self._spacing = mean

    def find(self, bindings: Bindings) -> Bools:
        """(E,) which of `edges` are torn; an edge with an unbound end is not."""
        both = bindings.bound[self._edges].all(axis=1)
        asked = np.flatnonzero(both)
        ends = self._edges[asked]
        slack = self._spacing[bindings.corners[ends]].reshape(len(ends), -1).max(axis=1, initial=0)
        limit = _FACTOR * self._lengths[asked] + _SLACK * slack
        near = _connected(
            ends, limit, bindings.corners, bindings.barycentric, self._surface[0],
            self._graph.indptr.astype(np.int64), self._graph.indices.astype(np.int64),
            self._graph.data,
        )  # fmt: skip
        torn = np.zeros(len(self._edges), dtype=np.bool_)
        torn[asked] = ~near
        return torn

    @property
    def edges(self) -> Ints:
        """(E, 2) edges of the mesh, each once."""
        return self._edges

    def repaired(self, bindings: Bindings, allowed_mm: float) -> Bindings:
        """Bind anew what torn edges cut off, near the places of the neighbours that are sound.

        Of each connected piece of the mesh the largest part without torn edges is taken for sound;
        the rest is bound from its border inwards. A vertex for which nothing is within
        `allowed_mm` near its neighbours' places is left unbound.
        """
        torn = self.find(bindings)
        if not torn.any():
            return bindings
        sound = self._sound(bindings, torn)
        corners, barycentric = bindings.corners.copy(), bindings.barycentric.copy()
        bound = bindings.bound.copy()
        waiting = bindings.bound & ~sound
        both = np.concatenate([self._edges, self._edges[:, ::-1]])
        length = np.concatenate([self._lengths, self._lengths])
        while True:
            ready = waiting[both[:, 0]] & sound[both[:, 1]]
            if not ready.any():
                break
            chosen, first = np.unique(both[ready, 0], return_index=True)
            beside, reach = both[ready, 1][first], length[ready][first]
            for vertex, neighbour, edge_mm in zip(chosen, beside, reach, strict=True):
                found = self._near(vertex, corners[neighbour], edge_mm)
                bound[vertex] = found is not None and found[2] < allowed_mm
                if found is not None:
                    corners[vertex], barycentric[vertex] = found[0], found[1]
            sound[chosen[bound[chosen]]] = True
            waiting[chosen] = False
        return Bindings(corners=corners, barycentric=barycentric, bound=bound)

    def _sound(self, bindings: Bindings, torn: Bools) -> Bools:
        """Bound vertices of the largest part, without torn edges, of each connected piece."""
        count = len(self._mesh[0])
        both = bindings.bound[self._edges].all(axis=1)
        whole = _pieces(self._edges[both], count)
        part = _pieces(self._edges[both & ~torn], count)
        parts, first, size = np.unique(part, return_index=True, return_counts=True)
        owner = whole[first]
        order = np.lexsort((parts, -size, owner))
        _, at = np.unique(owner[order], return_index=True)
        largest = parts[order][at]
        return np.asarray(bindings.bound & np.isin(part, largest))

    def _near(self, vertex: int, place: Ints, edge_mm: float) -> tuple[Ints, Floats, float] | None:
        """The closest point of the surface's triangles near a place, and how far it is."""
        limit = _FACTOR * edge_mm + float(self._spacing[place].max())
        away = csgraph.dijkstra(self._graph, indices=place, min_only=True, limit=limit)
        part = self._surface[1][np.isfinite(away)[self._surface[1]].all(axis=1)]
        if len(part) == 0:
            return None
        met = MatchSurface(self._surface[0], np.ascontiguousarray(part), normal_mm=1.0).match(
            self._mesh[0][[vertex]], np.zeros((1, 3))
        )
        return met.corners[0], met.barycentric[0], float(met.distance_mm[0])


def _pieces(edges: Ints, count: int) -> Ints:
    graph = sparse.coo_array(
        (np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count)
    )
    return np.asarray(csgraph.connected_components(graph, directed=False)[1], dtype=np.int64)


@numba.njit(cache=True, nogil=True)
def _connected(
    ends: Any, limit: Any, corners: Any, barycentric: Any, vertices: Any,
    first: Any, around: Any, length: Any,
) -> Any:  # fmt: skip
    """Whether the places of two ends are within the limit along the surface's edges."""
    near = np.zeros(len(ends), dtype=np.bool_)
    ball = np.empty(_BALL, dtype=np.int64)
    away = np.empty(_BALL)
    done = np.empty(_BALL, dtype=np.bool_)
    for n in range(len(ends)):
        start, goal = corners[ends[n, 0]], corners[ends[n, 1]]
        here, there = np.zeros(3), np.zeros(3)
        for k in range(3):
            here += barycentric[ends[n, 0], k] * vertices[start[k]]
            there += barycentric[ends[n, 1], k] * vertices[goal[k]]
        if (start == goal).all():
            near[n] = True
            continue
        count = 0
        for k in range(3):
            ball[count], done[count] = start[k], False
            away[count] = np.sqrt(((vertices[start[k]] - here) ** 2).sum())
            count += 1
        while not near[n]:
            nearest = -1
            for m in range(count):
                if not done[m] and (nearest < 0 or away[m] < away[nearest]):
                    nearest = m
            if nearest < 0 or away[nearest] > limit[n]:
                break
            done[nearest] = True
            vertex = ball[nearest]
            for k in range(3):
                if goal[k] == vertex:
                    rest = np.sqrt(((vertices[vertex] - there) ** 2).sum())
                    near[n] = near[n] or away[nearest] + rest <= limit[n]
            for slot in range(first[vertex], first[vertex + 1]):
                reached = away[nearest] + length[slot]
                known = -1
                for m in range(count):
                    if ball[m] == around[slot]:
                        known = m
                if known >= 0:
                    away[known] = min(away[known], reached)
                elif count < _BALL:
                    ball[count], away[count], done[count] = around[slot], reached, False
                    count += 1
    return near
