"""Locality: where each shape may depart from nothing, as the artist's template says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from capture.arrays import Bools, Floats, Ints
from capture.errors import InputError
from capture.settings import check_ranges
from rig.template import Template

MODES = ("vertex", "soft", "literal")
_DECADES = 4.0  # beyond this many tenfold rises of the stiffness a vertex is simply held


@dataclass(frozen=True, kw_only=True)
class Locality:
    """How strictly a shape keeps to the vertices that the template moves with it.

    Attributes:
        mode: "vertex": a vertex that the template holds still stays exactly still. "soft": one
            near the moving ones may move, against a stiffness that rises with its distance.
            "literal": the paper's rule, each coordinate on its own: a vertex of the midline that
            the template moves up and down alone may not move sideways.
        tolerance: of a shape's extent, at or below which the template counts as still.
        softening_mm: soft mode: distance along the mesh over which the stiffness grows tenfold.
        stiffness: soft mode: strength right outside the support (1: one sure observation at
            weight 1); it grows from there.
    """

    mode: str = "vertex"
    tolerance: float = 1e-3
    softening_mm: float = 4.0
    stiffness: float = 0.5

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise InputError(f"locality: mode must be one of {', '.join(MODES)}, found {self.mode}")
        check_ranges(
            "locality", self, tolerance=(0.0, 0.5), softening_mm=(1e-3, 1e3), stiffness=(0.0, 1e9)
        )


@dataclass(frozen=True, eq=False)
class Mask:
    """Where shapes may move, as `update_shapes` takes it.

    Attributes:
        support: (B, V), or (B, V, 3) in literal mode.
        extra_offset: (B, V) for `UpdatePriors.extra_offset`; None unless the mode is soft.
    """

    support: Bools
    extra_offset: Floats | None = None


def mask_shapes(template: Template, locality: Locality) -> Mask:
    """Work out where each shape of a template may move.

    The mask is taken from the template and not from the shapes carried onto an actor: the transfer
    leaves dust everywhere. The neutral is never masked. Distances are measured along the edges of
    the template's neutral, so that a lip does not reach across the slit to the other.

    Args:
        template: the artist's rig, mm.
        locality: the mode and its strengths.

    References:
        Ma et al. 2016, section 3.2, the hard constraint after Eq 7 (D_ki = 0 where D*_ki = 0).
    """
    if locality.mode == "literal":
        floor = np.maximum(locality.tolerance * template.extents_mm, 1e-9)
        return Mask(np.abs(template.deltas) > floor[:, None, None])
    support = template.support(locality.tolerance)
    if locality.mode == "vertex":
        return Mask(support)
    reach_mm = _DECADES * locality.softening_mm
    away = distances_mm(template, support, reach_mm)
    rise = locality.stiffness * 10.0 ** (np.minimum(away, reach_mm) / locality.softening_mm)
    return Mask(away < reach_mm, np.where(support, 0.0, rise))


def distances_mm(template: Template, support: Bools, reach_mm: float) -> Floats:
    """Distance of every vertex from each shape's support along edges: (B, V), mm.

    Infinite beyond `reach_mm`, on parts that no edge joins to the support, and everywhere for a
    shape that moves nothing.
    """
    graph = _edge_lengths(template)
    out = np.full(support.shape, np.inf)
    for moving, away in zip(support, out, strict=True):
        rim = _rim(graph, moving)
        if rim.size:
            away[:] = dijkstra(graph, directed=False, indices=rim, min_only=True, limit=reach_mm)
        away[moving] = 0.0
    return out


def _edge_lengths(template: Template) -> sparse.csr_array:
    """Lengths of the triangles' edges, (V, V) with both directions, mm."""
    triangles = template.mesh.triangles
    pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    pairs = np.unique(pairs, axis=0)
    apart = template.neutral[pairs[:, 0]] - template.neutral[pairs[:, 1]]
    length = np.maximum(np.linalg.norm(apart, axis=1), 1e-9)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    return sparse.csr_array(
        (np.tile(length, 2), (both[:, 0], both[:, 1])), shape=(len(template.neutral),) * 2
    )


def _rim(graph: sparse.csr_array, moving: Bools) -> Ints:
    """Vertices of the support that have a neighbour outside it."""
    outside = (graph @ (~moving).astype(np.float64)) > 0.0
    return np.flatnonzero(moving & outside)
