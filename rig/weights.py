"""Weights and head motion of each frame, the shapes held fixed.

Everything a frame's alternation needs is summed over the vertices once: the Gram matrix of the
shapes and one 3x3 matrix C_k a shape. After that neither the rotation nor the weights step knows
how many vertices there are. All sums are divided by the frame's summed squared confidence, so
that every strength below is in mm^2 of mean squared error, whatever the vertex count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Ints, check_shape
from rig.box_qp import solve_box_qp

_RIDGE = 1e-9  # of the Gram's mean diagonal: keeps shapes that move alike solvable
_CHUNK = 512  # vertices whose shape products are held at once


@dataclass(frozen=True, kw_only=True)
class WeightPriors:
    """What is asked of weights beyond a good fit.

    Attributes:
        sparsity_mm2: strength of (sum_b w_b)^2, in mean squared mm. Ma et al.'s lambda_s = 0.1 on
            sums over 6.7k vertices in cm is 0.0015 here.
        smoothness: strength of (w_f - w_(f-1))^2 between contiguous frames, as a fraction of each
            shape's own mean squared displacement; 0 turns it off.
        evidence: what a shape must take off a frame's mean squared residual to stay active, as a
            share of that residual; the least useful goes first, until all that remain earn their
            place. A shape imitates a few hundredths of a smooth tracking error by chance; 0 keeps
            every shape.
        debias: solve again, without sparsity, with the shapes that sparsity left active: keeps its
            choice and takes back its shrinking.
        active_above: weight above which a shape counts as active.
        iterations: most alternations.
        tolerance: largest change of a weight at which the alternation ends.
    """

    sparsity_mm2: float = 0.03
    smoothness: float = 0.002
    evidence: float = 0.2
    debias: bool = True
    active_above: float = 0.01
    iterations: int = 60
    tolerance: float = 1e-9


@dataclass(frozen=True, eq=False)
class FrameSums:
    """What a frame's weights and motion depend on, summed over the vertices with confidence.

    Attributes:
        gram: (F or 1, B+1, B+1) mean products of the centred neutral (0) and shapes, mm^2.
        cross: (F, B+1, 3, 3) mean of centred shape times centred point^T, mm^2.
        inertia: (F, 3, 3) mean of centred point times itself^T, mm^2.
        shape_means: (F or 1, B+1, 3) confidence-weighted means of neutral and shapes, mm.
        point_means: (F, 3) mm.
        seen: (F,) whether any vertex of the frame has confidence.
    """

    gram: Floats
    cross: Floats
    inertia: Floats
    shape_means: Floats
    point_means: Floats
    seen: Bools


def sum_frames(neutral: Floats, deltas: Floats, points: Floats, confidence: Floats) -> FrameSums:
    """Sum the products that the weights and rigid steps need, one pass over the vertices.

    Args:
        neutral: (V, 3) rig space, mm.
        deltas: (B, V, 3) mm.
        points: (F, V, 3) world, mm.
        confidence: (F, V) 0..1; enters squared, as the diagonal M of Ma et al. Eq 2.
    """
    check_shape(
        neutral=(neutral, "V 3"),
        deltas=(deltas, "B V 3"),
        points=(points, "F V 3"),
        confidence=(confidence, "F V"),
    )
    square = np.asarray(confidence, dtype=np.float64) ** 2
    mass = square.sum(axis=1)
    seen: Bools = mass > 0.0
    share = square / np.where(seen, mass, 1.0)[:, None]
    shared = bool((share == share[0]).all())
    kinds = share[:1] if shared else share
    count = len(neutral)
    basis = np.concatenate([neutral[None], deltas]).transpose(1, 0, 2).reshape(count, -1)
    basis_mean = basis.mean(axis=0)
    basis = basis - basis_mean
    point_means = np.einsum("fv,fva->fa", share, points)
    centred = points - point_means[:, None]
    weighted = (share[:, :, None] * centred).transpose(1, 0, 2).reshape(count, -1)
    cross = (basis.T @ weighted).reshape(len(deltas) + 1, 3, len(points), 3).transpose(2, 0, 1, 3)
    inertia = np.einsum("fva,fvb->fab", share[:, :, None] * centred, centred)
    local_means = (kinds @ basis).reshape(len(kinds), -1, 3)
    means = local_means + np.where(seen[: len(kinds), None, None], basis_mean.reshape(-1, 3), 0.0)
    gram = _grams(basis.reshape(count, -1, 3), kinds) - local_means @ local_means.transpose(0, 2, 1)
    return FrameSums(gram, np.ascontiguousarray(cross), inertia, means, point_means, seen)


def solve_weights(
    sums: FrameSums, contiguous: Bools, priors: WeightPriors, start: Floats | None = None
) -> tuple[Floats, Floats]:
    """Weights in [0, 1] and head motion of every frame: Ma et al. Eq 4.

    Alternates the closed-form rotation (weights fixed) with an exact box QP over weights and a
    small rotation together. Its fixed points are those of the paper's alternation, without that
    one's crawl where a shape holds some rigid motion, as an opening jaw does.

    Args:
        sums: from `sum_frames`.
        contiguous: (F,) whether each frame follows the one before it in the same take.
        priors: sparsity and smoothness.
        start: (F, B) guess, or None.

    Returns:
        weights (F, B) and head_from_rig (F, 4, 4).
    """
    frames, shapes = sums.cross.shape[0], sums.cross.shape[1] - 1
    check_shape(cross=(sums.cross, "F * 3 3"), contiguous=(contiguous, "F"))
    weights = np.zeros((frames, shapes)) if start is None else np.array(start, dtype=np.float64)
    ceiling = np.where(sums.seen[:, None], np.ones((frames, shapes)), 0.0)
    weights, hessian = _alternate(sums, contiguous, priors, weights, ceiling, priors.sparsity_mm2)
    if priors.debias and priors.sparsity_mm2 > 0.0:
        ceiling = ceiling * (weights > priors.active_above)
        weights, hessian = _alternate(sums, contiguous, priors, weights * ceiling, ceiling, 0.0)
    while priors.evidence > 0.0:
        wanted = priors.evidence * mean_square_residuals(sums, weights)
        weakest, useless = _weakest(weights, hessian, wanted)
        if not useless.any():
            break
        ceiling[useless, weakest[useless]] = 0.0
        strength = 0.0 if priors.debias else priors.sparsity_mm2
        weights, hessian = _alternate(
            sums, contiguous, priors, np.minimum(weights, ceiling), ceiling, strength
        )
    return weights, place_heads(sums, weights)


def mean_square_residuals(sums: FrameSums, weights: Floats) -> Floats:
    """Mean squared residual (F,) of each frame at weights (F, B) and their best motion, mm^2."""
    factors = np.concatenate([np.ones((len(weights), 1)), weights], axis=1)
    posed = np.einsum("fk,fkab->fab", factors, sums.cross)
    matched = np.einsum("fab,fba->f", posed, _rotations(sums, weights))
    own = ((factors[:, None, :] @ sums.gram)[:, 0] * factors).sum(axis=1)
    squares: Floats = np.maximum(own + np.einsum("faa->f", sums.inertia) - 2.0 * matched, 0.0)
    return squares


def _weakest(weights: Floats, hessian: Floats, wanted: Floats) -> tuple[Ints, Bools]:
    """Each frame's active shape whose loss would cost least, and whether less than wanted (F,).

    Taking variable k out of a least-squares fit raises its mean squared residual by
    w_k^2 / (H^-1)_kk, the others and the head's rotation having been fitted again.
    """
    frames, shapes = weights.shape
    active = np.concatenate([weights > 0.0, np.ones((frames, 3), dtype=bool)], axis=1)
    reduced = np.where(active[:, :, None] & active[:, None, :], hessian, 0.0)
    diagonal = np.arange(shapes + 3)
    reduced[:, diagonal, diagonal] += ~active
    spread = np.linalg.inv(reduced)[:, diagonal[:shapes], diagonal[:shapes]]
    cost = np.where(weights > 0.0, weights**2 / np.maximum(spread, 1e-300), np.inf)
    weakest = np.argmin(cost, axis=1)
    return weakest, cost[np.arange(frames), weakest] < wanted


def place_heads(sums: FrameSums, weights: Floats) -> Floats:
    """Head motion (F, 4, 4) that best places the face of given weights (F, B): Procrustes."""
    check_shape(cross=(sums.cross, "F * 3 3"), weights=(weights, "F *"))
    rotations = _rotations(sums, weights)
    factors = np.concatenate([np.ones((len(weights), 1)), weights], axis=1)
    centre = (factors[:, :, None] * sums.shape_means).sum(axis=1)
    motions = np.tile(np.eye(4), (len(weights), 1, 1))
    motions[:, :3, :3] = rotations
    motions[:, :3, 3] = sums.point_means - (rotations @ centre[:, :, None])[:, :, 0]
    motions[~sums.seen] = np.eye(4)
    return motions


def _alternate(
    sums: FrameSums,
    contiguous: Bools,
    priors: WeightPriors,
    weights: Floats,
    ceiling: Floats,
    sparsity_mm2: float,
) -> tuple[Floats, Floats]:
    frames, shapes = weights.shape
    gram = sums.gram[:, 1:, 1:]
    scale = np.einsum("fkk->fk", gram)
    ridge = _RIDGE * max(float(scale.mean()), 1e-12) + np.where(sums.seen, 0.0, 1.0)
    linked = contiguous & sums.seen & np.concatenate([[False], sums.seen[:-1]])
    pull = priors.smoothness * scale * linked[:, None]
    hessian = np.zeros((frames, shapes + 3, shapes + 3))
    hessian[:, :shapes, :shapes] = gram + sparsity_mm2
    diagonal = np.arange(shapes)
    hessian[:, diagonal, diagonal] += pull + ridge[:, None]
    low = np.concatenate([np.zeros((frames, shapes)), np.full((frames, 3), -np.inf)], axis=1)
    high = np.concatenate([ceiling, np.full((frames, 3), np.inf)], axis=1)
    for _ in range(priors.iterations):
        rotations = _rotations(sums, weights)
        linear = _linearise(sums, rotations, hessian)
        linear[:, :shapes] += pull * np.roll(weights, 1, axis=0)
        start = np.concatenate([weights, np.zeros((frames, 3))], axis=1)
        solved = solve_box_qp(hessian, linear, low, high, start)[:, :shapes]
        change = float(np.abs(solved - weights).max(initial=0.0))
        weights = solved
        if change <= priors.tolerance:
            break
    return weights, hessian


def _linearise(sums: FrameSums, rotations: Floats, hessian: Floats) -> Floats:
    """Fill the rows of a small rotation w, R exp([w]x), into `hessian`; give the linear term."""
    shapes = sums.cross.shape[1] - 1
    local = sums.cross @ rotations[:, None]  # mean of shape times (R^T point)^T
    turning = np.stack(
        [
            local[..., 1, 2] - local[..., 2, 1],
            local[..., 2, 0] - local[..., 0, 2],
            local[..., 0, 1] - local[..., 1, 0],
        ],
        axis=-1,
    )
    spread = rotations.transpose(0, 2, 1) @ sums.inertia @ rotations
    trace = np.einsum("faa->f", spread)
    floor = np.where(sums.seen, 1e-9 * trace, 1.0)
    hessian[:, shapes:, shapes:] = (trace + floor)[:, None, None] * np.eye(3) - spread
    hessian[:, :shapes, shapes:] = -turning[:, 1:]
    hessian[:, shapes:, :shapes] = -turning[:, 1:].transpose(0, 2, 1)
    linear = np.empty((len(rotations), shapes + 3))
    linear[:, :shapes] = np.einsum("fkaa->fk", local[:, 1:]) - sums.gram[:, 0, 1:]
    linear[:, shapes:] = turning[:, 0]
    return linear


def _rotations(sums: FrameSums, weights: Floats) -> Floats:
    """Rotations (F, 3, 3), determinant +1, that best turn the face of `weights` to the points."""
    posed = sums.cross[:, 0] + np.einsum("fk,fkab->fab", weights, sums.cross[:, 1:])
    left, _, right = np.linalg.svd(posed)
    sign = np.linalg.det(left) * np.linalg.det(right)
    left[:, :, 2] *= np.where(sign < 0, -1.0, 1.0)[:, None]
    rotations: Floats = (left @ right).transpose(0, 2, 1)
    return rotations


def _grams(basis: Floats, share: Floats) -> Floats:
    """Products of every two columns of basis (V, K, 3), summed with each row of share (F, V)."""
    width = basis.shape[1]
    if len(share) == 1:
        flat = basis.transpose(1, 0, 2).reshape(width, -1)
        single: Floats = ((flat * np.repeat(share[0], 3)) @ flat.T)[None]
        return single
    total = np.zeros((len(share), width * width))
    for begin in range(0, len(basis), _CHUNK):
        part = basis[begin : begin + _CHUNK]
        products = (part @ part.transpose(0, 2, 1)).reshape(len(part), -1)
        total += share[:, begin : begin + _CHUNK] @ products
    return total.reshape(-1, width, width)
