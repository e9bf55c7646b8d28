"""The alternation: weights and head motion, then neutral and shapes, until nothing moves."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from capture.arrays import Bools, Floats, Ints32
from capture.progress import Progress, silent
from rig.evidence import Evidence
from rig.gradient import gradient_operator
from rig.template import Template
from rig.transfer import transfer_shapes
from rig.update import (
    UpdatePriors,
    mean_vertex_area,
    offset_stiffness,
    update_shapes,
)
from rig.weights import WeightPriors, place_heads, solve_weights, sum_frames

_NOISE_FLOOR_MM = 0.05  # what tracking is never better than
_RETRANSFER_MM = 0.05  # root mean square move of the neutral that makes the transfer stale


@dataclass(frozen=True, eq=False)
class Observations:
    """Every frame of every performance, in order.

    Attributes:
        points: (F, V, 3) float64 world, mm; 0 where confidence is 0.
        confidence: (F, V) float64 0..1.
        contiguous: (F,) whether each frame follows the one before it in the same take.
        weights: (F, B) where they are known beforehand, or None.
    """

    points: Floats
    confidence: Floats
    contiguous: Bools
    weights: Floats | None = None


@dataclass(frozen=True, eq=False)
class Fit:
    """A rig and how it poses every frame.

    Attributes:
        neutral: (V, 3) rig space, mm.
        deltas: (B, V, 3) mm.
        weights: (F, B).
        motions: (F, 4, 4) head_from_rig.
    """

    neutral: Floats
    deltas: Floats
    weights: Floats
    motions: Floats

    def residuals(self, points: Floats) -> Floats:
        """Distance of each vertex of each frame from points (F, V, 3): (F, V), mm."""
        out = np.empty(points.shape[:2])
        for frame, motion in enumerate(self.motions):
            posed = self.neutral + np.tensordot(self.weights[frame], self.deltas, axes=1)
            away = posed @ motion[:3, :3].T + motion[:3, 3] - points[frame]
            out[frame] = np.linalg.norm(away, axis=1)
        return out


@dataclass(frozen=True)
class Iteration:
    """One turn of the alternation, in summed squared mm except where the unit is named.

    Attributes:
        data: E_g, confidence-weighted.
        gradient: lambda_r E_r.
        offset: lambda_d E_d.
        rms_mm: confidence-weighted root mean square residual.
        worst_mm: largest residual of a vertex with confidence.
        worst_vertex: its number.
        worst_frame: the frame it is in.
    """

    data: float
    gradient: float
    offset: float
    rms_mm: float
    worst_mm: float
    worst_vertex: int
    worst_frame: int

    @property
    def total(self) -> float:
        """The energy that both half-steps lower."""
        return self.data + self.gradient + self.offset


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How long to alternate, and with which priors.

    Attributes:
        iterations: most turns.
        relative_change: of the total energy, below which it stops.
        mask_tolerance: of a shape's extent, below which the template holds a vertex still.
        variation: how far the actor's shapes depart from the transferred ones, as a share of their
            own displacement. With the residual for noise it sets `relative_mm2` of the shapes
            step, anew at every turn.
        weights: priors of the weights step.
        update: priors of the shapes step.
    """

    iterations: int = 6
    relative_change: float = 0.005
    mask_tolerance: float = 1e-3
    variation: float = 0.2
    weights: WeightPriors = field(default_factory=WeightPriors)
    update: UpdatePriors = field(default_factory=UpdatePriors)


def weighted_rms(residuals: Floats, confidence: Floats) -> float:
    """Root mean square of residuals (F, V), mm, weighted by squared confidence (F, V)."""
    square = confidence**2
    return float(np.sqrt((square * residuals**2).sum() / max(float(square.sum()), 1e-300)))


def pose_frames(
    neutral: Floats,
    deltas: Floats,
    seen: Observations,
    priors: WeightPriors,
    start: Floats | None = None,
) -> Fit:
    """Weights and head motion of every frame for a given neutral and shapes."""
    sums = sum_frames(neutral, deltas, seen.points, seen.confidence)
    if seen.weights is not None:
        return Fit(neutral, deltas, seen.weights, place_heads(sums, seen.weights))
    weights, motions = solve_weights(sums, seen.contiguous, priors, start)
    return Fit(neutral, deltas, weights, motions)


