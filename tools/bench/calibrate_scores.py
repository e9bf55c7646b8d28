"""A calibration against the truth: what a bench measures of one solve, and of many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from capture.arrays import Floats
from capture.camera import CameraArray
from recon.calibration.covariance import ArrayCovariance
from tools.bench.board_scene import face_points, triangulate, triangulation_error
from track.rigid import fit_similarity

SIGMAS = ("focal", "principal point", "camera centres", "triangulated points")


def camera_scores(truth: CameraArray, found: CameraArray) -> dict[str, float]:
    """How far a found array is from the true one.

    Returns:
        `triangulation_um` (rms over the face volume after rigid alignment without scale),
        `focal_rms_px` and `focal_max_px` (fx), `principal_rms_px`, `centre_rms_um` (camera centres
        after rigid alignment).
    """
    error = triangulation_error(truth, found)
    focal = np.array([a.fx - b.fx for a, b in zip(found, truth, strict=True)])
    middle = np.array([[a.cx - b.cx, a.cy - b.cy] for a, b in zip(found, truth, strict=True)])
    centres = _centre_errors(truth, found)
    return {
        "triangulation_um": 1000.0 * float(np.sqrt((error**2).sum(axis=1).mean())),
        "focal_rms_px": _rms(focal),
        "focal_max_px": float(np.abs(focal).max()),
        "principal_rms_px": _rms(middle),
        "centre_rms_um": 1000.0 * float(np.sqrt((centres**2).sum(axis=1).mean())),
    }


def sigma_scores(
    truth: CameraArray, found: CameraArray, covariance: ArrayCovariance
) -> dict[str, list[float]]:
    """Predicted and true mean square errors of one solve, by what they are errors of.

    Args:
        truth: the true array.
        found: the calibrated one.
        covariance: what the solve says of itself.

    Returns:
        For each of `SIGMAS`: [mean of the predicted variances, mean of the squared errors], px^2 or
        mm^2.
    """
    lens = np.array(
        [
            [a.fx - b.fx, a.fy - b.fy, a.cx - b.cx, a.cy - b.cy]
            for a, b in zip(found, truth, strict=True)
        ]
    )
    predicted = covariance.lens_sigma[:, :4] ** 2
    points = face_points()
    solved = triangulate(truth, found, points)
    spread = np.trace(covariance.triangulation_sigma(solved), axis1=1, axis2=2)
    miss = fit_similarity(solved, points).apply(solved) - points
    return {
        "focal": [float(predicted[:, :2].mean()), float((lens[:, :2] ** 2).mean())],
        "principal point": [float(predicted[:, 2:].mean()), float((lens[:, 2:] ** 2).mean())],
        "camera centres": [
            float((covariance.place_sigma_mm**2).mean()),
            float((_centre_errors(truth, found) ** 2).mean()),
        ],
        "triangulated points": [float(spread.mean() / 3.0), float((miss**2).mean())],
    }


def sigma_ratios(rows: Sequence[Mapping[str, Sequence[float]]]) -> dict[str, float]:
    """Rms predicted deviation over rms error, over many solves; 1 is right, above 1 is cautious."""
    out = {}
    for name in SIGMAS:
        total = np.array([row[name] for row in rows]).sum(axis=0)
        out[name] = float(np.sqrt(total[0] / total[1]))
    return out


def _centre_errors(truth: CameraArray, found: CameraArray) -> Floats:
    """Errors (C, 3), mm, of the camera centres after rigid alignment."""
    source = np.stack([camera.centre for camera in found])
    target = np.stack([camera.centre for camera in truth])
    errors: Floats = fit_similarity(source, target).apply(source) - target
    return errors


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
