"""Where the world of a calibration lies: in the array, at a board pose, or as last session."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from capture.camera import CameraArray
from capture.errors import TakeError, raise_all
from recon.board.observations import BoardObservations
from recon.calibration.alignment import (
    align_to_previous,
    alignment_problems,
    exchange_words,
    size_words,
)
from recon.calibration.board_places import place_boards
from recon.calibration.solver import ArraySolution, CalibrateSettings
from recon.calibration.world import ArrayWorld, world_from_board_pose

_OTHER_SIZE = 5e-3  # a scale further off refuses; arrays of three or four differ by up to 0.2 %


@dataclass(frozen=True, eq=False)
class ChosenWorld:
    """A world, and what changed since the session it was taken from.

    Attributes:
        world: the motion into it from that of the solution, and where it came from.
        changes: what an operator should know, in words.
    """

    world: ArrayWorld
    changes: tuple[str, ...] = ()


def choose_world(
    solution: ArraySolution,
    every: BoardObservations,
    settings: CalibrateSettings,
    previous: CameraArray | None,
    square_mm: float | None,
) -> ChosenWorld | None:
    """The world that the settings or a previous session name; None keeps that of the array.

    Args:
        solution: the calibrated array.
        every: sightings of all frames.
        settings: of the stage: `world_frame`, `world_board`.
        previous: the cameras of a previous session whose world is to be kept.
        square_mm: side of the board's squares in its file, for messages.

    Raises:
        TakeError: when no usable view shows the board at the frame named; when devices have been
            exchanged since the previous session, or the whole array has another size by more than
            0.5 %. A lesser change of size is told.
    """
    if previous is not None:
        alignment = align_to_previous(solution.state.cameras, previous)
        grave = exchange_words(alignment)
        if abs(alignment.scale - 1.0) > _OTHER_SIZE:
            grave = [*size_words(alignment, square_mm), *grave]
        raise_all("the array is not that of the previous session", grave, TakeError)
        world = ArrayWorld(
            alignment.world_from_array, "that of the previous session", "that of the same"
        )
        return ChosenWorld(world, tuple(alignment_problems(alignment, square_mm)))
    if settings.world_frame is None:
        return None
    frames = list(every.frames)
    if settings.world_frame not in frames:
        raise TakeError(
            f"world_frame = {settings.world_frame}: no device has a usable view of the board in "
            f"that frame; frames with one: {_listed(frames)}"
        )
    only = every.select(every.pose == frames.index(settings.world_frame))
    placed = np.ones(solution.shape.face_count, dtype=np.bool_)
    shape = dataclasses.replace(solution.shape, corners=solution.state.corners, placed=placed)
    place = place_boards(only, shape, solution.state.cameras)[0]
    found = world_from_board_pose(place.world_from_board, shape, settings.world_board)
    origin = f"{found.origin} of frame {settings.world_frame}"
    return ChosenWorld(ArrayWorld(found.world_from_array, origin, found.up))


def _listed(frames: list[int]) -> str:
    shown = ", ".join(str(frame) for frame in frames[:12])
    return shown if len(frames) <= 12 else f"{shown} ... {frames[-1]}"
