"""What was seen, what a rig makes of it, and how far the two are apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats


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


def weighted_rms(residuals: Floats, confidence: Floats) -> float:
    """Root mean square of residuals (F, V), mm, weighted by squared confidence (F, V)."""
    square = confidence**2
    return float(np.sqrt((square * residuals**2).sum() / max(float(square.sum()), 1e-300)))


def undo_motion(fit: Fit, seen: Observations) -> Floats:
    """Points of every frame in rig space, minus the neutral: (F, V, 3), mm; 0 where unseen."""
    rotation, translation = fit.motions[:, :3, :3], fit.motions[:, None, :3, 3]
    offsets: Floats = (seen.points - translation) @ rotation - fit.neutral
    offsets[seen.confidence <= 0] = 0.0
    return offsets
