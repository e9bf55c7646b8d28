"""How near a solved rig comes to the hidden one: shapes, their scale and meaning, and weights."""

from __future__ import annotations

from typing import Any

import numpy as np

from capture.arrays import Bools, Floats, check_shape
from rig.face_rig import FaceRig
from rig.neutral_frame import align_frame
from rig.transfer import transfer_shapes
from tools.bench.rig_beds import HiddenRig

_EXERCISED = 0.5  # largest true weight above which a shape was exercised
_ACTIVE = 0.01


def laid_on(truth: Floats, rig: FaceRig) -> tuple[Floats, Floats]:
    """Neutral (V, 3) and shapes (B, V, 3) of a rig laid rigidly onto the true neutral, mm."""
    rotation, shift = align_frame(truth, rig.neutral, np.ones(len(truth)))
    return rig.neutral @ rotation.T + shift, rig.deltas @ rotation.T


def shape_rms(found: Floats, truth: Floats, acting: Bools, counted: Bools) -> float:
    """Root mean square error of the counted shapes (B, V, 3) where they act (B, V), mm."""
    check_shape(found=(found, "B V 3"), truth=(truth, "B V 3"), acting=(acting, "B V"))
    square = ((found - truth) ** 2).sum(axis=2)
    means = [float(square[k][acting[k]].mean()) for k in np.flatnonzero(counted)]
    return float(np.sqrt(np.mean(means)))


def best_scales(found: Floats, truth: Floats) -> Floats:
    """(B,) what each shape is to be multiplied with to come nearest to the truth; 0 for none."""
    own = (found**2).sum(axis=(1, 2))
    scales: Floats = (found * truth).sum(axis=(1, 2)) / np.where(own > 0.0, own, np.inf)
    return scales


def correlations(found: Floats, truth: Floats) -> Floats:
    """(B,) cosine between each shape and the true one."""
    lengths = np.linalg.norm(found, axis=(1, 2)) * np.linalg.norm(truth, axis=(1, 2))
    cosines: Floats = (found * truth).sum(axis=(1, 2)) / np.where(lengths > 0.0, lengths, np.inf)
    return cosines


def semantics(hidden: HiddenRig, weights: Floats, rig: FaceRig) -> dict[str, Any]:
    """Whether shapes still mean what the artist meant.

    Args:
        hidden: template and truth.
        weights: (F, B) true ones.
        rig: as it was solved.

    Returns:
        `worst_fall`: the largest fall of an exercised shape's correlation with the truth against
        the template's, and `worst_shape`; `unexercised_mm`: how far, at most, a shape that no
        frame shows is from the template transferred to the solver's own neutral.
    """
    exercised = weights.max(axis=0) > _EXERCISED
    fall = correlations(hidden.template.deltas, hidden.deltas) - correlations(
        laid_on(hidden.neutral, rig)[1], hidden.deltas
    )
    worst = int(np.argmax(np.where(exercised, fall, -np.inf)))
    resting = weights.max(axis=0) <= 0.0
    apart = 0.0
    if resting.any():
        transferred = transfer_shapes(hidden.template, rig.neutral)
        away = np.linalg.norm(rig.deltas[resting] - transferred[resting], axis=2)
        apart = float(away.max())
    return {
        "worst_fall": round(float(fall[worst]), 4),
        "worst_shape": hidden.template.names[worst],
        "unexercised": int(resting.sum()),
        "unexercised_mm": round(apart, 4),
    }


def solved_scores(hidden: HiddenRig, weights: Floats, rig: FaceRig) -> dict[str, Any]:
    """Shape, neutral and weight errors against the truth; shapes as a ratio to the template's.

    The template's error is that of its shapes transferred to the true neutral.
    """
    acting = np.linalg.norm(hidden.template.deltas, axis=2) > 1e-3
    exercised = weights.max(axis=0) > _EXERCISED
    neutral, deltas = laid_on(hidden.neutral, rig)
    generic = transfer_shapes(hidden.template, hidden.neutral)

    def error(found: Floats, scaled: bool) -> float:
        scale = best_scales(found, hidden.deltas) if scaled else np.ones(len(found))
        return shape_rms(scale[:, None, None] * found, hidden.deltas, acting, exercised)

    scale = best_scales(deltas, hidden.deltas)
    fitted = rig.weights / np.where(scale > 0.0, scale, 1.0)
    away = neutral - hidden.neutral
    return {
        "shape/DT": round(error(deltas, False) / error(generic, False), 3),
        "gauge/DT": round(error(deltas, True) / error(generic, True), 3),
        "neutral_mm": round(float(np.sqrt((away**2).sum(axis=1).mean())), 4),
        "weights": round(_rms(rig.weights - weights), 4),
        "weights_scaled": round(_rms(fitted - weights), 4),
        "active": round(float((rig.weights > _ACTIVE).sum(axis=1).mean()), 2),
        "active_true": round(float((weights > _ACTIVE).sum(axis=1).mean()), 2),
    }


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))
