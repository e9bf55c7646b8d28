"""The blendshape update: neutral and shapes from frames whose weights and head motion are known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from scipy import sparse

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape
from capture.errors import SolveError
from rig.evidence import Evidence
from rig.gradient import gradient_operator
from rig.ranges import run_ranges
from rig.transfer import factorised

_STILL = 0.02  # of a shape's extent: smaller displacements count as this much
_DIRECT_UNKNOWNS = 12_000  # up to here one sparse factorisation is faster than iterating


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
    """

    gradient_mm2: float = 1.0
    offset: float = 0.05
    relative_mm2: float = 0.3
    neutral_offset: float = 0.05
    tolerance: float = 1e-5
    iterations: int = 2000


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
        laplacian: (V, V) already scaled by the gradient strength.
        right: (N, 3) right-hand side for the departure from the targets.
    """

    starts: Ints
    columns: Ints
    position: Ints
    block_starts: Ints
    blocks: Floats
    laplacian: sparse.csr_array
    right: Floats


def update_shapes(
    neutral: Floats,
    triangles: Ints32,
    targets: Floats,
    support: Bools,
    evidence: Evidence,
    priors: UpdatePriors,
    start: Floats | None = None,
) -> tuple[Floats, Floats]:
    """Solve Ma et al. Eq 7 with the neutral column: new neutral and shapes, x, y, z at once.

    Args:
        neutral: (V, 3) current neutral, mm.
        triangles: (T, 3).
        targets: (B, V, 3) D*, the transferred shapes, mm; zero outside the support.
        support: (B, V) where each shape may move; the neutral's column is exempt.
        evidence: the frames.
        priors: strengths.
        start: (B, V, 3) shapes to start iterating from, mm; the targets when None.

    Returns:
        neutral (V, 3) and shapes (B, V, 3), mm, in the rig space of the input.

    Raises:
        SolveError: when the iteration does not reach its tolerance.

    References:
        Ma et al. 2016, section 3.2, Eqs 5-7 and "Neutral Vertex Positions".
    """
    check_shape(
        neutral=(neutral, "V 3"), targets=(targets, "B V 3"), support=(support, "B V"),
        offsets=(evidence.offsets, "F V 3"), confidence=(evidence.confidence, "F V"),
        weights=(evidence.weights, "F B"),
    )  # fmt: skip
    targets = np.where(support[:, :, None], targets, 0.0)
    system = assemble(neutral, triangles, targets, support, evidence, priors)
    if len(system.columns) <= _DIRECT_UNKNOWNS:
        change = solve_direct(system)
    else:
        guess = np.zeros((len(neutral), len(targets) + 1, 3))
        if start is not None:
            guess[:, 1:] = (start - targets).transpose(1, 0, 2)
        change = solve_iterative(system, guess[system.position >= 0], priors)
    full = np.zeros((len(neutral), len(targets) + 1, 3))
    full[system.position >= 0] = change
    moved = full.transpose(1, 0, 2)
    return neutral + moved[0], targets + moved[1:]


def assemble(
    neutral: Floats,
    triangles: Ints32,
    targets: Floats,
    support: Bools,
    evidence: Evidence,
    priors: UpdatePriors,
) -> UpdateSystem:
    """Build the normal equations for the departure of neutral and shapes from their targets.

    Arguments as of `update_shapes`.
    """
    operator = gradient_operator(neutral, triangles)
    area = float((operator.multiply(operator)).sum())  # only its being finite and > 0 matters here
    if not area > 0.0:
        raise SolveError("blendshape update: every triangle of the neutral has zero area")
    vertex_area = mean_vertex_area(neutral, triangles)
    laplacian = sparse.csr_array((operator.T @ operator) * (priors.gradient_mm2 / vertex_area))
    laplacian.sort_indices()
    active = np.concatenate([np.ones((1, len(neutral)), dtype=bool), support]).T
    counts = active.sum(axis=1)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    columns = np.nonzero(active)[1].astype(np.int64)
    position = np.full(active.shape, -1, dtype=np.int64)
    position[active] = np.arange(len(columns))
    block_starts = np.concatenate([[0], np.cumsum(counts**2)]).astype(np.int64)
    factors = evidence.factors
    residual = evidence.offsets - np.tensordot(evidence.weights, targets, axes=1)
    stiffness = offset_stiffness(targets, priors)[active]
    square = np.asarray(evidence.confidence, dtype=np.float64) ** 2
    blocks = np.empty(int(block_starts[-1]))
    right = np.empty((len(columns), 3))
    residual = np.ascontiguousarray(residual.transpose(1, 0, 2))
    arrays = (starts, columns, block_starts, square.T.copy(), factors, residual, stiffness)
    run_ranges(_fill, len(counts), *arrays, blocks, right)
    return UpdateSystem(starts, columns, position, block_starts, blocks, laplacian, right)


def offset_stiffness(targets: Floats, priors: UpdatePriors) -> Floats:
    """Strength (V, B + 1) of E_d at each vertex of the neutral (0) and of each target (B, V, 3)."""
    square = (targets**2).sum(axis=2).T
    floor = (_STILL * np.sqrt(square.max(axis=0, initial=0.0))) ** 2 + 1e-12
    shapes = priors.offset + priors.relative_mm2 / np.maximum(square, floor)
    return np.concatenate([np.full((len(square), 1), priors.neutral_offset), shapes], axis=1)


def mean_vertex_area(vertices: Floats, triangles: Ints32) -> float:
    """Area of the mesh divided by its vertex count, mm^2."""
    corner = vertices[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return float(np.linalg.norm(normal, axis=1).sum() / 2.0 / len(vertices))


def solve_direct(system: UpdateSystem) -> Floats:
    """Factorise the active system once and solve x, y and z with it: (N, 3)."""
    counts = np.diff(system.starts)
    owner = np.repeat(np.arange(len(counts)), counts)
    rows = np.repeat(np.arange(len(system.columns)), counts[owner])
    within = np.arange(len(rows)) - np.repeat(system.block_starts[:-1], counts**2)
    cols = np.repeat(system.starts[:-1], counts**2) + within % np.repeat(counts, counts**2)
    coupling = system.laplacian.tocoo()
    pair = system.position[coupling.row], system.position[coupling.col]
    both = (pair[0] >= 0) & (pair[1] >= 0)
    data = np.broadcast_to(coupling.data[:, None], both.shape)[both]
    matrix = sparse.coo_array(
        (
            np.concatenate([system.blocks, data]),
            (np.concatenate([rows, pair[0][both]]), np.concatenate([cols, pair[1][both]])),
        ),
        shape=(len(system.columns),) * 2,
    )
    solved: Floats = factorised(matrix).solve(system.right)
    return solved


def solve_iterative(system: UpdateSystem, start: Floats, priors: UpdatePriors) -> Floats:
    """Conjugate gradients on the active system, preconditioned by each vertex's block: (N, 3).

    Raises:
        SolveError: when the relative residual stays above `priors.tolerance`.
    """
    lap, count = system.laplacian, len(system.starts) - 1
    inverse = np.empty_like(system.blocks)
    run_ranges(
        _invert, count, system.starts, system.block_starts, system.blocks, lap.diagonal(), inverse
    )
    matrix = (system.starts, system.columns, system.block_starts, system.blocks)
    mesh = (system.position, lap.indptr, lap.indices, lap.data)
    solved = np.array(start, dtype=np.float64)
    product = np.empty_like(solved)
    run_ranges(_multiply, count, *matrix, *mesh, solved, product)
    residual = system.right - product
    goal = priors.tolerance * np.maximum(np.sqrt((system.right**2).sum(axis=0)), 1e-300)
    step = np.empty_like(residual)
    run_ranges(_multiply_blocks, count, system.starts, system.block_starts, inverse, residual, step)
    direction = step.copy()
    energy = (residual * step).sum(axis=0)
    for _ in range(priors.iterations):
        if (np.sqrt((residual**2).sum(axis=0)) <= goal).all():
            return solved
        run_ranges(_multiply, count, *matrix, *mesh, direction, product)
        curvature = (direction * product).sum(axis=0)
        length = np.where(curvature > 0.0, energy / np.where(curvature > 0.0, curvature, 1.0), 0.0)
        solved += length * direction
        residual -= length * product
        run_ranges(
            _multiply_blocks, count, system.starts, system.block_starts, inverse, residual, step
        )
        renewed = (residual * step).sum(axis=0)
        direction *= np.where(energy > 0.0, renewed / np.where(energy > 0.0, energy, 1.0), 0.0)
        direction += step
        energy = renewed
    reached = float((np.sqrt((residual**2).sum(axis=0)) / goal).max() * priors.tolerance)
    raise SolveError(
        f"blendshape update: relative residual {reached:.2g} after {priors.iterations} iterations, "
        f"asked for {priors.tolerance:.2g}; raise the offset strength or the tolerance"
    )


@numba.njit(cache=True, nogil=True)
def _fill(
    begin: int, end: int, starts: Any, columns: Any, block_starts: Any, square: Any, factors: Any,
    residual: Any, stiffness: Any, blocks: Any, right: Any,
) -> None:  # fmt: skip
    """Per vertex: sum_f m^2 w w^T + stiffness, and sum_f m^2 w residual."""
    frames = factors.shape[0]
    for v in range(begin, end):
        n = starts[v + 1] - starts[v]
        base = block_starts[v]
        for i in range(n):
            a = columns[starts[v] + i]
            for j in range(i + 1):
                b = columns[starts[v] + j]
                total = stiffness[starts[v] + i] if i == j else 0.0
                for f in range(frames):
                    total += square[v, f] * factors[f, a] * factors[f, b]
                blocks[base + i * n + j] = total
                blocks[base + j * n + i] = total
            for c in range(3):
                total = 0.0
                for f in range(frames):
                    total += square[v, f] * factors[f, a] * residual[v, f, c]
                right[starts[v] + i, c] = total


@numba.njit(cache=True, nogil=True)
def _invert(
    begin: int, end: int, starts: Any, block_starts: Any, blocks: Any, diagonal: Any, inverse: Any
) -> None:
    """Invert each vertex's block, its Laplacian diagonal added, by Gauss-Jordan (it is SPD)."""
    for v in range(begin, end):
        n = starts[v + 1] - starts[v]
        base = block_starts[v]
        a = np.empty((n, n))
        for i in range(n):
            for j in range(n):
                a[i, j] = blocks[base + i * n + j]
            a[i, i] += diagonal[v]
        for p in range(n):
            pivot = 1.0 / a[p, p]
            a[p, p] = 1.0
            for j in range(n):
                a[p, j] *= pivot
            for i in range(n):
                if i != p:
                    factor = a[i, p]
                    a[i, p] = 0.0
                    for j in range(n):
                        a[i, j] -= factor * a[p, j]
        for i in range(n):
            for j in range(n):
                inverse[base + i * n + j] = 0.5 * (a[i, j] + a[j, i])


