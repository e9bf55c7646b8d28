"""Depth maps of a mesh in the recorded views, for the tracker and for other tools."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from capture.archive import read_archive, write_archive
from capture.arrays import Floats, Floats32, Ints32
from capture.camera import Camera
from recon.surface import SurfaceQuery

_ROWS_AT_ONCE = 1 << 19  # pixels whose rays are held in memory together, about
_WIDER = 0.02  # of the shown part, added on each side: the lens bends edges beyond their ends


def depth_map(camera: Camera, vertices: Floats | Floats32, triangles: Ints32) -> Floats32:
    """Depth of a mesh in one view: the ray of each pixel, through the lens, meets the surface.

    Args:
        camera: any lens.
        vertices: (V, 3) world mm.
        triangles: (T, 3).

    Returns:
        (H, W) float32 mm along the optical axis (z of camera space, not the distance from the
        centre), to about 1e-4 mm; NaN where the ray meets nothing.
    """
    return _cast(camera, SurfaceQuery(vertices, triangles), vertices)


def depth_maps(
    cameras: Iterable[Camera], vertices: Floats | Floats32, triangles: Ints32
) -> dict[str, Floats32]:
    """Depth maps of one mesh in several views, by the camera's name; see `depth_map`."""
    query = SurfaceQuery(vertices, triangles)
    return {camera.name: _cast(camera, query, vertices) for camera in cameras}


def write_depth_maps(
    path: Path, cameras: Iterable[Camera], vertices: Floats | Floats32, triangles: Ints32
) -> None:
    """Write the depth maps of a mesh, one array a camera by its name, 0 where there is nothing."""
    maps = depth_maps(cameras, vertices, triangles)
    write_archive(path, {name: np.nan_to_num(depth, nan=0.0) for name, depth in maps.items()})


def read_depth_maps(path: Path, cameras: Iterable[Camera]) -> dict[str, Floats32]:
    """Read depth maps (H, W), mm, by camera name; NaN where there is nothing.

    Raises:
        ShapeError: naming the file, and the camera that it lacks or what is damaged.
    """
    held = read_archive(path, required=[camera.name for camera in cameras])
    return {
        name: np.where(depth > 0, depth, np.nan).astype(np.float32) for name, depth in held.items()
    }


def _cast(camera: Camera, query: SurfaceQuery, vertices: Floats | Floats32) -> Floats32:
    out = np.full((camera.height, camera.width), np.nan, np.float32)
    x0, y0, x1, y1 = _window(camera, vertices)
    if x0 >= x1 or y0 >= y1:
        return out
    columns = np.arange(x0, x1, dtype=np.float64)
    step = max(1, _ROWS_AT_ONCE // len(columns))
    for top in range(y0, y1, step):
        rows = np.arange(top, min(top + step, y1), dtype=np.float64)
        pixels = np.stack([grid.ravel() for grid in np.meshgrid(columns, rows)], axis=1)
        flat = camera.undistort(pixels)
        seen = np.isfinite(flat[:, 0])
        # A direction of unit depth: the length along it is the depth.
        local = np.concatenate([flat[seen], np.ones((int(seen.sum()), 1))], axis=1)
        rays = local @ camera.camera_from_world.rotation
        depth, _ = query.cast_rays(np.broadcast_to(camera.centre, rays.shape), rays)
        values = np.full(len(pixels), np.nan, np.float32)
        values[seen] = np.where(np.isfinite(depth), depth, np.float32(np.nan))
        out[top : top + len(rows), x0:x1] = values.reshape(len(rows), len(columns))
    return out


def _window(camera: Camera, vertices: Floats | Floats32) -> tuple[int, int, int, int]:
    """Columns and rows (x0, y0, x1, y1) outside of which nothing can be seen.

    The whole image, unless every vertex is in front of the camera and well within what the lens
    shows: beyond the image a strong lens folds back.
    """
    whole = (0, 0, camera.width, camera.height)
    local = camera.camera_from_world.apply(np.asarray(vertices, dtype=np.float64))
    if not (local[:, 2] > 0).all():
        return whole
    corners = camera.undistort(
        np.array([[x, y] for x in (0.0, camera.width - 1.0) for y in (0.0, camera.height - 1.0)])
    )
    reach = float(np.linalg.norm(corners, axis=1).max())
    flat = local[:, :2] / local[:, 2:]
    if not np.linalg.norm(flat, axis=1).max() < reach:  # NaN: no
        return whole
    pixels = camera.project(np.asarray(vertices, dtype=np.float64))
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    pad = 2.0 + _WIDER * float((high - low).max())
    x0, y0 = np.clip(np.floor(low - pad), 0, [camera.width, camera.height]).astype(int).tolist()
    x1, y1 = np.clip(np.ceil(high + pad) + 1, 0, whole[2:]).astype(int).tolist()
    return x0, y0, x1, y1
