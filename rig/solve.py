"""The alternation: weights and head motion, then neutral and shapes, until nothing moves."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from capture.arrays import Bools, Floats
from capture.progress import Progress, silent
from rig.evidence import Evidence
from rig.fit import Fit, Iteration, Observations, undo_motion, weighted_rms
from rig.gauge import (
    EXERCISED,
    choose_scales,
    repetition,
    resting_weights,
    shape_sizes,
    without_gaps,
)
from rig.gradient import gradient_operator
from rig.locality import Locality, Mask, mask_shapes
from rig.neutral_frame import rigid_weights
from rig.overrides import Override, overridden, override_evidence, sculpted
from rig.template import Template
from rig.transfer import transfer_shapes
from rig.transfer_rbf import WarpSettings, transfer_shapes_rbf
from rig.update import UpdatePriors, mean_vertex_area, offset_stiffness, update_shapes
from rig.weights import WeightLinks, WeightPriors, place_heads, solve_weights, sum_frames

__all__ = [
    "Fit",
    "Iteration",
    "Observations",
    "Problem",
    "Schedule",
    "Solution",
    "frames_evidence",
    "personalise",
    "pose_frames",
    "pose_problem",
    "shape_mask",
    "transferred",
    "update_priors",
    "weighted_rms",
]

_NOISE_FLOOR_MM = 0.05  # what tracking is never better than
_RETRANSFER_MM = 0.05  # root mean square move of the neutral that makes the transfer stale
_RELAXING = 0.8  # of the strict evidence is asked in the next turn
_FEW_REPEATS, _MANY_REPEATS = 1.5, 3.5  # activations a shape: not strict, fully strict
_STIFF_FIRST = 6.0  # how much stiffer shapes are at the first update; halved at each one after
_LOOSE_UPPER = 1.5  # bound of weights between turns: the gauge, not the box, sets a shape's size


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How long to alternate, and with which priors.

    Attributes:
        transfer: how the template's shapes are carried to the actor's neutral.
        iterations: most turns.
        relative_change: of the total energy, below which it stops.
        strict_evidence: what a shape must explain to be active in the first turn, if shapes are
            seen in many combinations; it falls to `weights.evidence` by a fifth a turn.
        rescale: whether each shape's size against its weights is chosen anew at every turn.
        mask: kind of locality.
        mask_tolerance: of a shape's extent, below which the template holds a vertex still.
        size_variation: how far the sizes of the actor's shapes depart from the template's, as a
            share.
        variation: how far their forms depart from the transferred ones, as a share of their own
            displacement. With the residual for noise it sets `relative_mm2` of the shapes step,
            anew at every turn.
        weights: priors of the weights step.
        update: priors of the shapes step.
    """

    transfer: Literal["gradient", "rbf"] = "gradient"
    iterations: int = 8
    relative_change: float = 0.005
    strict_evidence: float = 0.6
    rescale: bool = True
    mask: Literal["vertex", "soft", "literal"] = "vertex"
    mask_tolerance: float = 1e-3
    size_variation: float = 0.25
    variation: float = 0.12
    weights: WeightPriors = field(default_factory=WeightPriors)
    update: UpdatePriors = field(default_factory=UpdatePriors)

    def posing(self, turn: int, repeated: float) -> WeightPriors:
        """Priors of the weights step after `turn` updates of the shapes.

        What shape k lacks looks like another shape that is always active with k. Strictness has k
        learn it, and that is right where k was seen in several combinations. Where shapes were
        seen once, in one expression, it would melt those of an expression into one.

        Args:
            turn: updates so far.
            repeated: how often a shape is activated, on average.
        """
        share = min(max((repeated - _FEW_REPEATS) / (_MANY_REPEATS - _FEW_REPEATS), 0.0), 1.0)
        strict = share * self.strict_evidence * _RELAXING**turn
        evidence = max(self.weights.evidence, strict) if self.weights.evidence > 0.0 else 0.0
        return replace(self.weights, evidence=evidence)

    def relaxed(self, turn: int, repeated: float) -> bool:
        """Whether the priors stay as they are from this turn on."""
        return self.posing(turn, repeated).evidence <= self.weights.evidence


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """What a personalisation starts from.

    Attributes:
        template: shapes that all move something.
        seen: the frames.
        schedule: when to stop, and priors.
        overrides: shapes as the artist wants them.
        links: symmetric and exclusive shapes.
        rigid: whether the template's rigid vertices place the head alone.
    """

    template: Template
    seen: Observations
    schedule: Schedule
    overrides: tuple[Override, ...] = ()
    links: WeightLinks = field(default_factory=WeightLinks)
    rigid: bool = False

    @cached_property
    def told(self) -> Bools:
        """(B,) which shapes the artist has a word on."""
        found: Bools = np.isin(self.template.names, [item.name for item in self.overrides])
        return found


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """What a personalisation found.

    Attributes:
        first: the fit of the transferred template on the approximate neutral.
        fit: of the refined rig.
        turns: of the alternation.
        targets: (B, V, 3) the template's shapes transferred to the refined neutral, mm.
        settled: whether the energy settled; False when the turns ran out.
    """

    first: Fit
    fit: Fit
    turns: list[Iteration]
    targets: Floats
    settled: bool


