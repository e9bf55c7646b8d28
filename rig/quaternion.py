"""Unit quaternions of rotations, in the order w x y z, for formats that store them."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats, check_shape


def quaternions(rotations: Floats) -> Floats:
    """Unit quaternions (F, 4) as w x y z of rotations (F, 3, 3), each nearest to the one before.

    The sign of a quaternion is free; it is chosen so that interpolation between frames takes the
    short way round, and w >= 0 at the first frame.

    References:
        Bar-Itzhack 2000, "New method for extracting the quaternion from a rotation matrix",
        version 1: the leading eigenvector of a symmetric 4 x 4 matrix.
    """
    check_shape(rotations=(rotations, "F 3 3"))
    r = np.asarray(rotations, dtype=np.float64)
    k = np.empty((len(r), 4, 4))
    k[:, 1:, 1:] = r + r.transpose(0, 2, 1)
    trace = np.trace(r, axis1=1, axis2=2)
    k[:, [1, 2, 3], [1, 2, 3]] -= trace[:, None]
    k[:, 0, 0] = trace
    axis = np.stack(
        [r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1
    )
    k[:, 0, 1:] = k[:, 1:, 0] = axis
    out: Floats = np.linalg.eigh(k)[1][:, :, -1]
    before = np.array([1.0, 0.0, 0.0, 0.0])
    for row in out:
        if row @ before < 0:
            row *= -1.0
        before = row
    return out
