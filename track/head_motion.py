"""The head's rigid motion through a performance, found on the skin that moves least beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, check_shape
from capture.pose import Pose
from track.rigid import fit_similarity

_ROUNDS = 12
_FLOOR_MM = 0.06  # spread below which skin counts as rigid: thrice the tracker's own noise


@dataclass(frozen=True, eq=False, kw_only=True)
class HeadMotion:
    """Rigid head motion, and the skin it was measured on.

    Attributes:
        head_from_neutral: (F, 4, 4) motion from the neutral's place.
        rigid_weights: (V,) 0..1, how much each vertex spoke for it.
        spread_mm: (V,) root mean square distance of each vertex from rigid motion.
    """

    head_from_neutral: Floats
    rigid_weights: Floats
    spread_mm: Floats


def head_motion(neutral: Floats, vertices: Floats, confidence: Floats) -> HeadMotion:
    """Find the rigid motion that most of the upper face agrees on, over all frames at once.

    Reweighted Procrustes: a vertex that leaves the rigid motion in some frames loses its say in
    all frames, so moving skin (jaw, lips, brows, cheeks) drops out without being named. It starts
    from the upper half of the seen skin, world +Y being up.

    Args:
        neutral: (V, 3) mm.
        vertices: (F, V, 3) mm.
        confidence: (F, V) 0..1; 0 keeps a vertex out of a frame.

    Raises:
        SolveError: when the confident vertices do not span a plane.

    References:
        Beeler and Bradley 2014, "Rigid stabilization of facial expressions", for the problem;
        Geman and McClure 1987 for the weights.
    """
    check_shape(
        neutral=(neutral, "V 3"), vertices=(vertices, "F V 3"), confidence=(confidence, "F V")
    )
    seen = confidence.mean(axis=0) * (confidence.min(axis=0) > 0)
    if not (seen > 0).sum() >= 3:
        seen = np.ones(len(neutral))
    height = neutral[:, 1]
    weights = seen * np.where(height >= np.median(height[seen > 0]), 1.0, 0.05)
    motions, spread = _fit(neutral, vertices, weights)
    for _ in range(_ROUNDS):
        scale = max(_FLOOR_MM, _weighted_median(spread, weights))
        weights = seen / (1.0 + (spread / scale) ** 2) ** 2
        motions, spread = _fit(neutral, vertices, weights)
    return HeadMotion(
        head_from_neutral=motions,
        rigid_weights=weights / max(float(weights.max()), 1e-12),
        spread_mm=spread,
    )


def damped_motion(before: Floats, after: Floats, weights: Floats, share: float) -> Pose:
    """A share of the rigid motion that takes vertices `before` (V, 3) to `after` (V, 3).

    The turn is about the weighted centre of `after`, so that damping it does not fling the head.
    """
    check_shape(before=(before, "V 3"), after=(after, "V 3"), weights=(weights, "V"))
    whole = fit_similarity(before, after, weights)
    centre = np.average(after, axis=0, weights=weights)
    step = whole.apply(np.average(before, axis=0, weights=weights)) - np.average(
        before, axis=0, weights=weights
    )
    vector = Pose(whole.rotation, np.zeros(3)).rotation_vector()
    turn = Pose.from_rotation_vector(share * vector, np.zeros(3))
    return Pose(turn.rotation, centre - turn.rotation @ centre + share * step)


def _fit(neutral: Floats, vertices: Floats, weights: Floats) -> tuple[Floats, Floats]:
    motions = np.empty((len(vertices), 4, 4))
    square = np.zeros(len(neutral))
    for f, frame in enumerate(vertices):
        motion = fit_similarity(neutral, frame, weights)
        motions[f] = motion.matrix()
        square += ((motion.apply(neutral) - frame) ** 2).sum(axis=1)
    return motions, np.sqrt(square / max(len(vertices), 1))


def _weighted_median(values: Floats, weights: Floats) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])
