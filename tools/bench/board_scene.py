"""Synthetic board takes with known truth: an array of cameras, a waved board, corner noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from capture.arrays import Floats, Image
from capture.camera import Camera, CameraArray
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.charuco import Board
from recon.board.observations import BoardObservations
from recon.calibration.geometry import rigid_fit
from tools.bench.board_arrays import board_yaws, device_directions

_PRINT = 8.0  # pixels of the drawn pattern a millimetre
_FINE = 3  # samples a pixel, along each axis


@dataclass(frozen=True, kw_only=True)
class BoardScene:
    """How a synthetic board take looks.

    Attributes:
        devices: how many cameras.
        layout: how they stand, see `tools.bench.board_arrays`.
        span_deg: how far to either side of the face.
        size_px: side of the square images.
        focal_px: mean focal length.
        radius_mm: distance of the cameras from the face.
        poses: how many board poses.
        noise_px: standard deviation of a corner, per coordinate.
        bow_mm: how far the middle of the board stands out of its plane.
        outliers: fraction of corners moved by 6 px in a random direction.
        hidden: fraction of corners not seen.
        seed: of every random number.
    """

    devices: int = 16
    layout: str = "arc"
    span_deg: float = 62.0
    size_px: int = 2048
    focal_px: float = 4000.0
    radius_mm: float = 900.0
    poses: int = 40
    noise_px: float = 0.1
    bow_mm: float = 0.0
    outliers: float = 0.0
    hidden: float = 0.1
    seed: int = 0


A4_BOARD = Board(
    squares_x=12, squares_y=9, square_mm=20.0, marker_mm=15.0, dictionary="DICT_5X5_1000"
)

FACING = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))  # board +Y down, +Z away from the face


def make_array(scene: BoardScene) -> CameraArray:
    """Cameras of the scene's layout, looking at the origin, each with its own lens."""
    random = np.random.default_rng([scene.seed, 1])
    cameras = []
    directions = device_directions(scene.layout, scene.devices, scene.span_deg)
    for index, (yaw, pitch, roll) in enumerate(np.radians(directions).tolist()):
        centre = scene.radius_mm * np.array(
            [np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)]
        )
        target = random.normal(0, 8.0, 3)
        focal = scene.focal_px * (1 + random.normal(0, 0.02))
        middle = (scene.size_px - 1) / 2 + random.normal(0, 0.004 * scene.size_px, 2)
        bend = np.array([-0.12 + random.normal(0, 0.01), 0.1 + random.normal(0, 0.03), 0, 0, 0])
        bend[2:4] = random.normal(0, 3e-4, 2)
        cameras.append(
            Camera(
                name=f"cam{index:02d}",
                width=scene.size_px,
                height=scene.size_px,
                fx=focal,
                fy=focal * (1 + random.normal(0, 2e-4)),
                cx=float(middle[0]),
                cy=float(middle[1]),
                distortion=bend,
                camera_from_world=_rolled(roll) @ looking_at(centre, target),
            )
        )
    return CameraArray(tuple(cameras))


