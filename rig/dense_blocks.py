"""Many small systems that share their pose weights, one at each vertex or triangle."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from capture.arrays import Floats, check_shape
from rig.ranges import run_ranges

_CHUNK = 4096  # items whose matrices are held at a time


def pose_grams(weights: Floats, square: Floats) -> Floats:
    """Lower triangles, row by row, of `sum_f square[n, f] w_f w_f^T`, all by one matrix product.

    Args:
        weights: (F, B).
        square: (N, F) squared confidences of N items.

    Returns:
        (N, B (B + 1) / 2); a single row where all items have the same confidences.
    """
    check_shape(weights=(weights, "F B"), square=(square, "N F"))
    if len(square) and (square == square[:1]).all():
        square = square[:1]
    row, column = np.tril_indices(weights.shape[1])
    grams: Floats = square @ (weights[:, row] * weights[:, column])
    return grams


def solve_blocks(weights: Floats, square: Floats, stiffness: Floats, right: Floats) -> Floats:
    """Solve `(sum_f square[n, f] w_f w_f^T + diag(stiffness[n])) x = right[n]` at every item n.

    Args:
        weights: (F, B).
        square: (N, F) squared confidences.
        stiffness: (N, B) >= 0; infinity holds an unknown at 0, exactly.
        right: (N, B, R).

    Returns:
        (N, B, R); 0 for unknowns that nothing determines.
    """
    check_shape(
        weights=(weights, "F B"), square=(square, "N F"),
        stiffness=(stiffness, "N B"), right=(right, "N B R"),
    )  # fmt: skip
    solved = np.zeros(right.shape)
    uniform = bool(len(square)) and bool((square == square[:1]).all())
    shared = pose_grams(weights, square[:1]) if uniform else None
    for begin in range(0, len(right), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        gram = pose_grams(weights, square[part]) if shared is None else shared
        arrays = (gram, stiffness[part], np.ascontiguousarray(right[part]), solved[part])
        run_ranges(_solve, len(solved[part]), *arrays)
    return solved


@numba.njit(cache=True, nogil=True)
def _solve(begin: int, end: int, gram: Any, stiffness: Any, right: Any, out: Any) -> None:
    """Cholesky (upper factor, row operations only) on the unknowns that are not held."""
    size, sides = right.shape[1], right.shape[2]
    matrix = np.empty((size, size))
    side = np.empty((size, sides))
    active = np.empty(size, dtype=np.int64)
    for n in range(begin, end):
        own = n if gram.shape[0] > 1 else 0
        count = 0
        for k in range(size):
            if stiffness[n, k] < np.inf:
                active[count] = k
                count += 1
        for i in range(count):
            a = active[i]
            for j in range(i, count):
                b = active[j]  # b >= a
                matrix[i, j] = gram[own, b * (b + 1) // 2 + a]
            matrix[i, i] += stiffness[n, a]
            for s in range(sides):
                side[i, s] = right[n, a, s]
        _eliminate(matrix, side, count)
        for i in range(count):
            for s in range(sides):
                out[n, active[i], s] = side[i, s]


@numba.njit(cache=True, nogil=True)
def _eliminate(matrix: Any, side: Any, count: int) -> None:
    """Solve in place: the upper triangle of `matrix` becomes its factor, `side` the solution."""
    sides = side.shape[1]
    least = np.empty(count)
    for k in range(count):
        least[k] = 1e-14 * matrix[k, k]
    for k in range(count):
        pivot = matrix[k, k]
        scale = 1.0 / np.sqrt(pivot) if pivot > least[k] else 0.0  # 0: nothing determines it
        for j in range(k, count):
            matrix[k, j] *= scale
        for s in range(sides):
            side[k, s] *= scale
        for i in range(k + 1, count):
            factor = matrix[k, i]
            if factor != 0.0:
                for j in range(i, count):
                    matrix[i, j] -= factor * matrix[k, j]
                for s in range(sides):
                    side[i, s] -= factor * side[k, s]
    for k in range(count - 1, -1, -1):
        scale = 1.0 / matrix[k, k] if matrix[k, k] > 0.0 else 0.0
        for j in range(k + 1, count):
            factor = matrix[k, j]
            for s in range(sides):
                side[k, s] -= factor * side[j, s]
        for s in range(sides):
            side[k, s] *= scale
