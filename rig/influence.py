"""Influence masks: where, and how far, each shape of a template may be changed (Hable)."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from capture.arrays import Floats, Ints32, check_shape
from capture.errors import ShapeError
from rig.template import Template


def influence_masks(template: Template, rings: int = 2, painted: Floats | None = None) -> Floats:
    """How much each shape acts at each vertex: 0 (not at all) to 1.

    A smooth step of the vertex's displacement over the shape's extent, spread over a few rings of
    the mesh so that the actor's shape may reach a little further than the artist's.

    Args:
        template: the artist's rig.
        rings: how many rings of neighbours each mask grows by.
        painted: (B, V) values 0..1 that replace the computed ones; NaN where not painted.

    Returns:
        (B, V) in 0..1; 0 throughout for a shape that moves nothing.

    Raises:
        ShapeError: when what is painted does not fit the template or leaves 0..1.

    References:
        Hable, Solving blendshapes for ARKit, "The Blendshape Constraint", which wants such masks
        and leaves the formula open.
    """
    norms = np.linalg.norm(template.deltas, axis=2)
    share = np.where(template.moves()[:, None], norms, 0.0)
    share /= np.maximum(template.extents_mm, 1e-300)[:, None]
    mask: Floats = share**2 * (3.0 - 2.0 * share)
    link = neighbours(template.polygons, len(template.neutral))
    for _ in range(rings):
        mask = _dilated(mask, link)
    if painted is None:
        return mask
    check_shape(masks=(mask, "B V"), painted=(painted, "B V"))
    chosen = ~np.isnan(painted)
    low, high = painted[chosen].min(initial=0.0), painted[chosen].max(initial=0.0)
    if low < 0.0 or high > 1.0:
        raise ShapeError(
            f"painted influence: must lie in 0..1 (NaN: not painted), found {low:g}..{high:g}"
        )
    return np.where(chosen, painted, mask)


def neighbours(polygons: Ints32, count: int) -> sparse.csr_array:
    """Which of `count` vertices are joined by an edge of polygons (P, 4; -1 pads a triangle).

    Returns:
        (V, V) symmetric, 1 for neighbours; diagonals of quads are no edges.
    """
    following = np.where(polygons[:, 3:] < 0, polygons[:, [1, 2, 0, 0]], polygons[:, [1, 2, 3, 0]])
    begin, end = polygons.ravel(), following.ravel()
    real = (begin >= 0) & (begin != end)
    begin, end = begin[real], end[real]
    both = np.concatenate([begin, end]), np.concatenate([end, begin])
    link = sparse.csr_array(sparse.coo_array((np.ones(2 * len(begin)), both), shape=(count,) * 2))
    link.sum_duplicates()
    link.sort_indices()
    link.data[:] = 1.0
    return link


def _dilated(mask: Floats, link: sparse.csr_array) -> Floats:
    """The largest value among each vertex and its neighbours."""
    grown = mask.copy()
    joined = np.flatnonzero(np.diff(link.indptr) > 0)
    if joined.size:
        around = mask[:, link.indices]
        most = np.maximum.reduceat(around, link.indptr[joined], axis=1)
        grown[:, joined] = np.maximum(mask[:, joined], most)
    return grown
