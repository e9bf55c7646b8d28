"""Preconditioned conjugate gradients for the blendshape update, x, y and z together."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from capture.arrays import Floats
from capture.errors import SolveError
from rig.ranges import run_ranges
from rig.update_system import UpdatePriors, UpdateSystem


def solve_iterative(system: UpdateSystem, start: Floats, priors: UpdatePriors) -> Floats:
    """Conjugate gradients on the active system, preconditioned by each vertex's block: (N, 3).

    A step is three passes over the vertices. Sums over all unknowns are kept vertex by vertex and
    added up in one order, so that the result does not depend on how vertices are shared out.

    Args:
        system: the normal equations.
        start: (N, 3) departure from the targets to start from, mm.
        priors: tolerance and most steps.

    Raises:
        SolveError: when the relative residual stays above `priors.tolerance`.
    """
    count, lap = len(system.starts) - 1, system.laplacian
    matrix = (system.starts, system.columns, system.block_starts, system.blocks)
    mesh = (lap.indptr, lap.indices, lap.data, system.position.shape[1])
    inverse = invert_blocks(system)
    solved = np.array(start, dtype=np.float64)
    step, product, direction = (np.zeros_like(solved) for _ in range(3))
    energies, squares = np.empty((count, 3)), np.empty((count, 3))
    run_ranges(_multiply, count, *matrix, *mesh, solved, product, energies)
    residual = system.right - product
    goal = priors.tolerance * np.maximum(np.sqrt((system.right**2).sum(axis=0)), 1e-300)
    state = (direction, product, solved, residual, step, energies, squares)
    length, energy = np.zeros(3), np.zeros(3)
    for _ in range(priors.iterations + 1):
        run_ranges(_advance, count, *matrix[:1], *matrix[2:3], inverse, length, *state)
        size = np.sqrt(squares.sum(axis=0))
        if (size <= goal).all():
            return solved
        renewed = energies.sum(axis=0)
        ratio, energy = _quotient(renewed, energy), renewed
        run_ranges(_turn, count, system.starts, ratio, step, direction)
        run_ranges(_multiply, count, *matrix, *mesh, direction, product, energies)
        length = _quotient(energy, energies.sum(axis=0))
    reached = float((size / goal).max() * priors.tolerance)
    raise SolveError(
        f"blendshape update: relative residual {reached:.2g} after {priors.iterations} iterations, "
        f"asked for {priors.tolerance:.2g}; raise the offset strength or the tolerance"
    )


def invert_blocks(system: UpdateSystem) -> Floats:
    """The inverse of each vertex's block with its Laplacian diagonal added, laid out like them."""
    inverse = np.empty_like(system.blocks)
    ranges = (system.starts, system.block_starts)
    diagonal = system.laplacian.diagonal()
    run_ranges(_invert, len(diagonal), *ranges, system.blocks, diagonal, inverse)
    return inverse


def _quotient(a: Floats, b: Floats) -> Floats:
    """`a / b` where b is positive, else 0: a coordinate that is solved, or was never asked for."""
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0.0)


@numba.njit(cache=True, nogil=True)
def _invert(
    begin: int, end: int, starts: Any, block_starts: Any, blocks: Any, diagonal: Any, inverse: Any
) -> None:
    """Invert by Gauss-Jordan without pivoting: the blocks are symmetric positive definite."""
    for v in range(begin, end):
        n = starts[v + 1] - starts[v]
        base = block_starts[v]
        a = blocks[base : base + n * n].copy().reshape(n, n)
        for i in range(n):
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
def _multiply(
    begin: int, end: int, starts: Any, columns: Any, block_starts: Any, blocks: Any,
    indptr: Any, indices: Any, data: Any, width: int, x: Any, out: Any, energies: Any,
) -> None:  # fmt: skip
    """Matrix times x: the Laplacian gathers a vertex's neighbours, then its own block is added.

    Also each vertex's share of x . out. The innermost loops run over consecutive numbers, one row
    of a block (it is symmetric), so that they become vector instructions.
    """
    near, own = np.empty((width, 3)), np.empty((3, width))
    for v in range(begin, end):
        first = starts[v]
        n = starts[v + 1] - first
        near[:] = 0.0
        for e in range(indptr[v], indptr[v + 1]):
            u, strength = indices[e], data[e]
            for at in range(starts[u], starts[u + 1]):
                k = columns[at]
                near[k, 0] += strength * x[at, 0]
                near[k, 1] += strength * x[at, 1]
                near[k, 2] += strength * x[at, 2]
        for i in range(n):
            for c in range(3):
                own[c, i] = near[columns[first + i], c]
        for j in range(n):
            x0, x1, x2 = x[first + j, 0], x[first + j, 1], x[first + j, 2]
            row = block_starts[v] + j * n
            for i in range(n):
                value = blocks[row + i]
                own[0, i] += value * x0
                own[1, i] += value * x1
                own[2, i] += value * x2
        for c in range(3):
            total = 0.0
            for i in range(n):
                out[first + i, c] = own[c, i]
                total += own[c, i] * x[first + i, c]
            energies[v, c] = total


@numba.njit(cache=True, nogil=True)
def _advance(
    begin: int, end: int, starts: Any, block_starts: Any, inverse: Any, length: Any,
    direction: Any, product: Any, solved: Any, residual: Any, step: Any, energies: Any,
    squares: Any,
) -> None:  # fmt: skip
    """Go `length` along the direction, then precondition what is left of the residual.

    Also each vertex's share of residual . step and of residual . residual.
    """
    widest = 0
    for v in range(begin, end):
        widest = max(widest, starts[v + 1] - starts[v])
    own = np.empty((3, widest))
    for v in range(begin, end):
        first = starts[v]
        n = starts[v + 1] - first
        own[:, :n] = 0.0
        for j in range(n):
            at, row = first + j, block_starts[v] + j * n
            for c in range(3):
                solved[at, c] += length[c] * direction[at, c]
                residual[at, c] -= length[c] * product[at, c]
            r0, r1, r2 = residual[at, 0], residual[at, 1], residual[at, 2]
            for i in range(n):
                value = inverse[row + i]
                own[0, i] += value * r0
                own[1, i] += value * r1
                own[2, i] += value * r2
        for c in range(3):
            energy, square = 0.0, 0.0
            for i in range(n):
                step[first + i, c] = own[c, i]
                energy += own[c, i] * residual[first + i, c]
                square += residual[first + i, c] * residual[first + i, c]
            energies[v, c] = energy
            squares[v, c] = square


@numba.njit(cache=True, nogil=True)
def _turn(begin: int, end: int, starts: Any, ratio: Any, step: Any, direction: Any) -> None:
    """The next direction: the preconditioned residual and `ratio` of the last direction."""
    for at in range(starts[begin], starts[end]):
        for c in range(3):
            direction[at, c] = step[at, c] + ratio[c] * direction[at, c]