def pose_frames(
    neutral: Floats,
    deltas: Floats,
    seen: Observations,
    priors: WeightPriors,
    start: Floats | None = None,
    links: WeightLinks | None = None,
    rigid: Floats | None = None,
) -> Fit:
    """Weights and head motion of every frame for a given neutral and shapes.

    Args:
        neutral: (V, 3) mm.
        deltas: (B, V, 3) mm.
        seen: the frames; weights known in them are kept.
        priors: of the weights.
        start: (F, B) guess, or None.
        links: symmetric and exclusive shapes.
        rigid: (V,) weights of the vertices that place the head alone, or None.
    """
    sums = sum_frames(neutral, deltas, seen.points, seen.confidence, rigid)
    if seen.weights is not None:
        return Fit(neutral, deltas, seen.weights, place_heads(sums, seen.weights))
    weights, motions = solve_weights(sums, seen.contiguous, priors, start, links)
    return Fit(neutral, deltas, weights, motions)


def pose_problem(
    problem: Problem,
    shapes: tuple[Floats, Floats],
    priors: WeightPriors,
    start: Floats | None = None,
) -> Fit:
    """The same with the problem's links and rigid vertices, for shapes (neutral, deltas)."""
    rigid = rigid_weights(problem.template, np.ones(len(shapes[0]))) if problem.rigid else None
    return pose_frames(*shapes, problem.seen, priors, start, problem.links, rigid)


def shape_mask(problem: Problem) -> Mask:
    """Where each shape may move: by the template, and where an override says so."""
    schedule, template = problem.schedule, problem.template
    mask = mask_shapes(template, Locality(mode=schedule.mask, tolerance=schedule.mask_tolerance))
    told = overridden(problem.overrides, template.names, len(template.neutral))
    each = told if mask.support.ndim == 2 else told[:, :, None]
    extra = None if mask.extra_offset is None else np.where(told, 0.0, mask.extra_offset)
    return Mask(mask.support | each, extra)


def update_priors(problem: Problem, fit: Fit, mask: Mask) -> UpdatePriors:
    """Bayes' shrinkage: variance of the noise, per coordinate, over that of the departure."""
    schedule, seen = problem.schedule, problem.seen
    rms_mm = weighted_rms(fit.residuals(seen.points), seen.confidence)
    noise_mm2 = max(rms_mm, _NOISE_FLOOR_MM) ** 2 / 3.0
    return replace(
        schedule.update,
        relative_mm2=noise_mm2 / schedule.variation**2,
        extra_offset=mask.extra_offset,
    )


