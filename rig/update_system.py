"""The normal equations of the blendshape update: priors, unknowns, blocks, right-hand side."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
from scipy import sparse

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape
from capture.errors import SolveError
from rig.evidence import Evidence
from rig.gradient import gradient_operator
from rig.ranges import run_ranges

_STILL = 0.02  # of a shape's extent: smaller displacements count as this much
_CHUNK_NUMBERS = 4_000_000  # of residuals held at once while right-hand sides are summed


@dataclass(frozen=True, kw_only=True)
class UpdatePriors:
    """How far shapes may move from their targets.

    Attributes:
        gradient_mm2: lambda_r, the strength of E_r = |G (D - D*)|^2. Gradients are integrated over
            the mesh and divided by the mean area of a vertex, so the strength is in mm^2 and does
            not depend on how finely the face is meshed: sqrt(gradient / offset) is the distance,
            in mm, over which corrections are smoothed.
        offset: lambda_d, the strength of E_d = |D - D*|^2 (1: one sure observation at weight 1).
        relative_mm2: added to it at each vertex of each shape, divided by the squared displacement
            that the target has there: what hardly moves on the template hardly changes.
        neutral_offset: the same for the neutral's column.
        tolerance: relative residual at which iterating ends.
        iterations: most steps of the iterative solver.
        extra_offset: (B, V) >= 0, added to the strength of E_d too (a soft mask), or None.
    """

    gradient_mm2: float = 10.0
    offset: float = 0.05
    relative_mm2: float = 0.3
    neutral_offset: float = 0.05
    tolerance: float = 1e-5
    iterations: int = 2000
    extra_offset: Floats | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, eq=False)
class UpdateSystem:
    """The normal equations of Ma et al. Eq 7 on the active unknowns, vertex by vertex.

    Unknown n is column `columns[n]` (0 the neutral, k + 1 shape k) of the vertex whose range
    `starts[v]:starts[v + 1]` holds it; x, y and z share the matrix.

    Attributes:
        starts: (V + 1,) ranges of unknowns.
        columns: (N,) column of each unknown, ascending within a vertex.
        position: (V, B + 1) number of each unknown, -1 where the mask holds it at zero.
        block_starts: (V + 1,) where each vertex's dense block begins in `blocks`.
        blocks: the dense blocks, row by row: data and offset terms.
        laplacian: (V, V) already scaled by the gradient strength, columns ascending.
        stiffness: (N,) the offset terms alone, a part of the blocks' diagonals.
        right: (N, 3) right-hand side for the departure from the targets.
    """

    starts: Ints
    columns: Ints
    position: Ints
    block_starts: Ints
    blocks: Floats
    laplacian: sparse.csr_array
    stiffness: Floats
    right: Floats


def assemble(
    neutral: Floats,
    triangles: Ints32,
    targets: Floats,
    support: Bools,
    evidence: Evidence,
    priors: UpdatePriors,
) -> UpdateSystem:
    """Build the normal equations for the departure of neutral and shapes from their targets.

    Where a vertex has one confidence in every frame its block is cut out of a Gram matrix that all
    such vertices share; elsewhere the frames are summed for that vertex, with its own confidence.

    Args:
        neutral: (V, 3) current neutral, mm.
        triangles: (T, 3).
        targets: (B, V, 3) D*, mm; zero outside the support.
        support: (B, V) where each shape may move; the neutral's column is exempt.
        evidence: the frames.
        priors: strengths.

    Raises:
        SolveError: when the mesh has no area.
    """
    check_shape(neutral=(neutral, "V 3"), targets=(targets, "B V 3"), support=(support, "B V"))
    active = np.concatenate([np.ones((1, len(neutral)), dtype=bool), support]).T
    counts = active.sum(axis=1)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    columns = np.nonzero(active)[1].astype(np.int64)
    position = np.full(active.shape, -1, dtype=np.int64)
    position[active] = np.arange(len(columns))
    block_starts = np.concatenate([[0], np.cumsum(counts**2)]).astype(np.int64)
    blocks = np.empty(int(block_starts[-1]))
    factors = np.ascontiguousarray(evidence.factors, dtype=np.float64)
    square = np.asarray(evidence.confidence, dtype=np.float64) ** 2
    even = (square == square[:1]).all(axis=0)
    stiffness = offset_stiffness(targets, priors)[active]
    run_ranges(
        _fill_blocks, len(counts), starts, columns, block_starts, np.ascontiguousarray(square.T),
        even, factors, factors.T @ factors, stiffness, blocks,
    )  # fmt: skip
    return UpdateSystem(
        starts=starts,
        columns=columns,
        position=position,
        block_starts=block_starts,
        blocks=blocks,
        laplacian=_smoothing(neutral, triangles, priors.gradient_mm2),
        stiffness=stiffness,
        right=_right_side(targets, active, evidence, square),
    )


def offset_stiffness(targets: Floats, priors: UpdatePriors) -> Floats:
    """Strength (V, B + 1) of E_d at each vertex of the neutral (0) and of each target (B, V, 3)."""
    square = (targets**2).sum(axis=2).T
    floor = (_STILL * np.sqrt(square.max(axis=0, initial=0.0))) ** 2 + 1e-12
    shapes = priors.offset + priors.relative_mm2 / np.maximum(square, floor)
    if priors.extra_offset is not None:
        check_shape(targets=(targets, "B V 3"), extra_offset=(priors.extra_offset, "B V"))
        shapes = shapes + priors.extra_offset.T
    return np.concatenate([np.full((len(square), 1), priors.neutral_offset), shapes], axis=1)


def mean_vertex_area(vertices: Floats, triangles: Ints32) -> float:
    """Area of the mesh divided by its vertex count, mm^2."""
    corner = vertices[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return float(np.linalg.norm(normal, axis=1).sum() / 2.0 / len(vertices))


def _smoothing(neutral: Floats, triangles: Ints32, gradient_mm2: float) -> sparse.csr_array:
    """`G.T @ G`, scaled so that the strength does not depend on the mesh."""
    area = mean_vertex_area(neutral, triangles)
    if not (np.isfinite(area) and area > 0.0):
        raise SolveError("blendshape update: every triangle of the neutral has zero area")
    operator = gradient_operator(neutral, triangles)
    laplacian = sparse.csr_array((operator.T @ operator) * (gradient_mm2 / area))
    laplacian.sort_indices()
    return laplacian


def _right_side(targets: Floats, active: Bools, evidence: Evidence, square: Floats) -> Floats:
    """Sum over frames of squared confidence, factor and residual, at the active unknowns: (N, 3).

    One matrix product for a run of vertices at a time, so that memory stays bounded.
    """
    frames, vertices = square.shape
    right = np.empty((int(active.sum()), 3))
    step = max(1, _CHUNK_NUMBERS // max(3 * frames, 1))
    done = 0
    for begin in range(0, vertices, step):
        part = slice(begin, min(begin + step, vertices))
        residual = evidence.offsets[:, part] - np.tensordot(
            evidence.weights, targets[:, part], axes=1
        )
        residual *= square[:, part, None]
        summed = evidence.factors.T @ residual.reshape(frames, 3 * residual.shape[1])
        picked = summed.reshape(active.shape[1], -1, 3).transpose(1, 0, 2)[active[part]]
        right[done : done + len(picked)] = picked
        done += len(picked)
    return right


@numba.njit(cache=True, nogil=True)
def _fill_blocks(
    begin: int, end: int, starts: Any, columns: Any, block_starts: Any, square: Any, even: Any,
    factors: Any, gram: Any, stiffness: Any, blocks: Any,
) -> None:  # fmt: skip
    """Per vertex: sum_f m^2 w w^T + stiffness. Frames that show nothing of a shape cost nothing."""
    frames = factors.shape[0]
    packed = np.empty(factors.shape[1])
    for v in range(begin, end):
        first, base = starts[v], block_starts[v]
        n = starts[v + 1] - first
        if even[v]:
            share = square[v, 0] if frames > 0 else 0.0
            for i in range(n):
                for j in range(i + 1):
                    blocks[base + i * n + j] = share * gram[columns[first + i], columns[first + j]]
        else:
            blocks[base : base + n * n] = 0.0
            for f in range(frames):
                if square[v, f] == 0.0:
                    continue
                for i in range(n):
                    packed[i] = factors[f, columns[first + i]]
                for i in range(n):
                    if packed[i] != 0.0:
                        scaled, row = square[v, f] * packed[i], base + i * n
                        for j in range(i + 1):
                            blocks[row + j] += scaled * packed[j]
        for i in range(n):
            blocks[base + i * n + i] += stiffness[first + i]
            for j in range(i):
                blocks[base + j * n + i] = blocks[base + i * n + j]
