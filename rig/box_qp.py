"""Exact quadratic programs in a box, many at once: block principal pivoting, warm-started."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from capture.arrays import Floats, check_shape
from capture.errors import SolveError
from rig.ranges import run_ranges

_TOLERANCE = 1e-11  # of the gradient's scale: how far a sign may be wrong and count as zero
_PATIENCE = 4  # full exchanges allowed without progress before one index at a time


def solve_box_qp(
    hessians: Floats, linears: Floats, lower: Floats, upper: Floats, start: Floats
) -> Floats:
    """Minimise `x.H.x / 2 - c.x` within `lower <= x <= upper`, exactly, for a batch of problems.

    Active set by block principal pivoting: every variable is free or at a bound, the free ones
    are solved by Cholesky, all that break the Karush-Kuhn-Tucker signs are exchanged at once, and
    one at a time (Murty's rule, which ends) when that stops making progress.

    Args:
        hessians: (N, n, n) symmetric positive definite, or (1, n, n) shared by all.
        linears: (N, n).
        lower: (N, n) bounds; may be -inf.
        upper: (N, n) bounds, not below `lower`; may be inf.
        start: (N, n) any guess: which variables it puts on bounds is the warm start.

    Returns:
        (N, n), never outside the box by any amount.

    Raises:
        SolveError: when a Hessian is not positive definite.

    References:
        Portugal, Judice, Vicente 1994, A comparison of block pivoting and interior-point algorithms
        for linear least squares problems with nonnegative variables, with both bounds.
    """
    check_shape(
        hessians=(hessians, "* n n"),
        linears=(linears, "N n"),
        lower=(lower, "N n"),
        upper=(upper, "N n"),
        start=(start, "N n"),
    )
    out = np.empty(linears.shape)
    failed = np.zeros(len(linears), dtype=np.int64)
    run_ranges(
        _solve_batch,
        len(linears),
        np.ascontiguousarray(hessians, dtype=np.float64),
        np.ascontiguousarray(linears, dtype=np.float64),
        np.ascontiguousarray(lower, dtype=np.float64),
        np.ascontiguousarray(upper, dtype=np.float64),
        np.ascontiguousarray(start, dtype=np.float64),
        out,
        failed,
    )
    if failed.any():
        raise SolveError(
            f"box QP: {int((failed > 0).sum())} of {len(failed)} problems have a Hessian that is "
            f"not positive definite (two shapes that move alike, or one that moves nothing?)"
        )
    return out


def kkt_residual(
    hessian: Floats, linear: Floats, bounds: tuple[Floats, Floats], x: Floats
) -> float:
    """How far x (n,) is from optimal: `max |x - clip(x - gradient)|`, 0 at the exact minimum.

    Args:
        hessian: (n, n).
        linear: (n,).
        bounds: lower (n,) and upper (n,).
        x: (n,) the point to judge.
    """
    gradient = hessian @ x - linear
    return float(np.abs(x - np.clip(x - gradient, *bounds)).max(initial=0.0))


@numba.njit(cache=True, nogil=True)
def _solve_batch(
    begin: int, end: int, hessians: Any, linears: Any, lower: Any, upper: Any, start: Any, out: Any,
    failed: Any,
) -> None:  # fmt: skip
    scratch = box_qp_scratch(linears.shape[1])
    for i in range(begin, end):
        h = hessians[i] if hessians.shape[0] > 1 else hessians[0]
        out[i] = start[i]
        failed[i] = solve_one_box_qp(h, linears[i], lower[i], upper[i], out[i], scratch)


@numba.njit(cache=True)
def box_qp_scratch(n: int) -> Any:
    """What `solve_one_box_qp` works in, for n variables: made once a thread."""
    return np.empty((n, n)), np.empty((3, n)), np.empty((4, n), np.int64)


@numba.njit(cache=True)
def solve_one_box_qp(h: Any, c: Any, low: Any, high: Any, x: Any, scratch: Any) -> int:
    """One problem of `solve_box_qp`, for other kernels: x (n,) is the guess and then the minimum.

    Args:
        h: (n, n).
        c: (n,).
        low: (n,).
        high: (n,).
        x: (n,) read and written.
        scratch: from `box_qp_scratch(n)`.

    Returns:
        0, or 1 when h is not positive definite on the free variables.
    """
    n = c.shape[0]
    factor, vectors, lists = scratch
    wrong, state, free, listed = lists[0], lists[1], lists[2], lists[3]
    size = _first_free(low, high, x, state, free, listed, vectors[0])
    kept = 0
    best = n + 1
    patience = _PATIENCE
    for _ in range(200 * n + 200):
        if not _solve_free(h, c, x, state, free[:size], kept, factor, vectors):
            return 1
        count = _find_wrong(h, c, low, high, state, x, vectors[1], wrong)
        if count == 0:
            break
        block = True
        if count < best:
            best = count
            patience = _PATIENCE
        elif patience > 0:
            patience -= 1
        else:
            block = False
        _exchange(state, wrong, x, low, high, block)
        size, kept = _update_free(state, free, listed, size)
    for k in range(n):
        x[k] = min(max(x[k], low[k]), high[k])
    return 0


@numba.njit(cache=True)
def _first_free(
    low: Any, high: Any, x: Any, state: Any, free: Any, listed: Any, margin: Any
) -> int:
    """Each variable's state by the guess, x put on its bound; the list of free ones, its length.

    States: -1 at the lower bound, 1 at the upper, 0 free. Those far from a bound come first: they
    are likely to stay, and a factor is kept up to the first variable that leaves.
    """
    n = x.shape[0]
    for k in range(n):
        state[k] = 0
        if low[k] == high[k] or x[k] <= low[k]:
            state[k] = -1
            x[k] = low[k]
        elif x[k] >= high[k]:
            state[k] = 1
            x[k] = high[k]
        listed[k] = 0
    size = 0
    for k in range(n):
        if state[k] == 0:
            margin[k] = min(x[k] - low[k], high[k] - x[k])
            listed[k] = 1
            place = size
            while place > 0 and margin[free[place - 1]] < margin[k]:
                free[place] = free[place - 1]
                place -= 1
            free[place] = k
            size += 1
    return size


@numba.njit(cache=True)
def _update_free(state: Any, free: Any, listed: Any, size: int) -> tuple[int, int]:
    """Drop what is no longer free, append what is: the list's length, and how much is unchanged."""
    kept = size
    after = 0
    for i in range(size):
        k = free[i]
        if state[k] == 0:
            free[after] = k
            after += 1
        else:
            listed[k] = 0
            kept = min(kept, i)
    for k in range(state.shape[0]):
        if state[k] == 0 and listed[k] == 0:
            free[after] = k
            listed[k] = 1
            after += 1
    return after, kept


@numba.njit(cache=True)
def _solve_free(
    h: Any, c: Any, x: Any, state: Any, free: Any, kept: int, factor: Any, vectors: Any
) -> bool:
    """Solve the free variables, the others at their bounds in x; False when H is not positive.

    The factor's first `kept` rows and columns are those of the call before.
    """
    n, m = c.shape[0], free.shape[0]
    right, row = vectors[0], vectors[1]
    for k in range(n):
        row[k] = c[k]
    for k in range(n):
        if state[k] != 0 and x[k] != 0.0:
            for j in range(n):
                row[j] -= h[k, j] * x[k]
    for i in range(m):
        right[i] = row[free[i]]
        line = h[free[i]]
        for j in range(numba.uintp(max(i, kept)), numba.uintp(m)):
            factor[i, j] = line[numba.uintp(free[j])]
    if not factor_upper(factor, m, row, kept):
        return False
    for i in range(m):
        right[i] /= factor[i, i]
        for j in range(numba.uintp(i + 1), numba.uintp(m)):
            right[j] -= factor[i, j] * right[i]
    for i in range(m - 1, -1, -1):
        sums = (0.0, 0.0)
        k = i + 1
        if (m - k) % 2 == 1:
            sums = (factor[i, k] * right[k], 0.0)
            k += 1
        while k < m:
            sums = (sums[0] + factor[i, k] * right[k], sums[1] + factor[i, k + 1] * right[k + 1])
            k += 2
        right[i] = (right[i] - (sums[0] + sums[1])) / factor[i, i]
        x[free[i]] = right[i]
    return True


@numba.njit(cache=True)
def factor_upper(matrix: Any, size: int, row: Any, kept: int) -> bool:
    """Cholesky in place, H = U^T U, of the upper triangle of the first `size` rows and columns.

    Row by row and without sums along a row, so that it vectorises in a fixed order (over unsigned
    indices: numba leaves loops from a signed beginning scalar). The first `kept` rows and columns
    hold the factor already. `row` is scratch. False when the matrix is not positive definite.
    """
    end = numba.uintp(size)
    for i in range(size):
        begin = numba.uintp(max(i, kept))
        for j in range(begin, end):
            row[j] = matrix[i, j]
        k = 0
        while k + 4 <= i:
            f0, f1, f2, f3 = matrix[k, i], matrix[k + 1, i], matrix[k + 2, i], matrix[k + 3, i]
            for j in range(begin, end):
                row[j] = (
                    ((row[j] - matrix[k, j] * f0) - matrix[k + 1, j] * f1) - matrix[k + 2, j] * f2
                ) - matrix[k + 3, j] * f3
            k += 4
        while k < i:
            f0 = matrix[k, i]
            for j in range(begin, end):
                row[j] -= matrix[k, j] * f0
            k += 1
        root = matrix[i, i]
        if i >= kept:
            if not row[i] > 1e-15 * root:
                return False
            root = np.sqrt(row[i])
        for j in range(begin, end):
            matrix[i, j] = row[j] / root
    return True


@numba.njit(cache=True)
def _find_wrong(
    h: Any, c: Any, low: Any, high: Any, state: Any, x: Any, gradient: Any, wrong: Any
) -> int:
    """Mark the variables whose sign conditions fail; how many there are."""
    n = c.shape[0]
    for k in range(n):
        gradient[k] = -c[k]
    for j in range(n):
        value = x[j]
        if value != 0.0:
            for k in range(n):
                gradient[k] += h[j, k] * value
    count = 0
    for k in range(n):
        wrong[k] = 0
        if state[k] == 0:
            margin = _TOLERANCE * (1.0 + abs(x[k]))
            if x[k] < low[k] - margin or x[k] > high[k] + margin:
                wrong[k] = 1
        elif low[k] < high[k]:
            away = gradient[k] if state[k] > 0 else -gradient[k]
            if away > 0.0:
                scale = abs(c[k])
                for j in range(n):
                    scale += abs(h[k, j] * x[j])
                if away > _TOLERANCE * scale:
                    wrong[k] = 1
        count += wrong[k]
    return count


@numba.njit(cache=True)
def _exchange(state: Any, wrong: Any, x: Any, low: Any, high: Any, block: bool) -> None:
    """Move wrong variables between free and bound: all of them, or the last alone."""
    for k in range(state.shape[0] - 1, -1, -1):
        if wrong[k] != 0:
            if state[k] != 0:
                state[k] = 0
            elif x[k] < low[k]:
                state[k] = -1
                x[k] = low[k]
            else:
                state[k] = 1
                x[k] = high[k]
            if not block:
                return