def frames_evidence(problem: Problem, fit: Fit, targets: Floats) -> Evidence:
    """The frames; what shapes that were hardly exercised show is taken off, as not theirs."""
    seen = problem.seen
    offsets = undo_motion(fit, seen)
    if seen.weights is not None:
        return Evidence(offsets, seen.confidence, fit.weights)
    resting = (fit.weights.max(axis=0, initial=0.0) < EXERCISED) & ~problem.told
    offsets -= np.tensordot(fit.weights[:, resting], targets[resting], axes=1)
    return Evidence(offsets, seen.confidence, np.where(resting, 0.0, fit.weights))


def transferred(template: Template, neutral: Floats, schedule: Schedule) -> Floats:
    """The template's shapes (B, V, 3) on another neutral, by the schedule's kind of transfer."""
    if schedule.transfer == "rbf":
        return transfer_shapes_rbf(
            template, neutral, WarpSettings(tolerance=schedule.mask_tolerance)
        )
    return transfer_shapes(template, neutral, schedule.mask_tolerance)


def personalise(problem: Problem, neutral: Floats, progress: Progress = silent) -> Solution:
    """Transfer the template, then alternate weights with shapes until the energy settles.

    The targets D* belong to the neutral they were made on: they are made again once the neutral has
    moved from there. The gradient operator is rebuilt on the current neutral at every update. What
    the data cannot tell, a shape's size against its weights and where a shape rests, is fixed
    before each update (`rig.gauge`).

    Args:
        problem: template, frames and priors.
        neutral: (V, 3) the actor's approximate neutral in template space, mm.
        progress: told after each turn.

    References:
        Ma et al. 2016, section 3.
    """
    schedule = problem.schedule
    progress(0, schedule.iterations, "rig")
    work = _Alternation(problem, neutral)
    for turn in range(schedule.iterations):
        work.update()
        progress(turn + 1, schedule.iterations, "rig")
        if turn + 1 == schedule.iterations or work.settled():
            break
        work.pose(turn + 1)
    progress(schedule.iterations, schedule.iterations, "rig")
    return work.finish()


