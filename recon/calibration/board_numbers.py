"""How flat and how square the board turned out, each face of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from recon.calibration.device_numbers import number
from recon.calibration.solver import ArraySolution

_LEAST_CORNERS = 4  # fewer lie in a plane by themselves
_HELD_MM = 1e-9  # a face flatter than this was held flat


def board_numbers(solution: ArraySolution, names: Sequence[str]) -> dict[str, Any]:
    """Bend and stretch of the board, for JSON: over all its faces the worst, and each by itself.

    Args:
        solution: the calibrated array.
        names: of the faces.

    Returns:
        `shape_solved`; corners seen and there; `bow_mm` (from the lowest to the highest corner over
        the best plane), `flatness_rms_mm` and `width_over_height` of the worst face; `faces`: the
        same for each, and `in_plane_rms_mm`: how far the corners lie beside their nominal places
        in the plane, stretch taken out. Null where a face showed too few corners.
    """
    faces = [_face(solution, index, name) for index, name in enumerate(names)]
    known = [face for face in faces if face["bow_mm"] is not None]
    stretch = [face["width_over_height"] for face in known if face["width_over_height"] is not None]
    return {
        "shape_solved": any(face["bow_mm"] > _HELD_MM for face in known),
        "corners_seen": sum(face["corners_seen"] for face in faces),
        "corners": sum(face["corners"] for face in faces),
        "bow_mm": max((face["bow_mm"] for face in known), default=None),
        "flatness_rms_mm": max((face["flatness_rms_mm"] for face in known), default=None),
        "width_over_height": max(stretch, key=lambda ratio: abs(ratio - 1.0), default=None),
        "faces": faces,
    }


def _face(solution: ArraySolution, index: int, name: str) -> dict[str, Any]:
    mine = solution.shape.face == index
    used = np.unique(solution.observations.corner[solution.kept])
    seen = used[mine[used]]
    numbers: dict[str, Any] = {
        "name": name,
        "corners_seen": len(seen),
        "corners": int(mine.sum()),
        "bow_mm": None,
        "flatness_rms_mm": None,
        "width_over_height": None,
        "in_plane_rms_mm": None,
    }
    if len(seen) < _LEAST_CORNERS:
        return numbers
    centred = solution.state.corners[seen] - solution.state.corners[seen].mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    height = centred @ axes[2]
    nominal = solution.shape.flat[seen]
    flat, _, rank, _ = np.linalg.lstsq(nominal - nominal.mean(axis=0), centred, rcond=None)
    numbers["bow_mm"] = number(np.ptp(height))
    numbers["flatness_rms_mm"] = number(height.std())
    if rank == 2:
        lengths = np.linalg.norm(flat, axis=1)
        numbers["width_over_height"] = number(lengths[0] / lengths[1])
        astray = (centred - (nominal - nominal.mean(axis=0)) @ flat) @ axes[:2].T
        numbers["in_plane_rms_mm"] = number(np.sqrt((astray**2).sum(axis=1).mean()))
    return numbers
