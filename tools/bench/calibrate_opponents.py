"""What others do with the same sightings: OpenCV's chain and multiview solve, and less of ours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from capture.arrays import Bools, Floats
from capture.camera import Camera, CameraArray
from capture.errors import LikenessError, SolveError
from capture.pose import Pose
from recon.board.observations import BoardObservations
from recon.calibration.chain import initial_state
from recon.calibration.solver import CalibrateSettings, solve_array
from recon.colmap import AdjustOptions, adjust_array

_LEAST_CORNERS = 8  # of a view that OpenCV is given
_MILLI = 0.001
_DIVERGING_SEEDS = 2  # it takes minutes to diverge

AnyArray = np.ndarray[Any, np.dtype[Any]]
Solve = Callable[[BoardObservations, Floats], CameraArray]


@dataclass(frozen=True)
class Opponent:
    """One way to calibrate an array.

    Attributes:
        name: what it is.
        solve: cameras from sightings and nominal board corners (N, 3), mm; raises a
            `LikenessError` when it has no answer.
        most_seeds: of a long table it is tried on so many seeds only.
    """

    name: str
    solve: Solve
    most_seeds: int = 1000


def opponents() -> list[Opponent]:
    """All of them, ours in full first."""
    return [
        Opponent("ours", _ours(CalibrateSettings())),
        Opponent("ours, board not released", _ours(CalibrateSettings(free_board=False))),
        Opponent("pycolmap, board not released, plain loss", plain_adjustment),
        Opponent("OpenCV calibrateCamera + PnP chain", opencv_chain),
        Opponent("OpenCV calibrateMultiview, full boards", full_board_multiview),
        Opponent("OpenCV calibrateMultiview, all views", partial_multiview, _DIVERGING_SEEDS),
        Opponent("nominal lenses + PnP chain (our start)", _start),
    ]


def plain_adjustment(observations: BoardObservations, corners: Floats) -> CameraArray:
    """COLMAP's bundle adjustment alone: flat board, least squares, nothing thrown away."""
    start = initial_state(observations, corners)
    return adjust_array(start, observations, AdjustOptions(loss_px=0.0)).state.cameras


def opencv_chain(observations: BoardObservations, corners: Floats) -> CameraArray:
    """The usual sixty lines: each device by `calibrateCamera`, then relative poses chained.

    k1 k2 p1 p2 with k3 fixed; each view's pose is that of the lens fit. Two devices that share
    board poses have a relative pose from each, averaged without the worst half; devices hang on the
    one with the most shared views, over as few links as possible.
    """
    lenses: list[Camera] = []
    views: dict[tuple[int, int], Pose] = {}
    for device, name in enumerate(observations.device_names):
        camera, poses = _one_device(observations, corners, device, name)
        lenses.append(camera)
        views.update({(device, pose): value for pose, value in poses.items()})
    count = len(lenses)
    seen = np.array(
        [[(c, p) in views for p in range(len(observations.frames))] for c in range(count)]
    )
    shared = seen.astype(np.int64) @ seen.T
    root = int(np.argmax(shared.sum(axis=1)))
    camera_from_root = {root: Pose.identity()}
    while len(camera_from_root) < count:
        links = [
            (int(shared[known, new]), known, new)
            for known in camera_from_root
            for new in range(count)
            if new not in camera_from_root
        ]
        most, known, new = max(links, key=lambda link: (link[0], -link[1], -link[2]))
        if most == 0:
            raise SolveError(f"{lenses[new].name}: shares no view with the rest")
        relative = [
            views[new, p] @ views[known, p].inverse()
            for p in np.flatnonzero(seen[new] & seen[known]).tolist()
        ]
        camera_from_root[new] = _average(relative) @ camera_from_root[known]
    return CameraArray(tuple(lens.posed(camera_from_root[c]) for c, lens in enumerate(lenses)))


def full_board_multiview(observations: BoardObservations, corners: Floats) -> CameraArray:
    """`cv2.calibrateMultiview` on the views that show every corner; the others are dropped."""
    counts = observations.view_counts()
    return _multiview(observations, corners, counts == len(corners))


def partial_multiview(observations: BoardObservations, corners: Floats) -> CameraArray:
    """`cv2.calibrateMultiview` on all views, unseen corners at (-1, -1) as its pages say."""
    return _multiview(observations, corners, observations.view_counts() >= _LEAST_CORNERS)


def _ours(settings: CalibrateSettings) -> Solve:
    def solve(observations: BoardObservations, corners: Floats) -> CameraArray:
        return solve_array(observations, corners, settings).state.cameras

    return solve


