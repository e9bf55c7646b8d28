"""What no image shows of a board whose shape was free: its space and the scale of everything."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats, Ints, check_shape
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.shape import BoardShape
from recon.calibration.geometry import rigid_fit


def regauged(state: ArrayState, shape: BoardShape, seen: Ints) -> ArrayState:
    """The same array at the board's nominal size, the board in its nominal place.

    The sizes of the flat boards give the scale, all their corners alike; the place of a body of
    several is that of the first board. No residual changes.

    Args:
        state: as a bundle adjustment left it.
        shape: the nominal board.
        seen: (K,) ids of the corners that were solved for.

    References:
        Horn 1987, symmetric scale: the ratio of root mean square distances from the centroids.
    """
    scaled = state.scaled(board_scale(state.corners, shape, seen))
    first = seen[shape.face[seen] == shape.face[seen].min()]
    fit = rigid_fit(scaled.corners[first], shape.corners[first])
    found_from_nominal = fit.inverse()
    return ArrayState(
        scaled.cameras,
        tuple(pose @ found_from_nominal for pose in scaled.array_from_board),
        fit.apply(scaled.corners),
    )


def board_scale(found: Floats, shape: BoardShape, seen: Ints) -> float:
    """The factor that brings a found board shape (N, 3), mm, to the sizes of the nominal one.

    Args:
        found: solved corners, mm.
        shape: the nominal board.
        seen: (K,) ids of the corners that were solved for.
    """
    check_shape(found=(found, "N 3"), nominal=(shape.corners, "N 3"))
    squares = np.zeros(2)
    for face in range(shape.face_count):
        own = seen[shape.face[seen] == face]
        for place, corners in enumerate((shape.corners[own], found[own])):
            squares[place] += ((corners - corners.mean(axis=0)) ** 2).sum() if len(own) else 0.0
    return float(np.sqrt(squares[0] / squares[1]))


def flat_places(state: ArrayState, shape: BoardShape) -> tuple[Pose, ...]:
    """Motions body_from_face of each flat board, mm: as solved, for the report."""
    flat = np.concatenate([shape.flat, np.zeros((len(shape.flat), 1))], axis=1)
    return tuple(
        rigid_fit(flat[shape.face == face], state.corners[shape.face == face])
        for face in range(shape.face_count)
    )
