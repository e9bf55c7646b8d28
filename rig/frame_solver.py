"""Weights and rotation of one frame after the other, compiled: kernels of `rig.weights`.

Kernels take plain tuples of arrays, made by `rig.weights`:

- `sums`: gram, cross, inertia, shape_means, point_means of `FrameSums`; then held (F,) bool,
  whether the frame's motion comes from the rigid vertices, and their cross, shape_means and
  point_means.
- `terms`: strength of (sum w)^2; ridge (F,); pull (F, B) towards the frame before and (F, B)
  towards the one after; costs (F, B), half of a linear term; pairs (P, 2) of mirrored shapes and
  half the strength (F or 1, P) of (w_l - w_r)^2; iterations; tolerance.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from rig.box_qp import box_qp_scratch, factor_upper, solve_one_box_qp
from rig.rotation_fit import fit_rotation


@numba.njit(cache=True, nogil=True)
def sweep_blocks(
    begin: int, end: int, edges: Any, sums: Any, terms: Any, frames: Any, weights: Any
) -> None:
    """Solve the frames of each block in order, each pulled towards the weights of the one before.

    Args:
        begin: first frame; blocks that begin before it are left to others.
        end: blocks that begin here or later are left to others.
        edges: (N + 1,) first frame of each block.
        sums: see the module.
        terms: see the module.
        frames: linked (F,) whether pulled; ceiling (F, B); dirty (F,) to be solved in any case;
            used (F, B) weights of the frame before that each was solved with; first (N, B) those
            that each block begins with; solved (F,) and failed (F,) are written.
        weights: (F, B) read and written.
    """
    linked, ceiling, dirty, used, first, solved, failed = frames
    work = _workspace(weights.shape[1])
    tolerance = 0.01 * terms[8]
    for block in range(edges.shape[0] - 1):
        if edges[block] < begin or edges[block] >= end:
            continue
        for f in range(edges[block], edges[block + 1]):
            before = first[block] if f == edges[block] else weights[f - 1]
            if not dirty[f] and not (linked[f] and _differ(before, used[f], tolerance)):
                continue
            used[f] = before
            dirty[f], solved[f] = False, True
            failed[f] = _solve_frame(f, sums, terms, ceiling[f], before, before, weights[f], work)


@numba.njit(cache=True, nogil=True)
def visit_frames(
    begin: int, end: int, parity: int, sums: Any, terms: Any, frames: Any, weights: Any
) -> None:
    """Solve frames 2 i + parity, each pulled towards both its neighbours, which stay as they are.

    Args:
        begin: first i.
        end: past the last.
        parity: 0 or 1.
        sums: see the module.
        terms: see the module.
        frames: linked (F,) to the one before; ceiling (F, B); dirty (F,); used (2, F, B) weights of
            the neighbours that each was solved with; solved (F,) and failed (F,) are written.
        weights: (F, B) read and written.
    """
    linked, ceiling, dirty, used, solved, failed = frames
    work = _workspace(weights.shape[1])
    tolerance = 0.1 * terms[8]
    for i in range(begin, end):
        f = 2 * i + parity
        before = weights[f - 1] if f > 0 and linked[f] else used[0, f]
        chained = f + 1 < weights.shape[0] and linked[f + 1]
        after = weights[f + 1] if chained else used[1, f]
        moved = _differ(before, used[0, f], tolerance) or _differ(after, used[1, f], tolerance)
        if not dirty[f] and not moved:
            continue
        used[0, f], used[1, f] = before, after
        dirty[f], solved[f] = False, True
        failed[f] = _solve_frame(f, sums, terms, ceiling[f], before, after, weights[f], work)


@numba.njit(cache=True, nogil=True)
def drop_weakest(
    begin: int, end: int, evidence: float, sums: Any, terms: Any, frames: Any, weights: Any
) -> None:
    """Take out each open frame's least useful shape, where it explains less than `evidence`.

    Taking variable k out of a least-squares fit raises its mean squared residual by
    w_k^2 / (H^-1)_kk, the others and the head's rotation having been fitted again.

    Args:
        begin: first frame.
        end: past the last.
        evidence: share of the frame's mean squared residual.
        sums: see the module.
        terms: see the module.
        frames: open (F,) frames that may have a useless shape, cleared where there is none;
            ceiling (F, B) set to 0 for what is taken out; dirty (F,) set where something is.
        weights: (F, B) what is taken out becomes 0.
    """
    open_frames, ceiling, dirty = frames
    shapes = weights.shape[1]
    h, c, _, qp, three = _workspace(shapes)
    factor, vectors, lists = qp
    for f in range(begin, end):
        if not open_frames[f]:
            continue
        w = weights[f]
        _fit_motion(f, sums, w, three)
        wanted = evidence * _mean_square(f, sums, w, three)
        _fill_base(f, sums, terms, h)
        _linearise(f, sums, terms, w, w, w, h, c, three)
        weakest = _find_weakest(h, w, factor, vectors, lists[0])
        open_frames[f] = weakest >= 0 and vectors[2, 0] < wanted
        if open_frames[f]:
            ceiling[f, weakest] = 0.0
            weights[f, weakest] = 0.0
            dirty[f] = True


@numba.njit(cache=True, nogil=True)
def place_frames(begin: int, end: int, sums: Any, weights: Any, motions: Any, squares: Any) -> None:
    """Head motion (F, 4, 4) and mean squared residual (F,) of frames with given weights (F, B)."""
    three = np.empty((9, 3, 3))
    for f in range(begin, end):
        _fit_motion(f, sums, weights[f], three)
        squares[f] = _mean_square(f, sums, weights[f], three)
        held, points = sums[5][f], sums[4]
        placed = sums[8] if held else points
        for a in range(3):
            total = 0.0
            for b in range(3):
                motions[f, a, b] = three[0, a, b]
                total += three[0, a, b] * three[6, 0, b]
            motions[f, a, 3] = placed[f, a] - total
            motions[f, 3, a] = 0.0
        motions[f, 3, 3] = 1.0


@numba.njit(cache=True)
def _workspace(shapes: int) -> Any:
    """H, c, (low, high, x) of a frame's QP, what the QP works in, and small matrices.

    The matrices: 0 the rotation, 1 the posed cross, 2 to 5 scratch, 6 row 0 the weighted mean of
    the posed shape that the motion places, row 1 that of all vertices, row 2 of the points in rig
    space (held frames), 7 the inertia in rig space, 8 scratch.
    """
    n = shapes + 3
    bounds = np.zeros(n), np.zeros(n), np.zeros(n)
    return np.empty((n, n)), np.empty(n), bounds, box_qp_scratch(n), np.empty((9, 3, 3))


@numba.njit(cache=True)
def _differ(a: Any, b: Any, tolerance: float) -> bool:
    most = 0.0
    for k in range(a.shape[0]):
        most = max(most, abs(a[k] - b[k]))
    return most > tolerance


@numba.njit(cache=True)
def _solve_frame(
    f: int, sums: Any, terms: Any, ceiling: Any, before: Any, after: Any, w: Any, work: Any
) -> int:
    """Alternate rotation with the box QP over weights and a small rotation: w (B,) in and out."""
    h, c, (low, high, x), qp, three = work
    shapes = w.shape[0]
    held = sums[5][f]
    for k in range(shapes):
        high[k] = ceiling[k]
    for k in range(shapes, shapes + 3):
        low[k], high[k] = (0.0, 0.0) if held else (-np.inf, np.inf)
    _fill_base(f, sums, terms, h)
    for _ in range(terms[7]):
        _fit_motion(f, sums, w, three)
        _linearise(f, sums, terms, w, before, after, h, c, three)
        for k in range(shapes):
            x[k] = w[k]
        x[shapes:] = 0.0
        if solve_one_box_qp(h, c, low, high, x, qp) != 0:
            return 1
        change = 0.0
        for k in range(shapes):
            change = max(change, abs(x[k] - w[k]))
            w[k] = x[k]
        if change <= terms[8]:
            break
    return 0


@numba.njit(cache=True)
def _fill_base(f: int, sums: Any, terms: Any, h: Any) -> None:
    """The part of H that the rotation does not change: shapes against shapes."""
    strength, ridge, pull, pull_after, _, pairs, tied, _, _ = terms
    gram, means = sums[0], sums[3]
    g = f if gram.shape[0] > 1 else 0
    shapes = gram.shape[1] - 1
    for k in range(shapes):
        for j in range(shapes):
            h[k, j] = gram[g, k + 1, j + 1] + strength
        if sums[5][f]:
            for a in range(3):
                for j in range(shapes):
                    h[k, j] += means[g, k + 1, a] * means[g, j + 1, a]
        h[k, k] += pull[f, k] + pull_after[f, k] + ridge[f]
    for p in range(pairs.shape[0]):
        left, right = pairs[p, 0], pairs[p, 1]
        part = tied[f if tied.shape[0] > 1 else 0, p]
        h[left, left] += part
        h[right, right] += part
        h[left, right] -= part
        h[right, left] -= part


@numba.njit(cache=True)
def _fit_motion(f: int, sums: Any, w: Any, three: Any) -> None:
    """Rotation and the means that the translation needs, for weights w (B,)."""
    gram, cross, _, means, points, held, rigid_cross, rigid_means, rigid_points = sums
    products = rigid_cross if held[f] else cross
    placed = rigid_means if held[f] else means
    g, r = f if gram.shape[0] > 1 else 0, f if placed.shape[0] > 1 else 0
    for a in range(3):
        for b in range(3):
            three[1, a, b] = products[f, 0, a, b]
        three[6, 0, a] = placed[r, 0, a]
        three[6, 1, a] = means[g, 0, a]
    for k in range(w.shape[0]):
        if w[k] != 0.0:
            for a in range(3):
                for b in range(3):
                    three[1, a, b] += w[k] * products[f, k + 1, a, b]
                three[6, 0, a] += w[k] * placed[r, k + 1, a]
                three[6, 1, a] += w[k] * means[g, k + 1, a]
    fit_rotation(three[1], three[0], three[2:6])
    for a in range(3):
        three[6, 2, a] = three[6, 0, a]
        if held[f]:
            for b in range(3):
                three[6, 2, a] += three[0, b, a] * (points[f, b] - rigid_points[f, b])


@numba.njit(cache=True)
def _linearise(
    f: int, sums: Any, terms: Any, w: Any, before: Any, after: Any, h: Any, c: Any, three: Any
) -> None:
    """Rows of H for a small rotation o, R exp([o]x), and the linear term, at R = three[0]."""
    gram, cross, inertia, means, held = sums[0], sums[1], sums[2], sums[3], sums[5][f]
    pull, pull_after, costs = terms[2], terms[3], terms[4]
    shapes = w.shape[0]
    g = f if gram.shape[0] > 1 else 0
    rotation, local = three[0], three[8]
    for k in range(shapes + 1):
        for a in range(3):
            for b in range(3):
                local[a, b] = (
                    cross[f, k, a, 0] * rotation[0, b]
                    + cross[f, k, a, 1] * rotation[1, b]
                    + cross[f, k, a, 2] * rotation[2, b]
                )
        for a in range(3):
            i, j = (a + 1) % 3, (a + 2) % 3
            turning = 0.0 if held else local[i, j] - local[j, i]
            if k == 0:
                c[shapes + a] = turning
            else:
                h[k - 1, shapes + a] = h[shapes + a, k - 1] = -turning
        if k > 0:
            value = local[0, 0] + local[1, 1] + local[2, 2] - gram[g, 0, k]
            if held:
                for a in range(3):
                    value += means[g, k, a] * (three[6, 2, a] - means[g, 0, a])
            m = k - 1
            value += pull[f, m] * before[m] + pull_after[f, m] * after[m]
            c[m] = value - costs[f, m]
    _turn_inertia(inertia[f], rotation, three)
    trace = three[7, 0, 0] + three[7, 1, 1] + three[7, 2, 2]
    floor = 1e-9 * trace if trace > 0.0 else 1.0
    for a in range(3):
        for b in range(3):
            h[shapes + a, shapes + b] = -three[7, a, b]
            if held:
                h[shapes + a, shapes + b] = 0.0
        h[shapes + a, shapes + a] += 1.0 if held else trace + floor


@numba.njit(cache=True)
def _turn_inertia(inertia: Any, rotation: Any, three: Any) -> None:
    """R^T inertia R into three[7]."""
    for a in range(3):
        for b in range(3):
            three[2, a, b] = 0.0
            for i in range(3):
                three[2, a, b] += inertia[a, i] * rotation[i, b]
    for a in range(3):
        for b in range(3):
            three[7, a, b] = 0.0
            for i in range(3):
                three[7, a, b] += rotation[i, a] * three[2, i, b]


@numba.njit(cache=True)
def _mean_square(f: int, sums: Any, w: Any, three: Any) -> float:
    """Mean squared residual at weights w (B,) and the motion of `_fit_motion`, mm^2."""
    gram, cross, inertia, held = sums[0], sums[1], sums[2], sums[5][f]
    g = f if gram.shape[0] > 1 else 0
    matched = 0.0
    own = gram[g, 0, 0]
    for a in range(3):
        for b in range(3):
            matched += three[0, b, a] * cross[f, 0, a, b]
    for k in range(w.shape[0]):
        if w[k] != 0.0:
            for a in range(3):
                for b in range(3):
                    matched += w[k] * three[0, b, a] * cross[f, k + 1, a, b]
            row = gram[g, k + 1, 0] * 2.0
            for j in range(w.shape[0]):
                row += gram[g, k + 1, j + 1] * w[j]
            own += w[k] * row
    total = own + inertia[f, 0, 0] + inertia[f, 1, 1] + inertia[f, 2, 2] - 2.0 * matched
    if held:
        for a in range(3):
            total += (three[6, 1, a] - three[6, 2, a]) ** 2
    return float(max(total, 0.0))


@numba.njit(cache=True)
def _find_weakest(h: Any, w: Any, factor: Any, vectors: Any, kept: Any) -> int:
    """The active shape whose loss costs least, or -1; what it costs goes to vectors[2, 0].

    With H = U^T U over the active variables, (H^-1)_kk is the squared norm of row k of U^-1.
    """
    shapes = w.shape[0]
    m = 0
    for k in range(shapes + 3):
        if k >= shapes or w[k] > 0.0:
            kept[m] = k
            m += 1
    for i in range(m):
        for j in range(i, m):
            factor[i, j] = h[kept[i], kept[j]]
    vectors[2, 0] = np.inf
    if not factor_upper(factor, m, vectors[0], 0):
        return -1
    weakest = -1
    row = vectors[1]
    for i in range(m - 3):
        for j in range(i, m):
            row[j] = 0.0
        row[i] = 1.0
        total = 0.0
        for j in range(i, m):  # row i of U^-1 from row . U = e_i
            row[j] /= factor[j, j]
            total += row[j] * row[j]
            for k in range(numba.uintp(j + 1), numba.uintp(m)):
                row[k] -= row[j] * factor[j, k]
        cost = w[kept[i]] ** 2 / max(total, 1e-300)
        if cost < vectors[2, 0]:
            weakest, vectors[2, 0] = kept[i], cost
    return weakest
