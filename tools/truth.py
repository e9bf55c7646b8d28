"""Errors against the truth of a simulated take: for tests and reports, never for a stage.

A calibration chooses its own world, and a registered template its own place on the skin. Truth is
first brought into the calibrated world by the cameras, and each vertex of the tracked mesh is
compared with the true motion of the skin point that it sits on in the neutral.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, Ints32, check_shape
from capture.camera import CameraArray
from capture.errors import CameraError
from capture.pose import Pose
from recon.surface import closest_points
from track.rigid import fit_similarity


def world_from_truth(cameras: CameraArray, true_cameras: CameraArray, near: Floats) -> Pose:
    """The rigid motion from the simulator's world to the calibrated one, about the face.

    Points about the face are projected by the true cameras and triangulated by the calibrated ones.
    Camera centres would not do: an array fits its images with centres some tenths of a mm off.

    Args:
        cameras: the calibrated array.
        true_cameras: the simulated array; cameras are paired by name.
        near: (N, 3) points to align by, true world mm.

    Raises:
        CameraError: when fewer than two cameras are in both.
    """
    names = [name for name in cameras.names if name in true_cameras.names]
    if len(names) < 2:
        raise CameraError(f"need two cameras in common to align worlds, found {len(names)}")
    found = _meeting_points(
        np.array([cameras.by_name(name).centre for name in names]),
        np.stack([cameras.by_name(n).rays(true_cameras.by_name(n).project(near)) for n in names]),
    )
    fit = fit_similarity(near, found)
    return Pose(fit.rotation, fit.translation)


def _meeting_points(centres: Floats, rays: Floats) -> Floats:
    """Points (N, 3) nearest to all rays (C, N, 3) from centres (C, 3), in least squares."""
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    system = across.sum(axis=0)
    right = (across @ centres[:, None, :, None]).sum(axis=0)
    met: Floats = np.linalg.solve(system, right)[..., 0]
    return met


def scan_distances(scan_points: Floats, vertices: Floats, triangles: Ints32) -> Floats:
    """Distance (N,) mm of scan points (N, 3) from the true surface (V, 3), (T, 3)."""
    return np.asarray(closest_points(vertices, triangles, scan_points)[2], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class SkinPoints:
    """Points that stick to the true skin: a triangle, barycentrics and a normal offset each.

    Attributes:
        corners: (N, 3) vertex ids of the true mesh.
        barycentric: (N, 3).
        offset_mm: (N,) along the interpolated normal.
    """

    corners: Ints32
    barycentric: Floats
    offset_mm: Floats

    @classmethod
    def attach(cls, points: Floats, vertices: Floats, triangles: Ints32) -> SkinPoints:
        """Attach points (N, 3) to the closest place of a surface (V, 3), (T, 3)."""
        check_shape(
            points=(points, "N 3"), vertices=(vertices, "V 3"), triangles=(triangles, "T 3")
        )
        foot, ids, _ = closest_points(vertices, triangles, points)
        corners = triangles[ids]
        barycentric = _barycentric(np.asarray(foot, dtype=np.float64), vertices[corners])
        normal = _normals(vertices[corners])
        offset = ((points - foot) * normal).sum(axis=1)
        return cls(corners, barycentric, offset)

    def at(self, vertices: Floats) -> Floats:
        """Where the points (N, 3) are when the true mesh's vertices are (V, 3)."""
        corner = vertices[self.corners]
        on_skin = (corner * self.barycentric[:, :, None]).sum(axis=1)
        moved: Floats = on_skin + self.offset_mm[:, None] * _normals(corner)
        return moved


def _normals(corner: Floats) -> Floats:
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    unit: Floats = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return unit


def _barycentric(points: Floats, corner: Floats) -> Floats:
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    rest = points - corner[:, 0]
    d11, d12, d22 = (one * one).sum(1), (one * two).sum(1), (two * two).sum(1)
    r1, r2 = (rest * one).sum(1), (rest * two).sum(1)
    area = np.maximum(d11 * d22 - d12 * d12, 1e-18)
    v, w = (d22 * r1 - d12 * r2) / area, (d11 * r2 - d12 * r1) / area
    return np.stack([1.0 - v - w, v, w], axis=1)
