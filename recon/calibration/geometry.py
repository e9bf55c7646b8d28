"""Geometry of a calibrated array: points from rays, rigid fits, lattices of the face volume."""

from __future__ import annotations

import numpy as np

from capture.arrays import Bools, Floats, check_shape
from capture.camera import CameraArray
from capture.pose import Pose

_STEPS = 9  # places across the ball, along each axis


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


def rigid_fit(source: Floats, target: Floats) -> Pose:
    """The motion target_from_source that brings points (N, 3) nearest to points (N, 3), mm.

    References:
        Umeyama 1991, with the scale held at 1.
    """
    check_shape(source=(source, "N 3"), target=(target, "N 3"))
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    u[:, 2] *= np.linalg.det(u @ vt)
    rotation = u @ vt
    return Pose(rotation, target.mean(axis=0) - rotation @ source.mean(axis=0))


def ball_points(centre: Floats, radius_mm: float, steps: int = _STEPS) -> Floats:
    """Points (N, 3) of a cubic lattice inside a ball, mm."""
    line = np.linspace(-1.0, 1.0, steps)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = grid[(grid**2).sum(axis=1) <= 1.0 + 1e-9]
    points: Floats = np.asarray(centre) + radius_mm * inside
    return points
