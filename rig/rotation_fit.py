"""The rotation nearest to a 3x3 matrix, compiled: Procrustes for kernels that solve many frames."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

_SWEEPS = 30  # of Jacobi rotations; five or six are enough
_ORTHOGONAL = 1e-16  # cosine of two columns that counts as none


@numba.njit(cache=True)
def fit_rotation(cross: Any, rotation: Any, scratch: Any) -> None:
    """Write into `rotation` (3, 3) the R, determinant +1, with the largest trace of R @ cross.

    With `cross = sum_i a_i b_i^T` of centred points, R turns the a best onto the b. One-sided
    Jacobi makes the columns of cross V orthogonal, each U times its singular value; the last
    columns of U and V are the cross products of the first two, so that a reflection is paid for
    by the smallest singular value. A cross of rank 0 gives the identity, rank 1 some rotation.

    Args:
        cross: (3, 3).
        rotation: (3, 3) written.
        scratch: (4, 3, 3).

    References:
        Kabsch 1976; Golub and Van Loan, Matrix Computations, 8.6.3 (one-sided Jacobi).
    """
    columns, v, u = scratch[0], scratch[1], scratch[2]
    for i in range(3):
        for j in range(3):
            columns[i, j] = cross[i, j]
            v[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        turned = _turn_pair(columns, v, 0, 1)
        turned |= _turn_pair(columns, v, 0, 2)
        turned |= _turn_pair(columns, v, 1, 2)
        if not turned:
            break
    first, second = _by_size(columns)
    size = np.sqrt(_squared(columns, first))
    if size == 0.0:
        for i in range(3):
            for j in range(3):
                rotation[i, j] = 1.0 if i == j else 0.0
        return
    length = np.sqrt(_squared(columns, second))
    for i in range(3):
        u[i, 0] = columns[i, first] / size
        u[i, 1] = columns[i, second] / length if length > 1e-14 * size else 0.0
    if length <= 1e-14 * size:
        _perpendicular(u)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        u[i, 2] = u[j, 0] * u[k, 1] - u[k, 0] * u[j, 1]
        scratch[3, i, 0] = v[j, first] * v[k, second] - v[k, first] * v[j, second]
    for i in range(3):
        for j in range(3):
            rotation[i, j] = (
                v[i, first] * u[j, 0] + v[i, second] * u[j, 1] + scratch[3, i, 0] * u[j, 2]
            )


@numba.njit(cache=True)
def _turn_pair(columns: Any, v: Any, p: int, q: int) -> bool:
    """Turn columns p and q until they are orthogonal; False when they were."""
    a, b, product = 0.0, 0.0, 0.0
    for i in range(3):
        a += columns[i, p] * columns[i, p]
        b += columns[i, q] * columns[i, q]
        product += columns[i, p] * columns[i, q]
    if abs(product) <= _ORTHOGONAL * np.sqrt(a) * np.sqrt(b):
        return False
    ratio = (b - a) / (2.0 * product)
    tangent = 1.0 / (abs(ratio) + np.sqrt(1.0 + ratio * ratio))
    if ratio < 0.0:
        tangent = -tangent
    cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
    sine = cosine * tangent
    for i in range(3):
        x, y = columns[i, p], columns[i, q]
        columns[i, p], columns[i, q] = cosine * x - sine * y, sine * x + cosine * y
        x, y = v[i, p], v[i, q]
        v[i, p], v[i, q] = cosine * x - sine * y, sine * x + cosine * y
    return True


@numba.njit(cache=True)
def _squared(columns: Any, k: int) -> float:
    total: float = columns[0, k] ** 2 + columns[1, k] ** 2 + columns[2, k] ** 2
    return total


@numba.njit(cache=True)
def _by_size(columns: Any) -> tuple[int, int]:
    """The longest column and the one after it."""
    a, b, c = _squared(columns, 0), _squared(columns, 1), _squared(columns, 2)
    if a >= b:
        if b >= c:
            return 0, 1
        return (0, 2) if a >= c else (2, 0)
    if a >= c:
        return 1, 0
    return (1, 2) if b >= c else (2, 1)


@numba.njit(cache=True)
def _perpendicular(u: Any) -> None:
    """Fill column 1 of u with a unit vector at right angles to column 0."""
    least = 0
    for i in range(1, 3):
        if abs(u[i, 0]) < abs(u[least, 0]):
            least = i
    length = np.sqrt(max(1.0 - u[least, 0] ** 2, 0.0))
    for i in range(3):
        u[i, 1] = ((1.0 if i == least else 0.0) - u[least, 0] * u[i, 0]) / length
