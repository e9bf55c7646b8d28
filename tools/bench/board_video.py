"""A board that is waved without a stop, recorded as video, and what devices do wrong."""

from __future__ import annotations

import dataclasses

import numpy as np

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.charuco import Board
from recon.board.observations import BoardObservations
from tools.bench.board_scene import A4_BOARD, FACING, BoardScene, bent_corners, make_array

_WAVES = np.array([0.7, 1.0, 1.7, 2.6])  # turns a hundred frames
_STRENGTHS = np.array([1.0, 0.9, 0.5, 0.25])
_PLACE_MM, _TILT_DEG, _SPIN_DEG, _YAW_DEG = 40.0, 24.0, 18.0, 9.0


def make_video(scene: BoardScene, pace: float = 1.0, board: Board = A4_BOARD) -> ArrayState:
    """The true array and the smooth motion of a waved board, one pose a frame.

    The board sweeps once or more across all devices, as an operator shows it to them, while it
    tilts, spins and moves about.

    Args:
        scene: how the take looks; its `poses` are the frames.
        pace: how fast the board is waved; at 1 a point moves by some millimetres a frame.
        board: the board.

    Returns:
        The truth; `tools.bench.board_scene.observe` makes sightings of it.
    """
    random = np.random.default_rng([scene.seed, 7])
    middle = board.corners_mm().mean(axis=0)
    time: Floats = 0.01 * pace * np.arange(scene.poses, dtype=np.float64)
    place = _PLACE_MM * np.stack([_waves(random, time) for _ in range(3)], axis=1)
    pitch = np.radians(_TILT_DEG * _waves(random, time))
    spin = np.radians(_SPIN_DEG * _waves(random, time))
    yaw = _sweep(scene, time) + np.radians(_YAW_DEG * _waves(random, time))
    poses = []
    for index in range(scene.poses):
        turn = (
            Pose.from_rotation_vector(np.array([0.0, yaw[index], 0.0]), place[index])
            @ Pose.from_rotation_vector(np.array([pitch[index], 0.0, 0.0]), np.zeros(3))
            @ Pose.from_rotation_vector(np.array([0.0, 0.0, spin[index]]), np.zeros(3))
        )
        poses.append(turn @ FACING @ Pose(np.eye(3), -middle))
    return ArrayState(make_array(scene), tuple(poses), bent_corners(board, scene.bow_mm))


def _waves(random: np.random.Generator, time: Floats) -> Floats:
    """A smooth motion (F,) of unit size made of a few slow waves."""
    phase = random.uniform(0.0, 2.0 * np.pi, len(_WAVES))
    turns = _WAVES * random.uniform(0.85, 1.15, len(_WAVES))
    total = np.sin(2.0 * np.pi * time[:, None] * turns + phase) * _STRENGTHS
    out: Floats = total.sum(axis=1) / np.linalg.norm(_STRENGTHS)
    return out


def _sweep(scene: BoardScene, time: Floats) -> Floats:
    """Where the board faces (F,), radians: once around a ring, to and fro before other arrays."""
    if scene.layout == "ring":
        around: Floats = 2.0 * np.pi * 0.5 * time
        return around
    reach = np.radians(max(scene.span_deg - 8.0, 30.0))
    fro: Floats = reach * np.sin(2.0 * np.pi * (0.5 * time - 0.25))
    return fro


def pick_poses(observations: BoardObservations, count: int) -> BoardObservations:
    """`count` of the poses, evenly spread, as the stage picks them from a long take."""
    places = np.linspace(0, len(observations.frames) - 1, count).round().astype(np.int64)
    places = np.unique(places)
    keep = np.isin(observations.pose, places)
    return BoardObservations(
        device_names=observations.device_names, sizes=observations.sizes,
        frames=tuple(observations.frames[place] for place in places.tolist()),
        device=observations.device[keep],
        pose=np.searchsorted(places, observations.pose[keep]),
        corner=observations.corner[keep], pixels=observations.pixels[keep],
    )  # fmt: skip


def delay_device(observations: BoardObservations, device: int, frames: int) -> BoardObservations:
    """The same take with one device that files each image `frames` too late; its last are lost."""
    mine = observations.device == device
    pose = observations.pose + np.where(mine, frames, 0)
    keep = (pose >= 0) & (pose < len(observations.frames))
    return dataclasses.replace(
        observations, device=observations.device[keep], pose=pose[keep],
        corner=observations.corner[keep], pixels=observations.pixels[keep],
    )  # fmt: skip


def swap_devices(
    observations: BoardObservations, one: int, other: int, from_pose: int = 0
) -> BoardObservations:
    """The same take with the images of two devices exchanged, from one pose on."""
    late = observations.pose >= from_pose
    device = np.where(late & (observations.device == one), other, observations.device)
    device = np.where(late & (observations.device == other), one, device)
    return dataclasses.replace(observations, device=device)


def mirror_device(observations: BoardObservations, device: int) -> BoardObservations:
    """The same take with the images of one device mirrored left to right."""
    width = observations.sizes[device][0]
    mine = (observations.device == device)[:, None] & np.array([True, False])
    pixels = np.where(mine, width - 1.0 - observations.pixels, observations.pixels)
    return dataclasses.replace(observations, pixels=pixels)


def drop_rows(observations: BoardObservations, device: int, keep_views: int) -> BoardObservations:
    """The same take in which one device saw the board in its first `keep_views` views only."""
    mine = observations.device == device
    seen = np.unique(observations.pose[mine])[:keep_views]
    return observations.select(~mine | np.isin(observations.pose, seen))


def earlier_session(cameras: CameraArray, seed: int, turn_deg: float = 0.02) -> CameraArray:
    """The array as calibrated the day before: each device since then turned and moved a little."""
    random = np.random.default_rng([seed, 8])
    moved: list[Camera] = []
    for camera in cameras:
        jolt = Pose.from_rotation_vector(
            np.radians(random.normal(0.0, turn_deg, 3)), random.normal(0.0, 0.05, 3)
        )
        moved.append(camera.posed(jolt @ camera.camera_from_world))
    return CameraArray(tuple(moved))
