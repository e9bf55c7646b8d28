"""Shapes fitted to posed positions, each vertex on its own (Menzel et al.)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, check_finite, check_shape
from capture.settings import check_ranges
from rig.dense_blocks import solve_blocks
from rig.evidence import Evidence


@dataclass(frozen=True, kw_only=True)
class MenzelSettings:
    """Settings of the position-based fit.

    Attributes:
        strength: lambda, of the pull towards the targets; the paper has none, which is 1. It is
            what one sure observation at weight 1 counts, so more poses need no other value.
        clamp: how many times less than the furthest vertex of its shape a vertex may move before
            its shape is held at the target there, exactly. (The paper weighs such vertices by
            this figure instead, which double precision only just bears.)
    """

    strength: float = 1.0
    clamp: float = 1e5

    def __post_init__(self) -> None:
        check_ranges("menzel", self, strength=(0.0, 1e9), clamp=(1.0, 1e12))


def solve_menzel(
    targets: Floats,
    evidence: Evidence,
    settings: MenzelSettings,
    reference: Floats | None = None,
) -> Floats:
    """Shapes B that minimise `|W B - offsets|^2 + strength sum_j |D_j (B_j - T_j)|^2`.

    D_j is diagonal: at a vertex, the furthest displacement of shape j divided by the vertex's own.
    Nothing couples vertices, so each has one small dense system that x, y and z share.

    Args:
        targets: (B, V, 3) T, the transferred shapes, mm.
        evidence: poses, their weights, and how sure each vertex is.
        settings: strength and clamp.
        reference: (B, V, 3) shapes whose displacements make D, mm: those of the generic template,
            say; the targets when None. The paper leaves open which of the two it means.

    Returns:
        (B, V, 3) displacements from the unchanged neutral, mm.

    References:
        Menzel, Botsch, Latoschik 2022, Automated blendshape personalization for faithful face
        animations using commodity smartphones, Eqs 1-3.
    """
    check_shape(
        targets=(targets, "B V 3"), offsets=(evidence.offsets, "F V 3"),
        confidence=(evidence.confidence, "F V"), weights=(evidence.weights, "F B"),
    )  # fmt: skip
    check_finite(targets=targets, offsets=evidence.offsets, weights=evidence.weights)
    if reference is not None:
        check_shape(targets=(targets, "B V 3"), reference=(reference, "B V 3"))
    square = np.asarray(evidence.confidence, dtype=np.float64).T ** 2
    residual = evidence.offsets - np.tensordot(evidence.weights, targets, axes=1)
    weighed = residual * square.T[:, :, None]
    right = np.tensordot(weighed, evidence.weights, axes=(0, 0))  # V, 3, B
    stiffness = stillness(targets if reference is None else reference, settings)
    change = solve_blocks(evidence.weights, square, stiffness, right.transpose(0, 2, 1))
    shapes: Floats = targets + change.transpose(1, 0, 2)
    return shapes


def stillness(shapes: Floats, settings: MenzelSettings) -> Floats:
    """`strength D^2` (V, B) of shapes (B, V, 3); infinite where D reaches the clamp."""
    norms = np.linalg.norm(shapes, axis=2).T
    ratio = np.full(norms.shape, np.inf)
    np.divide(norms.max(axis=0, initial=0.0), norms, out=ratio, where=norms > 0.0)
    held = ratio >= settings.clamp
    stiff: Floats = np.where(held, np.inf, settings.strength * np.where(held, 0.0, ratio) ** 2)
    return stiff
