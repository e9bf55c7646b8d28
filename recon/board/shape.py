"""`BoardShape`: the nominal corners of everything that is waved before the array, face by face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Ints, check_finite, check_shape
from capture.errors import ShapeError


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardShape:
    """The nominal geometry of one flat board, or of several rigid ones on one body.

    Attributes:
        corners: (N, 3) body space, mm, in the order of the corner ids.
        face: (N,) index of the flat board that each corner is printed on.
        flat: (N, 2) the same corners on their own board, mm.
        placed: (F,) whether the place of that board on the body is known beforehand. The corners
            of one that is not are given in its own space, at Z = 0.
    """

    corners: Floats
    face: Ints
    flat: Floats
    placed: Bools

    def __post_init__(self) -> None:
        check_shape(
            corners=(self.corners, "N 3"), face=(self.face, "N"), flat=(self.flat, "N 2"),
            placed=(self.placed, "F"),
        )  # fmt: skip
        check_finite(corners=self.corners, flat=self.flat)
        found = np.unique(self.face)
        if not np.array_equal(found, np.arange(len(self.placed))):
            raise ShapeError(
                f"face: expected every index from 0 to {len(self.placed) - 1}, "
                f"found {found.tolist()}"
            )

    @classmethod
    def flat_board(cls, corners: Floats) -> BoardShape:
        """One flat board from its corners (N, 3), mm, at Z = 0."""
        check_shape(corners=(corners, "N 3"))
        return cls(
            corners=np.array(corners, dtype=np.float64),
            face=np.zeros(len(corners), dtype=np.int64),
            flat=np.array(corners[:, :2], dtype=np.float64),
            placed=np.ones(1, dtype=np.bool_),
        )

    @property
    def face_count(self) -> int:
        """How many flat boards there are."""
        return len(self.placed)
