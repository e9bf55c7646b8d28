"""Deformation transfer: an artist's shapes carried onto an actor's neutral of the same topology."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from capture.arrays import Bools, Floats, Ints, Ints32, check_finite, check_shape
from rig.gradient import components, deformation_gradients, gradient_operator
from rig.template import Template

MASK_TOLERANCE = 1e-3  # of a shape's own extent: below it a vertex counts as static
_LEAK_MM = 0.03  # motion of static vertices above which a shape is solved with them held
_SHUT_MM = 0.3  # lids or lips of the template nearer than this at rest are shut
_BRIDGE_STRENGTH = 10.0  # of virtual triangles against skin: closing matters more than stretch


def transfer_shapes(
    template: Template, neutral: Floats, tolerance: float = MASK_TOLERANCE
) -> Floats:
    """Carry every shape of a template onto another neutral of the same topology.

    For each shape, the displacements d minimise `|G (neutral + d) - F G neutral|^2`, with G the
    actor's area-weighted gradient operator and F the template's deformation gradients: one
    factorisation of `G.T @ G` serves every shape and coordinate. The gauge is fixed once per
    connected component, at the vertices that the template's shape leaves alone (or, where it
    leaves none, by the template's mean displacement). A shape that would still move those
    vertices is solved again on its own, with every one of them held. Triangles spanned between
    paired lids and lips make eyes and mouth shut on the actor when they shut on the template.

    Args:
        template: the artist's rig.
        neutral: (V, 3) the actor's neutral, in the template's place and axes, mm.
        tolerance: of each shape's extent, below which the template's vertex counts as static;
            such vertices stay exactly where they are.

    Returns:
        (B, V, 3) displacements from `neutral`, mm.

    References:
        Sumner and Popovic 2004; Botsch et al. 2006, section 3; Saito 2013 (virtual triangles).
    """
    check_shape(template=(template.neutral, "V 3"), neutral=(neutral, "V 3"))
    check_finite(neutral=neutral)
    support = template.support(tolerance)
    bridges = virtual_triangles(template)
    triangles = np.concatenate([template.mesh.triangles, bridges])
    strength = np.ones(len(triangles))
    strength[len(triangles) - len(bridges) :] = _BRIDGE_STRENGTH
    operator = gradient_operator(neutral, triangles)
    operator = sparse.csr_array(sparse.diags_array(np.repeat(np.sqrt(strength), 3)) @ operator)
    rest = (operator @ neutral).reshape(-1, 3, 3)  # triangle, axis, coordinate
    labels = components(triangles, len(neutral))
    right = np.zeros((len(neutral), 3 * len(template.names)))
    transposed = operator.T.tocsr()
    for index, delta in enumerate(template.deltas):
        wanted = _wanted(template.neutral, np.where(support[index][:, None], delta, 0.0), triangles)
        right[:, 3 * index : 3 * index + 3] = transposed @ (rest @ wanted).reshape(-1, 3)
    laplacian = sparse.csr_array(transposed @ operator)
    solved = _solve_anchored(laplacian, right, labels)
    deltas = np.ascontiguousarray(solved.reshape(len(neutral), -1, 3).transpose(1, 0, 2))
    for index, source in enumerate(template.deltas):
        settled, leak_mm = _settle(deltas[index], source, support[index], labels)
        if leak_mm > _LEAK_MM:
            wanted = right[:, 3 * index : 3 * index + 3]
            _solve_held(laplacian, wanted, support[index], labels, settled)
        deltas[index] = settled
    return deltas


def virtual_triangles(template: Template) -> Ints32:
    """Triangles across the slit between paired lids and lips: (n, 3), two a step along the loop.

    A pair is joined to the next when both its ends are the neighbours (or the same vertices) of the
    next one's, so that one array may hold both eyes. Slits that are shut at rest, as lips mostly
    are, get none: a triangle without area has no gradient to carry, and would glue the lips.
    """
    polygons = template.polygons
    following = np.where(polygons[:, 3:] < 0, polygons[:, [1, 2, 0, 0]], polygons[:, [1, 2, 3, 0]])
    ends = np.where(polygons < 0, polygons[:, :1], polygons)
    edges = {
        frozenset(edge)
        for edge in zip(ends.ravel().tolist(), following.ravel().tolist(), strict=True)
    }
    found: list[tuple[int, int, int]] = []
    for pairs in (template.lid_pairs, template.lip_pairs):
        for (a, b), (c, d) in zip(pairs[:-1].tolist(), pairs[1:].tolist(), strict=True):
            joined = all(p == q or frozenset((p, q)) in edges for p, q in ((a, c), (b, d)))
            apart = template.neutral[[a, c]] - template.neutral[[b, d]]
            if joined and np.linalg.norm(apart, axis=1).max() > _SHUT_MM:
                found += [t for t in ((a, b, d), (a, d, c)) if len(set(t)) == 3]
    return np.array(found, dtype=np.int32).reshape(-1, 3)


def _wanted(rest: Floats, delta: Floats, triangles: Ints32) -> Floats:
    """(F - I)^T of every triangle, exactly zero where the template does not move."""
    change = np.zeros((len(triangles), 3, 3))
    moved = np.flatnonzero((delta[triangles] != 0.0).any(axis=(1, 2)))
    gradients = deformation_gradients(rest, rest + delta, triangles[moved])
    change[moved] = (gradients - np.eye(3)).transpose(0, 2, 1)
    return change


def _solve_anchored(laplacian: sparse.csr_array, right: Floats, labels: Ints) -> Floats:
    """Solve with one vertex of each component held at zero."""
    anchors = np.unique(labels, return_index=True)[1]
    free = np.ones(len(labels), dtype=bool)
    free[anchors] = False
    free &= laplacian.diagonal() > 0.0
    kept = np.flatnonzero(free)
    solved = np.zeros_like(right)
    if kept.size:
        solved[kept] = factorised(laplacian[kept][:, kept]).solve(right[kept])
    return solved


def factorised(matrix: sparse.sparray) -> sparse.linalg.SuperLU:
    """Factorise a symmetric positive definite sparse matrix (SuperLU in its symmetric mode)."""
    return splu(
        sparse.csc_matrix(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _solve_held(
    laplacian: sparse.csr_array, right: Floats, support: Bools, labels: Ints, out: Floats
) -> None:
    """Solve one shape with all its static vertices at zero, in components that have any."""
    has_still = np.bincount(labels[~support], minlength=int(labels.max()) + 1) > 0
    free = np.flatnonzero(support & has_still[labels] & (laplacian.diagonal() > 0.0))
    if free.size:
        out[free] = factorised(laplacian[free][:, free]).solve(right[free])


def _settle(delta: Floats, source: Floats, support: Bools, labels: Ints) -> tuple[Floats, float]:
    """Fix each component's translation, hold static vertices; also how far they were off, mm."""
    count = int(labels.max()) + 1
    has_still = np.bincount(labels[~support], minlength=count) > 0
    chosen = ~support | ~has_still[labels]
    reference = np.where(has_still[labels][:, None], 0.0, source)
    total = np.bincount(labels[chosen], minlength=count)
    shift = np.stack(
        [
            np.bincount(labels[chosen], (reference - delta)[chosen, axis], minlength=count) / total
            for axis in range(3)
        ],
        axis=1,
    )
    moved = delta + shift[labels]
    leak_mm = float(np.linalg.norm(moved[~support], axis=1).max(initial=0.0))
    return np.where(support[:, None], moved, 0.0), leak_mm