def personalise(
    template: Template,
    neutral: Floats,
    seen: Observations,
    schedule: Schedule,
    progress: Progress = silent,
) -> tuple[Fit, Fit, list[Iteration]]:
    """Transfer the template, then alternate weights with shapes until the energy settles.

    The targets D* belong to the neutral they were made on: they are made again once the neutral has
    moved from there. The gradient operator is rebuilt on the current neutral at every update.

    Args:
        template: shapes that all move something.
        neutral: (V, 3) the actor's approximate neutral in template space, mm.
        seen: the frames.
        schedule: when to stop, and priors.
        progress: told after each turn.

    Returns:
        the fit of the transferred template, the fit of the refined rig, and each turn.

    References:
        Ma et al. 2016, section 3.
    """
    support = template.support(schedule.mask_tolerance)
    triangles = template.mesh.triangles
    targets = transfer_shapes(template, neutral, schedule.mask_tolerance)
    first = pose_frames(neutral, targets, seen, schedule.weights)
    fit, carried, turns = first, neutral, list[Iteration]()
    progress(0, schedule.iterations, "rig")
    for turn in range(schedule.iterations):
        evidence = Evidence(_undo_motion(fit, seen), seen.confidence, fit.weights)
        priors = _priors(schedule, weighted_rms(fit.residuals(seen.points), seen.confidence))
        neutral, deltas = update_shapes(
            fit.neutral, triangles, targets, support, evidence, priors, fit.deltas
        )
        start = neutral - fit.neutral
        turns.append(_measure(fit, (neutral, deltas, start), targets, seen, priors, triangles))
        fit = pose_frames(neutral, deltas, seen, schedule.weights, fit.weights)
        progress(turn + 1, schedule.iterations, "rig")
        settled = len(turns) > 1 and (
            abs(turns[-2].total - turns[-1].total) <= schedule.relative_change * turns[-1].total
        )
        if settled or turn + 1 == schedule.iterations:
            break
        if _distance_rms(neutral, carried) > _RETRANSFER_MM:
            targets = transfer_shapes(template, neutral, schedule.mask_tolerance)
            carried = neutral
    progress(schedule.iterations, schedule.iterations, "rig")
    return first, fit, turns


def _priors(schedule: Schedule, rms_mm: float) -> UpdatePriors:
    """Bayes' shrinkage: variance of the noise, per coordinate, over that of the departure."""
    noise_mm2 = max(rms_mm, _NOISE_FLOOR_MM) ** 2 / 3.0
    return replace(schedule.update, relative_mm2=noise_mm2 / schedule.variation**2)


def _distance_rms(a: Floats, b: Floats) -> float:
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))


def _undo_motion(fit: Fit, seen: Observations) -> Floats:
    """Points of every frame in rig space, minus the neutral: (F, V, 3), mm."""
    rotation, translation = fit.motions[:, :3, :3], fit.motions[:, None, :3, 3]
    offsets: Floats = (seen.points - translation) @ rotation - fit.neutral
    offsets[seen.confidence <= 0] = 0.0
    return offsets


def _measure(
    fit: Fit,
    updated: tuple[Floats, Floats, Floats],
    targets: Floats,
    seen: Observations,
    priors: UpdatePriors,
    triangles: Ints32,
) -> Iteration:
    neutral, deltas, shift = updated
    away = Fit(neutral, deltas, fit.weights, fit.motions).residuals(seen.points)
    away = np.where(seen.confidence > 0, away, 0.0)
    frame, vertex = np.unravel_index(int(np.argmax(away)), away.shape)
    operator = gradient_operator(fit.neutral, triangles)
    area = mean_vertex_area(fit.neutral, triangles)
    change = np.concatenate([shift[None], deltas - targets]).transpose(1, 0, 2)
    bent = operator @ change.reshape(len(neutral), -1)
    return Iteration(
        data=float(((seen.confidence * away) ** 2).sum()),
        gradient=float((bent**2).sum()) * priors.gradient_mm2 / area,
        offset=float((offset_stiffness(targets, priors)[:, :, None] * change**2).sum()),
        rms_mm=weighted_rms(away, seen.confidence),
        worst_mm=float(away[frame, vertex]),
        worst_vertex=int(vertex),
        worst_frame=int(frame),
    )
