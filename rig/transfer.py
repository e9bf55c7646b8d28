"""Deformation transfer: an artist's shapes carried onto an actor's neutral of the same topology."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from capture.arrays import Bools, Floats, Ints, Ints32, check_finite, check_shape
from rig.gradient import RestFrames, components, gradient_operator
from rig.slits import polygon_edges
from rig.template import Template

MASK_TOLERANCE = 1e-3  # of a shape's own extent: below it a vertex counts as static
_LEAK_MM = 0.03  # motion of static vertices above which a shape is solved with them held
_THREADS = 2
_TOGETHER = 200_000  # triangles of several shapes whose gradients are held at once
_SHUT_MM = 0.3  # lids or lips of the template nearer than this at rest are shut
_DISTORTED = 5.0  # a triangle stretched more than this between the two faces tells no gradient
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
    Lids and lips that part do so by the template's millimetres: their gap at rest is no measure.
    So is a triangle of the template that is turned over or much thinner than the actor's: there the
    plain gradient of the template's displacements is asked for.

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
    skin = len(triangles) - len(bridges)
    plain = _distorted(template.neutral, neutral, triangles)
    frames = RestFrames(template.neutral, triangles)
    sources = np.where(support[:, :, None], template.deltas, 0.0)
    together = max(1, _TOGETHER // max(len(triangles), 1))
    for begin in range(0, len(sources), together):
        part = sources[begin : begin + together]
        wanted = rest @ _wanted(frames, part, triangles)
        for index, delta in enumerate(part):
            plain[skin:] = _parting(template.neutral, delta, bridges)
            if plain.any():
                wanted[index, plain] = (operator @ delta).reshape(-1, 3, 3)[plain]
        stacked = wanted.reshape(len(part), -1, 3).transpose(1, 0, 2)
        right[:, 3 * begin : 3 * (begin + len(part))] = transposed @ stacked.reshape(
            3 * len(triangles), -1
        )
    laplacian = sparse.csr_array(transposed @ operator)
    solved = _solve_anchored(laplacian, right, labels)
    deltas = np.ascontiguousarray(solved.reshape(len(neutral), -1, 3).transpose(1, 0, 2))

    def settle(index: int) -> None:
        settled, leak_mm = _settle(deltas[index], template.deltas[index], support[index], labels)
        if leak_mm > _LEAK_MM:
            wanted = right[:, 3 * index : 3 * index + 3]
            _solve_held(laplacian, wanted, support[index], labels, settled)
        deltas[index] = settled

    with ThreadPoolExecutor(_THREADS) as pool:  # the factorisations leave the interpreter's lock
        list(pool.map(settle, range(len(deltas))))
    return deltas


def virtual_triangles(template: Template) -> Ints32:
    """Triangles across the slit between paired lids and lips: (n, 3), two a step along the loop.

    A pair is joined to the next when both its ends are the neighbours (or the same vertices) of the
    next one's, so that one array may hold both eyes. Slits that are shut at rest, as lips mostly
    are, get none: a triangle without area has no gradient to carry, and would glue the lips.
    """
    edges = polygon_edges(template.polygons)
    found: list[tuple[int, int, int]] = []
    for pairs in (template.lid_pairs, template.lip_pairs):
        for (a, b), (c, d) in zip(pairs[:-1].tolist(), pairs[1:].tolist(), strict=True):
            joined = all(p == q or frozenset((p, q)) in edges for p, q in ((a, c), (b, d)))
            apart = template.neutral[[a, c]] - template.neutral[[b, d]]
            if joined and np.linalg.norm(apart, axis=1).max() > _SHUT_MM:
                found += [t for t in ((a, b, d), (a, d, c)) if len(set(t)) == 3]
    return np.array(found, dtype=np.int32).reshape(-1, 3)


def _wanted(frames: RestFrames, deltas: Floats, triangles: Ints32) -> Floats:
    """(F - I)^T of every shape and triangle, exactly zero where the template does not move."""
    moves = deltas[:, triangles]  # shape, triangle, corner, axis
    shape, triangle = np.nonzero((moves != 0.0).any(axis=(2, 3)))
    change = np.zeros((len(deltas), len(triangles), 3, 3))
    gradients = frames.gradients(moves[shape, triangle], triangle)
    change[shape, triangle] = (gradients - np.eye(3)).transpose(0, 2, 1)
    return change


def _distorted(source: Floats, target: Floats, triangles: Ints32) -> Bools:
    """Triangles turned over or stretched by far more than their surface is, or without area."""
    edges = [points[triangles[:, 1:]] - points[triangles[:, :1]] for points in (source, target)]
    normals = [np.cross(edge[:, 0], edge[:, 1]) for edge in edges]
    areas = [np.linalg.norm(normal, axis=1) for normal in normals]
    over = np.einsum("tx,tx->t", *normals) <= 0.0
    gram = [np.einsum("tix,tjx->tij", edge, edge) for edge in edges]
    flat = areas[0] <= 1e-12 * float(areas[0].max(initial=0.0))
    safe = np.where(flat, 1.0, areas[0])
    adjugate = gram[0][:, ::-1, ::-1] * np.array([[1.0, -1.0], [-1.0, 1.0]])
    mixed = np.einsum("tij,tji->t", adjugate, gram[1]) / safe**2  # sum of squared stretches
    product = (areas[1] / safe) ** 2
    most = 0.5 * (mixed + np.sqrt(np.maximum(mixed**2 - 4.0 * product, 0.0)))
    least = product / np.maximum(most, 1e-300)
    usual = float(areas[1].sum()) / max(float(areas[0].sum()), 1e-300)
    far = (most > usual * _DISTORTED**2) | (least < usual / _DISTORTED**2)
    distorted: Bools = over | far | flat
    return distorted


def _parting(rest: Floats, delta: Floats, bridges: Ints32) -> Bools:
    """Which triangles between lids or lips a shape makes larger."""
    areas = []
    for points in (rest, rest + delta):
        corner = points[bridges]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        areas.append(np.linalg.norm(normal, axis=1))
    larger: Bools = areas[1] > areas[0]
    return larger


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
