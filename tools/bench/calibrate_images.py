"""The calibration from rendered images: bent board, real lens, hands, through the real detector."""

from __future__ import annotations

import time

import numpy as np

from capture.arrays import Floats, Image, Ints
from capture.camera import CameraArray
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.corners import CornerDetector
from recon.board.observations import BoardObservations
from recon.calibration.solver import CalibrateSettings, solve_array
from tools.bench.bench_rows import Row, RowFile
from tools.bench.board_images import BoardCamera
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state
from tools.bench.calibrate_protocol import solution_scores

IMAGES = BoardScene(poses=60, bow_mm=0.3)
SMALL_IMAGES = BoardScene(
    size_px=640, focal_px=1440.0, radius_mm=620.0, devices=6, poses=14, bow_mm=0.3
)
_LEAST_FACING = 0.2  # cosine; the detector finds nothing long before a board is that slanted


def run_images(scene: BoardScene, rows: RowFile) -> Row:
    """Render a whole take, find its corners, solve, measure; prints one line a figure."""
    row = rows.row(f"images {scene}", lambda: _run(scene))
    print("| figure | asked | measured |\n| --- | --- | --- |")
    for name, asked, key, form in (
        ("triangulation rmse, um", "<= 10", "triangulation_um", ".2f"),
        ("focal error rms of devices, px", "", "focal_rms_px", ".3f"),
        ("focal error of the worst device, px", "", "focal_max_px", ".3f"),
        ("held-out over training residual", "<= 1.15", "held_out_ratio", ".3f"),
        ("split-half p95, px", "<= 0.1", "split_half_p95_px", ".4f"),
        ("robust sigma of a residual, px", "", "sigma_px", ".4f"),
        ("corner rms against the truth, px", "", "corner_rms_px", ".4f"),
        ("corner median size against the truth, px", "", "corner_median_px", ".4f"),
        ("corners off by more than 0.5 px", "", "corners_wrong", ".0f"),
        ("corners", "", "sightings", ".0f"),
        ("images, of which usable", "", "images", ".0f"),
        ("  usable", "", "usable", ".0f"),
        ("rendering, s", "", "render_s", ".0f"),
        ("detection, s", "", "detect_s", ".0f"),
        ("solve, s", "<= 60", "seconds", ".1f"),
    ):
        print(f"| {name} | {asked} | {row[key]:{form}} |")
    return row


def render_and_detect(scene: BoardScene, truth: ArrayState) -> tuple[BoardObservations, Row]:
    """Sightings of the detector in rendered images; no image is kept.

    A device that sees the back of the board, or its edge, is given no image.

    Returns:
        The sightings, and the counts and seconds of both steps.
    """
    detector = CornerDetector(A4_BOARD)
    cost: Row = {"images": 0, "usable": 0, "render_s": 0.0, "detect_s": 0.0}
    found: list[tuple[int, int, Ints, Floats]] = []
    middle = truth.corners.mean(axis=0)[None]
    for device, camera in enumerate(truth.cameras):
        start = time.perf_counter()
        lens = BoardCamera(camera, A4_BOARD, scene.bow_mm)
        cost["render_s"] += time.perf_counter() - start
        for pose, array_from_board in enumerate(truth.array_from_board):
            if facing(camera.centre, array_from_board, middle) < _LEAST_FACING:
                continue
            start = time.perf_counter()
            image: Image = lens.image(array_from_board, 1000 * scene.seed + 60 * device + pose)
            shot = time.perf_counter()
            view = detector.detect(image)
            cost["render_s"] += shot - start
            cost["detect_s"] += time.perf_counter() - shot
            cost["images"] += 1
            if not view.refusal:
                cost["usable"] += 1
                found.append((device, pose, view.ids, view.pixels))
    return _gather(truth.cameras, len(truth.array_from_board), found), cost


def facing(centre: Floats, array_from_board: Pose, middle: Floats) -> float:
    """Cosine between the board's normal and the direction (3,) to a camera's centre, mm."""
    towards = centre - array_from_board.apply(middle)[0]
    return float(-array_from_board.rotation[:, 2] @ towards / np.linalg.norm(towards))


def _run(scene: BoardScene) -> Row:
    truth = make_state(scene)
    observations, row = render_and_detect(scene, truth)
    off = np.linalg.norm(truth.residuals(observations), axis=1)
    start = time.perf_counter()
    solution = solve_array(observations, A4_BOARD.corners_mm(), CalibrateSettings())
    row["seconds"] = time.perf_counter() - start
    row["sightings"] = len(observations)
    row["corner_rms_px"] = float(np.sqrt((off**2).mean() / 2.0))
    row["corner_median_px"] = float(np.median(off))
    row["corners_wrong"] = int((off > 0.5).sum())
    return row | solution_scores(scene, solution)


def _gather(
    cameras: CameraArray, poses: int, found: list[tuple[int, int, Ints, Floats]]
) -> BoardObservations:
    counts = [len(ids) for _, _, ids, _ in found]
    return BoardObservations(
        device_names=cameras.names,
        sizes=tuple((camera.width, camera.height) for camera in cameras),
        frames=tuple(range(poses)),
        device=np.repeat([device for device, _, _, _ in found], counts),
        pose=np.repeat([pose for _, pose, _, _ in found], counts),
        corner=np.concatenate([ids for _, _, ids, _ in found]),
        pixels=np.concatenate([pixels for _, _, _, pixels in found]),
    )
