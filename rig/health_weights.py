"""Weights as a sign of health: use, bounds, scale against the template, interference, jitter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats, check_shape

ACTIVE = 0.01  # weight above which a shape counts as active in a frame
EXERCISED = 0.1  # largest weight above which a shape counts as exercised
WEAK = 0.5  # largest weight below which an exercised shape's size is anybody's guess
DRIFTED = (0.67, 1.5)  # scale against the transferred template outside which it has drifted
_AT_BOUND = 1e-9
_ALIKE = 0.3  # cosine above which a pair of shapes is told as overlapping
_APART = 0.1  # cosine below which the template keeps two shapes apart
_TOGETHER = 0.5  # correlation of weights above which such a pair is told
_MOST = 20  # pairs told at most


def activity(weights: Floats, names: Sequence[str]) -> dict[str, Any]:
    """How many shapes act at once, which never do, and how much lies at the bounds.

    Args:
        weights: (F, B).
        names: B names.

    Returns:
        active shapes a frame (above 0.01): mean, 95th percentile, most; shapes whose weight never
        reaches 0.1; shares of all weights at 0 and at 1; how many lie outside 0..1.
    """
    check_shape(weights=(weights, "F B"), names=(np.asarray(names), "B"))
    active = (weights > ACTIVE).sum(axis=1)
    peaks = weights.max(axis=0, initial=0.0)
    count = max(weights.size, 1)
    return {
        "active_mean": float(active.mean()) if len(active) else 0.0,
        "active_p95": float(np.percentile(active, 95)) if len(active) else 0.0,
        "active_max": int(active.max(initial=0)),
        "never_exercised": [n for n, p in zip(names, peaks, strict=True) if p < EXERCISED],
        "at_zero_share": float((np.abs(weights) <= _AT_BOUND).sum() / count),
        "at_one_share": float((np.abs(weights - 1.0) <= _AT_BOUND).sum() / count),
        "outside_bounds": int(((weights < -_AT_BOUND) | (weights > 1.0 + _AT_BOUND)).sum()),
    }


def gauge_report(
    deltas: Floats, targets: Floats | None, weights: Floats, names: Sequence[str]
) -> dict[str, Any]:
    """Where a shape's size and its weights may have traded a factor.

    Only the product of shape and weight is seen in frames. Against the transferred shape D* the
    scale of a solved one is <D, D*> / <D*, D*>.

    Args:
        deltas: (B, V, 3) mm.
        targets: (B, V, 3) the template's shapes on the actor, mm; or None.
        weights: (F, B).
        names: B names.

    Returns:
        "shapes": of each its peak weight, the natural logarithm of it (None at 0), scale and cosine
        against D* (None without one or where it is zero), and amplitude = peak x scale;
        "drifted": those whose scale lies outside 0.67..1.5; "weak": exercised ones whose weight
        never reaches 0.5, whose size the captures therefore hardly fix.
    """
    check_shape(deltas=(deltas, "B V 3"), weights=(weights, "F B"), names=(np.asarray(names), "B"))
    peaks = weights.max(axis=0, initial=0.0)
    shapes, drifted, weak = {}, [], []
    for k, name in enumerate(names):
        peak = float(peaks[k])
        scale, cosine = (None, None) if targets is None else _scale(deltas[k], targets[k])
        shapes[name] = {
            "peak_weight": peak,
            "log_peak_weight": float(np.log(peak)) if peak > 0 else None,
            "scale": scale,
            "cosine": cosine,
            "amplitude": None if scale is None else peak * scale,
        }
        if scale is not None and not DRIFTED[0] <= scale <= DRIFTED[1]:
            drifted.append(name)
        if EXERCISED <= peak < WEAK:
            weak.append(name)
    return {"shapes": shapes, "drifted": drifted, "weak": weak}


def overlaps(deltas: Floats) -> Floats:
    """(B, B) cosines between shapes; 0 where one moves nothing."""
    check_shape(deltas=(deltas, "B V 3"))
    flat = deltas.reshape(len(deltas), 3 * deltas.shape[1])
    sizes = np.sqrt(np.einsum("bn,bn->b", flat, flat))
    unit = np.where(sizes > 1e-9, sizes, np.inf)
    cosines: Floats = (flat @ flat.T) / np.outer(unit, unit)
    return cosines


def interference_report(
    cosines: Floats, template_cosines: Floats | None, weights: Floats, names: Sequence[str]
) -> dict[str, Any]:
    """Shapes that do each other's work, and weights that move together without need.

    Args:
        cosines: (B, B) of the rig's shapes, from `overlaps`.
        template_cosines: (B, B) of the template's; or None.
        weights: (F, B).
        names: B names.

    Returns:
        "overlapping": at most 20 pairs with |cosine| >= 0.3, the strongest first, with the
        template's cosine; "cross_activated": at most 20 pairs whose weights correlate by 0.5 or
        more though the template (the rig, without one) keeps their shapes below a cosine of 0.1.
    """
    check_shape(cosines=(cosines, "B B"), weights=(weights, "F B"), names=(np.asarray(names), "B"))
    apart = np.abs(cosines if template_cosines is None else template_cosines) < _APART
    correlated = _correlations(weights)
    overlapping = [
        {
            "shapes": [names[i], names[j]],
            "cosine": float(cosines[i, j]),
            "template_cosine": None if template_cosines is None else float(template_cosines[i, j]),
        }
        for i, j in _strongest(np.abs(cosines), _ALIKE)
    ]
    crossed = [
        {"shapes": [names[i], names[j]], "correlation": float(correlated[i, j])}
        for i, j in _strongest(np.where(apart, correlated, 0.0), _TOGETHER)
    ]
    return {"overlapping": overlapping, "cross_activated": crossed}


def jitter_report(
    weights: Floats, deltas: Floats, contiguous: Bools, names: Sequence[str]
) -> dict[str, Any]:
    """Root mean square second difference in time, of weights and of the vertices they move.

    Args:
        weights: (F, B).
        deltas: (B, V, 3) mm.
        contiguous: (F,) whether each frame follows the one before it in the same take.
        names: B names.

    Returns:
        "weights_rms" a frame and shape and "vertices_rms_mm" over all takes (None without three
        contiguous frames), "worst_shape" with its own root mean square, and each take of three
        frames or more with its first frame.
    """
    check_shape(weights=(weights, "F B"), deltas=(deltas, "B V 3"), contiguous=(contiguous, "F"))
    middle = np.flatnonzero(contiguous[1:-1] & contiguous[2:]) + 1
    bend = weights[middle - 1] - 2.0 * weights[middle] + weights[middle + 1]
    flat = deltas.reshape(len(deltas), 3 * deltas.shape[1])
    gram = flat @ flat.T / max(deltas.shape[1], 1)
    square = np.maximum(np.einsum("fb,bc,fc->f", bend, gram, bend), 0.0)
    starts = np.flatnonzero(~contiguous)
    take_of = np.searchsorted(starts, middle, side="right")
    takes = []
    for take in np.unique(take_of):
        inside = take_of == take
        takes.append(
            {
                "first_frame": int(starts[take - 1]) if take else 0,
                "frames": int(inside.sum()) + 2,
                "weights_rms": float(np.sqrt((bend[inside] ** 2).mean())),
                "vertices_rms_mm": float(np.sqrt(square[inside].mean())),
            }
        )
    some = bool(bend.size)
    per_shape = np.sqrt((bend**2).mean(axis=0)) if some else np.zeros(weights.shape[1])
    return {
        "weights_rms": float(np.sqrt((bend**2).mean())) if some else None,
        "vertices_rms_mm": float(np.sqrt(square.mean())) if some else None,
        "worst_shape": names[int(np.argmax(per_shape))] if some else None,
        "worst_shape_rms": float(per_shape.max()) if some else None,
        "takes": takes,
    }


def _scale(delta: Floats, target: Floats) -> tuple[float | None, float | None]:
    own, wanted = float((delta**2).sum()), float((target**2).sum())
    if wanted <= 1e-18:
        return None, None
    product = float((delta * target).sum())
    return product / wanted, product / np.sqrt(own * wanted) if own > 1e-18 else None


def _correlations(weights: Floats) -> Floats:
    """Pearson's correlation of every two columns (B, B); 0 where one does not vary."""
    if len(weights) < 3:
        return np.zeros((weights.shape[1],) * 2)
    centred = weights - weights.mean(axis=0)
    sizes = np.sqrt((centred**2).sum(axis=0))
    varying = weights.max(axis=0) - weights.min(axis=0) > ACTIVE
    unit = np.where(varying, sizes, np.inf)
    correlated: Floats = (centred.T @ centred) / np.outer(unit, unit)
    return correlated


def _strongest(values: Floats, least: float) -> list[tuple[int, int]]:
    """Pairs (i < j) whose value reaches `least`, the largest first, at most 20."""
    first, second = np.triu_indices(len(values), 1)
    found = values[first, second]
    order = np.argsort(-found, kind="stable")[:_MOST]
    return [(int(first[k]), int(second[k])) for k in order if found[k] >= least]
