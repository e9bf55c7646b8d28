"""The actor's approximate neutral: which frame shows it, and that frame in the template's space."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from capture.arrays import Floats, Ints, check_shape
from rig.box_qp import solve_box_qp
from rig.gradient import gradient_operator
from rig.template import Template
from rig.transfer import factorised
from rig.update import mean_vertex_area

_RIDGE = 1e-3  # of the mean diagonal of the shapes' Gram matrix
_CLEARLY_BETTER = 0.7  # of the first frame's fault: above it the first frame is neutral enough
_CANDIDATES = 64  # frames, evenly spread, that are tried in a long take
_OFTEN = 0.8  # of the frames that must see a vertex for it to have a say
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
    """The frame from which every other frame is best reached with weights in [0, 1].

    Each frame is placed on the template. A frame's fault is the mean squared residual of the others
    when it stands for the neutral and the template's own shapes are added to it. The first frame,
    where takes begin at rest, is kept unless another is clearly better.

    Args:
        template: the artist's rig.
        points: (F, V, 3) world, mm.
        confidence: (F, V) 0..1.
    """
    moving = template.moves()
    seen = np.flatnonzero((confidence > 0).sum(axis=1) >= 0.5 * confidence.shape[1])
    if not moving.any() or len(seen) < 2:
        return int(np.argmax(confidence.sum(axis=1)))
    seen = seen[np.unique(np.linspace(0, len(seen) - 1, _CANDIDATES).round().astype(int))]
    often = (confidence[seen] > 0).mean(axis=0)
    kept = often >= min(_OFTEN, float(often.max()))
    rigid = _rigid_modes(template.neutral[kept])
    basis = template.deltas[moving][:, kept].reshape(int(moving.sum()), -1)
    basis = basis - (basis @ rigid) @ rigid.T
    offsets = _placed_offsets(template, points[seen], confidence[seen])[:, kept]
    offsets = offsets.reshape(len(seen), -1)
    offsets -= (offsets @ rigid) @ rigid.T
    count = int(kept.sum())
    gram = basis @ basis.T / count
    gram += _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    linear = basis @ offsets.T / count
    apart = offsets @ offsets.T / count
    fault = np.empty(len(seen))
    zeros = np.zeros((len(seen), len(gram)))
    for candidate in range(len(seen)):
        wanted = (linear - linear[:, candidate : candidate + 1]).T
        amounts = solve_box_qp(gram[None], wanted, zeros, zeros + 1.0, zeros)
        gain = (amounts * (2.0 * wanted - amounts @ gram)).sum(axis=1)
        far = apart[candidate, candidate] + np.diag(apart) - 2.0 * apart[candidate]
        fault[candidate] = (far - gain).mean()
    best = int(np.argmin(fault))
    return int(seen[best if fault[best] < _CLEARLY_BETTER * fault[0] else 0])


def _placed_offsets(template: Template, points: Floats, confidence: Floats) -> Floats:
    """Placed frames minus the neutral: (F, V, 3), mm; unseen vertices take their mean."""
    offsets = np.empty(points.shape)
    known = confidence > 0
    for row, (frame, sure) in enumerate(zip(points, confidence, strict=True)):
        square = sure.astype(np.float64) ** 2
        rotation, shift = align_frame(template.neutral, frame, rigid_weights(template, square))
        away = frame @ rotation.T + shift - template.neutral
        offsets[row] = np.where(known[row][:, None], away, 0.0)
    mean = offsets.sum(axis=0) / np.maximum(known.sum(axis=0), 1)[:, None]
    filled: Floats = np.where(known[:, :, None], offsets, mean)
    return filled


def _rigid_modes(vertices: Floats) -> Floats:
    """Orthonormal small motions (3 V, 6) of a rigid body: what an open jaw adds to a placement."""
    x, y, z = (vertices - vertices.mean(axis=0)).T
    zero = np.zeros_like(x)
    turns = [np.stack(axis, axis=1) for axis in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    shifts = [np.tile(axis, (len(vertices), 1)) for axis in np.eye(3)]
    modes: Floats = np.linalg.qr(np.stack([*turns, *shifts]).reshape(6, -1).T)[0]
    return modes


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