def looking_at(centre: Floats, target: Floats) -> Pose:
    """camera_from_world of a camera at `centre` that looks at `target`, +Y of the world up; mm."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ centre)


def _rolled(roll: float) -> Pose:
    return Pose.from_rotation_vector(np.array([0.0, 0.0, roll]), np.zeros(3))


def make_state(scene: BoardScene, board: Board = A4_BOARD) -> ArrayState:
    """The true array, board poses and board shape."""
    random = np.random.default_rng([scene.seed, 2])
    middle = board.corners_mm().mean(axis=0)
    poses = []
    for mean_yaw in board_yaws(scene.layout, scene.span_deg, scene.poses):
        yaw = np.radians(mean_yaw + random.normal(0, 6.0))
        pitch = np.radians(random.uniform(-35, 35))
        spin = np.radians(random.uniform(-25, 25))
        turn = (
            Pose.from_rotation_vector(np.array([0, yaw, 0]), random.normal(0, 35.0, 3))
            @ Pose.from_rotation_vector(np.array([pitch, 0, 0]), np.zeros(3))
            @ Pose.from_rotation_vector(np.array([0, 0, spin]), np.zeros(3))
        )
        poses.append(turn @ FACING @ Pose(np.eye(3), -middle))
    return ArrayState(make_array(scene), tuple(poses), bent_corners(board, scene.bow_mm))


def bent_corners(board: Board, bow_mm: float) -> Floats:
    """Corners (N, 3), board space, mm, of a board that is bowed along both of its axes."""
    corners = board.corners_mm()
    corners[:, 2] += bow_height(board, bow_mm, corners[:, :2])
    return corners


def bow_height(board: Board, bow_mm: float, flat: Floats) -> Floats:
    """Height (...), mm along +Z, of places (..., 2) on a bowed board, mm on the flat one."""
    corners = board.corners_mm()[:, :2]
    middle = corners.mean(axis=0)
    across = (flat - middle) / np.abs(corners - middle).max(axis=0)
    height: Floats = bow_mm * (1.0 - (across**2).sum(axis=-1) / 2.0)
    return height


def observe(scene: BoardScene, truth: ArrayState) -> BoardObservations:
    """What the array sees of the board: corners in the image and facing the camera, with noise."""
    random = np.random.default_rng([scene.seed, 3])
    rows: list[tuple[int, int, int, float, float]] = []
    for pose, array_from_board in enumerate(truth.array_from_board):
        points = array_from_board.apply(truth.corners)
        normal = -array_from_board.rotation[:, 2]
        for device, camera in enumerate(truth.cameras):
            towards = camera.centre - points.mean(axis=0)
            if normal @ towards < 0.4 * np.linalg.norm(towards):
                continue
            pixels = camera.project(points)
            margin = (np.abs(pixels - (scene.size_px - 1) / 2) < scene.size_px / 2 - 6).all(axis=1)
            seen = np.flatnonzero(margin & (random.random(len(points)) >= scene.hidden))
            if len(seen) < 12:
                continue
            noisy = pixels[seen] + random.normal(0, scene.noise_px, (len(seen), 2))
            wrong = random.random(len(seen)) < scene.outliers
            angle = random.uniform(0, 2 * np.pi, len(seen))
            noisy += 6.0 * wrong[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            rows += [(device, pose, int(n), *p) for n, p in zip(seen, noisy.tolist(), strict=True)]
    table = np.array(rows).reshape(-1, 5)
    return BoardObservations(
        device_names=truth.cameras.names,
        sizes=tuple((camera.width, camera.height) for camera in truth.cameras),
        frames=tuple(range(len(truth.array_from_board))),
        device=table[:, 0].astype(np.int64), pose=table[:, 1].astype(np.int64),
        corner=table[:, 2].astype(np.int64), pixels=table[:, 3:],
    )  # fmt: skip


def render_board(
    camera: Camera, world_from_board: Pose, board: Board, blur_px: float = 0.7, seed: int = 0
) -> Image:
    """An 8-bit image of a flat board through the camera's lens, with blur and 2 DN of noise.

    The printed pattern is warped by `cv2.remap`, three samples a pixel along each axis.

    Args:
        camera: which sees it.
        world_from_board: where the board is, mm.
        board: its pattern.
        blur_px: standard deviation of the blur.
        seed: of the noise.
    """
    size = (board.squares_x * board.square_mm, board.squares_y * board.square_mm)
    print_px = (int(size[0] * _PRINT), int(size[1] * _PRINT))
    print_mm = np.array(size) / print_px
    pattern = board.pattern().generateImage(print_px, marginSize=0)
    pose = camera.camera_from_world @ world_from_board
    plane = np.column_stack([pose.rotation[:, :2], pose.translation])
    to_print = np.array([[1 / print_mm[0], 0, -0.5], [0, 1 / print_mm[1], -0.5], [0, 0, 1.0]])
    ideal = _ideal_grid(camera)
    maps = cv2.perspectiveTransform(ideal, to_print @ np.linalg.inv(plane)).astype(np.float32)
    fine = cv2.remap(
        pattern, maps[:, :, 0], maps[:, :, 1], cv2.INTER_LINEAR, borderValue=255.0
    )  # outside the print the paper is white
    image = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(0.75 * image.astype(np.float64) + 20.0, (0, 0), blur_px)
    noisy = blurred + np.random.default_rng([seed, 5]).normal(0.0, 2.0, blurred.shape)
    seen: Image = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    return seen


@lru_cache(maxsize=2)
def _ideal_grid(camera: Camera) -> Floats:
    """Ideal places (H', W', 2) of samples finer than pixels, linear between every fourth pixel."""
    columns = np.arange(-4.0, camera.width + 8.0, 4.0)
    rows = np.arange(-4.0, camera.height + 8.0, 4.0)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    coarse = camera.undistort(grid.reshape(-1, 2)).reshape(grid.shape)
    x = (np.arange(camera.width * _FINE) + 0.5) / _FINE - 0.5
    y = (np.arange(camera.height * _FINE) + 0.5) / _FINE - 0.5
    u, v = np.meshgrid((x + 4.0) / 4.0, (y + 4.0) / 4.0)
    i, j = u.astype(np.int64), v.astype(np.int64)
    a, b = (u - i)[:, :, None], (v - j)[:, :, None]
    top = (1 - a) * coarse[j, i] + a * coarse[j, i + 1]
    low = (1 - a) * coarse[j + 1, i] + a * coarse[j + 1, i + 1]
    fine: Floats = (1 - b) * top + b * low
    return fine


def face_points(seed: int = 0) -> Floats:
    """400 points (N, 3), mm, all through a ball of 80 mm about the origin."""
    random = np.random.default_rng([seed, 4])
    ball = random.normal(size=(400, 3))
    points = 80.0 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    points = points * random.random((400, 1)) ** (1 / 3)
    return np.asarray(points, dtype=np.float64)


def triangulate(truth: CameraArray, found: CameraArray, points: Floats) -> Floats:
    """Where the found cameras see points (N, 3), mm, that the true ones project without noise.

    The place nearest to all rays, in the world of the found cameras, mm.
    """
    normal: Floats = np.zeros((len(points), 3, 3))
    right: Floats = np.zeros((len(points), 3))
    for one, other in zip(truth, found, strict=True):
        rays = other.rays(one.project(points))
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        normal += across
        right += across @ other.centre
    solved = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    return np.asarray(solved, dtype=np.float64)


def triangulation_error(truth: CameraArray, found: CameraArray, seed: int = 0) -> Floats:
    """Errors (N, 3), mm, of the face volume triangulated with the found cameras.

    Exact projections of 400 points in a 160 mm ball around the origin by the true cameras are
    triangulated by the found ones, and the result is aligned rigidly, without scale.
    """
    points = face_points(seed)
    solved = triangulate(truth, found, points)
    return rigid_fit(solved, points).apply(solved) - points
