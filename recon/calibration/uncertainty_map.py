"""How exactly a calibrated array triangulates, over the face volume."""

from __future__ import annotations

from typing import Any

import numpy as np

from capture.arrays import Floats
from recon.calibration.solver import ArraySolution
from recon.calibration.volume_coverage import FACE_RADIUS_MM, ball_grid

_NODES = 11  # along each edge of the cube around the ball: 1331, of which 515 in the ball
_UM = 1000.0


def uncertainty_map(
    solution: ArraySolution, radius_mm: float = FACE_RADIUS_MM
) -> dict[str, Any] | None:
    """Deviations of triangulated points, um, at the nodes of a grid over the face volume.

    Args:
        solution: the calibrated array.
        radius_mm: of the volume, a ball about the world's origin.

    Returns:
        For JSON: `calibration_um`, what the calibration alone contributes, and `with_noise_um`,
        with the noise of one corner in each image added; each the square root of the trace of a
        covariance, x fastest, null outside the ball and where fewer than two devices see; root mean
        square and 95th percentile over the ball. None when the covariance is not known.
    """
    if solution.covariance is None:
        return None
    step = 2.0 * radius_mm / (_NODES - 1)
    nodes = ball_grid(radius_mm, step, _NODES)
    inside = np.linalg.norm(nodes, axis=1) <= radius_mm * (1 + 1e-9)
    alone, noisy = np.full(len(nodes), np.nan), np.full(len(nodes), np.nan)
    calibration = solution.covariance.triangulation_sigma(nodes[inside])
    noise = solution.covariance.noise_sigma(nodes[inside])
    alone[inside] = _deviation_um(calibration)
    noisy[inside] = _deviation_um(calibration + noise)
    known = np.isfinite(alone)
    if not known.any():
        return None
    both = known & np.isfinite(noisy)
    return {
        "origin_mm": nodes[0].tolist(),
        "step_mm": step,
        "shape": [_NODES] * 3,
        "calibration_um": _listed(alone),
        "with_noise_um": _listed(noisy),
        "rms_um": _digits(np.sqrt((alone[known] ** 2).mean())),
        "p95_um": _digits(np.percentile(alone[known], 95)),
        "rms_with_noise_um": _digits(np.sqrt((noisy[both] ** 2).mean())) if both.any() else None,
    }


def _deviation_um(covariance: Floats) -> Floats:
    trace = np.trace(covariance, axis1=1, axis2=2)
    deviation: Floats = _UM * np.sqrt(np.where(trace >= 0, trace, np.nan))
    return deviation


def _listed(values: Floats) -> list[float | None]:
    return [_digits(value) if np.isfinite(value) else None for value in values]


def _digits(value: float) -> float:
    return float(f"{value:.5g}")
