"""The numbers of one device in a calibration's report: residuals, lens, where it saw the board."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats, Ints
from capture.camera import Camera
from recon.calibration.place_words import find_gaps
from recon.calibration.solver import ArraySolution

_GRID = 8  # coverage cells along the longer side of an image
_MOST_VECTORS = 200
_LEAST_SHARE = 0.34  # of the wanted cells of a part of the image, below which it is missing
_LEAST_WANTED = 9  # cells; of a smaller face volume in the image, all of the image is wanted
_LEAST_TILT_DEG = 15.0  # a way the board was tilted less than this is missing
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2")
_UM = 1000.0
_MDEG = 1000.0
_WAYS = ("left", "right", "up", "down")


def device_numbers(
    solution: ArraySolution, index: int, frames: Mapping[str, int], radius_mm: float
) -> dict[str, Any]:
    """The numbers of one device, for JSON; those that could not be determined are null.

    Args:
        solution: the calibrated array.
        index: of the device.
        frames: how many of its frames were used or refused, by reason.
        radius_mm: of the face volume, a ball about the world's origin.

    Returns:
        Residuals in px, the lens and its standard deviations, `coverage` (corners by cell of the
        image) and `heat` (mean residual by cell), `tilts_deg`: how far the board's face was turned
        towards each side of the image; `image_gaps`: signs (right, up) of the parts of the image
        that the face volume falls on and no board did; `tilt_gaps`: ways it was hardly tilted.
    """
    observations, kept = solution.observations, solution.kept
    mine = observations.device == index
    used = mine & kept
    camera = solution.state.cameras[index]
    residuals, pixels = solution.residuals[used], observations.pixels[used]
    size = np.linalg.norm(residuals, axis=1)
    sigma = solution.focal_sigma[index]
    cells, shape = _cells(pixels, camera)
    grid = np.bincount(cells, minlength=shape[0] * shape[1]).reshape(shape)
    tilts = _tilts(solution, index)
    return {
        "name": camera.name,
        "views": len(np.unique(observations.pose[used])),
        "corners_used": int(used.sum()),
        "corners_rejected": int((mine & ~kept).sum()),
        "frames": dict(frames),
        "mean_reprojection_px": number(size.mean()) if len(size) else None,
        "rms_per_coordinate_px": number(np.sqrt((residuals**2).mean())) if len(size) else None,
        "largest_px": number(size.max(initial=0.0)),
        "fx_px": number(camera.fx),
        "fy_px": number(camera.fy),
        "fx_sigma_px": number(sigma[0]),
        "fy_sigma_px": number(sigma[1]),
        "covered": number((grid > 0).mean()),
        "coverage": grid.tolist(),
        "sigmas": _sigmas(solution, index),
        "tilts_deg": tilts,
        "heat": _heat(cells, shape, residuals),
        "image_gaps": [
            list(gap.signs)
            for gap in find_gaps(*_wanted(camera, grid > 0, radius_mm), least=_LEAST_SHARE)
        ],
        "tilt_gaps": [way for way in _WAYS if tilts[way] < _LEAST_TILT_DEG],
    }


def residual_vectors(solution: ArraySolution, index: int) -> list[list[float]]:
    """Residuals [x, y, dx, dy] of one device, px: the place seen, predicted minus it."""
    rows = np.flatnonzero((solution.observations.device == index) & solution.kept)
    if len(rows) > _MOST_VECTORS:
        rows = rows[np.linspace(0, len(rows) - 1, _MOST_VECTORS).round().astype(int)]
    table = np.concatenate([solution.observations.pixels[rows], solution.residuals[rows]], axis=1)
    vectors: list[list[float]] = np.round(table, 3).tolist()
    return vectors


def number(value: Any) -> float | None:
    """A float with seven digits, or None for what is not finite: JSON knows no NaN."""
    exact = float(value)
    return float(f"{exact:.7g}") if np.isfinite(exact) else None


def _cells(pixels: Floats, camera: Camera) -> tuple[Ints, tuple[int, int]]:
    """Index (M,) of the cell of each pixel, row by row, and the (rows, columns) of the grid."""
    width, height = camera.width, camera.height
    cell = max(width, height) / _GRID
    shape = (max(1, round(height / cell)), max(1, round(width / cell)))
    place = np.floor((pixels[:, ::-1] + 0.5) / [height, width] * shape).astype(np.int64)
    row, column = np.clip(place, 0, np.array(shape) - 1).T
    index: Ints = row * shape[1] + column
    return index, shape


def _heat(cells: Ints, shape: tuple[int, int], residuals: Floats) -> dict[str, Any]:
    """Mean length and mean components of the residuals in each cell; null where there are none."""
    total = shape[0] * shape[1]
    count = np.bincount(cells, minlength=total)
    columns = {
        "size_px": np.linalg.norm(residuals, axis=1),
        "dx_px": residuals[:, 0],
        "dy_px": residuals[:, 1],
    }
    heat = {}
    for key, values in columns.items():
        sums = np.bincount(cells, weights=values, minlength=total)
        means = [
            float(f"{s / n:.4g}") if n else None for s, n in zip(sums, count.tolist(), strict=True)
        ]
        heat[key] = [means[start : start + shape[1]] for start in range(0, total, shape[1])]
    return heat


def _sigmas(solution: ArraySolution, index: int) -> dict[str, Any] | None:
    """Standard deviations of lens and place; None when the covariance is not known."""
    if solution.covariance is None:
        return None
    lens = solution.covariance.lens_sigma[index]
    place = _UM * solution.covariance.place_sigma_mm[index]
    turn = _MDEG * np.degrees(solution.covariance.turn_sigma[index])
    sigmas: dict[str, Any] = {
        key: number(value) for key, value in zip(_LENS, lens.tolist(), strict=True)
    }
    sigmas["place_um"] = [number(value) for value in place.tolist()]
    sigmas["turn_mdeg"] = [number(value) for value in turn.tolist()]
    return sigmas


def _tilts(solution: ArraySolution, index: int) -> dict[str, float]:
    """How far the faces that this device used were turned towards each side of its image, deg."""
    observations, face = solution.observations, solution.shape.face
    camera = solution.state.cameras[index]
    normals = _face_normals(solution.state.corners, face, solution.shape.face_count)
    middles = [solution.state.corners[face == one].mean(axis=0) for one in range(len(normals))]
    used = (observations.device == index) & solution.kept
    pairs = np.unique(
        np.stack([observations.pose[used], face[observations.corner[used]]], axis=1), axis=0
    )
    largest = dict.fromkeys(_WAYS, 0.0)
    for pose, one in pairs.tolist():
        camera_from_board = camera.camera_from_world @ solution.state.array_from_board[pose]
        x, y, z = camera_from_board.rotation @ normals[one]
        if (camera_from_board.apply(middles[one])) @ [x, y, z] > 0:
            x, y, z = -x, -y, -z  # the side of the board that this device sees
        right, up = np.degrees([np.arctan2(x, -z), np.arctan2(-y, -z)]).tolist()
        for way, angle in zip(_WAYS, (-right, right, up, -up), strict=True):
            largest[way] = max(largest[way], angle)
    return {way: round(angle, 1) for way, angle in largest.items()}


def _face_normals(corners: Floats, face: Ints, count: int) -> list[Floats]:
    """Unit normals (3,) of the faces in body space, of either sign."""
    normals: list[Floats] = []
    for one in range(count):
        centred = corners[face == one] - corners[face == one].mean(axis=0)
        normals.append(np.linalg.svd(centred, full_matrices=True)[2][2])
    return normals


def _wanted(camera: Camera, seen: Bools, radius_mm: float) -> tuple[Floats, Bools]:
    """Cells (N, 2) on which the face volume falls, right and up in half extents; which saw a board.

    All cells of the image where the face volume covers next to none of it.
    """
    rows, columns = seen.shape
    y, x = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    places = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    pixels = (places + 0.5) * [camera.width / columns, camera.height / rows] - 0.5
    rays, centre = camera.rays(pixels), camera.centre
    along = np.maximum(-(rays @ centre), 0.0)
    apart = np.linalg.norm(centre + along[:, None] * rays, axis=1)
    wanted: Bools = apart <= radius_mm
    if wanted.sum() < _LEAST_WANTED:
        wanted = np.ones(rows * columns, dtype=np.bool_)
    low, high = places[wanted].min(axis=0) - 0.5, places[wanted].max(axis=0) + 0.5
    half = (places[wanted] - (low + high) / 2.0) / ((high - low) / 2.0)
    return half * [1.0, -1.0], seen.ravel()[wanted]
