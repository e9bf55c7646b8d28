"""Small scenes with known truth, shared by tests of several packages."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from capture.camera_file import write_cameras
from capture.pose import Pose


def looking_at(centre: Floats, target: Floats) -> Pose:
    """The camera_from_world of a camera at `centre` that looks at `target`, world +Y upwards."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ centre)


def small_array(count: int = 3, width: int = 64, height: int = 48) -> CameraArray:
    """Cameras on an arc of 300 mm about the origin, with a little distortion."""
    cameras = []
    for c in range(count):
        angle = 0.3 * (c - (count - 1) / 2)
        centre = 300.0 * np.array([np.sin(angle), 0.1, np.cos(angle)])
        cameras.append(
            Camera(
                name=f"cam{c:02d}",
                width=width,
                height=height,
                fx=2.0 * width,
                fy=2.0 * width,
                cx=(width - 1) / 2 + 0.3,
                cy=(height - 1) / 2 - 0.2,
                distortion=np.array([-0.1, 0.05, 2e-4, -1e-4, 0.0]),
                camera_from_world=looking_at(centre, np.zeros(3)),
            )
        )
    return CameraArray(tuple(cameras))


def write_visit(folder: Path, cameras: CameraArray, frames: int = 4, seed: int = 0) -> Path:
    """A visiting take of seeded noise images; returns its folder."""
    rng = np.random.default_rng(seed)
    write_cameras(folder / "cameras.json", cameras)
    for camera in cameras:
        (folder / camera.name).mkdir()
        for f in range(frames):
            image = rng.integers(0, 256, (camera.height, camera.width), dtype=np.uint8)
            cv2.imwrite(str(folder / camera.name / f"{f:04d}.png"), image)
    return folder
