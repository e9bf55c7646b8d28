"""The actor's appearance, baked from the views of one frame, and drawn again when he moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import sparse

from capture.arrays import Bools, Floats, Floats32, Ints32, check_shape
from capture.camera import Camera
from recon.mesh import vertex_normals
from track.raster import RasterBuffers, Rasterizer
from track.surface_samples import vertex_rings

_GAP_MM = 1.5  # a vertex this far behind the surface shown at its pixel is hidden
_COSINE = 0.25  # skin turned further away is not baked: its pixel holds too much of it
_UNROLLED = 8  # edges from seen skin over which hidden skin looks like it
_DARK = 0.25  # of the skin's median: what nothing is known of


def bake_appearance(
    vertices: Floats,
    triangles: Ints32,
    cameras: Mapping[str, Camera],
    images: Mapping[str, Floats32],
) -> Floats32:
    """The grey value of every vertex in every view of one frame.

    Args:
        vertices: (V, 3) world mm, on the skin at that frame.
        triangles: (T, 3).
        cameras: C views, by name.
        images: (H, W) mono of those that have one.

    Returns:
        (C, V) float32 in the images' unit, in the order of the cameras; NaN where the view does
        not show the vertex, or has no image.
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    raster = Rasterizer(triangles, len(vertices))
    normals = np.nan_to_num(vertex_normals(vertices, triangles))
    out = np.full((len(cameras), len(vertices)), np.nan, dtype=np.float32)
    for row, (name, camera) in enumerate(cameras.items()):
        if name not in images:
            continue
        shown = _shown(camera, vertices, normals, raster.render(camera, vertices))
        pixels = camera.project(vertices[shown]).astype(np.float32)
        out[row, shown] = _sampled(images[name], pixels)
    return out


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """A drawn view.

    Attributes:
        image: (H, W) float32, in the unit of the images that were baked.
        buffers: what the camera sees of the mesh.
    """

    image: Floats32
    buffers: RasterBuffers