@numba.njit(cache=True, nogil=True)
def _multiply_blocks(
    begin: int, end: int, starts: Any, block_starts: Any, blocks: Any, x: Any, out: Any
) -> None:
    """Multiply the coordinates of each vertex's shapes by the vertex's own block."""
    for v in range(begin, end):
        first = starts[v]
        n = starts[v + 1] - first
        base = block_starts[v]
        for i in range(n):
            sx, sy, sz = 0.0, 0.0, 0.0
            for j in range(n):
                value = blocks[base + i * n + j]
                sx += value * x[first + j, 0]
                sy += value * x[first + j, 1]
                sz += value * x[first + j, 2]
            out[first + i, 0], out[first + i, 1], out[first + i, 2] = sx, sy, sz


@numba.njit(cache=True, nogil=True)
def _multiply(
    begin: int, end: int, starts: Any, columns: Any, block_starts: Any, blocks: Any,
    position: Any, indptr: Any, indices: Any, data: Any, x: Any, out: Any,
) -> None:  # fmt: skip
    """The same, and what the Laplacian couples each shape of a vertex to at its neighbours."""
    _multiply_blocks(begin, end, starts, block_starts, blocks, x, out)
    for v in range(begin, end):
        for own in range(starts[v], starts[v + 1]):
            sx, sy, sz = out[own, 0], out[own, 1], out[own, 2]
            k = columns[own]
            for e in range(indptr[v], indptr[v + 1]):
                at = position[indices[e], k]
                if at >= 0:
                    sx += data[e] * x[at, 0]
                    sy += data[e] * x[at, 1]
                    sz += data[e] * x[at, 2]
            out[own, 0], out[own, 1], out[own, 2] = sx, sy, sz
