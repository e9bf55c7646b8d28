"""From suspicion to words: the board's motion as the others saw it, laid before each suspect."""

from __future__ import annotations

import dataclasses

import numpy as np

from capture.camera import Camera, CameraArray
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.calibration.board_places import place_boards
from recon.calibration.faults import DeviceViews, explain_odd

_MOST_FRAMES = 400  # of a long take so many are looked at, in one stretch


def explain_suspects(
    healthy: ArrayState,
    lenses: list[Camera],
    every: BoardObservations,
    noise_px: float,
    shape: BoardShape,
) -> dict[str, str]:
    """What is wrong with the devices that are not among the healthy ones, by name, in words.

    Args:
        healthy: the array of the devices beyond suspicion, solved; its board shape is used.
        lenses: a rough lens of every device, in the order of `every`.
        every: all sightings there are, of all devices.
        noise_px: standard deviation of a corner, per coordinate.
        shape: the nominal board.
    """
    fine = set(healthy.cameras.names)
    every = _stretch(every)
    inside = [index for index, name in enumerate(every.device_names) if name in fine]
    motion = _motion(healthy, every.of_devices(inside), shape)
    views = {}
    for index, name in enumerate(every.device_names):
        rows = every.device == index
        if name not in fine and rows.any():
            views[name] = DeviceViews(
                lens=lenses[index], frame=np.array(every.frames)[every.pose[rows]],
                board=healthy.corners[every.corner[rows]], pixels=every.pixels[rows],
            )  # fmt: skip
    return explain_odd(views, healthy.cameras, motion, noise_px)


def _stretch(every: BoardObservations) -> BoardObservations:
    if len(every.frames) <= _MOST_FRAMES:
        return every
    first = (len(every.frames) - _MOST_FRAMES) // 2
    return every.select((every.pose >= first) & (every.pose < first + _MOST_FRAMES))


def _motion(healthy: ArrayState, seen: BoardObservations, shape: BoardShape) -> dict[int, Pose]:
    """Where the healthy devices had the board, by frame."""
    solved = dataclasses.replace(
        shape, corners=healthy.corners, placed=np.ones(shape.face_count, dtype=np.bool_)
    )
    near = _near_px(healthy.cameras)
    return {
        place.frame: place.world_from_board
        for place in place_boards(seen, solved, healthy.cameras)
        if float(np.median(list(place.miss_px.values()))) < near
    }


def _near_px(cameras: CameraArray) -> float:
    """A frame whose median miss is beyond this shows something else."""
    return 0.002 * max(max(camera.width, camera.height) for camera in cameras)
