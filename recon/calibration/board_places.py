"""Where a board was in each frame, from sightings by cameras that are already calibrated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, Ints
from capture.camera import CameraArray
from capture.errors import ShapeError
from capture.pose import Pose
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.calibration.chain import board_poses
from recon.calibration.view_poses import rigid_columns

_STEPS = 20
_STOP = 1e-9  # radians and mm
_LOSS_PX = 0.5  # scale of the Cauchy loss


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardPlace:
    """A board at one instant.

    Attributes:
        pose: index of the board pose in the sightings.
        frame: its frame number.
        world_from_board: where the board was, mm.
        miss_px: by device index, the median reprojection error of its corners.
    """

    pose: int
    frame: int
    world_from_board: Pose
    miss_px: dict[int, float]


def place_boards(
    observations: BoardObservations,
    shape: BoardShape,
    cameras: CameraArray,
    starts: Sequence[Pose] | None = None,
) -> list[BoardPlace]:
    """Find the board at every pose that the cameras can tell, the cameras held as they are.

    The pose of any view that all devices together like best is refined on all of them, with a
    Cauchy loss.

    Args:
        observations: corner sightings, of the devices of `cameras`, in their order.
        shape: the board's corners, every face of it placed.
        cameras: calibrated.
        starts: world_from_board near each pose, where that is known: refined instead.

    References:
        Triggs et al. 2000, section 4 (robust Gauss-Newton).
    """
    if observations.device_names != cameras.names:
        raise ShapeError(
            f"sightings of {', '.join(observations.device_names)} do not belong to cameras "
            f"{', '.join(cameras.names)}"
        )
    corners = shape.corners
    found = []
    starts = board_poses(observations, shape, cameras) if starts is None else starts
    for pose, frame in enumerate(observations.frames):
        rows = np.flatnonzero(observations.pose == pose)
        if not len(rows):
            continue
        best = _refined(observations, rows, corners, cameras, starts[pose])
        miss = np.linalg.norm(_misses(observations, rows, corners, cameras, best), axis=1)
        device = observations.device[rows]
        found.append(
            BoardPlace(
                pose=pose, frame=frame, world_from_board=best,
                miss_px={
                    int(d): float(np.median(np.nan_to_num(miss[device == d], nan=np.inf)))
                    for d in np.unique(device)
                },
            )
        )  # fmt: skip
    return found


def _misses(
    observations: BoardObservations,
    rows: Ints,
    corners: Floats,
    cameras: CameraArray,
    pose: Pose,
) -> Floats:
    """Predicted minus seen (R, 2), px; NaN behind a camera."""
    points = pose.apply(corners[observations.corner[rows]])
    out = np.empty((len(rows), 2))
    for device in np.unique(observations.device[rows]):
        mine = observations.device[rows] == device
        out[mine] = cameras[int(device)].project(points[mine])
    return out - observations.pixels[rows]


def _cost(misses: Floats) -> float:
    squared = np.nan_to_num((misses**2).sum(axis=1), nan=1e12)
    return float(np.log1p(squared / _LOSS_PX**2).sum())


def _refined(
    observations: BoardObservations,
    rows: Ints,
    corners: Floats,
    cameras: CameraArray,
    pose: Pose,
) -> Pose:
    """The pose after Gauss-Newton steps, as long as they lower the robust cost."""
    cost = _cost(_misses(observations, rows, corners, cameras, pose))
    device = observations.device[rows]
    for _ in range(_STEPS):
        points = pose.apply(corners[observations.corner[rows]])
        middle = points.mean(axis=0)
        slope = np.zeros((len(rows), 2, 6))
        for index in np.unique(device):
            mine = device == index
            by_point = cameras[int(index)].project_jacobian(points[mine])
            slope[mine] = rigid_columns(points[mine] - middle, by_point)
        misses = _misses(observations, rows, corners, cameras, pose)
        good = np.isfinite(misses).all(axis=1)
        weight = 1.0 / (1.0 + (misses[good] ** 2).sum(axis=1) / _LOSS_PX**2)
        jacobian = slope[good].reshape(-1, 6)
        each = np.repeat(weight, 2)[:, None]
        step, _, _, _ = np.linalg.lstsq(
            jacobian.T @ (each * jacobian), -jacobian.T @ (each[:, 0] * misses[good].ravel()),
            rcond=None,
        )  # fmt: skip
        about = Pose.from_rotation_vector(step[:3].astype(np.float64), np.zeros(3))
        moved = Pose(about.rotation, middle - about.rotation @ middle + step[3:]) @ pose
        after = _cost(_misses(observations, rows, corners, cameras, moved))
        if not after < cost:
            break
        pose, cost = moved, after
        if float(np.abs(step).max()) < _STOP:
            break
    return pose
