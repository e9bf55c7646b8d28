"""The calibration stage: a board take in, the cameras of the array and their report out."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

from capture.camera import CameraArray
from capture.camera_file import read_cameras, write_cameras
from capture.product import is_current, replacing, stage_record, write_record
from capture.progress import Progress, silent
from capture.take import Take
from recon.array_solver import CalibrateSettings, check_views, solve_array
from recon.board import Board
from recon.calibration_report import calibration_report, summary_of
from recon.corners import CornerLimits, observe_board

__all__ = ["CalibrateSettings", "calibrate", "report_path"]


def calibrate(
    take: Take, board: Board, settings: CalibrateSettings, out: Path, *, progress: Progress = silent
) -> CameraArray:
    """Calibrate an array from a take of a waved board.

    Args:
        take: the board take.
        board: the board waved in it.
        settings: of the stage.
        out: cameras.json to write; `report.json` is written beside it.
        progress: told after each frame searched and each step of the solve.

    Returns:
        The cameras, one a device in the take's order, in a world with +Y up and the face along +Z
        (see `recon.array_world`), mm.

    Raises:
        TakeError: naming every device that saw too little of the board, with its counts.
        SolveError: when the devices do not hang together, or the solve fails.
    """
    out = Path(out)
    shape = json.dumps(dataclasses.asdict(board), sort_keys=True)
    inputs = {"frames": take.frames_hash(), "board": hashlib.sha256(shape.encode()).hexdigest()}
    record = stage_record("calibrate", settings, inputs)
    if is_current(out, record) and report_path(out).is_file():
        return read_cameras(out)
    limits = CornerLimits(
        min_corners=settings.min_corners,
        max_blur_px=settings.max_blur_px,
        still_px=settings.still_px,
        max_poses=settings.max_poses,
    )
    observations, tally = observe_board(take, board, limits, progress=progress)
    check_views(observations, settings, tally)
    solution = solve_array(observations, board.corners_mm(), settings, progress=progress)
    report = calibration_report(solution, board, tally)
    _write_report(report_path(out), report)
    write_cameras(out, solution.state.cameras, summary_of(report))
    write_record(out, record)
    return read_cameras(out)  # as a second run finds them


def report_path(cameras: Path) -> Path:
    """Where the full report stands: `report.json` beside the cameras."""
    return Path(cameras).with_name("report.json")


def _write_report(path: Path, report: dict[str, Any]) -> None:
    with replacing(path) as partial:
        partial.write_text(json.dumps(report, allow_nan=False) + "\n", encoding="utf-8")
