"""The calibration stage: a board take in, the cameras of the array and their report out."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from capture.camera import CameraArray
from capture.camera_file import read_cameras, write_cameras
from capture.errors import SettingsError, SolveError, TakeError
from capture.pose import Pose
from capture.product import is_current, replacing, stage_record, write_record
from capture.progress import Progress, silent
from capture.take import Take
from recon.array_state import ArrayState
from recon.board.body import BoardBody, FlatBoard
from recon.board.charuco import Board
from recon.board.corner_cache import CornerCache
from recon.board.corners import CornerLimits
from recon.board.diagnosis import explain_blind, merged_words
from recon.board.shape import BoardShape
from recon.board.sightings import BoardSightings, observe_board
from recon.board.take_devices import TakeDevices
from recon.board.view_check import check_views
from recon.calibration.chosen_world import ChosenWorld, choose_world
from recon.calibration.corner_log import write_corner_log
from recon.calibration.geometry import ball_points
from recon.calibration.report import (
    ReportExtras,
    calibration_report,
    scale_bar_numbers,
    summary_of,
)
from recon.calibration.scale_bar import BarLength, measure_bar
from recon.calibration.solver import ArraySolution, CalibrateSettings, solve_array

__all__ = ["CalibrateSettings", "calibrate", "corner_log_path", "report_path"]

_BAR_SPREAD = 3.0  # a bar across the face volume may be off by so many times a point of it
_SURE = 4.0  # standard deviations of the bar's length by which it must be off as well


def calibrate(
    take: Take,
    board: FlatBoard | BoardBody,
    settings: CalibrateSettings,
    out: Path,
    *,
    previous: CameraArray | None = None,
    progress: Progress = silent,
) -> CameraArray:
    """Calibrate an array from a take of a waved board.

    Args:
        take: the board take.
        board: what was waved in it.
        settings: of the stage.
        out: cameras.json to write; `report.json` and a table of rejected corners stand beside it.
        previous: cameras of a previous session of the same array, whose world is kept.
        progress: told after each frame searched and each step of the solve.

    Returns:
        The cameras, one a device in the take's order, in a world with +Y up and the face along +Z
        (see `recon.calibration.world`), at the named pose of the board, or of the previous session,
        mm.

    Raises:
        SettingsError: when both a frame and a previous session are to give the world, or `out` has
            the name of the report.
        TakeError: naming every device that saw too little of the board, with its counts and the
            reason its images show; that is late, moved, mirrored or exchanged with another; or the
            scale bar, when it does not have its length.
        SolveError: when the devices do not hang together, or the solve fails.
    """
    out, products = Path(out), _products(Path(out))
    if previous is not None and settings.world_frame is not None:
        raise SettingsError(
            f"world_frame = {settings.world_frame} and a previous session both name the world: "
            "give one of them"
        )
    body = board if isinstance(board, BoardBody) else BoardBody.of(board)
    inputs = {"frames": take.frames_hash(), "board": _digest(_plain_body(body))}
    if previous is not None:
        inputs["previous"] = _digest([_plain_camera(camera) for camera in previous])
    record = stage_record("calibrate", settings, inputs)
    if all(is_current(product, record) for product in products):
        return read_cameras(out)
    seen, odd = _sightings(take, body, settings, progress)
    try:
        solution = solve_array(
            seen.observations, body.shape(), settings, every=seen.every, progress=progress
        )
    except (TakeError, SolveError) as error:
        if odd:
            raise TakeError(f"{error}\nwhat the images show:\n  - " + "\n  - ".join(odd)) from error
        raise
    bar = _check_bar(solution, seen, body, settings)
    square_mm = _square_mm(body)
    chosen = choose_world(solution, seen.every, settings, previous, square_mm)
    log = corner_log_path(out)
    extras = ReportExtras(
        volume_radius_mm=settings.volume_mm, log=log.name,
        scale_bar=None if bar is None else scale_bar_numbers(bar),
    )  # fmt: skip
    report = calibration_report(solution, body, seen.tally, extras)
    report["warnings"] = [*report["warnings"], *odd, *_unseen(bar)]
    state = solution.state
    if chosen is not None:
        state = state.moved(chosen.world.world_from_array)
        _tell_world(report, chosen)
    report["board_places"] = _board_places(state, solution.shape)
    write_corner_log(log, solution)
    _write_report(report_path(out), report)
    write_cameras(out, state.cameras, summary_of(report))
    for product in products:
        write_record(product, record)
    return read_cameras(out)  # as a second run finds them


def report_path(cameras: Path) -> Path:
    """Where the full report stands: `report.json` beside the cameras."""
    return Path(cameras).with_name("report.json")


def corner_log_path(cameras: Path) -> Path:
    """Where the table of rejected corners stands, beside the cameras."""
    return Path(cameras).with_name("rejected_corners.csv")


def _products(out: Path) -> tuple[Path, ...]:
    """All that is written, the cameras last; refused where one would replace another."""
    beside = corner_log_path(out), report_path(out)
    if out in beside:
        raise SettingsError(f"{out}: that name is taken by what stands beside the cameras")
    return *beside, out


def _unseen(bar: BarLength | None) -> list[str]:
    if bar is None or bar.frames:
        return []
    return [
        "The board file has a scale bar, and no frame shows both its ends to two devices: nothing "
        "checks the size of the squares."
    ]


def _sightings(
    take: Take, body: BoardBody, settings: CalibrateSettings, progress: Progress
) -> tuple[BoardSightings, list[str]]:
    """What the devices saw of the board, and what is odd in the images of some of them."""
    chosen = TakeDevices.without(take, settings.leave_out)
    limits = CornerLimits(
        min_corners=settings.min_corners,
        max_blur_px=settings.max_blur_px,
        still_px=settings.still_px,
        max_poses=settings.max_poses,
    )
    cache = CornerCache(take, body)
    seen = observe_board(chosen, body, limits, cache=cache, progress=progress)
    words = explain_blind(chosen, body, seen)
    few = settings.least_poses, settings.least_views
    check_views(seen.observations, *few, seen.tally, words)
    fault = (
        [f"corners found could not be kept for the next run: {cache.fault}"] if cache.fault else []
    )
    return seen, [*merged_words(words, len(chosen.device_names)), *fault]


def _check_bar(
    solution: ArraySolution, seen: BoardSightings, body: BoardBody, settings: CalibrateSettings
) -> BarLength | None:
    """The scale bar as measured; refused when it does not have its length."""
    if body.scale_bar is None:
        return None
    bar = measure_bar(solution.state.cameras, seen.bar, body.scale_bar.length_mm)
    if not bar.frames:
        return bar
    off = abs(bar.ratio - 1.0)
    sigma_mm = float(np.hypot(bar.sigma_mm, _BAR_SPREAD * _volume_sigma_mm(solution, settings)))
    sure = not off * bar.length_mm <= _SURE * sigma_mm
    if off > settings.bar_tolerance and sure:
        square_mm = _square_mm(body)
        fitting = (
            f"square_mm = {square_mm:g} should be {square_mm / bar.ratio:.4g}"
            if square_mm is not None
            else f"the sizes in the board file should be {1.0 / bar.ratio:.5g} times as large"
        )
        raise TakeError(
            f"the scale bar is {bar.length_mm:.2f} mm long, and with this board file it measures "
            f"{bar.measured_mm:.2f} mm in {bar.frames} frames: {fitting}, or length_mm of the bar "
            "is wrong; measure both again"
        )
    return bar


def _volume_sigma_mm(solution: ArraySolution, settings: CalibrateSettings) -> float:
    """What the calibration's own uncertainty does to a point of the face volume, rms, mm."""
    if solution.covariance is None:
        return float("inf")  # such a calibration proves nothing of the bar
    points = ball_points(np.zeros(3), settings.volume_mm, 5)
    sigma = solution.covariance.triangulation_sigma(points)
    traces = np.einsum("nii->n", sigma)
    return float(np.sqrt(np.nanmean(traces))) if np.isfinite(traces).any() else float("inf")


