"""Rectified pairs: two views resampled so that corresponding points lie on the same row.

The rectified views are ideal pinholes that share one rotation and one focal length. Their rows
run along the baseline, whichever way it points, so that a pair one above the other comes out
turned by 90 degrees. Maps go from rectified pixels through `Camera.distort` to the recorded
image: no other lens model exists.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from scipy import ndimage

from capture.arrays import Bools, Floats, Floats32, Ints, check_shape
from capture.camera import Camera
from capture.errors import CameraError

_BORDER_STEPS = 40  # samples along each image edge
_GRID = 8  # px between exact evaluations of the lens


@dataclass(frozen=True, eq=False)
class Rectification:
    """The geometry of one rectified pair.

    A rectified left pixel (u, v) with disparity d matches the right pixel (u - d, v).

    Attributes:
        left: the reference camera.
        right: the other camera.
        rotation: (3, 3) rectified axes (rows x, y, z) in world space; x runs along the baseline.
        focal_px: common focal length.
        baseline_mm: distance between the centres.
        left_column: principal column of the left view, px.
        right_column: principal column of the right view, px; chosen so that the disparity is 0 at
            the depth of the scene centre.
        row: principal row of both views, px.
        width: columns of the crop.
        height: rows of the crop.
    """

    left: Camera
    right: Camera
    rotation: Floats
    focal_px: float
    baseline_mm: float
    left_column: float
    right_column: float
    row: float
    width: int
    height: int

    def disparity(self, depth: Floats) -> Floats:
        """Disparity, px, of rectified depths, mm, of any shape."""
        offset = self.left_column - self.right_column
        return self.focal_px * self.baseline_mm / np.asarray(depth, dtype=np.float64) + offset

    def depth(self, disparity: Floats) -> Floats:
        """Rectified depth, mm, of disparities, px, of any shape; not positive beyond infinity."""
        offset = self.left_column - self.right_column
        return self.focal_px * self.baseline_mm / (np.asarray(disparity) - offset)

    def project(self, points: Floats) -> Floats:
        """Rectified (column, row, disparity) (N, 3), px, of world points (N, 3), mm."""
        check_shape(points=(points, "N 3"))
        local = (points - self.left.centre) @ self.rotation.T
        flat = local[:, :2] / local[:, 2:]
        return np.stack(
            [
                flat[:, 0] * self.focal_px + self.left_column,
                flat[:, 1] * self.focal_px + self.row,
                self.disparity(local[:, 2]),
            ],
            axis=1,
        )

    def triangulate(self, matches: Floats) -> Floats:
        """World points (N, 3), mm, of rectified (column, row, disparity) (N, 3), px."""
        check_shape(matches=(matches, "N 3"))
        z = self.depth(matches[:, 2])
        x = (matches[:, 0] - self.left_column) * z / self.focal_px
        y = (matches[:, 1] - self.row) * z / self.focal_px
        world: Floats = np.stack([x, y, z], axis=1) @ self.rotation + self.left.centre
        return world

    def maps(self, side: str) -> tuple[Floats32, Floats32]:
        """Recorded columns and rows (height, width), px, of every rectified pixel of `side`."""
        columns, rows = self.recorded(side, np.arange(self.width), np.arange(self.height))
        return (
            np.nan_to_num(columns, nan=-1e4).astype(np.float32),
            np.nan_to_num(rows, nan=-1e4).astype(np.float32),
        )

    def recorded(self, side: str, columns: Ints, rows: Ints) -> tuple[Floats, Floats]:
        """Where a grid of rectified pixels of `side` lies on the recorded image.

        Args:
            side: "left" or "right".
            columns: (w,) rectified columns, px; they may lie outside the crop.
            rows: (h,) rectified rows, px.

        Returns:
            Recorded columns and rows (h, w), px; NaN behind the camera.
        """
        camera = self.left if side == "left" else self.right
        column = self.left_column if side == "left" else self.right_column
        turn = self.rotation @ camera.camera_from_world.rotation.T
        u = (columns - column)[None, :]
        v = (rows - self.row)[:, None]
        x, y, z = (u * turn[0, k] + v * turn[1, k] + self.focal_px * turn[2, k] for k in range(3))
        z = np.where(z > 0, z, np.nan)
        bent = camera.distort(np.stack([x / z, y / z], axis=-1).reshape(-1, 2))
        pixels = (bent * [camera.fx, camera.fy] + [camera.cx, camera.cy]).reshape(*z.shape, 2)
        return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])

    def cropped(self, column: int, row: int, width: int, height: int) -> Rectification:
        """The same geometry seen through a smaller window that starts at (column, row)."""
        return replace(
            self,
            left_column=self.left_column - column,
            right_column=self.right_column - column,
            row=self.row - row,
            width=width,
            height=height,
        )


def coarser(camera: Camera, halvings: int) -> Camera:
    """The camera of an image halved so many times by the mean of 2 x 2 pixels."""
    scale = 0.5**halvings
    return replace(
        camera,
        width=camera.width >> halvings,
        height=camera.height >> halvings,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=(camera.cx + 0.5) * scale - 0.5,
        cy=(camera.cy + 0.5) * scale - 0.5,
    )


def rectification(left: Camera, right: Camera, centre: Floats, extent_mm: float) -> Rectification:
    """Rectify a pair and crop it to what both views see around the scene centre.

    Args:
        left: reference camera.
        right: the other camera.
        centre: (3,) scene centre, world mm; it gets disparity 0.
        extent_mm: radius around the centre that is kept, where the views reach so far.

    Raises:
        CameraError: when the centres coincide, or the views share nothing around the centre.

    References:
        Fusiello, Trucco, Verri, A compact algorithm for rectification of stereo pairs, 2000; here
        the common axis z is the mean direction to the scene centre, made orthogonal to the
        baseline.
    """
    rotation, baseline_mm = _axes(left, right, centre)
    focal = min(_focal(left), _focal(right))
    depth = float(rotation[2] @ (centre - left.centre))
    if depth <= 0:
        raise CameraError(f"{left.name}, {right.name}: the scene centre lies behind the pair")
    left_column = -focal * float(rotation[0] @ (centre - left.centre)) / depth
    row = -focal * float(rotation[1] @ (centre - left.centre)) / depth
    whole = Rectification(
        left, right, rotation, focal, baseline_mm,
        left_column, left_column + focal * baseline_mm / depth, row, 0, 0,
    )  # fmt: skip
    reach = focal * extent_mm / max(depth - 0.5 * extent_mm, 0.3 * depth)
    low, high = _shared_window(whole, reach)
    if (high - low < 16).any():
        raise CameraError(f"{left.name} and {right.name} share no view of the scene centre")
    width, height = (high - low).astype(int)
    return whole.cropped(int(low[0]), int(low[1]), int(width), int(height))


def rectified(
    geometry: Rectification, side: str, coefficients: Floats32, clipped: Bools | None = None
) -> Floats32:
    """One view of a pair, resampled: (height, width), NaN off the recorded image.

    The lens is evaluated exactly at every eighth pixel and carried in between by cubics, which is
    `Rectification.maps` to a millionth of a pixel at a thirtieth of its cost.

    Args:
        geometry: of the pair.
        side: "left" or "right".
        coefficients: (H, W) of `spline_coefficients` of the recorded image.
        clipped: (H, W), where the recorded image is too bright to tell how bright; the view is inf
            there. None: nowhere.
    """
    check_shape(coefficients=(coefficients, "H W"))
    mask = np.zeros((0, 0), np.bool_)
    if clipped is not None:
        check_shape(coefficients=(coefficients, "H W"), clipped=(clipped, "H W"))
        mask = clipped
    across = np.arange(-_GRID, geometry.width + 3 * _GRID, _GRID)
    down = np.arange(-_GRID, geometry.height + 3 * _GRID, _GRID)
    columns, rows = geometry.recorded(side, across, down)
    shape = (geometry.height, geometry.width)
    return _resample_grid(coefficients, mask, columns, rows, shape)  # type: ignore[no-any-return]


def spline_coefficients(image: Floats32) -> Floats32:
    """Cubic B-spline coefficients (H, W) of an image (H, W), mirrored at the borders.

    References:
        Unser, Splines: a perfect fit for signal and image processing, 1999.
    """
    filtered = ndimage.spline_filter(image, order=3, output=np.float32, mode="mirror")
    return np.ascontiguousarray(filtered)


def resample(coefficients: Floats32, columns: Floats32, rows: Floats32) -> tuple[Floats32, Bools]:
    """Cubic B-spline values at (columns, rows), and whether each lies on the image.

    Args:
        coefficients: (H, W) of `spline_coefficients`.
        columns: (h, w) px.
        rows: (h, w) px.

    Returns:
        Values (h, w), 0 off the image, and the mask (h, w).
    """
    check_shape(coefficients=(coefficients, "* *"), columns=(columns, "h w"), rows=(rows, "h w"))
    return _resample(coefficients, columns, rows)  # type: ignore[no-any-return]


@numba.njit(cache=True, nogil=True)
def _resample(
    coefficients: Floats32, columns: Floats32, rows: Floats32
) -> tuple[Floats32, Bools]:  # pragma: no cover - compiled
    height, width = coefficients.shape
    values = np.zeros(columns.shape, np.float32)
    inside = np.zeros(columns.shape, np.bool_)
    for i in range(columns.shape[0]):
        for j in range(columns.shape[1]):
            x, y = columns[i, j], rows[i, j]
            if x >= 0.0 and y >= 0.0 and x <= width - 1.0 and y <= height - 1.0:
                inside[i, j] = True
                values[i, j] = _spline_value(coefficients, x, y)
    return values, inside


@numba.njit(cache=True, nogil=True)
def _resample_grid(
    coefficients: Floats32, clipped: Bools, columns: Floats, rows: Floats, shape: tuple[int, int]
) -> Floats32:  # pragma: no cover - compiled
    """Spline values (h, w) at positions given at every eighth pixel, beginning at -8."""
    height, width = coefficients.shape
    all_known = clipped.size == 0
    out = np.full(shape, np.float32(np.nan))
    count = columns.shape[1]
    line_x, line_y = np.empty(count), np.empty(count)
    weights = np.empty((_GRID, 4))
    for phase in range(_GRID):
        t = phase / _GRID  # the cubic through four equidistant values, Lagrange's form
        weights[phase, 0] = -t * (t - 1.0) * (t - 2.0) / 6.0
        weights[phase, 1] = (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0
        weights[phase, 2] = -(t + 1.0) * t * (t - 2.0) / 2.0
        weights[phase, 3] = (t + 1.0) * t * (t - 1.0) / 6.0
    for i in range(shape[0]):
        first, w = i // _GRID, weights[i % _GRID]
        for k in range(count):
            line_x[k] = line_y[k] = 0.0
            for m in range(4):
                line_x[k] += w[m] * columns[first + m, k]
                line_y[k] += w[m] * rows[first + m, k]
        for j in range(shape[1]):
            start, w = j // _GRID, weights[j % _GRID]
            x, y = 0.0, 0.0
            for m in range(4):
                x += w[m] * line_x[start + m]
                y += w[m] * line_y[start + m]
            if x >= 0.0 and y >= 0.0 and x <= width - 1.0 and y <= height - 1.0:
                if all_known or not clipped[int(y + 0.5), int(x + 0.5)]:
                    out[i, j] = _spline_value(coefficients, np.float32(x), np.float32(y))
                else:
                    out[i, j] = np.float32(np.inf)
    return out


@numba.njit(cache=True, nogil=True, inline="always")
def _spline_value(
    coefficients: Floats32, x: np.float32, y: np.float32
) -> np.float32:  # pragma: no cover - compiled
    """Cubic B-spline at (x, y) on the image, mirrored at the borders."""
    height, width = coefficients.shape
    x0, y0 = int(x), int(y)
    a0, a1, a2, a3 = _spline_weights(np.float32(x - x0))
    b0, b1, b2, b3 = _spline_weights(np.float32(y - y0))
    total = np.float32(0.0)
    if x0 >= 1 and y0 >= 1 and x0 + 2 < width and y0 + 2 < height:
        for k in range(4):
            r = y0 + k - 1
            line = (
                a0 * coefficients[r, x0 - 1] + a1 * coefficients[r, x0]
                + a2 * coefficients[r, x0 + 1] + a3 * coefficients[r, x0 + 2]
            )  # fmt: skip
            total += (b0 if k == 0 else b1 if k == 1 else b2 if k == 2 else b3) * line
        return total
    w0, w2, w3 = _mirror(x0 - 1, width), _mirror(x0 + 1, width), _mirror(x0 + 2, width)
    for k in range(4):
        r = _mirror(y0 + k - 1, height)
        line = (
            a0 * coefficients[r, w0] + a1 * coefficients[r, x0]
            + a2 * coefficients[r, w2] + a3 * coefficients[r, w3]
        )  # fmt: skip
        total += (b0 if k == 0 else b1 if k == 1 else b2 if k == 2 else b3) * line
    return total


@numba.njit(cache=True, nogil=True, inline="always")
def _spline_weights(
    t: np.float32,
) -> tuple[np.float32, np.float32, np.float32, np.float32]:  # pragma: no cover - compiled
    s = np.float32(1.0) - t
    sixth, two = np.float32(1.0 / 6.0), np.float32(2.0)
    third2, half = np.float32(2.0 / 3.0), np.float32(0.5)
    return (
        s * s * s * sixth,
        third2 - half * t * t * (two - t),
        third2 - half * s * s * (two - s),
        t * t * t * sixth,
    )


@numba.njit(cache=True, nogil=True, inline="always")
def _mirror(index: int, size: int) -> int:  # pragma: no cover - compiled
    if index < 0:
        index = -index
    if index >= size:
        index = 2 * size - 2 - index
    return max(index, 0)


def _axes(left: Camera, right: Camera, centre: Floats) -> tuple[Floats, float]:
    baseline = right.centre - left.centre
    length = float(np.linalg.norm(baseline))
    if length < 1e-6:
        raise CameraError(f"{left.name} and {right.name} stand at the same place: no baseline")
    x = baseline / length
    towards = _unit(centre - left.centre) + _unit(centre - right.centre)
    z = _unit(towards - (towards @ x) * x)
    return np.stack([x, np.cross(z, x), z]), length


def _unit(vector: Floats) -> Floats:
    unit: Floats = vector / np.linalg.norm(vector)
    return unit


def _focal(camera: Camera) -> float:
    return float(np.sqrt(camera.fx * camera.fy))


def _shared_window(whole: Rectification, reach: float) -> tuple[Floats, Floats]:
    """Corners (column, row) of the rectified window seen by both views near the centre."""
    boxes = []
    for camera, column in ((whole.left, whole.left_column), (whole.right, whole.right_column)):
        step = np.linspace(0.0, 1.0, _BORDER_STEPS)
        zero, one = np.zeros_like(step), np.ones_like(step)
        edge = np.concatenate(
            [np.stack(p, 1) for p in ((step, zero), (step, one), (zero, step), (one, step))]
        )
        flat = camera.undistort(edge * [camera.width - 1, camera.height - 1])
        rays = np.concatenate([flat, np.ones((len(flat), 1))], 1)
        local = rays @ camera.camera_from_world.rotation @ whole.rotation.T
        local = local[np.isfinite(local).all(axis=1) & (local[:, 2] > 0.05)]
        if len(local) == 0:
            raise CameraError(f"{camera.name}: its view cannot be rectified")
        pixels = local[:, :2] / local[:, 2:] * whole.focal_px + [column, whole.row]
        boxes.append((pixels.min(axis=0), pixels.max(axis=0)))
    low = np.maximum(np.minimum(boxes[0][0], boxes[1][0]), -reach)
    high = np.minimum(np.maximum(boxes[0][1], boxes[1][1]), reach)
    low[1] = max(boxes[0][0][1], boxes[1][0][1], -reach)
    high[1] = min(boxes[0][1][1], boxes[1][1][1], reach)
    return np.floor(low), np.ceil(high)
