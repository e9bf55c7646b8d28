"""Strengths chosen by frames that were held out of the shapes' solve."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from capture.arrays import Bools, Floats, Ints
from capture.errors import InputError
from capture.progress import Progress, silent
from rig.evidence import Evidence
from rig.fit import Fit, Observations, weighted_rms
from rig.overrides import override_evidence
from rig.solve import (
    Problem,
    Schedule,
    frames_evidence,
    pose_problem,
    shape_mask,
    update_priors,
)
from rig.update import update_shapes

_FOLDS = 4
_BLOCK = 8  # contiguous frames that are held out together
_VARIATIONS = (0.05, 0.1, 0.2, 0.4, 0.8)
_GRADIENTS_MM2 = (0.01, 0.1, 1.0, 10.0, 100.0)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One pair of strengths, and what it makes of frames that it has not seen.

    Attributes:
        variation: as in the schedule.
        gradient_mm2: as in the update's priors.
        held_out_mm: root mean square residual of the held-out frames.
    """

    variation: float
    gradient_mm2: float
    held_out_mm: float


def choose_strengths(
    problem: Problem, fit: Fit, targets: Floats, progress: Progress = silent
) -> tuple[Schedule, list[Trial]]:
    """Choose `variation`, then `gradient_mm2`, by what the shapes make of held-out frames.

    Shapes are solved from three quarters of the frames, four times; the others are then posed with
    them, their known weights kept or theirs solved anew. Frames that follow each other in a take
    are held out together, as they are all but the same frame.

    Args:
        problem: template, frames and the schedule to improve.
        fit: of a rig whose weights and head motion are trusted.
        targets: (B, V, 3) the transferred shapes in the scale of the fit's, mm.
        progress: told after each trial.

    Returns:
        the schedule with the best strengths, and every trial.

    Raises:
        InputError: when there is nothing to hold out.
    """
    schedule = problem.schedule
    trials: list[Trial] = []
    total = len(_VARIATIONS) + len(_GRADIENTS_MM2) + 1
    base = schedule.update.gradient_mm2
    best = schedule.variation
    folds = list(_folds(problem.seen))
    if not folds:
        raise InputError(
            f"rig.hold_out wants frames to hold out: more than {_BLOCK} of one take, or several "
            f"takes; found {len(problem.seen.points)}"
        )
    for variation, gradient in _candidates(schedule.variation, base):
        chosen = best if variation is None else variation
        if any((t.variation, t.gradient_mm2) == (chosen, gradient) for t in trials):
            continue
        tried = replace(
            schedule, variation=chosen, update=replace(schedule.update, gradient_mm2=gradient)
        )
        error = _held_out(replace(problem, schedule=tried), fit, targets, folds)
        trials.append(Trial(variation=chosen, gradient_mm2=gradient, held_out_mm=error))
        best = min(trials, key=lambda t: t.held_out_mm).variation
        progress(min(len(trials), total), total, "hold-out")
    winner = min(trials, key=lambda t: t.held_out_mm)
    update = replace(schedule.update, gradient_mm2=winner.gradient_mm2)
    return replace(schedule, variation=winner.variation, update=update), trials


def _candidates(own: float, base: float) -> Iterator[tuple[float | None, float]]:
    """Variations at the base gradient first; then gradients, at the best variation by then."""
    yield from ((variation, base) for variation in (own, *_VARIATIONS))
    yield from ((None, gradient) for gradient in _GRADIENTS_MM2)


def _folds(seen: Observations) -> Iterator[Bools]:
    """For each fold, which frames (F,) are held out."""
    fresh = ~seen.contiguous
    fresh[:1] = True
    start = np.maximum.accumulate(np.where(fresh, np.arange(len(fresh)), 0))
    fresh |= (np.arange(len(fresh)) - start) % _BLOCK == 0
    block: Ints = np.cumsum(fresh) - 1
    folds = min(_FOLDS, int(block[-1]) + 1)
    for fold in range(folds if folds > 1 else 0):
        yield block % folds == fold


def _held_out(problem: Problem, fit: Fit, targets: Floats, folds: list[Bools]) -> float:
    schedule, seen, template = problem.schedule, problem.seen, problem.template
    mask = shape_mask(problem)
    priors = update_priors(problem, fit, mask)
    whole = frames_evidence(problem, fit, targets)
    square, mass = 0.0, 0.0
    for out in folds:
        kept = ~out
        evidence = Evidence(whole.offsets[kept], whole.confidence[kept], whole.weights[kept])
        if problem.overrides:
            evidence = evidence.with_rows(override_evidence(problem.overrides, template.names))
        shapes = update_shapes(
            fit.neutral,
            template.mesh.triangles,
            targets,
            mask.support,
            evidence,
            priors,
            fit.deltas,
        )
        part = Observations(
            seen.points[out], seen.confidence[out],
            (seen.contiguous & np.concatenate([[False], out[:-1]]))[out],
            None if seen.weights is None else seen.weights[out],
        )  # fmt: skip
        posed = pose_problem(
            replace(problem, seen=part), shapes, schedule.weights, fit.weights[out]
        )
        error = weighted_rms(posed.residuals(part.points), part.confidence)
        weight = float((part.confidence**2).sum())
        square, mass = square + weight * error**2, mass + weight
    return float(np.sqrt(square / mass)) if mass > 0 else float("nan")
