"""Rigid motions, named `a_from_b` so that names cancel: `a_from_c = a_from_b @ b_from_c`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, check_finite, check_shape
from capture.errors import ShapeError

_ORTHONORMAL_TOLERANCE = 1e-5  # a rotation read from text with six digits must pass


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid motion x_a = rotation @ x_b + translation, in millimetres.

    Attributes:
        rotation: (3, 3), orthonormal with determinant +1.
        translation: (3,), millimetres.
    """

    rotation: Floats
    translation: Floats

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation, dtype=np.float64)
        check_shape(rotation=(rotation, "3 3"), translation=(translation, "3"))
        check_finite(rotation=rotation, translation=translation)
        error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if error > _ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
            raise ShapeError(
                f"rotation: expected orthonormal with determinant +1, found a departure of "
                f"{error:.2g} and determinant {np.linalg.det(rotation):.4f}"
            )
        rotation.flags.writeable = False
        translation.flags.writeable = False
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def identity(cls) -> Pose:
        """The motion that moves nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: Floats) -> Pose:
        """From a (4, 4) homogeneous matrix whose last row is 0 0 0 1."""
        check_shape(matrix=(matrix, "4 4"))
        if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
            raise ShapeError(f"matrix: expected last row 0 0 0 1, found {matrix[3].tolist()}")
        return cls(matrix[:3, :3], matrix[:3, 3])

    @classmethod
    def from_rotation_vector(cls, vector: Floats, translation: Floats) -> Pose:
        """From an axis times angle (3,) in radians, and a translation (3,) in millimetres.

        References:
            Rodrigues' formula, with the series of sin(a)/a and (1-cos(a))/a^2 near zero.
        """
        vector = np.asarray(vector, dtype=np.float64)
        check_shape(vector=(vector, "3"))
        angle = float(np.linalg.norm(vector))
        x, y, z = vector
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        if angle < 1e-4:
            first, second = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0
        else:
            first, second = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
        return cls(np.eye(3) + first * cross + second * cross @ cross, translation)

    def rotation_vector(self) -> Floats:
        """Axis times angle (3,), radians, angle in [0, pi]."""
        r = self.rotation
        sine_axis = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
        sine = float(np.linalg.norm(sine_axis))
        angle = float(np.arctan2(sine, 0.5 * (np.trace(r) - 1.0)))
        if sine > 1e-6:
            return sine_axis * (angle / sine)
        if angle < 1.0:
            return sine_axis
        outer = 0.5 * (r + np.eye(3))  # angle near pi: axis axis^T
        axis = outer[:, int(np.argmax(np.diag(outer)))]
        return angle * axis / float(np.linalg.norm(axis))

    def matrix(self) -> Floats:
        """The (4, 4) homogeneous matrix."""
        out = np.eye(4)
        out[:3, :3] = self.rotation
        out[:3, 3] = self.translation
        return out

    def apply(self, points: Floats) -> Floats:
        """Move points (..., 3), millimetres; NaN stays NaN."""
        check_shape(points=(points, "... 3"))
        moved: Floats = np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation
        return moved

    def inverse(self) -> Pose:
        """The motion that undoes this one: b_from_a of a_from_b."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: Pose) -> Pose:
        """a_from_c of a_from_b and b_from_c."""
        return Pose(
            self.rotation @ other.rotation, self.rotation @ other.translation + self.translation
        )
