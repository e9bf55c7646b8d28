"""The health of a rig: what it can be trusted with, told in numbers. See docs/health.md."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats, check_shape
from capture.errors import InputError
from rig.captures import (
    Captures,
    leverages,
    redundant_captures,
    remaining_uncertainty,
    suggest_captures,
)
from rig.degenerate import find_degenerate
from rig.face_rig import FaceRig
from rig.fit import Fit, Observations, weighted_rms
from rig.health_contact import contact_report
from rig.health_symmetry import find_mirror, symmetry_report
from rig.health_weights import (
    activity,
    gauge_report,
    interference_report,
    jitter_report,
    overlaps,
)
from rig.mouth_close import find_mouth_shapes, guess_convention
from rig.solve import Schedule, pose_frames
from rig.template import ZERO_SHAPE_MM, Template
from rig.transfer import transfer_shapes
from rig.weights import WeightPriors

VERSION = 1
"""Of the report: it grows when a key changes its meaning or goes."""
UNDETERMINED = 0.5  # share of the prior's variance left above which a shape counts as unknown
_ALLOWED_GROWTH = 0.1  # of the total variance, by leaving out redundant captures
_AT_REST = 0.1  # a frame whose weights all lie below shows the neutral
_NOISE_MM = 0.3  # of a vertex, where no frames say
_LEAST_NOISE_MM = 0.05  # what tracking is never better than


def rig_health(
    rig: FaceRig,
    template: Template | None = None,
    *,
    seen: Observations | None = None,
    held_out: Observations | None = None,
    priors: WeightPriors | None = None,
    transferred: Floats | None = None,
    variation: float = Schedule.variation,
) -> dict[str, Any]:
    """Everything that can be told of a rig's health from what is at hand, ready for JSON.

    Args:
        rig: the solved rig with the weights of the frames it was solved on.
        template: the artist's rig, same names and vertices; without it nothing is compared.
        seen: the frames that the rig was solved on, as many as it has weights.
        held_out: frames that it was not solved on, in the same topology.
        priors: of the weights solved on held-out frames; the solver's own when None.
        transferred: (B, V, 3) the template's shapes on the actor, mm; made when None.
        variation: expected departure of shapes from those, as a share of their displacement.

    Returns:
        a dict of the keys that docs/health.md lists; a key whose inputs are missing is None.

    Raises:
        InputError: when vertices, names or frames do not fit each other.
    """
    _check(rig, template, seen, held_out)
    targets = transferred
    if targets is None and template is not None:
        targets = transferred_shapes(template, rig.neutral)
    cosines = overlaps(rig.deltas)
    contiguous = _one_take(len(rig.weights)) if seen is None else seen.contiguous
    lost = None if seen is None else detail_lost(rig, seen)
    noise_mm = _NOISE_MM if lost is None else max(lost["rmse_mm"], _LEAST_NOISE_MM)
    mirror = find_mirror(rig.neutral if template is None else template.neutral)
    return {
        "version": VERSION,
        "frames": len(rig.weights),
        "shapes": len(rig.names),
        "degenerate": find_degenerate(rig.deltas, rig.names, rig.neutral).as_report(),
        "held_out": None
        if held_out is None
        else held_out_error(rig, held_out, priors or WeightPriors(), targets),
        "activity": activity(rig.weights, rig.names),
        "gauge": gauge_report(rig.deltas, targets, rig.weights, rig.names),
        "contact": None if template is None else contact_report(rig.neutral, rig.deltas, template),
        "symmetry": symmetry_report(
            rig.deltas, rig.names, mirror, None if template is None else template.deltas
        ),
        "interference": interference_report(
            cosines, None if targets is None else overlaps(targets), rig.weights, rig.names
        ),
        "jitter": jitter_report(rig.weights, rig.deltas, contiguous, rig.names),
        "captures": captures_report(rig, noise_mm, targets, variation) | {"detail_lost": lost},
        "mouth_close": mouth_close_report(rig, template),
    }


def transferred_shapes(template: Template, neutral: Floats) -> Floats:
    """The template's shapes (B, V, 3) on another neutral, mm; those that move nothing as zeros."""
    moving = template.moves()
    targets = np.zeros(template.deltas.shape)
    if moving.any():
        targets[moving] = transfer_shapes(template.with_shapes(moving), neutral)
    return targets


