"""What a calibration says of itself: numbers to draw, a verdict, warnings in operator's words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from recon.board.body import BoardBody
from recon.board.charuco import Board
from recon.calibration.board_numbers import board_numbers
from recon.calibration.corner_log import rejection_summary
from recon.calibration.device_numbers import device_numbers, number, residual_vectors
from recon.calibration.gate import GateSettings, judge_calibration
from recon.calibration.remarks import calibration_warnings
from recon.calibration.scale_bar import BarLength
from recon.calibration.solver import ArraySolution
from recon.calibration.uncertainty_map import uncertainty_map
from recon.calibration.volume_coverage import FACE_RADIUS_MM, volume_coverage

RMS_NAME = "mean reprojection error, vector norm (COLMAP)"
_BULKY = ("residual_vectors", "uncertainty", "volume", "rejected", "board_places")


@dataclass(frozen=True, kw_only=True)
class ReportExtras:
    """What a report tells beside the solution.

    Attributes:
        volume_radius_mm: of the face volume, a ball about the world's origin.
        scale_bar: what `scale_bar_numbers` found; None when no bar was shown.
        log: name of the table of rejected corners beside the report; None when none is written.
        gate: the levels of the verdict.
    """

    volume_radius_mm: float = FACE_RADIUS_MM
    scale_bar: Mapping[str, Any] | None = None
    log: str | None = None
    gate: GateSettings = field(default_factory=GateSettings)


def calibration_report(
    solution: ArraySolution,
    board: Board | BoardBody,
    tally: Mapping[str, Mapping[str, int]] | None = None,
    extras: ReportExtras | None = None,
) -> dict[str, Any]:
    """The report of a calibration, ready for JSON.

    Args:
        solution: the calibrated array.
        board: what was waved, nominal.
        tally: by device, how many frames were used or refused for each reason.
        extras: the face volume, the scale bar, the log, the levels of the verdict.

    Returns:
        Residuals in px over the corners used: overall, by device, by pose; counts; coverage of the
        images and of the face volume; flatness of the board; standard deviations of lenses and
        places; the map of triangulation uncertainty; the held-out and the split-half check; what
        was rejected; the scale bar; warnings; the verdict (`gate`). What could not be determined
        is null.
    """
    extras = extras or ReportExtras()
    names = [face.name for face in board.faces] if isinstance(board, BoardBody) else ["board"]
    kept, size = solution.kept, np.linalg.norm(solution.residuals, axis=1)
    devices = [
        device_numbers(solution, index, (tally or {}).get(name, {}), extras.volume_radius_mm)
        for index, name in enumerate(solution.observations.device_names)
    ]
    report: dict[str, Any] = {
        "residual_definition": RMS_NAME,
        "mean_reprojection_px": number(size[kept].mean()),
        "rms_per_coordinate_px": number(np.sqrt((solution.residuals[kept] ** 2).mean())),
        "robust_sigma_px": number(solution.sigma_px),
        "corners_used": int(kept.sum()),
        "corners_rejected": int((~kept).sum()),
        "rejection": "further off than the robust limit of its device",
        "converged": solution.converged,
        "poses_used": len(np.unique(solution.observations.pose[kept])),
        "devices": devices,
        "poses": [_pose(solution, index) for index in range(len(solution.observations.frames))],
        "board": board_numbers(solution, names),
        "held_out": _held_out(solution),
        "split_half": _split_half(solution),
        "scale_bar": None if extras.scale_bar is None else dict(extras.scale_bar),
        "volume": volume_coverage(solution, extras.volume_radius_mm),
        "uncertainty": uncertainty_map(solution, extras.volume_radius_mm),
        "rejected": rejection_summary(solution),
        "log": extras.log,
        "world": {
            "origin": solution.world.origin,
            "z": "towards the mean of the camera centres",
            "y": solution.world.up,
        },
    }
    report["warnings"] = calibration_warnings(report)
    report["gate"] = judge_calibration(report, extras.gate)
    report["residual_vectors"] = {
        device["name"]: residual_vectors(solution, index) for index, device in enumerate(devices)
    }
    return report


def summary_of(report: Mapping[str, Any]) -> dict[str, Any]:
    """The report without what only a page draws, to stand inside cameras.json."""
    summary = {key: value for key, value in report.items() if key not in _BULKY}
    summary["devices"] = [
        {key: value for key, value in device.items() if key != "heat"}
        for device in report["devices"]
    ]
    return summary


def scale_bar_numbers(bar: BarLength) -> dict[str, Any] | None:
    """The scale bar as the calibrated array measures it, for the report.

    Args:
        bar: as measured.

    Returns:
        Lengths, standard deviation (null when not known), how many frames, and measured over
        calibrated length; None when no frame shows the bar.
    """
    if not (bar.frames and np.isfinite(bar.measured_mm)):
        return None
    return {
        "length_mm": number(bar.length_mm),
        "measured_mm": number(bar.measured_mm),
        "sigma_mm": number(bar.sigma_mm),
        "frames": int(bar.frames),
        "ratio": number(bar.ratio),
    }


def _pose(solution: ArraySolution, index: int) -> dict[str, Any]:
    rows = (solution.observations.pose == index) & solution.kept
    size = np.linalg.norm(solution.residuals[rows], axis=1)
    return {
        "frame": int(solution.observations.frames[index]),
        "devices": len(np.unique(solution.observations.device[rows])),
        "corners_used": int(rows.sum()),
        "corners_rejected": int(((solution.observations.pose == index) & ~solution.kept).sum()),
        "mean_reprojection_px": number(size.mean()) if len(size) else None,
    }


def _held_out(solution: ArraySolution) -> dict[str, Any]:
    check = solution.held_out
    frames = [int(solution.observations.frames[pose]) for pose in check.poses]
    return {
        "frames": frames,
        "training_rms_per_coordinate_px": number(check.training_px),
        "held_out_rms_per_coordinate_px": number(check.held_out_px),
        "ratio": number(check.ratio),
        "remark": check.remark,
    }


def _split_half(solution: ArraySolution) -> dict[str, Any]:
    check = solution.split_half
    return {
        "p95_px": number(check.p95_px),
        "median_px": number(check.median_px),
        "by_device": {name: number(value) for name, value in check.by_device.items()},
        "remark": check.remark,
    }
