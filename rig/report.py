"""What a rig solve tells about itself: report.json."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats
from capture.pose import Pose
from capture.product import replacing
from rig.solve import Fit, Iteration, Observations, weighted_rms
from rig.template import Template

_ACTIVE = 0.01  # weight above which a shape counts as active in a frame
_EXERCISED = 0.1  # largest weight above which a shape counts as exercised by the performances


def describe_solve(
    template: Template,
    moving: Bools,
    seen: Observations,
    fits: tuple[Fit, Fit],
    turns: Sequence[Iteration],
) -> dict[str, Any]:
    """Residuals before and after, energies of each turn, and the health of weights and shapes.

    Args:
        template: the artist's rig, with all its shapes.
        moving: (B,) which shapes were solved; the others move nothing.
        seen: the frames.
        fits: the transferred template's own best fit, and the refined rig's.
        turns: of the alternation.
    """
    first, last = fits
    residuals = [np.where(seen.confidence > 0, f.residuals(seen.points), 0.0) for f in fits]
    before, after = (weighted_rms(r, seen.confidence) for r in residuals)
    names = [name for name, moves in zip(template.names, moving, strict=True) if moves]
    peaks = last.weights.max(axis=0)
    return {
        "residual_transferred_mm": before,
        "residual_refined_mm": after,
        "ratio": after / before if before > 0 else 0.0,
        "residual_per_frame_mm": _per_frame(residuals[1], seen.confidence),
        "worst_mm": float(residuals[1].max()),
        "worst_vertex": int(np.unravel_index(int(residuals[1].argmax()), residuals[1].shape)[1]),
        "iterations": [{**dataclasses.asdict(turn), "total": turn.total} for turn in turns],
        "frames": len(last.weights),
        "shapes": len(template.names),
        "weights_known": seen.weights is not None,
        "weights_min": float(last.weights.min()),
        "weights_max": float(last.weights.max()),
        "active_shapes_per_frame": [int(n) for n in (last.weights > _ACTIVE).sum(axis=1)],
        "active_shapes_mean": float((last.weights > _ACTIVE).sum(axis=1).mean()),
        "max_weight": {name: float(peak) for name, peak in zip(names, peaks, strict=True)},
        "never_exercised": [n for n, peak in zip(names, peaks, strict=True) if peak < _EXERCISED],
        "dropped_zero_shapes": [
            name for name, moves in zip(template.names, moving, strict=True) if not moves
        ],
        "shape_change_mm": _shape_change(names, first, last),
        "neutral_change_mm": float(
            np.sqrt(((last.neutral - first.neutral) ** 2).sum(axis=1).mean())
        ),
        "unseen_vertices": int((seen.confidence.max(axis=0) <= 0).sum()),
        "head_motion": _head_motion(last.motions),
    }


def write_report(path: Path, report: Mapping[str, Any]) -> None:
    """Write a report as JSON, whole or not at all."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def _per_frame(residuals: Floats, confidence: Floats) -> list[float]:
    square = confidence**2
    mass = square.sum(axis=1)
    mean = (square * residuals**2).sum(axis=1) / np.where(mass > 0, mass, 1.0)
    return [float(value) for value in np.sqrt(mean)]


def _shape_change(names: Sequence[str], first: Fit, last: Fit) -> dict[str, float]:
    """Largest displacement of each refined shape from the transferred one, mm."""
    moved = np.linalg.norm(last.deltas - first.deltas, axis=2).max(axis=1)
    return {name: float(value) for name, value in zip(names, moved, strict=True)}


def _head_motion(motions: Floats) -> dict[str, list[float]]:
    """Rotation in degrees and translation in mm of each frame, from the first."""
    start = Pose.from_matrix(motions[0])
    away = [Pose.from_matrix(motion) @ start.inverse() for motion in motions]
    centre = motions[0][:3, 3]
    return {
        "rotation_deg": [
            float(np.rad2deg(np.linalg.norm(pose.rotation_vector()))) for pose in away
        ],
        "translation_mm": [float(np.linalg.norm(pose.apply(centre) - centre)) for pose in away],
    }
