"""Weights and head motion of each frame, the shapes held fixed.

Everything a frame's alternation needs is summed over the vertices once (`rig.frame_sums`). Each
frame is then solved to its end by compiled code (`rig.frame_solver`), and solved again only when
its own bounds or the frames it is tied to have changed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from capture.arrays import Bools, Floats, Ints, check_shape
from capture.errors import InputError, SolveError
from rig.frame_solver import drop_weakest, place_frames, sweep_blocks, visit_frames
from rig.frame_sums import FrameSums, sum_frames
from rig.ranges import run_ranges

__all__ = [
    "FrameSums",
    "WeightLinks",
    "WeightPriors",
    "mean_square_residuals",
    "place_heads",
    "solve_weights",
    "sum_frames",
]

_RIDGE = 1e-9  # of the Gram's mean diagonal: keeps shapes that move alike solvable
_BLOCK = 32  # frames solved in order by one thread
_PASSES = 2000  # most over the take in a joint solution; settled frames are passed over


def _no_pairs() -> Ints:
    return np.zeros((0, 2), dtype=np.int64)


@dataclass(frozen=True, kw_only=True)
class WeightPriors:
    """What is asked of weights beyond a good fit.

    The fit is a frame's mean squared residual, mm^2; each strength is added to that.

    Attributes:
        sparsity: which term keeps weights few. "squared": sparsity_mm2 (sum_b w_b)^2, Ma et al.'s
            ||w||_1^2. "l1": l1_mm2 sum_b w_b. "reweighted": l1, then again with each weight's
            share over w_b + `reweight_floor` of the solution before, which frees large weights of
            shrinking and comes close to a price for each active shape.
        sparsity_mm2: strength of "squared". Ma et al.'s lambda_s = 0.1 on sums over 6.7k vertices
            in cm is 0.0015 here.
        l1_mm2: strength of "l1": a shape stays out unless its best weight alone takes more than
            about l1_mm2 times that weight, halved, off the mean squared residual.
        reweighted_mm2: strength of "reweighted": about what an active shape must take off.
        reweight_floor: weight below which a shape is priced as if it were out.
        reweight_rounds: solutions in all, the first of them "l1".
        temporal: "causal" ties a frame to the one before, whose weights are settled without regard
            to what follows, as in the paper; "joint" finds the minimum over the whole take.
        smoothness: strength of (w_f - w_(f-1))^2 between contiguous frames, as a fraction of each
            shape's own mean squared displacement; 0 turns it off.
        symmetry: strength of (w_l - w_r)^2 of the symmetric pairs given, as a fraction of their
            mean squared displacement.
        evidence: what a shape must take off a frame's mean squared residual to stay active, as a
            share of that residual; the least useful goes first, until all that remain earn their
            place. A shape imitates a few hundredths of a smooth tracking error by chance; 0 keeps
            every shape.
        debias: solve again, without sparsity, with the shapes that sparsity left active: keeps its
            choice and takes back its shrinking.
        active_above: weight above which a shape counts as active.
        upper: largest weight. Above 1 only while a shape's size is still to be found.
        iterations: most alternations of a frame.
        tolerance: largest change of a weight at which the alternation ends.

    Raises:
        InputError: when `sparsity` or `temporal` is none of these words.
    """

    sparsity: Literal["squared", "l1", "reweighted"] = "squared"
    sparsity_mm2: float = 0.01
    l1_mm2: float = 0.02
    reweighted_mm2: float = 0.01
    reweight_floor: float = 0.1
    reweight_rounds: int = 4
    temporal: Literal["causal", "joint"] = "causal"
    smoothness: float = 0.002
    symmetry: float = 0.0
    evidence: float = 0.12
    debias: bool = True
    active_above: float = 0.01
    upper: float = 1.0
    iterations: int = 60
    tolerance: float = 1e-9

    def __post_init__(self) -> None:
        for name, known in (
            ("sparsity", ("squared", "l1", "reweighted")),
            ("temporal", ("causal", "joint")),
        ):
            given = getattr(self, name)
            if given not in known:
                raise InputError(f"weights: {name} = {given!r}; one of {', '.join(known)}")

    @property
    def strength_mm2(self) -> float:
        """Strength of the chosen kind of sparsity."""
        return {
            "squared": self.sparsity_mm2,
            "l1": self.l1_mm2,
            "reweighted": self.reweighted_mm2,
        }[self.sparsity]


@dataclass(frozen=True, eq=False)
class WeightLinks:
    """Shapes whose weights have to do with each other.

    Attributes:
        symmetric: (P, 2) shapes of the left and right side, drawn towards equal weights.
        exclusive: (Q, 2) shapes of which only one is active in a frame: where both would be, the
            smaller is held at 0 and the frame is solved again.
    """

    symmetric: Ints = field(default_factory=_no_pairs)
    exclusive: Ints = field(default_factory=_no_pairs)

    def __post_init__(self) -> None:
        check_shape(symmetric=(self.symmetric, "* 2"), exclusive=(self.exclusive, "* 2"))


def solve_weights(
    sums: FrameSums,
    contiguous: Bools,
    priors: WeightPriors,
    start: Floats | None = None,
    links: WeightLinks | None = None,
) -> tuple[Floats, Floats]:
    """Weights in [0, 1] and head motion of every frame: Ma et al. Eq 4.

    Alternates the closed-form rotation (weights fixed) with an exact box QP over weights and a
    small rotation together. Its fixed points are those of the paper's alternation, without that
    one's crawl where a shape holds some rigid motion, as an opening jaw does. Where `sums` has
    rigid vertices they alone place the head, and the QP is over the weights with the head held.

    Args:
        sums: from `sum_frames`.
        contiguous: (F,) whether each frame follows the one before it in the same take.
        priors: sparsity and smoothness.
        start: (F, B) guess, or None.
        links: pairs of shapes, or None.

    Returns:
        weights (F, B) and head_from_rig (F, 4, 4).

    Raises:
        InputError: when a link names a shape that is not there.
        SolveError: when a frame's QP is not positive definite.

    References:
        Ma et al. 2016, Eq 2-4; Candes, Wakin, Boyd 2008, Enhancing sparsity by reweighted l1
        minimization.
    """
    frames, shapes = sums.cross.shape[0], sums.cross.shape[1] - 1
    check_shape(cross=(sums.cross, "F * 3 3"), contiguous=(contiguous, "F"))
    links = WeightLinks() if links is None else links
    _check_links(links, shapes)
    weights = np.zeros((frames, shapes)) if start is None else np.array(start, dtype=np.float64)
    check_shape(weights=(weights, "F B"), cross=(sums.cross[:, 1:], "F B 3 3"))
    solver = _Solver(sums, np.asarray(contiguous, dtype=np.bool_), priors, weights, links)
    strength = priors.strength_mm2
    solver.price(strength)
    solver.settle()
    if priors.sparsity == "reweighted" and strength > 0.0:
        for _ in range(priors.reweight_rounds - 1):
            solver.price(strength, 1.0 / (solver.weights + priors.reweight_floor))
            solver.settle()
    if priors.debias and strength > 0.0:
        solver.keep(solver.weights > priors.active_above)
        solver.price(0.0)
        solver.settle()
    while priors.evidence > 0.0 and solver.drop(priors.evidence):
        solver.settle()
    return solver.weights, place_heads(sums, solver.weights)


def mean_square_residuals(sums: FrameSums, weights: Floats) -> Floats:
    """Mean squared residual (F,) of each frame at weights (F, B) and their best motion, mm^2."""
    return _place(sums, weights)[1]


def place_heads(sums: FrameSums, weights: Floats) -> Floats:
    """Head motion (F, 4, 4) that best places the face of given weights (F, B): Procrustes."""
    motions, _ = _place(sums, weights)
    motions[~sums.seen] = np.eye(4)
    return motions


def _place(sums: FrameSums, weights: Floats) -> tuple[Floats, Floats]:
    check_shape(cross=(sums.cross[:, 1:], "F B 3 3"), weights=(weights, "F B"))
    given = np.ascontiguousarray(weights, dtype=np.float64)
    motions, squares = np.empty((len(given), 4, 4)), np.empty(len(given))
    run_ranges(place_frames, len(given), _sums_for_kernels(sums), given, motions, squares)
    return motions, squares


def _sums_for_kernels(sums: FrameSums) -> tuple[Any, ...]:
    rigid = sums if sums.rigid is None else sums.rigid
    held = np.zeros(len(sums.seen), dtype=np.bool_) if sums.rigid is None else rigid.seen
    arrays = (
        sums.gram, sums.cross, sums.inertia, sums.shape_means, sums.point_means, held,
        rigid.cross, rigid.shape_means, rigid.point_means,
    )  # fmt: skip
    return tuple(np.ascontiguousarray(array) for array in arrays)


def _check_links(links: WeightLinks, shapes: int) -> None:
    for name in ("symmetric", "exclusive"):
        pairs = getattr(links, name)
        if pairs.size and (pairs.min() < 0 or pairs.max() >= shapes):
            raise InputError(
                f"weights: {name} pairs name shapes {pairs.min()}..{pairs.max()}; "
                f"there are shapes 0..{shapes - 1}"
            )
        if (pairs[:, 0] == pairs[:, 1]).any():
            raise InputError(f"weights: a shape cannot be its own {name} partner")


class _Solver:
    """Weights of a take while bounds and prices change: only what changed is solved again."""

    def __init__(
        self,
        sums: FrameSums,
        contiguous: Bools,
        priors: WeightPriors,
        weights: Floats,
        links: WeightLinks,
    ) -> None:
        frames, shapes = weights.shape
        self.weights = np.ascontiguousarray(weights)
        self._priors, self._links = priors, links
        self._sums = _sums_for_kernels(sums)
        scale = np.einsum("fkk->fk", sums.gram[:, 1:, 1:])
        self._ridge = _RIDGE * max(float(scale.mean()) if scale.size else 0.0, 1e-12) + np.where(
            sums.seen, 0.0, 1.0
        )
        self._linked = contiguous & sums.seen & np.concatenate([[False], sums.seen])[:-1]
        self._linked &= priors.smoothness > 0.0
        self._linked[:1] = False
        self._pull = priors.smoothness * scale * self._linked[:, None]
        self._pairs = np.ascontiguousarray(links.symmetric, dtype=np.int64)
        self._tied = priors.symmetry * scale[:, self._pairs].mean(axis=2)
        self._ceiling = np.where(sums.seen[:, None], np.full((frames, shapes), priors.upper), 0.0)
        self._squared, self._costs = 0.0, np.zeros((frames, shapes))
        self._dirty = np.ones(frames, dtype=np.bool_)
        self._open = np.ones(frames, dtype=np.bool_)
        self._used = np.zeros((2, frames, shapes))

    def price(self, strength_mm2: float, factors: Floats | None = None) -> None:
        """Set the sparsity's strength; `factors` (F, B) multiply that of an l1 term."""
        squared = self._priors.sparsity == "squared"
        self._squared = strength_mm2 if squared else 0.0
        linear = 0.0 if squared else 0.5 * strength_mm2
        self._costs = linear * (np.ones(self.weights.shape) if factors is None else factors)
        self._dirty[:] = True

    def keep(self, active: Bools) -> None:
        """Hold every shape at 0 that is not active (F, B)."""
        self._ceiling *= active
        self.weights = np.minimum(self.weights, self._ceiling)
        self._dirty[:] = True

    def settle(self) -> None:
        """Solve what changed, until every frame is solved and no exclusive pair is active."""
        while True:
            self._sweep()
            if not self._cancel():
                return

    def drop(self, evidence: float) -> bool:
        """Take out each frame's least useful shape if it explains too little; whether any went."""
        frames = self._open, self._ceiling, self._dirty
        terms = self._terms(joint=self._priors.temporal == "joint")
        run_ranges(drop_weakest, len(self._open), evidence, self._sums, terms, frames, self.weights)
        return bool(self._open.any())

    def _cancel(self) -> bool:
        """Hold at 0 the smaller of each exclusive pair where both are active; whether any was."""
        found = False
        for first, second in self._links.exclusive:
            one, other = self.weights[:, first], self.weights[:, second]
            both = (one > 0.0) & (other > 0.0)
            loses = both & (one < other), both & (one >= other)
            for shape, lost in zip((first, second), loses, strict=True):
                self._ceiling[lost, shape] = 0.0
                self.weights[lost, shape] = 0.0
            self._dirty |= both
            found |= bool(both.any())
        return found

    def _terms(self, joint: bool) -> tuple[Any, ...]:
        after = np.zeros_like(self._pull)
        if joint:
            after[:-1] = self._pull[1:]
        return (
            self._squared, self._ridge, np.ascontiguousarray(self._pull), after, self._costs,
            self._pairs, self._tied, self._priors.iterations, self._priors.tolerance,
        )  # fmt: skip

    def _sweep(self) -> None:
        if self._priors.temporal == "joint" and self._linked.any():
            self._sweep_joint()
        else:
            self._sweep_causal()

    def _sweep_causal(self) -> None:
        """Blocks side by side, each beginning with what the last pass left before it."""
        count = len(self.weights)
        edges = np.append(np.arange(0, count, _BLOCK), count)
        terms = self._terms(joint=False)
        while True:
            first = np.ascontiguousarray(self.weights[edges[:-1] - 1])
            solved, failed = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.int64)
            frames = (
                self._linked, self._ceiling, self._dirty, self._used[0], first, solved, failed,
            )  # fmt: skip
            run_ranges(sweep_blocks, count, edges, self._sums, terms, frames, self.weights)
            self._open |= solved
            _check_solved(failed)
            if not solved.any() or not self._linked.any():
                return

    def _sweep_joint(self) -> None:
        """Every other frame at a time, between neighbours that stay as they are."""
        count = len(self.weights)
        if self._dirty.all():  # a guess
            self._sweep_causal()
            self._dirty[:] = True
        terms = self._terms(joint=True)
        for _ in range(_PASSES):
            solved, failed = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.int64)
            frames = self._linked, self._ceiling, self._dirty, self._used, solved, failed
            for parity in (0, 1):
                half = (count + 1 - parity) // 2
                run_ranges(visit_frames, half, parity, self._sums, terms, frames, self.weights)
            self._open |= solved
            _check_solved(failed)
            if not solved.any():
                return


def _check_solved(failed: Ints) -> None:
    if failed.any():
        raise SolveError(
            f"weights: the QP of {int((failed > 0).sum())} frames is not positive definite, first "
            f"of frame {int(np.argmax(failed > 0))} (two shapes that move alike, or one that moves "
            f"nothing?)"
        )
