"""Prior meshes: where the surface was an instant ago, as the rectified view of a pair sees it.

Disparity is affine in the pixel over the image of any plane, so that a triangle of the prior mesh
is drawn exactly by plain barycentric weights of the disparities of its corners, and the nearest
surface is the one of the largest disparity.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numba
import numpy as np

from capture.arrays import Floats, Floats32, Ints, Ints32, check_finite, check_shape
from capture.errors import ShapeError
from capture.settings import check_ranges
from recon.rectify import Rectification

_NEAREST_MM = 1.0  # corners nearer to the baseline's plane than this have no disparity
_SLACK = 1e-9  # of a triangle's area: neighbours leave no crack between them


@dataclass(frozen=True, eq=False)
class PriorMesh:
    """Where the surface is expected at one instant.

    Attributes:
        vertices: (V, 3) world mm.
        triangles: (T, 3), wound one way throughout.
        reach_mm: how far from it, along depth, the surface may lie.
    """

    vertices: Floats | Floats32
    triangles: Ints32
    reach_mm: float = 8.0

    def __post_init__(self) -> None:
        _check_mesh(self.vertices, self.triangles)
        check_ranges("prior", self, reach_mm=(0.01, 1000.0))


@dataclass(frozen=True, eq=False)
class PriorMeshes:
    """Meshes of one topology through a take, to look near to.

    Attributes:
        frames: (F,) frame numbers, rising.
        vertices: (F, V, 3) float32, world mm.
        triangles: (T, 3), wound one way throughout.
    """

    frames: Ints
    vertices: Floats32
    triangles: Ints32

    def __post_init__(self) -> None:
        check_shape(frames=(self.frames, "F"), vertices=(self.vertices, "F V 3"))
        if len(self.frames) == 0 or (np.diff(self.frames) <= 0).any():
            raise ShapeError(
                f"frames: expected rising frame numbers, found {self.frames[:8].tolist()}"
            )
        _check_mesh(self.vertices.reshape(-1, 3), self.triangles)
        if self.triangles.max(initial=0) >= self.vertices.shape[1]:
            raise ShapeError(
                f"triangles: indices must be below the {self.vertices.shape[1]} vertices, "
                f"found {int(self.triangles.max())}"
            )

    def at(self, frame: int, reach_mm: float) -> PriorMesh | None:
        """The mesh of a frame, or of the nearest frame before it; None before the first."""
        place = self._place(frame)
        if place < 0:
            return None
        return PriorMesh(self.vertices[place], self.triangles, reach_mm)

    def digest(self, frame: int) -> str:
        """SHA-256 of what `at` gives for a frame, as hex; "none" where it gives nothing."""
        place = self._place(frame)
        if place < 0:
            return "none"
        digest = hashlib.sha256(np.ascontiguousarray(self.vertices[place]).tobytes())
        digest.update(np.ascontiguousarray(self.triangles).tobytes())
        return digest.hexdigest()

    def _place(self, frame: int) -> int:
        return int(np.searchsorted(self.frames, frame, side="right")) - 1


def prior_disparity(
    geometry: Rectification, vertices: Floats | Floats32, triangles: Ints32, level: int = 0
) -> Floats32:
    """Disparity of a mesh as the rectified left view of a pair sees it.

    Args:
        geometry: of the pair; its size is that of the map.
        vertices: (V, 3) world mm; triangles with a corner that is NaN, or behind the pair, are
            left out.
        triangles: (T, 3), wound one way throughout, either way: of a mesh that is convex on the
            whole, as a head is, the outside is known without being told. The inside is not drawn.
        level: halvings, each the mean of 2 x 2 pixels: a coarse pixel j stands at the fine column
            2^level (j + 1/2) - 1/2, and its disparity is in coarse pixels.

    Returns:
        (height >> level, width >> level) float32 px; NaN where the mesh is not seen.

    References:
        Hartley and Zisserman, Multiple view geometry, 2nd ed., section 13.1: a plane maps one
        view to the other by a homography; in a rectified pair that is affine in disparity.
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    world = np.asarray(vertices, dtype=np.float64)
    local = (world - geometry.left.centre) @ geometry.rotation.T
    depth = np.where(local[:, 2] > _NEAREST_MM, local[:, 2], np.nan)
    shrink = 0.5**level
    corners = np.stack(
        [
            local[:, 0] / depth * geometry.focal_px + geometry.left_column,
            local[:, 1] / depth * geometry.focal_px + geometry.row,
            geometry.disparity(depth),
        ],
        axis=1,
    )
    corners[:, :2] = (corners[:, :2] + 0.5) * shrink - 0.5
    corners[:, 2] *= shrink
    seen = np.full((geometry.height >> level, geometry.width >> level), -np.inf, np.float32)
    faces = np.ascontiguousarray(triangles, dtype=np.int64)
    _draw(corners, faces, _winding(world, faces), seen)
    seen[np.isneginf(seen)] = np.nan
    return seen


def _winding(vertices: Floats, triangles: Ints) -> float:
    """1 when the triangles are counter-clockwise seen from outside, else -1.

    The sign of the volume between the surface and its own middle, which lies behind the skin of an
    open mask as it lies within a closed head.
    """
    corner = vertices[triangles]
    corner = corner[np.isfinite(corner).all(axis=(1, 2))]
    if len(corner) == 0:
        return 1.0
    a, b, c = np.moveaxis(corner - corner.mean(axis=(0, 1)), 1, 0)
    return 1.0 if float((a * np.cross(b, c)).sum()) >= 0.0 else -1.0


@numba.njit(cache=True, nogil=True)
def _draw(
    corners: Floats, triangles: Ints, winding: float, seen: Floats32
) -> None:  # pragma: no cover - compiled
    """Draw the front of triangles (T, 3) of corners (V, 3) (column, row, disparity) into `seen`.

    The largest disparity wins, so that the order of the triangles does not matter.
    """
    height, width = seen.shape
    for t in range(len(triangles)):
        a, b, c = corners[triangles[t, 0]], corners[triangles[t, 1]], corners[triangles[t, 2]]
        # Rows run down: what is counter-clockwise to the eye has a negative area here.
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if not -winding * area > 1e-12:  # the inside, seen on edge, or NaN
            continue
        left = max(min(min(a[0], b[0]), c[0]), 0.0)
        right = min(max(max(a[0], b[0]), c[0]), width - 1.0)
        top = max(min(min(a[1], b[1]), c[1]), 0.0)
        bottom = min(max(max(a[1], b[1]), c[1]), height - 1.0)
        if left > right or top > bottom:
            continue
        for i in range(int(np.ceil(top)), int(bottom) + 1):
            for j in range(int(np.ceil(left)), int(right) + 1):
                wa = ((b[0] - j) * (c[1] - i) - (c[0] - j) * (b[1] - i)) / area
                wb = ((c[0] - j) * (a[1] - i) - (a[0] - j) * (c[1] - i)) / area
                wc = 1.0 - wa - wb
                if wa < -_SLACK or wb < -_SLACK or wc < -_SLACK:
                    continue
                value = np.float32(wa * a[2] + wb * b[2] + wc * c[2])
                if value > seen[i, j]:
                    seen[i, j] = value


def _check_mesh(vertices: Floats | Floats32, triangles: Ints32) -> None:
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    check_finite(vertices=vertices)
    if len(triangles) == 0:
        raise ShapeError("triangles: expected at least one, found none")
    low, high = int(triangles.min()), int(triangles.max())
    if low < 0 or high >= len(vertices):
        raise ShapeError(
            f"triangles: indices must lie in 0..{len(vertices) - 1}, found {low}..{high}"
        )