def _square_mm(body: BoardBody) -> float | None:
    sizes = {face.board.square_mm for face in body.faces if isinstance(face.board, Board)}
    return sizes.pop() if len(sizes) == 1 and len(body.faces) >= 1 else None


def _tell_world(report: dict[str, Any], chosen: ChosenWorld) -> None:
    """Put the world that was chosen into the report; the face volume stays where it was."""
    motion: Pose = chosen.world.world_from_array
    report["world"] = {"origin": chosen.world.origin, "y": chosen.world.up}
    report["world_from_volume"] = motion.matrix().tolist()
    if report["volume"] is not None:
        report["volume"]["centre_mm"] = motion.translation.round(3).tolist()
    report["warnings"] = [*report["warnings"], *chosen.changes]


def _board_places(state: ArrayState, shape: BoardShape) -> list[list[list[float]]]:
    """The outermost corners (4, 3) of the first board at each pose, in turn about it, world mm."""
    x, y = shape.flat.T
    first = shape.face == 0
    far = [x + y, y - x, -x - y, x - y]
    around = [int(np.argmin(np.where(first, reach, np.inf))) for reach in far]
    return [pose.apply(state.corners[around]).round(2).tolist() for pose in state.array_from_board]


def _plain_body(body: BoardBody) -> dict[str, Any]:
    return {
        "faces": [
            {
                "name": face.name, "board": dataclasses.asdict(face.board),
                "body_from_board": None if face.body_from_board is None
                else face.body_from_board.matrix().tolist(),
            }
            for face in body.faces
        ],
        "scale_bar": None if body.scale_bar is None else dataclasses.asdict(body.scale_bar),
    }  # fmt: skip


def _plain_camera(camera: Any) -> list[Any]:
    return [
        camera.name, camera.width, camera.height, camera.matrix.tolist(),
        camera.distortion.tolist(), camera.camera_from_world.matrix().tolist(),
    ]  # fmt: skip


def _digest(document: Any) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _write_report(path: Path, report: dict[str, Any]) -> None:
    with replacing(path) as partial:
        partial.write_text(json.dumps(report, allow_nan=False) + "\n", encoding="utf-8")
