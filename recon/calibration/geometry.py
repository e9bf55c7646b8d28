"""Geometry of a calibrated array: points from rays, rigid fits, lattices of the face volume."""

from __future__ import annotations

import numpy as np

from capture.arrays import Bools, Floats, check_shape
from capture.camera import CameraArray
from capture.pose import Pose

_STEPS = 9  # places across the ball, along each axis
_CONVERGING = (
    0.02  # least eigenvalue of the mean projector across the axes: about 8 degrees of spread
)


def triangulate(cameras: CameraArray, pixels: list[Floats], seen: list[Bools]) -> Floats:
    """Points (N, 3) nearest to their rays, each device's rays counting by its focal length.

    Args:
        cameras: the array.
        pixels: by device, (N, 2) px.
        seen: by device, (N,) which of the points it sees; every point needs two.
    """
    normal = np.zeros((len(pixels[0]), 3, 3))
    right = np.zeros((len(pixels[0]), 3))
    for camera, places, there in zip(cameras, pixels, seen, strict=True):
        rays = camera.rays(places[there])
        outer = rays[:, :, None] * rays[:, None, :]
        across = camera.fx**2 * (np.eye(3) - outer)
        normal[there] += across
        right[there] += across @ camera.centre
    points: Floats = np.asarray(np.linalg.solve(normal, right[:, :, None]), np.float64)[:, :, 0]
    return points


def nearest_to_axes(centres: Floats, axes: Floats) -> Floats | None:
    """The point (3,) nearest to all optical axes, mm, or None where they do not converge.

    Args:
        centres: (C, 3) projection centres, mm.
        axes: (C, 3) unit directions.
    """
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total / len(axes))[0] < _CONVERGING:
        return None
    point: Floats = np.linalg.solve(total, (across @ centres[:, :, None]).sum(axis=0))[:, 0]
    return point


def rigid_basis(points: Floats) -> Floats:
    """Motion (N, 3, 6) of points (N, 3) by a small turn about the origin, radians, and a shift."""
    out = np.zeros((len(points), 3, 6))
    x, y, z = points.T
    out[:, 0, 1], out[:, 0, 2] = z, -y
    out[:, 1, 0], out[:, 1, 2] = -z, x
    out[:, 2, 0], out[:, 2, 1] = y, -x
    out[:, :, 3:] = np.eye(3)
    return out


def rigid_fit(source: Floats, target: Floats, weight: Floats | None = None) -> Pose:
    """The motion target_from_source that brings points (N, 3) nearest to points (N, 3), mm.

    Args:
        source: points, mm.
        target: where they should come to lie, mm.
        weight: (N,) of each point; all alike when None.

    References:
        Umeyama 1991, with the scale held at 1.
    """
    check_shape(source=(source, "N 3"), target=(target, "N 3"))
    share = np.ones(len(source)) if weight is None else weight
    share = share / share.sum()
    middle, goal = share @ source, share @ target
    u, _, vt = np.linalg.svd(((target - goal) * share[:, None]).T @ (source - middle))
    u[:, 2] *= np.linalg.det(u @ vt)
    rotation = u @ vt
    return Pose(rotation, goal - rotation @ middle)


def ball_points(centre: Floats, radius_mm: float, steps: int = _STEPS) -> Floats:
    """Points (N, 3) of a cubic lattice inside a ball, mm."""
    line = np.linspace(-1.0, 1.0, steps)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = grid[(grid**2).sum(axis=1) <= 1.0 + 1e-9]
    points: Floats = np.asarray(centre) + radius_mm * inside
    return points
