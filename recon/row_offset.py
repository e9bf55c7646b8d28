"""Whether the two views of a pair lie on the same rows: the calibration, seen across the search.

Disparity tells an error of calibration only along the baseline. Across it the windows of a match
slide over each other, and how far is measured here, on the surface that was found.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from capture.arrays import Floats, Floats32, Ints
from capture.camera import Camera
from recon.fusion import DepthView
from recon.rectify import Rectification

_RADIUS = 3  # px, of the windows compared
_WINDOWS = 300
_LEAST = 30  # windows from which a median is told
_LARGEST_PX = 2.0  # of a shift that a linear step can find


def row_offset(view: DepthView, left: Floats32, right: Floats32) -> float:
    """How far, px, the right view lies below the rows where the left one says it is.

    Args:
        view: what the pair found.
        left: (H, W) recorded grey image of the left camera, a little smoothed.
        right: the same of the right camera.

    Returns:
        The median over windows spread over the surface; NaN when there are too few.

    References:
        Lucas and Kanade 1981: one least-squares step on brightness, with gain and offset of each
        window taken out.
    """
    rows, columns = _places(view)
    if len(rows) < _LEAST:
        return float("nan")
    reach = np.arange(-_RADIUS, _RADIUS + 1)
    r = rows[:, None, None] + reach[:, None]
    c = columns[:, None, None] + reach
    r, c = np.broadcast_arrays(r, c)
    disparity = view.disparity[r, c].astype(np.float64)
    g = view.geometry
    seen = _window(g, g.left, g.left_column, left, (c, r))
    found = [
        _window(g, g.right, g.right_column, right, (c - disparity, r + step)) for step in (-1, 0, 1)
    ]
    slope = 0.5 * (found[2] - found[0])
    first, second = _levelled(seen), _levelled(found[1])
    scale = np.std(found[1], axis=(1, 2), keepdims=True) + 1e-9
    slope = (slope - slope.mean(axis=(1, 2), keepdims=True)) / scale
    strength = (slope * slope).sum(axis=(1, 2))
    moved = (slope * (first - second)).sum(axis=(1, 2)) / np.maximum(strength, 1e-9)
    good = (strength > np.median(strength) * 0.2) & (np.abs(moved) < _LARGEST_PX)
    return float(np.median(moved[good])) if good.sum() >= _LEAST else float("nan")


def _places(view: DepthView) -> tuple[Ints, Ints]:
    """Rows and columns (N,) of windows whose disparities are all known, spread evenly."""
    height, width = view.disparity.shape
    stride = max(1, int(np.sqrt(height * width / (8 * _WINDOWS))))
    rows, columns = np.nonzero(np.isfinite(view.disparity[::stride, ::stride]))
    rows, columns = rows * stride, columns * stride
    inside = (rows >= _RADIUS) & (rows < height - _RADIUS)
    inside &= (columns >= _RADIUS) & (columns < width - _RADIUS)
    rows, columns = rows[inside], columns[inside]
    reach = np.arange(-_RADIUS, _RADIUS + 1)
    window = view.disparity[rows[:, None, None] + reach[:, None], columns[:, None, None] + reach]
    whole = np.isfinite(window).all(axis=(1, 2))
    rows, columns = rows[whole], columns[whole]
    step = max(1, len(rows) // _WINDOWS)
    return rows[step // 2 :: step], columns[step // 2 :: step]


def _window(
    geometry: Rectification,
    camera: Camera,
    column: float,
    image: Floats32,
    at: tuple[Floats | Ints, Floats | Ints],
) -> Floats:
    """Brightness at rectified (columns, rows) of any shape, through the lens."""
    u, v = np.asarray(at[0], dtype=np.float64), np.asarray(at[1], dtype=np.float64)
    focal = np.full(u.shape, geometry.focal_px)
    local = np.stack([u - column, v - geometry.row, focal], axis=-1).reshape(-1, 3)
    pixels = camera.project(camera.centre + local @ geometry.rotation)
    values = ndimage.map_coordinates(
        image, pixels[:, ::-1].T, order=1, output=np.float64, mode="nearest", prefilter=False
    )
    return np.asarray(values).reshape(u.shape)


def _levelled(window: Floats) -> Floats:
    """Windows (N, h, w) without their mean, in units of their deviation."""
    centred = window - window.mean(axis=(1, 2), keepdims=True)
    return np.asarray(centred / (np.std(window, axis=(1, 2), keepdims=True) + 1e-9))
