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
    for i in range(begin, end):
        h = hessians[i] if hessians.shape[0] > 1 else hessians[0]
        failed[i] = _solve_one(h, linears[i], lower[i], upper[i], start[i], out[i])


@numba.njit(cache=True)
def _solve_one(h: Any, c: Any, low: Any, high: Any, start: Any, x: Any) -> int:
    n = c.shape[0]
    state = np.zeros(n, np.int64)  # -1 at the lower bound, 1 at the upper, 0 free
    for k in range(n):
        if low[k] == high[k] or start[k] <= low[k]:
            state[k] = -1
        elif start[k] >= high[k]:
            state[k] = 1
    gradient = np.empty(n)
    wrong = np.zeros(n, np.bool_)
    factor = np.empty((n, n))
    free = np.empty(n, np.int64)
    best = n + 1
    patience = _PATIENCE
    for _ in range(200 * n + 200):
        if _solve_free(h, c, low, high, state, x, factor, free):
            return 1
        count = _find_wrong(h, c, low, high, state, x, gradient, wrong)
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
        _exchange(state, wrong, x, low, block)
    for k in range(n):
        x[k] = min(max(x[k], low[k]), high[k])
    return 0


@numba.njit(cache=True)
def _solve_free(
    h: Any, c: Any, low: Any, high: Any, state: Any, x: Any, factor: Any, free: Any
) -> bool:
    """Solve the free variables with the others at their bounds; True when H is not positive."""
    n = c.shape[0]
    m = 0
    for k in range(n):
        if state[k] == 0:
            free[m] = k
            m += 1
        else:
            x[k] = low[k] if state[k] < 0 else high[k]
    for i in range(m):
        a = free[i]
        total = c[a]
        for k in range(n):
            if state[k] != 0 and x[k] != 0.0:
                total -= h[a, k] * x[k]
        x[a] = total
        for j in range(i + 1):
            value = h[a, free[j]]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                if not value > 1e-15 * h[a, a]:
                    return True
                factor[i, i] = np.sqrt(value)
            else:
                factor[i, j] = value / factor[j, j]
    for i in range(m):
        value = x[free[i]]
        for k in range(i):
            value -= factor[i, k] * x[free[k]]
        x[free[i]] = value / factor[i, i]
    for i in range(m - 1, -1, -1):
        value = x[free[i]]
        for k in range(i + 1, m):
            value -= factor[k, i] * x[free[k]]
        x[free[i]] = value / factor[i, i]
    return False


@numba.njit(cache=True)
def _find_wrong(
    h: Any, c: Any, low: Any, high: Any, state: Any, x: Any, gradient: Any, wrong: Any
) -> int:
    """Mark the variables whose sign conditions fail; how many there are."""
    n = c.shape[0]
    count = 0
    for k in range(n):
        wrong[k] = False
        if state[k] == 0:
            margin = _TOLERANCE * (1.0 + abs(x[k]))
            wrong[k] = x[k] < low[k] - margin or x[k] > high[k] + margin
        elif low[k] < high[k]:
            total = -c[k]
            scale = abs(c[k])
            for j in range(n):
                total += h[k, j] * x[j]
                scale += abs(h[k, j] * x[j])
            gradient[k] = total
            wrong[k] = (total if state[k] > 0 else -total) > _TOLERANCE * scale
        if wrong[k]:
            count += 1
    return count


@numba.njit(cache=True)
def _exchange(state: Any, wrong: Any, x: Any, low: Any, block: bool) -> None:
    """Move wrong variables between free and bound: all of them, or the last alone."""
    for k in range(state.shape[0] - 1, -1, -1):
        if wrong[k]:
            if state[k] != 0:
                state[k] = 0
            else:
                state[k] = -1 if x[k] < low[k] else 1
            if not block:
                return
