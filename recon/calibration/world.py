"""The world of a calibrated array: from a named board pose, or from the array itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, check_shape
from capture.camera import CameraArray
from capture.errors import SettingsError
from capture.pose import Pose
from recon.board.shape import BoardShape
from recon.calibration.geometry import nearest_to_axes

IMAGE_UP: dict[str, tuple[float, float, float]] = {
    "top": (0.0, -1.0, 0.0),
    "bottom": (0.0, 1.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "right": (1.0, 0.0, 0.0),
}
BOARD_STANDS: dict[str, tuple[tuple[int, int, int], ...]] = {  # world axes in those of the board
    "upright": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "lying": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
_AGREEING = 0.3  # length of the mean of the devices' up directions that still means anything


@dataclass(frozen=True, eq=False)
class ArrayWorld:
    """Where the world lies.

    Attributes:
        world_from_array: the motion into it.
        origin: what its origin was taken from, in words.
        up: what its +Y was taken from, in words.
    """

    world_from_array: Pose
    origin: str
    up: str


def array_world(cameras: CameraArray, board_centres: Floats, image_up: str = "top") -> ArrayWorld:
    """A world with +Y up and the face along +Z, from the array itself.

    Origin: the point nearest to all optical axes, which stays the same however the board was waved;
    when the axes do not converge, the centroid of the board's places. +Z: from there towards the
    mean of the camera centres, which is where a face before the array looks. +Y: the mean up
    direction of the devices' images, made orthogonal to +Z.

    Args:
        cameras: the array, in any space, mm.
        board_centres: (P, 3) centres of the board at its poses, same space, mm.
        image_up: which side of the images is up: "top", or another for devices mounted turned.
    """
    check_shape(board_centres=(board_centres, "P 3"))
    centres = np.stack([camera.centre for camera in cameras])
    axes = np.stack([camera.camera_from_world.rotation[2] for camera in cameras])
    origin, words = _origin(centres, axes, board_centres)
    front = (centres - origin).mean(axis=0)
    front /= max(float(np.linalg.norm(front)), 1e-12)
    local = np.array(IMAGE_UP[image_up])
    ups = np.stack([local @ camera.camera_from_world.rotation for camera in cameras])
    up, up_words = ups.mean(axis=0), f"mean of the {image_up} of the images"
    up = up - (up @ front) * front
    if np.linalg.norm(up) < _AGREEING:
        up, up_words = (
            ups[0] - (ups[0] @ front) * front,
            f"{image_up} of the images of the first device",
        )
    up /= max(float(np.linalg.norm(up)), 1e-12)
    rotation = np.stack([np.cross(up, front), up, front])
    return ArrayWorld(Pose(rotation, -rotation @ origin), words, up_words)


def world_from_board_pose(
    array_from_board: Pose, shape: BoardShape, how: str = "upright"
) -> ArrayWorld:
    """The world that one pose of the board names, its origin in the middle of the corners.

    The board's own axes are those of its print: +X to the right, +Y down, +Z into it.

    Args:
        array_from_board: the board at that pose, mm.
        shape: its corners; boards whose place on the body is unknown do not count.
        how: "upright", the board on a stand, facing the array: world +X along board +X, +Y
            against board +Y, +Z out of its front. "lying", the board flat on a table: +Y out of
            its front, +X along board +X, +Z along board +Y.

    Raises:
        SettingsError: for any other word.
    """
    if how not in BOARD_STANDS:
        raise SettingsError(
            f"how the board stands: found {how!r}, expected one of {', '.join(BOARD_STANDS)}"
        )
    rotation = np.array(BOARD_STANDS[how], dtype=np.float64)
    placed = shape.placed[shape.face]
    middle = shape.corners[placed if placed.any() else slice(None)].mean(axis=0)
    world_from_board = Pose(rotation, -rotation @ middle)
    words = f"middle of the {how} board"
    return ArrayWorld(
        world_from_board @ array_from_board.inverse(), words, f"axes of the {how} board"
    )


def _origin(centres: Floats, axes: Floats, board_centres: Floats) -> tuple[Floats, str]:
    middle = board_centres.mean(axis=0)
    nearest = nearest_to_axes(centres, axes)
    if nearest is None:
        return middle, "centroid of the board's places: the optical axes do not converge"
    reach = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    if np.linalg.norm(nearest - middle) > 0.5 * reach:
        return middle, "centroid of the board's places: the optical axes meet far from them"
    return nearest, "point nearest to all optical axes"
