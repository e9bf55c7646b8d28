"""`ArrayState`: what a calibration solves for: lenses, places, board poses, board shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, check_shape
from capture.camera import CameraArray
from capture.errors import ShapeError
from capture.pose import Pose
from recon.board.observations import BoardObservations


@dataclass(frozen=True, eq=False)
class ArrayState:
    """One estimate of the whole array.

    Attributes:
        cameras: whose world is the array's space while the solve runs.
        array_from_board: (P) motion of the board into the array's space at each pose, mm.
        corners: (N, 3) shape of the board, board space, mm.
    """

    cameras: CameraArray
    array_from_board: tuple[Pose, ...]
    corners: Floats

    def __post_init__(self) -> None:
        check_shape(corners=(self.corners, "N 3"))

    def points(self, observations: BoardObservations) -> Floats:
        """Array-space positions (M, 3) of the corner of each sighting, mm."""
        turn = np.stack([pose.rotation for pose in self.array_from_board])
        shift = np.stack([pose.translation for pose in self.array_from_board])
        local = self.corners[observations.corner]
        moved: Floats = np.einsum("mij,mj->mi", turn[observations.pose], local)
        return moved + shift[observations.pose]

    def residuals(self, observations: BoardObservations) -> Floats:
        """Predicted minus observed (M, 2), px; NaN where a corner falls behind its camera."""
        if len(observations.device_names) != len(self.cameras):
            raise ShapeError(
                f"observations: expected {len(self.cameras)} devices, "
                f"found {len(observations.device_names)}"
            )
        points = self.points(observations)
        out = np.empty((len(observations), 2))
        for index, camera in enumerate(self.cameras):
            rows = observations.device == index
            out[rows] = camera.project(points[rows]) - observations.pixels[rows]
        return out

    def moved(self, world_from_array: Pose) -> ArrayState:
        """The same array described in another space."""
        array_from_world = world_from_array.inverse()
        return ArrayState(
            CameraArray(
                tuple(c.posed(c.camera_from_world @ array_from_world) for c in self.cameras)
            ),
            tuple(world_from_array @ pose for pose in self.array_from_board),
            self.corners,
        )

    def scaled(self, factor: float) -> ArrayState:
        """All lengths multiplied by `factor`; every residual stays."""
        cameras = [
            c.posed(Pose(c.camera_from_world.rotation, factor * c.camera_from_world.translation))
            for c in self.cameras
        ]
        poses = [Pose(p.rotation, factor * p.translation) for p in self.array_from_board]
        return ArrayState(CameraArray(tuple(cameras)), tuple(poses), factor * self.corners)