class _Alternation:
    """The state of the alternation between its steps."""

    def __init__(self, problem: Problem, neutral: Floats) -> None:
        schedule = problem.schedule
        names = problem.template.names
        self._problem, self._schedule = problem, schedule
        self._mask = shape_mask(problem)
        self._artist = override_evidence(problem.overrides, names) if problem.overrides else None
        self._triangles = problem.template.mesh.triangles
        self._carried = neutral
        self._original = self._transferred(neutral)
        self._targets = self._original
        self._first = pose_problem(problem, (neutral, self._original), schedule.weights)
        self._fit = self._first
        self._repeated = repetition(self._first.weights, problem.seen.contiguous)
        self._turns: list[Iteration] = []
        if problem.seen.weights is None:
            self.pose(0)

    def update(self) -> None:
        """Fix what the data leave open, then solve the neutral and all shapes."""
        fit = self._fit
        if len(self._turns) > 0 and _rms(fit.neutral - self._carried) > _RETRANSFER_MM:
            sizes = shape_sizes(self._targets, self._original)
            self._carried = fit.neutral
            self._original = self._transferred(fit.neutral)
            self._targets = self._original * sizes[:, None, None]
        if self._schedule.rescale:
            fit = self._fix_gauge(fit)
        self._targets = sculpted(
            self._targets, self._problem.overrides, self._problem.template.names
        )
        priors = update_priors(self._problem, fit, self._mask)
        if self._problem.seen.weights is None:  # who did what is not yet sure: learn slowly
            early = 1.0 + _STIFF_FIRST * 0.5 ** len(self._turns)
            priors = replace(priors, relative_mm2=priors.relative_mm2 * early)
        evidence = frames_evidence(self._problem, fit, self._targets)
        if self._artist is not None:
            evidence = evidence.with_rows(self._artist)
        neutral, deltas = update_shapes(
            fit.neutral,
            self._triangles,
            self._targets,
            self._mask.support,
            evidence,
            priors,
            fit.deltas,
        )
        self._fit = Fit(neutral, deltas, fit.weights, fit.motions)
        self._turns.append(self._measure(fit.neutral, priors))

    def pose(self, turn: int) -> None:
        """Solve weights and head motion, with room above 1 that the gauge takes back."""
        priors = self._schedule.posing(turn, self._repeated)
        if self._schedule.rescale and self._problem.seen.weights is None:
            priors = replace(priors, upper=_LOOSE_UPPER)
        shapes = self._fit.neutral, self._fit.deltas
        self._fit = pose_problem(self._problem, shapes, priors, self._fit.weights)

    def settled(self) -> bool:
        """Whether the last turn changed the energy by less than asked, the priors being final."""
        turns = self._turns
        if len(turns) < 2 or not self._schedule.relaxed(len(turns) - 2, self._repeated):
            return False
        change = abs(turns[-2].total - turns[-1].total)
        return change <= self._schedule.relative_change * turns[-1].total

    def finish(self) -> Solution:
        """The last weights, inside [0, 1]."""
        fit = pose_problem(
            self._problem, (self._fit.neutral, self._fit.deltas), self._schedule.weights,
            self._fit.weights,
        )  # fmt: skip
        return Solution(
            first=self._first, fit=fit, turns=self._turns, targets=self._original,
            settled=self.settled(),
        )  # fmt: skip

    def _transferred(self, neutral: Floats) -> Floats:
        shapes = transferred(self._problem.template, neutral, self._schedule)
        literal = self._mask.support.ndim == 3
        return np.where(self._mask.support, shapes, 0.0) if literal else shapes

    def _fix_gauge(self, fit: Fit) -> Fit:
        """Choose sizes and rests; where weights are known, targets take the sizes found so far."""
        seen = self._problem.seen
        if seen.weights is not None:
            sizes = shape_sizes(fit.deltas, self._original)
            self._targets = self._original * sizes[:, None, None]
            return fit
        looked = np.asarray(seen.confidence.any(axis=1))
        rest = resting_weights(fit.weights[looked])
        neutral = fit.neutral + np.tensordot(rest, fit.deltas, axes=1)
        weights = np.maximum(fit.weights - rest, 0.0)
        sizes = shape_sizes(fit.deltas, self._original)
        kept, linked = without_gaps(looked, seen.contiguous)
        scales = choose_scales(weights[kept], linked, sizes, self._schedule.size_variation)
        scales[self._problem.told] = 1.0
        deltas = fit.deltas * scales[:, None, None]
        self._targets = self._original * np.maximum(sizes * scales, 0.0)[:, None, None]
        return Fit(neutral, deltas, np.minimum(weights / scales, 1.0), fit.motions)

    def _measure(self, rest: Floats, priors: UpdatePriors) -> Iteration:
        """Energies of the updated rig at the weights it was solved with; `rest` (V, 3) before."""
        seen, fit = self._problem.seen, self._fit
        away = np.where(seen.confidence > 0, fit.residuals(seen.points), 0.0)
        frame, vertex = np.unravel_index(int(np.argmax(away)), away.shape)
        operator = gradient_operator(rest, self._triangles)
        area = mean_vertex_area(rest, self._triangles)
        moved = np.concatenate([(fit.neutral - rest)[None], fit.deltas - self._targets])
        change = moved.transpose(1, 0, 2)
        bent = operator @ change.reshape(len(rest), -1)
        stiffness = offset_stiffness(self._targets, priors)
        return Iteration(
            data=float(((seen.confidence * away) ** 2).sum()),
            gradient=float((bent**2).sum()) * priors.gradient_mm2 / area,
            offset=float((stiffness[:, :, None] * change**2).sum()),
            rms_mm=weighted_rms(away, seen.confidence),
            worst_mm=float(away[frame, vertex]),
            worst_vertex=int(vertex),
            worst_frame=int(frame),
        )


def _rms(offsets: Floats) -> float:
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))