class ActorSkin:
    """Draws the actor with his own skin: each view's from the same view of the baked frame."""

    def __init__(
        self,
        vertices: Floats,
        triangles: Ints32,
        cameras: Mapping[str, Camera],
        images: Mapping[str, Floats32],
    ) -> None:
        """Take the mesh on the skin (V, 3), (T, 3), the views and their mono images."""
        self._vertices, self._triangles = vertices, triangles
        self._cameras, self._images = cameras, images
        self._raster = Rasterizer(triangles, len(vertices))
        self._baked = bake_appearance(vertices, triangles, cameras, images)
        known = np.isfinite(self._baked)
        total = np.where(known, self._baked, 0.0).sum(axis=0)
        count = known.sum(axis=0)
        typical = float(np.median(total[count > 0] / count[count > 0])) if count.any() else 0.5
        self._typical = typical
        mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        self._mean = _unrolled(mean, triangles, _DARK * typical)
        self._row = {name: row for row, name in enumerate(cameras)}

    def draw(
        self, view: str, lens: Camera, posed: Floats, head: Floats, opening: Floats32 | None = None
    ) -> Picture:
        """Draw the posed mesh (V, 3) as the view would see it through a lens.

        Skin that the view saw is taken from its image, other skin from the mean of the other views
        at the vertices. Around the mesh stands the image itself, moved with the head; where it
        showed skin that has moved away, an opening shows what no image of the frame does.

        Args:
            view: whose image is used.
            lens: another crop and scale of the same camera.
            posed: (V, 3) world mm.
            head: (4, 4) rigid motion of the head from the baked frame.
            opening: (h, w) what openings show, stretched over the picture, as a share of the
                skin's median; dark when not given.
        """
        buffers = self._raster.render(lens, posed)
        corners = self._triangles[np.maximum(buffers.triangle, 0)]
        weights = buffers.barycentric
        facing = (buffers.triangle >= 0) & self._towards(lens, posed)[buffers.triangle]
        ys, xs = np.nonzero(facing)
        corner, weight = corners[ys, xs], weights[ys, xs].astype(np.float64)
        source = np.einsum("nk,nkx->nx", weight, self._vertices[corner])
        pixels = self._cameras[view].project(source).astype(np.float32)
        own = np.isfinite(self._baked[self._row[view]])[corner].mean(axis=1) > 0.5
        spread = np.einsum("nk,nk->n", weight, self._mean[corner])
        image = self._around(view, lens, head, opening)
        image[ys, xs] = np.where(own, _sampled(self._images[view], pixels), spread)
        return Picture(image=image, buffers=buffers)

    def _towards(self, lens: Camera, vertices: Floats) -> Bools:
        """Which triangles (T,) turn their front to the lens."""
        corner = vertices[self._triangles]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        front: Bools = np.einsum("tx,tx->t", normal, lens.centre - corner[:, 0]) > 0.0
        return front

    def _around(self, view: str, lens: Camera, head: Floats, opening: Floats32 | None) -> Floats32:
        """The view's image seen through the lens, moved as the head moves, openings filled."""
        camera = self._cameras[view]
        chosen = self._vertices[:: max(1, len(self._vertices) // 500)]
        moved = lens.project(chosen @ head[:3, :3].T + head[:3, 3])
        affine, _ = cv2.estimateAffine2D(moved, camera.project(chosen), method=cv2.LMEDS)
        size = (lens.width, lens.height)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        image = cv2.warpAffine(
            self._images[view], affine, size, flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        still = self._vertices @ head[:3, :3].T + head[:3, 3]
        there = self._raster.render(lens, still).triangle
        gone = (there >= 0) & self._towards(lens, still)[there]  # but not eyes: no mesh there
        shown = np.full((1, 1), _DARK, np.float32) if opening is None else opening
        image[gone] = self._typical * cv2.resize(shown, size, interpolation=cv2.INTER_LINEAR)[gone]
        return np.asarray(image, dtype=np.float32)


def _unrolled(values: Floats, triangles: Ints32, beyond: float) -> Floats:
    """Values (V,) with the unknown ones taken from their neighbours, some edges far.

    A lid that closes shows skin that was rolled up: it looks as what lies beside it does. What
    lies deeper, a mouth bag say, gets the value `beyond`.
    """
    rings = sparse.csr_matrix(vertex_rings(triangles, len(values), 1), dtype=np.float64)
    filled = values.copy()
    for _ in range(_UNROLLED):
        known = np.isfinite(filled)
        count = rings @ known.astype(np.float64)
        near = (rings @ np.where(known, filled, 0.0)) / np.maximum(count, 1.0)
        filled = np.where(~known & (count > 0), near, filled)
    return np.where(np.isfinite(filled), filled, beyond)


def _shown(camera: Camera, vertices: Floats, normals: Floats, buffers: RasterBuffers) -> Bools:
    """Which vertices (V,) a view shows: in the image, in front, turned to it."""
    pixels = camera.project(vertices)
    towards = camera.centre - vertices
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    cosine = np.einsum("vx,vx->v", normals, towards)
    near = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.int64)
    inside = (near >= 0).all(axis=1) & (near[:, 0] < camera.width) & (near[:, 1] < camera.height)
    column, row = np.where(inside[:, None], near, 0).T
    behind = camera.depths(vertices) - buffers.depth[row, column]
    shown: Bools = inside & (cosine > _COSINE)
    shown &= behind < _GAP_MM / np.maximum(cosine, _COSINE)
    return shown


def _sampled(image: Floats32, pixels: Floats32) -> Floats32:
    """Bilinear values (N,) of an image at pixels (N, 2)."""
    rows = -(-len(pixels) // 1024)
    padded = np.zeros((rows * 1024, 2), dtype=np.float32)  # cv2.remap takes no longer rows
    padded[: len(pixels)] = np.nan_to_num(pixels)
    columns, lines = padded.reshape(rows, 1024, 2).transpose(2, 0, 1)
    if rows == 0:
        return np.zeros(0, dtype=np.float32)
    found = cv2.remap(
        image, columns.copy(), lines.copy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(found.reshape(-1)[: len(pixels)], dtype=np.float32)
