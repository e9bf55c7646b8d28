"""Lifting by depth: a frame's own scan, drawn into a view, says how deep a match of it lies."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from capture.arrays import Bools, Floats, Ints, check_shape
from capture.camera import Camera
from recon.surface import Scan
from track.lift import Observations
from track.raster import RasterBuffers, Rasterizer

_REACH_MM = 3.0  # a scan farther from where the skin is expected shows something else
_FACING = 0.7  # least cosine between the scan's normal and the mesh's
_NOISE_MM = 0.1  # of a scan's surface where few views see it, about
_EDGE_PX = 4.0  # neighbours whose depths differ by more pixels' widths lie across an edge


class ScanDepth:
    """The scan of one frame, for the views of that frame to look up depths in.

    Only the scan's surface around the wanted points is drawn: few points need it, and a scan has
    a hundred times the triangles of the mesh.

    Args:
        scan: of the frame, world mm.
        wanted: (N, 3) world mm, about where depths will be asked for.
    """

    def __init__(self, scan: Scan, wanted: Floats) -> None:
        check_shape(wanted=(wanted, "N 3"))
        near = np.zeros(len(scan.vertices), dtype=np.bool_)
        if len(wanted):
            away, _ = cKDTree(wanted).query(scan.vertices, distance_upper_bound=2.0 * _REACH_MM)
            near = np.isfinite(away)
        kept = scan.triangles[near[scan.triangles].all(axis=1)]
        used, packed = np.unique(kept, return_inverse=True)
        self._vertices = scan.vertices[used].astype(np.float64)
        self._normals = scan.normals[used].astype(np.float64)
        self._triangles = packed.reshape(-1, 3).astype(np.int32)
        self._raster = Rasterizer(self._triangles, len(self._vertices))
        self._drawn: dict[str, RasterBuffers] = {}

    def lift(self, camera: Camera, pixels: Floats) -> tuple[Floats, Floats]:
        """The scan's points behind pixels, by its depth map, and its unit normals there.

        The inverse of depth, linear on a plane's image, is interpolated between the four pixels
        around, where all of them show the scan and none of them lies across an edge of depth.

        Args:
            camera: of the view; the map is drawn once for each name.
            pixels: (N, 2).

        Returns:
            Points (N, 3), world mm, and normals (N, 3); NaN where the scan has no depth.

        References:
            Ma et al. 2016, section 2.2: "inverting the perspective projection to lift all 2D
            feature matches to 3D world space using per view depth maps".
        """
        check_shape(pixels=(pixels, "N 2"))
        if camera.name not in self._drawn:
            self._drawn[camera.name] = self._raster.render(camera, self._vertices)
        drawn = self._drawn[camera.name]
        corner = np.floor(pixels)
        limit = [camera.width - 1, camera.height - 1]
        inside: Bools = np.all((corner >= 0) & (corner < limit), axis=1)
        x, y = np.where(inside[:, None], corner, 0.0).astype(np.int64).T
        square = np.stack([drawn.depth[y + i, x + j] for i in (0, 1) for j in (0, 1)], axis=1)
        u, v = (pixels - corner).T
        share = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=1)
        depth = 1.0 / (share / square).sum(axis=1)
        step = square.max(axis=1) - square.min(axis=1)
        known: Bools = inside & (
            step < _EDGE_PX * depth / camera.fx
        )  # NaN, where a corner is empty: no
        points = np.full((len(pixels), 3), np.nan)
        points[known] = camera.unproject(pixels[known], depth[known])
        normals = np.full((len(pixels), 3), np.nan)
        normals[known] = self._normal(drawn, x[known], y[known])
        return points, normals

    def _normal(self, drawn: RasterBuffers, x: Ints, y: Ints) -> Floats:
        weights = drawn.barycentric[y, x].astype(np.float64)
        corners = self._triangles[drawn.triangle[y, x]]
        mixed = np.einsum("nk,nkx->nx", weights, self._normals[corners])
        unit: Floats = mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-12)
        return unit


def depth_observations(
    depth: ScanDepth,
    camera: Camera,
    seen: Observations,
    chosen: Bools,
    estimate: tuple[Floats, Floats],
) -> Observations:
    """What the scan adds to some of a view's matches: the tangent plane that the skin lies in.

    The match tells two coordinates of the skin's point; the plane through the scan's point behind
    the match tells the third. Written in pixels, as the view would see the gap sideways, so that
    one robust scale fits both.

    Args:
        depth: the frame's scan.
        camera: of the view.
        seen: the view's L matches.
        chosen: (L,) which of them.
        estimate: points (N, 3) and unit normals (N, 3) of all samples on the skin's estimate.

    Returns:
        An observation for each chosen match whose point on the scan is near and faces the same
        way as the estimate.

    References:
        Chen and Medioni 1992 for the distance to a tangent plane.
    """
    which = seen.sample[chosen]
    points, normals = estimate[0][which], estimate[1][which]
    found, facing = depth.lift(camera, camera.project(points) + seen.offset[chosen])
    gap = np.einsum("nx,nx->n", facing, found - points)
    good = (np.abs(gap) < _REACH_MM) & (np.einsum("nx,nx->n", facing, normals) > _FACING)
    px_per_mm = camera.fx / np.abs(camera.depths(points[good]))
    nothing = np.zeros(len(px_per_mm))  # a plane is one equation: the second row is empty
    return Observations(
        sample=which[good],
        offset=np.stack([gap[good] * px_per_mm, nothing], axis=1),
        jacobian=np.stack([facing[good] * px_per_mm[:, None], np.zeros((len(nothing), 3))], axis=1),
        information=np.stack([(_NOISE_MM * px_per_mm) ** -2.0, nothing, nothing], axis=1),
    )