def _start(observations: BoardObservations, corners: Floats) -> CameraArray:
    return initial_state(observations, corners).cameras


def _one_device(
    observations: BoardObservations, corners: Floats, device: int, name: str
) -> tuple[Camera, dict[int, Pose]]:
    rows = [
        (pose, view)
        for index, pose, view in observations.views()
        if index == device and view.stop - view.start >= _LEAST_CORNERS
    ]
    if len(rows) < 3:
        raise SolveError(f"{name}: {len(rows)} views; calibrateCamera wants 3 or more")
    boards = [corners[observations.corner[view]].astype(np.float32) for _, view in rows]
    pixels = [observations.pixels[view].astype(np.float32) for _, view in rows]
    size = observations.sizes[device]
    try:
        _, matrix, bend, turns, shifts = cv2.calibrateCamera(
            boards, pixels, size, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3
        )
    except cv2.error as error:
        raise SolveError(f"{name}: calibrateCamera: {error.err}") from error
    poses = {
        pose: Pose.from_rotation_vector(np.ravel(turn), np.ravel(shift))
        for (pose, _), turn, shift in zip(rows, turns, shifts, strict=True)
    }
    lens = _camera(name, size, np.asarray(matrix), np.asarray(bend), Pose.identity())
    return lens, poses


def _average(motions: list[Pose]) -> Pose:
    """Chordal mean of the half of the motions that lies nearest to the median translation."""
    shifts = np.stack([motion.translation for motion in motions])
    off = np.linalg.norm(shifts - np.median(shifts, axis=0), axis=1)
    near = np.argsort(off, kind="stable")[: max(1, (len(motions) + 1) // 2)]
    u, _, vt = np.linalg.svd(sum(motions[n].rotation for n in near.tolist()))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return Pose(turn, shifts[near].mean(axis=0))


def _multiview(observations: BoardObservations, corners: Floats, use: Bools) -> CameraArray:
    """OpenCV's joint solve; metres: in millimetres it says that the points lie on a line."""
    names, count = observations.device_names, len(observations.device_names)
    lacking = [name for name, views in zip(names, use.sum(axis=1), strict=True) if views < 3]
    if lacking:
        raise SolveError(f"fewer than 3 usable views: {', '.join(lacking)}")
    pixels = np.full((*use.shape, len(corners), 2), -1.0, np.float32)
    pixels[observations.device, observations.pose, observations.corner] = observations.pixels
    pixels[~use] = -1.0
    poses = np.flatnonzero(use.any(axis=0))
    board = (_MILLI * corners).astype(np.float32)
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        rms, matrices, bends, turns, shifts = cv2.calibrateMultiview(
            [board] * len(poses),
            [[pixels[c, p] for p in poses] for c in range(count)],
            list(observations.sizes),
            np.ascontiguousarray(use[:, poses]).astype(np.uint8),
            np.full((count, 1), cv2.CALIB_MODEL_PINHOLE, np.uint8),
            [], [], [], [],
            np.full((count, 1), cv2.CALIB_FIX_K3, np.int32),
        )  # fmt: skip
    except cv2.error as error:
        raise SolveError(f"calibrateMultiview: {error.err}") from error
    finally:
        cv2.utils.logging.setLogLevel(level)
    values = [np.isfinite(np.asarray(x)).all() for x in (*matrices, *bends, *turns, *shifts)]
    if not (np.isfinite(rms) and all(values)):
        raise SolveError(f"calibrateMultiview: RMS {rms:.3g} px, cameras that are not numbers")
    cameras = [
        _camera(
            name, size, np.asarray(matrix), np.asarray(bend),
            Pose.from_rotation_vector(np.ravel(turn), np.ravel(shift) / _MILLI),
        )
        for name, size, matrix, bend, turn, shift in zip(
            names, observations.sizes, matrices, bends, turns, shifts, strict=True
        )
    ]  # fmt: skip
    if rms > 10.0:
        raise SolveError(f"calibrateMultiview: diverged, RMS {rms:.3g} px")
    return CameraArray(tuple(cameras))


def _camera(
    name: str, size: tuple[int, int], matrix: AnyArray, bend: AnyArray, camera_from_array: Pose
) -> Camera:
    return Camera(
        name=name, width=size[0], height=size[1], fx=float(matrix[0, 0]), fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]), cy=float(matrix[1, 2]),
        distortion=np.ravel(bend)[:5].astype(np.float64), camera_from_world=camera_from_array,
    )  # fmt: skip


def failure(error: LikenessError) -> str:
    """What went wrong on one line, for a table."""
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
