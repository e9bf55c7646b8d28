"""Surfaces that crossed are pushed apart until they touch, and nothing else moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape
from capture.errors import SettingsError
from track.laplacian import cotangent_laplacian, vertex_areas
from track.openings import Opening
from track.opposed import Crossings, OpposedSurfaces
from track.surface_samples import vertex_rings

_BENDING_MM = 1.5  # how far a push carries its surroundings
_RINGS = 6  # of edges around the opposed surfaces that may give way
_PRESS = 100.0  # of a push, against the pull of 1 that keeps sure skin in place
_UNSURE = 0.02  # what keeps skin in place that nobody saw
_CLEAR_MM = 0.01  # crossings that remain when it is enough


class Separation:
    """Pushes crossed surfaces apart by the smoothest small displacement.

    The displacement d minimises, over the vertices around the opposed surfaces,

        sum_v m_v (b^4 |(L d)_v / m_v|^2 + stay_v |d_v|^2) + press sum_a m_a |d_a - push_a|^2

    with m the areas and a the active vertices: those found crossed, and the corners of what they
    crossed. Pushes of crossings that remain are made longer, round by round.

    Args:
        neutral: (V, 3) mm.
        triangles: (T, 3).
        margins: openings that are no holes of the mesh, see `track.openings.split_rim`.

    References:
        Nocedal and Wright 2006, "Numerical optimization", Sec. 16.5, for active sets.
    """

    def __init__(self, neutral: Floats, triangles: Ints32, margins: Sequence[Opening] = ()) -> None:
        self._surfaces = OpposedSurfaces(neutral, triangles, margins)
        self._region = _grown(self._surfaces.vertices, triangles, len(neutral))
        area = vertex_areas(neutral, triangles)
        area = np.maximum(area, 0.05 * area[area > 0].mean()) if (area > 0).any() else area + 1.0
        laplacian = cotangent_laplacian(neutral, triangles)
        whole = _BENDING_MM**4 * laplacian @ sparse.diags(1.0 / area) @ laplacian
        self._bending = sparse.csc_matrix(whole[self._region][:, self._region])
        self._area = area[self._region]

    @property
    def surfaces(self) -> OpposedSurfaces:
        """The surfaces that may not cross."""
        return self._surfaces

    def parted(self, vertices: Floats, confidence: Floats, *, rounds: int = 3) -> Floats:
        """The mesh with its crossed surfaces pushed apart.

        Args:
            vertices: (V, 3) mm.
            confidence: (V,) 0..1; of two surfaces that crossed, the surer one moves less.
            rounds: of finding crossings and pushing, >= 1.

        Returns:
            (V, 3) mm; `vertices` itself when nothing crosses. Vertices far from what crossed stay.

        Raises:
            SettingsError: when rounds is below 1.
        """
        check_shape(vertices=(vertices, "V 3"), confidence=(confidence, "V"))
        if rounds < 1:
            raise SettingsError(f"rounds: expected >= 1, found {rounds}")
        stay = _UNSURE + np.clip(confidence, 0.0, 1.0)
        moved, push = vertices, np.zeros_like(vertices)
        active = np.zeros(len(vertices), dtype=np.bool_)
        for _ in range(rounds):
            crossed = self._surfaces.crossings(moved)
            if len(crossed.vertex) == 0 or float(crossed.depth_mm.max()) < _CLEAR_MM:
                break
            wanted = _pushes(crossed, stay)
            fresh = wanted.any(axis=1) & ~active
            push[fresh] = moved[fresh] - vertices[fresh]
            active |= fresh
            push += wanted
            moved = self._displaced(vertices, stay, push, active)
        return moved

    def _displaced(self, vertices: Floats, stay: Floats, push: Floats, active: Bools) -> Floats:
        own = self._region
        press = _PRESS * self._area * active[own]
        system = self._bending + sparse.diags(self._area * stay[own] + press)
        displacement = splu(
            sparse.csc_matrix(system), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        ).solve(press[:, None] * push[own])  # fmt: skip
        out = vertices.copy()
        out[own] += displacement
        return out


def _pushes(crossed: Crossings, stay: Floats) -> Floats:
    """How far each vertex (V, 3) should go: the longest of what is asked of it."""
    facing = np.einsum("nk,nk->n", crossed.barycentric, stay[crossed.corners])
    own = facing / (facing + stay[crossed.vertex])
    step = crossed.depth_mm[:, None] * crossed.direction
    who = np.concatenate([crossed.vertex, crossed.corners.ravel()])
    # the corners move so that the point among them moves by its part
    spread = crossed.barycentric / (crossed.barycentric**2).sum(axis=1, keepdims=True)
    back = -(1.0 - own)[:, None, None] * spread[:, :, None] * step[:, None]
    asked = np.concatenate([own[:, None] * step, back.reshape(-1, 3)])
    length = np.linalg.norm(asked, axis=1)
    order = np.lexsort((length, who))
    out = np.zeros((len(stay), 3))
    out[who[order]] = asked[order]  # the last, the longest, stays
    return out


def _grown(vertices: Ints, triangles: Ints32, count: int) -> Ints:
    start = np.zeros(count, dtype=np.int64)
    start[vertices] = 1
    reach = vertex_rings(triangles, count, _RINGS)
    return np.flatnonzero(reach @ start)
