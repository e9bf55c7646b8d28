"""Which views are matched with which: pairs by the angle of their baseline, seen from the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats
from capture.camera import CameraArray
from capture.errors import CameraError, SettingsError
from capture.settings import check_ranges

_PARALLEL = 1e-3  # smallest eigenvalue of the meeting-point system, of a possible 1


@dataclass(frozen=True, kw_only=True)
class PairSettings:
    """How pairs are chosen.

    Attributes:
        angle_min_deg: below this angle a pair measures depth too poorly.
        angle_max_deg: above it the two views look too different.
        angle_best_deg: the angle preferred when a camera has more partners than it needs.
        angle_last_deg: a camera with no partner in the range takes its best one up to this angle.
        partners: partners a camera asks for; it may be asked by others too.
    """

    angle_min_deg: float = 9.0
    angle_max_deg: float = 27.0
    angle_best_deg: float = 19.0
    angle_last_deg: float = 45.0
    partners: int = 4

    def __post_init__(self) -> None:
        angles = (self.angle_min_deg, self.angle_best_deg, self.angle_max_deg, self.angle_last_deg)
        if not 0.0 < angles[0] < angles[1] < angles[2] <= angles[3] < 90.0:
            raise SettingsError(
                "pair angles: expected 0 < angle_min_deg < angle_best_deg < angle_max_deg <= "
                f"angle_last_deg < 90, found {angles}"
            )
        check_ranges("pairs", self, partners=(1, 64))


@dataclass(frozen=True)
class StereoPair:
    """Two cameras of an array, by index; the baseline runs from left to right.

    Attributes:
        left: the reference view.
        right: the view searched in.
        angle_deg: angle between the rays from the scene centre to the two camera centres.
    """

    left: int
    right: int
    angle_deg: float


def scene_centre(cameras: CameraArray) -> Floats:
    """The point (3,), world mm, that lies nearest to all optical axes in the least-squares sense.

    Raises:
        CameraError: when there are fewer than two cameras, when the axes are parallel, or when they
            meet behind a camera.
    """
    if len(cameras) < 2:
        raise CameraError(f"stereo needs at least 2 cameras, found {len(cameras)}")
    system, target = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras:
        axis = camera.camera_from_world.rotation[2]
        across = np.eye(3) - np.outer(axis, axis)
        system += across
        target += across @ camera.centre
    if np.linalg.eigvalsh(system / len(cameras))[0] < _PARALLEL:
        raise CameraError(
            "the optical axes of the cameras are parallel and meet nowhere; set centre_mm to the "
            "place of the face in world space"
        )
    centre = np.asarray(np.linalg.solve(system, target), dtype=np.float64)
    behind = [camera.name for camera in cameras if camera.depths(centre[None])[0] <= 0]
    if behind:
        raise CameraError(
            f"the optical axes meet at {np.round(centre).tolist()} mm, behind {', '.join(behind)}; "
            "set centre_mm to the place of the face in world space"
        )
    return centre


def select_pairs(
    cameras: CameraArray, centre: Floats, settings: PairSettings | None = None
) -> tuple[StereoPair, ...]:
    """Pairs whose baseline angle suits stereo, in either orientation, each camera in at least one.

    Args:
        cameras: the array; any layout, sizes and focal lengths.
        centre: (3,) world mm, the place angles are measured from.
        settings: the angles wanted.

    Returns:
        Pairs ordered by (left, right). Empty when no two cameras lie within `angle_last_deg`.
    """
    settings = settings or PairSettings()
    rays = np.stack([camera.centre - centre for camera in cameras])
    unit: Floats = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    angles: Floats = np.degrees(np.arccos(np.clip(unit @ unit.T, -1.0, 1.0)))
    chosen: set[tuple[int, int]] = set()
    for index in range(len(cameras)):
        chosen.update(_partners(index, angles[index], settings))
    oriented = [(*_orient(cameras, a, b), float(angles[a, b])) for a, b in sorted(chosen)]
    return tuple(StereoPair(*entry) for entry in sorted(oriented))


def _partners(index: int, angles: Floats, settings: PairSettings) -> list[tuple[int, int]]:
    """Unordered pairs of one camera with its best partners."""
    others = [other for other in range(len(angles)) if other != index]
    others.sort(
        key=lambda other: (round(abs(float(angles[other]) - settings.angle_best_deg), 6), other)
    )
    inside = [o for o in others if settings.angle_min_deg <= angles[o] <= settings.angle_max_deg]
    if not inside:
        low = 0.25 * settings.angle_min_deg
        inside = [o for o in others if low <= angles[o] <= settings.angle_last_deg][:1]
    return [(min(index, o), max(index, o)) for o in inside[: settings.partners]]


def _orient(cameras: CameraArray, first: int, second: int) -> tuple[int, int]:
    """Left and right such that the baseline runs along the images' rows, or else down them."""
    baseline = cameras[second].centre - cameras[first].centre
    axes = (
        cameras[first].camera_from_world.rotation + cameras[second].camera_from_world.rotation
    ) @ baseline
    along = axes[0] if abs(axes[0]) >= abs(axes[1]) else axes[1]
    return (first, second) if along >= 0 else (second, first)
