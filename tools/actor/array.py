"""A plausible array of cameras about the simulated actor."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from capture.errors import SettingsError
from capture.pose import Pose

_AZIMUTHS = (-62.0, 62.0)
_ELEVATIONS = ((14.0, -6.0), (22.0, 2.0))  # degrees: the two rows, alternating along them
_RADIUS_MM = 620.0
_FOCAL = 2.25  # of the image's longer side
_TARGET = np.array([0.0, -12.0, 40.0])


def make_array(seed: int, count: int = 16, size: int = 640) -> CameraArray:
    """Two rows of cameras in an arc before the face, each a little off its nominal place.

    Args:
        seed: of the jitter of places, focal lengths and lenses.
        count: cameras; they spread over the arc from one side to the other.
        size: columns and rows of the square images, px.

    Raises:
        SettingsError: when `count` is not 1..64 or `size` not 16..8192.
    """
    if not 1 <= count <= 64:
        raise SettingsError(f"count: must lie in 1..64, found {count}")
    if not 16 <= size <= 8192:
        raise SettingsError(f"size: must lie in 16..8192 px, found {size}")
    random = np.random.default_rng([abs(seed), 31])
    columns = (count + 1) // 2
    azimuths = np.linspace(*_AZIMUTHS, columns) if columns > 1 else np.zeros(1)
    cameras = []
    for index in range(count):
        azimuth = np.radians(azimuths[index // 2] + random.normal(0.0, 0.8))
        elevation = np.radians(_ELEVATIONS[(index // 2) % 2][index % 2] + random.normal(0.0, 0.8))
        away = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation),
                         np.cos(azimuth) * np.cos(elevation)])  # fmt: skip
        place = _TARGET + (_RADIUS_MM + random.normal(0.0, 6.0)) * away
        target = _TARGET + random.normal(0.0, 3.0, 3)
        pose = _look(place, target, float(random.normal(0.0, 0.02)))
        focal = _FOCAL * size * (1.0 + random.normal(0.0, 0.004))
        centre = 0.5 * (size - 1) + random.normal(0.0, 0.004 * size, 2)
        lens = random.normal([-0.12, 0.15, 0.0, 0.0, 0.0], [0.01, 0.02, 2e-4, 2e-4, 0.0])
        cameras.append(Camera(
            name=f"cam{index:02d}", width=size, height=size, fx=focal, fy=focal,
            cx=float(centre[0]), cy=float(centre[1]), distortion=lens, camera_from_world=pose,
        ))  # fmt: skip
    return CameraArray(tuple(cameras))


def _look(place: Floats, target: Floats, roll: float) -> Pose:
    """camera_from_world of a camera at `place` that looks at `target`, world +Y up."""
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    upright = np.stack([right, np.cross(forward, right), forward])
    turned = Pose.from_rotation_vector(np.array([0.0, 0.0, roll]), np.zeros(3)).rotation @ upright
    return Pose(turned, -turned @ place)


def camera_at(
    target: Floats, azimuth_deg: float, elevation_deg: float, size: int, zoom: float = 1.0
) -> Camera:
    """One camera of a plain lens that looks at a place from a direction, for pictures.

    Args:
        target: (3,) world, mm.
        azimuth_deg: 0 before the face, growing to the actor's left.
        elevation_deg: above the horizon.
        size: columns and rows, px.
        zoom: of the focal length; 1 shows the whole head.
    """
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    away = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation),
                     np.cos(azimuth) * np.cos(elevation)])  # fmt: skip
    focal, centre = _FOCAL * size * zoom, 0.5 * (size - 1)
    return Camera(
        name="view", width=size, height=size, fx=focal, fy=focal, cx=centre, cy=centre,
        distortion=np.zeros(5), camera_from_world=_look(target + _RADIUS_MM * away, target, 0.0),
    )  # fmt: skip