def held_out_error(
    rig: FaceRig,
    held_out: Observations,
    priors: WeightPriors,
    template_deltas: Floats | None = None,
) -> dict[str, Any]:
    """How well a rig reaches frames it was not solved on, weights and head motion solved anew.

    Both the root mean square and the largest error are told: still vertices lower the former.

    Args:
        rig: shapes and neutral, held fixed.
        held_out: the frames; weights known in them are kept.
        priors: of the weights.
        template_deltas: (B, V, 3) shapes to compare with, on the same neutral, mm; or None.

    Returns:
        errors of the frames, those of the template's shapes, and "ratio" of the root mean squares.

    References:
        Menzel et al. 2022, Eq 5 and the remark on it.
    """
    error = _solved_error(rig.neutral, rig.deltas, held_out, priors)
    if template_deltas is None:
        return error | {"template": None, "ratio": None}
    other = _solved_error(rig.neutral, template_deltas, held_out, priors)
    base = other["rmse_mm"]
    return error | {"template": other, "ratio": error["rmse_mm"] / base if base > 0 else None}


def detail_lost(rig: FaceRig, seen: Observations) -> dict[str, Any]:
    """What of each captured frame the rig does not reproduce, at the weights it was solved with.

    References:
        Hable: detail lost, scan against solved, per pose.
    """
    check_shape(weights=(rig.weights, "F B"), points=(seen.points, "F V 3"))
    return _error(Fit(rig.neutral, rig.deltas, rig.weights, rig.head_from_rig), seen)


def captures_report(
    rig: FaceRig,
    noise_mm: float,
    targets: Floats | None = None,
    variation: float = Schedule.variation,
) -> dict[str, Any]:
    """Leverage of each frame, frames to leave out, shapes left unknown, expressions to shoot next.

    Each shape is judged at the vertices it moves most (means weighted by squared displacement),
    where the actor may depart from the template by `Schedule.variation` of the displacement.
    Weights are taken as known and neighbouring vertices to say nothing of each other: the figures
    rank shapes and frames, and are no bounds of error.

    Args:
        rig: weights say what was captured; shapes that move nothing are left out.
        noise_mm: root mean square error of a captured vertex, mm.
        targets: (B, V, 3) the prior's shapes, mm; the rig's own when None.
        variation: expected departure from them, as a share of their displacement.
    """
    shapes = rig.deltas if targets is None else targets
    square = np.einsum("bva,bva->bv", shapes, shapes)
    moving = np.sqrt(square.max(axis=1, initial=0.0)) > ZERO_SHAPE_MM
    square = square[moving]
    total, fourth = square.sum(axis=1), (square**2).sum(axis=1)
    areas = total**2 / fourth / square.shape[1]  # of the vertices, as many as move like the strong
    captures = Captures(
        weights=rig.weights[:, moving],
        ridge=noise_mm**2 * total / (variation**2 * fourth),
        areas=areas,
    )
    names = [name for name, moves in zip(rig.names, moving, strict=True) if moves]
    left = remaining_uncertainty(captures)
    error_mm = noise_mm * np.sqrt(areas * np.diag(captures.covariance()))
    return {
        "noise_mm": noise_mm,
        "leverage": [float(h) for h in leverages(captures)],
        "redundant": [
            {"frame": drop.frame, "growth": drop.growth}
            for drop in redundant_captures(captures, _ALLOWED_GROWTH)
            if rig.weights[drop.frame].max(initial=0.0) > _AT_REST  # the neutral is never to spare
        ],
        "uncertainty": {name: float(u) for name, u in zip(names, left, strict=True)},
        "expected_error_mm": {name: float(e) for name, e in zip(names, error_mm, strict=True)},
        "undetermined": [n for n, u in zip(names, left, strict=True) if u > UNDETERMINED],
        "shoot_next": [
            {"shapes": [names[k] for k in suggestion.shapes], "gain": suggestion.gain}
            for suggestion in suggest_captures(captures, 5, overlaps(shapes[moving]))
        ],
    }


