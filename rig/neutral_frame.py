"""The actor's approximate neutral: which frame shows it, and that frame in the template's space."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from capture.arrays import Floats, Ints, check_shape
from rig.gradient import gradient_operator
from rig.template import Template
from rig.transfer import factorised
from rig.update import mean_vertex_area

_RIDGE = 1e-3  # of the mean diagonal of the shapes' Gram matrix
_CLEARLY_BETTER = 0.5  # another frame must halve the first one's fault to replace it
_FAULT_FLOOR_MM2 = 0.05  # below this mean squared fault the first frame is neutral enough
_BRIDGE_MM2 = 0.01  # how strongly the template's form carries over where nothing was seen


def align_frame(target: Floats, points: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) that place points (V, 3) on target: Procrustes.

    Args:
        target: (V, 3) mm.
        points: (V, 3) mm.
        weights: (V,) non-negative, not all zero.
    """
    check_shape(target=(target, "V 3"), points=(points, "V 3"), weights=(weights, "V"))
    share = weights / weights.sum()
    centre, goal = share @ points, share @ target
    left, _, right = np.linalg.svd(((points - centre) * share[:, None]).T @ (target - goal))
    left[:, 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))
    rotation: Floats = (left @ right).T
    return rotation, goal - rotation @ centre


def choose_neutral_frame(template: Template, points: Floats, confidence: Floats) -> int:
    """The frame from which every other frame is reached with weights that are not negative.

    Each frame is placed on the template and its displacement expressed in the template's shapes
    without bounds. A frame's fault is how much negative motion the others would need, had it been
    the neutral. The first frame, where takes begin at rest, is kept unless another is clearly better.

    Args:
        template: the artist's rig.
        points: (F, V, 3) world, mm.
        confidence: (F, V) 0..1.
    """
    moving = template.moves()
    seen = np.flatnonzero((confidence > 0).sum(axis=1) >= 0.5 * confidence.shape[1])
    if not moving.any() or len(seen) < 2:
        return int(seen[0]) if len(seen) else 0
    basis = template.deltas[moving].reshape(int(moving.sum()), -1)
    gram = basis @ basis.T
    gram += _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    offsets = np.empty((len(seen), basis.shape[1]))
    for row, frame in enumerate(seen):
        square = confidence[frame].astype(np.float64) ** 2
        rotation, translation = align_frame(template.neutral, points[frame], rigid_weights(template, square))
        placed = points[frame] @ rotation.T + translation
        offsets[row] = np.where(square[:, None] > 0, placed - template.neutral, 0.0).ravel()
    amounts = np.linalg.solve(gram, basis @ offsets.T).T
    size = np.diag(gram) / len(template.neutral)
    lacking = np.minimum(amounts[None] - amounts[:, None], 0.0)  # candidate, other, shape
    fault = (lacking**2 @ size).mean(axis=1)
    best = int(np.argmin(fault))
    if fault[0] <= _FAULT_FLOOR_MM2 or fault[best] > _CLEARLY_BETTER * fault[0]:
        best = 0
    return int(seen[best])


def rigid_weights(template: Template, weights: Floats) -> Floats:
    """Weights (V,) kept on the template's rigid vertices alone, where enough of them are seen."""
    chosen: Ints = template.rigid_vertices
    if (weights[chosen] > 0).sum() < 3:
        return weights
    kept = np.zeros_like(weights)
    kept[chosen] = weights[chosen]
    return kept


def approximate_neutral(template: Template, points: Floats, confidence: Floats) -> Floats:
    """One frame in the template's place, its unseen vertices carried by the template's form.

    Minimises `|C (x - points)|^2 + bridge |grad (x - template)|^2`, C the confidence.

    Args:
        template: the artist's rig.
        points: (V, 3) world, mm; anything where confidence is 0.
        confidence: (V,) 0..1.

    Returns:
        (V, 3) template space, mm.
    """
    square = np.asarray(confidence, dtype=np.float64) ** 2
    rotation, translation = align_frame(template.neutral, points, rigid_weights(template, square))
    placed = np.asarray(points, dtype=np.float64) @ rotation.T + translation
    triangles = template.mesh.triangles
    operator = gradient_operator(template.neutral, triangles)
    scale = _BRIDGE_MM2 / mean_vertex_area(template.neutral, triangles)
    matrix = (operator.T @ operator) * scale + sparse.diags_array(square + 1e-9)
    moved: Floats = factorised(matrix).solve(square[:, None] * (placed - template.neutral))
    return template.neutral + moved