def mouth_close_report(rig: FaceRig, template: Template | None) -> dict[str, Any] | None:
    """Which convention mouthClose follows, in the rig and in the template; None without one."""
    found = find_mouth_shapes(rig.names)
    if found is None:
        return None
    jaw, close = found
    pairs = None if template is None else template.lip_pairs
    return {
        "shape": rig.names[close],
        "convention": guess_convention(rig.neutral, rig.deltas[jaw], rig.deltas[close], pairs),
        "template_convention": None
        if template is None
        else guess_convention(
            template.neutral, template.deltas[jaw], template.deltas[close], pairs
        ),
    }


def _solved_error(
    neutral: Floats, deltas: Floats, frames: Observations, priors: WeightPriors
) -> dict[str, Any]:
    check_shape(deltas=(deltas, "B V 3"), points=(frames.points, "F V 3"))
    moving = np.abs(deltas).max(axis=(1, 2), initial=0.0) > ZERO_SHAPE_MM
    known = frames.weights
    some = replace(frames, weights=None if known is None else known[:, moving])
    return _error(pose_frames(neutral, deltas[moving], some, priors), frames)


def _error(fit: Fit, frames: Observations) -> dict[str, Any]:
    """Confidence-weighted root mean square and largest distance, over all and of each frame."""
    away = np.where(frames.confidence > 0, fit.residuals(frames.points), 0.0)
    square = frames.confidence**2
    mass = square.sum(axis=1)
    means = (square * away**2).sum(axis=1) / np.where(mass > 0, mass, 1.0)
    most = away.max(axis=1, initial=0.0)
    worst = int(np.argmax(most)) if len(most) else 0
    return {
        "frames": len(away),
        "rmse_mm": weighted_rms(away, frames.confidence),
        "mean_max_mm": float(most.mean()) if len(most) else 0.0,
        "max_mm": float(most.max(initial=0.0)),
        "worst_frame": worst,
        "worst_vertex": int(np.argmax(away[worst])) if len(most) else 0,
        "per_frame_rmse_mm": [float(value) for value in np.sqrt(means)],
        "per_frame_max_mm": [float(value) for value in most],
    }


def _one_take(frames: int) -> Bools:
    following = np.ones(frames, dtype=bool)
    following[:1] = False
    return following


def _check(
    rig: FaceRig,
    template: Template | None,
    seen: Observations | None,
    held_out: Observations | None,
) -> None:
    count = len(rig.neutral)
    if template is not None and template.names != rig.names:
        odd = sorted(set(template.names) ^ set(rig.names))
        what = f"not in both: {', '.join(odd[:8])}" if odd else "in another order"
        raise InputError(f"health: rig and template need the same shape names; {what}")
    if template is not None and len(template.neutral) != count:
        raise InputError(
            f"health: the rig has {count} vertices, the template {len(template.neutral)}: "
            "both must be in one topology"
        )
    for called, frames in (("captured", seen), ("held-out", held_out)):
        if frames is not None and frames.points.shape[1] != count:
            raise InputError(
                f"health: the rig has {count} vertices, the {called} frames "
                f"{frames.points.shape[1]}: both must be in one topology"
            )
    if seen is not None and len(seen.points) != len(rig.weights):
        raise InputError(
            f"health: the rig was solved on {len(rig.weights)} frames, the performances hold "
            f"{len(seen.points)}: give the ones it was solved on, in the same order"
        )
