"""Where the cameras really look: their aims, told by the surface that many pairs measure at once.

Between calibration and take a mount sags and a lens warms, and the image moves on the sensor by a
fraction of a pixel. Pairs then disagree about the surface by hundredths of a millimetre, each in
its own way. The turns of the cameras that make the pairs agree best are found here, from thousands
of points, before the pairs are fused; they are reported, not hidden.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numba
import numpy as np
from scipy.spatial.transform import Rotation

from capture.arrays import Bools, Floats, Floats32, Ints
from capture.camera import Camera, CameraArray
from recon.fusion import DepthView, lift_at
from recon.images import bilinear
from recon.rectify import Rectification
from recon.stereo import PairDepth

_SAMPLES = 8000  # points, over all pairs
_EXPECTED_PX = 0.3  # deviation of an aim before anything is known
_ALIKE_PX = 50.0  # so many neighbouring pixels err alike, their windows being much the same
_CERTAIN_PX = 0.04  # aims less certain than this are not believed
_AGREE_PX = 1.0  # pairs farther apart see different surfaces
_FACING = 0.4  # least cosine between normal and view
_FLOOR_PX = 0.05  # no match is trusted beyond this
_MOVED_PX = 0.2  # faces before cameras that stand still show up to 0.15
_ROUNDS = 4  # of reweighting
_NUDGE = 1e-6  # rad


@dataclass(frozen=True, eq=False)
class Aims:
    """How far each camera has turned about its centre since it was calibrated.

    Attributes:
        turns: (C, 3) rotation vectors in camera axes, rad, that take the ray a pixel was calibrated
            to see to the one it sees.
        sigma: (C, 3) their standard deviations, rad; where nothing is known they stay wide.
        focal_px: (C,) focal lengths, px.
        agreement: deviation of pairs from their consensus in units of what their matches predict,
            before and after.
        samples: measurements that the aims were found from.
    """

    turns: Floats
    sigma: Floats
    focal_px: Floats
    agreement: tuple[float, float]
    samples: int

    @property
    def certain(self) -> bool:
        """Whether the pairs tell all aims well enough to correct anything by them."""
        return self.samples > 0 and float(self.shift_sigma_px.max()) <= _CERTAIN_PX

    @property
    def moved(self) -> Bools:
        """(C,) cameras whose image has moved by more than light and slant make believe."""
        length = np.hypot(*self.shift_px.T)
        beyond: Bools = length > np.maximum(_MOVED_PX, 3.0 * np.hypot(*self.shift_sigma_px.T))
        return beyond & self.certain

    @property
    def correct(self) -> bool:
        """Whether a scan should be corrected by these aims: one image at least has moved."""
        return bool(self.moved.any())

    @property
    def shift_px(self) -> Floats:
        """(C, 2) how far the images have moved on the sensors, columns and rows, px."""
        return np.stack([-self.turns[:, 1], self.turns[:, 0]], axis=1) * self.focal_px[:, None]

    @property
    def shift_sigma_px(self) -> Floats:
        """(C, 2) standard deviations of `shift_px`, px."""
        return self.sigma[:, [1, 0]] * self.focal_px[:, None]


class _Seen(NamedTuple):
    """One pair at the sampled points that it sees."""

    point: Ints  # (M,) which points
    offset: Floats  # (M,) along the normal, mm, from the point to this pair's surface
    slope: Floats  # (M, 6) of the offset by the turns of the left and the right camera, mm per rad
    sigma: Floats  # (M,) mm; of a sample as much as it counts
    columns: list[int]  # of the six turns among all unknowns


def estimate_aims(cameras: CameraArray, pairs: Sequence[PairDepth]) -> Aims:
    """Find the turns of the cameras about their centres that make all pairs agree best.

    Where the pairs tell nothing of a turn it stays 0: each is expected to be a third of a pixel.

    Args:
        cameras: in the order that pairs count them.
        pairs: what each pair saw.
    """
    focal = np.array([np.sqrt(camera.fx * camera.fy) for camera in cameras])
    views = [(pair, pair.view) for pair in pairs if pair.view is not None]
    expected = np.repeat((_EXPECTED_PX / focal) ** 2, 3)
    turns: Floats = np.zeros(len(expected))
    covariance: Floats = np.diag(expected)
    points, normals = _sampled([view for _, view in views])
    seen = [_seen(pair, view, points, normals) for pair, view in views]
    seen = [entry for entry in seen if len(entry.point)]
    agreement = (float("nan"), float("nan"))
    if seen:
        weights = [1.0 / entry.sigma**2 for entry in seen]
        before = _disagreement(seen, weights, turns, len(points))
        for _ in range(_ROUNDS):
            deviations = _disagreement(seen, weights, turns, len(points))
            weights = [
                1.0 / (entry.sigma**2 * (1.0 + (deviation / 2.0) ** 2))
                for entry, deviation in zip(seen, deviations, strict=True)
            ]
            system, target = _normal_equations(seen, weights, len(expected), len(points))
            system += np.diag(1.0 / expected)
            covariance = np.asarray(np.linalg.inv(system), dtype=np.float64)
            turns = -covariance @ target
        after = _disagreement(seen, weights, turns, len(points))
        agreement = (_typical(before), _typical(after))
    sigma = np.sqrt(np.diag(covariance)).reshape(-1, 3)
    count = sum(len(entry.point) for entry in seen)
    return Aims(turns.reshape(-1, 3), sigma, focal, agreement, count)


def aimed(pair: PairDepth, aims: Aims) -> PairDepth:
    """What a pair saw, as if its cameras looked where they were calibrated to look.

    The geometry stays; the disparity is what the turned rays make of it.
    """
    if pair.view is None:
        return pair
    geometry = pair.view.geometry
    left = _turn(geometry.rotation, geometry.left, aims.turns[pair.pair.left])
    right = _turn(geometry.rotation, geometry.right, aims.turns[pair.pair.right])
    lens = (geometry.focal_px, geometry.left_column, geometry.right_column, geometry.row)
    disparity = _turned(pair.view.disparity, left, right, lens)
    return replace(pair, view=replace(pair.view, disparity=disparity))


def _turn(frame: Floats, camera: Camera, turn: Floats) -> Floats:
    """A turn in camera axes as the rotation (3, 3) of rays in the axes of a rectified view."""
    axes = frame @ camera.camera_from_world.rotation.T
    rotation: Floats = Rotation.from_rotvec(axes @ turn).as_matrix()
    return rotation


@numba.njit(cache=True, nogil=True)
def _turned(
    disparity: Floats32, left: Floats, right: Floats, lens: tuple[float, float, float, float]
) -> Floats32:  # pragma: no cover - compiled
    """The disparity map (H, W) when the rays of both views are turned, in their common axes."""
    focal, left_column, right_column, centre_row = lens
    height, width = disparity.shape
    out = np.full((height, width), np.float32(np.nan))
    for i in range(height):
        for j in range(width):
            d = np.float64(disparity[i, j])
            if np.isnan(d):
                continue
            y = i - centre_row
            x = j - left_column
            z = left[2, 0] * x + left[2, 1] * y + left[2, 2] * focal
            du = focal * (left[0, 0] * x + left[0, 1] * y + left[0, 2] * focal) / z - x
            dv = focal * (left[1, 0] * x + left[1, 1] * y + left[1, 2] * focal) / z - y
            x = j - d - right_column
            z = right[2, 0] * x + right[2, 1] * y + right[2, 2] * focal
            dr = focal * (right[0, 0] * x + right[0, 1] * y + right[0, 2] * focal) / z - x
            along = _slope(disparity, i, j, 0, 1)
            down = _slope(disparity, i, j, 1, 0)
            out[i, j] = np.float32(d + du - dr - along * du - down * dv)
    return out


@numba.njit(cache=True, nogil=True, inline="always")
def _slope(
    field: Floats32, i: int, j: int, di: int, dj: int
) -> float:  # pragma: no cover - compiled
    """Central difference along one axis, one-sided at a border, 0 with no neighbour."""
    height, width = field.shape
    centre = np.float64(field[i, j])
    total, count = 0.0, 0
    if i + di < height and j + dj < width and not np.isnan(field[i + di, j + dj]):
        total, count = total + field[i + di, j + dj] - centre, count + 1
    if i - di >= 0 and j - dj >= 0 and not np.isnan(field[i - di, j - dj]):
        total, count = total + centre - field[i - di, j - dj], count + 1
    slope = total / max(count, 1)
    return slope if abs(slope) < 2.0 else 0.0


def _sampled(views: Sequence[DepthView]) -> tuple[Floats, Floats]:
    """Points and normals (N, 3) spread over all views."""
    points, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for view in views:
        known = np.flatnonzero(np.isfinite(view.disparity))
        step = max(len(known) * len(views) // _SAMPLES, 1)
        rows, columns = np.divmod(known[step // 2 :: step], view.disparity.shape[1])
        where, direction, _ = lift_at(view, rows, columns)
        whole = np.isfinite(direction).all(axis=1)
        points.append(where[whole].astype(np.float64))
        normals.append(direction[whole].astype(np.float64))
    return np.concatenate(points), np.concatenate(normals)


def _seen(pair: PairDepth, view: DepthView, points: Floats, normals: Floats) -> _Seen:
    """The surface that a pair has at the points, and how it answers to turns of its cameras."""
    geometry = view.geometry
    place = geometry.project(points)
    towards = geometry.left.centre - points
    facing = (normals * towards).sum(axis=1) > _FACING * np.linalg.norm(towards, axis=1)
    disparity = bilinear(view.disparity, place[:, 0], place[:, 1])
    near = facing & (np.abs(disparity - place[:, 2]) < _AGREE_PX)  # NaN fails
    index = np.flatnonzero(near)
    column, row = np.rint(place[index, :2]).astype(np.int64).T
    sigma_px = view.sigma_px[row, column].astype(np.float64)
    match = np.stack([place[index, 0], place[index, 1], disparity[index]], axis=1)
    at, normal = geometry.triangulate(match), normals[index]
    offset = ((at - points[index]) * normal).sum(axis=1)
    match[:, 2] += 0.01
    deeper = 100.0 * ((geometry.triangulate(match) - at) * normal).sum(axis=1)
    sigma = np.hypot(sigma_px, _FLOOR_PX) * np.maximum(np.abs(deeper), 1e-9)
    first = [3 * pair.pair.left, 3 * pair.pair.right]
    columns = [start + axis for start in first for axis in range(3)]
    alike = max(_ALIKE_PX * len(index) / max(int(np.isfinite(view.disparity).sum()), 1), 1.0)
    slope = _slopes(geometry, at, normal)
    return _Seen(index, offset, slope, sigma * np.sqrt(alike), columns)


def _slopes(geometry: Rectification, at: Floats, normals: Floats) -> Floats:
    """How points (M, 3) of a pair move along normals (M, 3) with turns of its cameras, (M, 6)."""
    rays = at - geometry.left.centre, at - geometry.right.centre
    still = _met(geometry, *rays)
    slopes = []
    for side, camera in enumerate((geometry.left, geometry.right)):
        for axis in camera.camera_from_world.rotation:
            turned = list(rays)
            turned[side] = rays[side] + _NUDGE * np.cross(axis, rays[side])
            moved = _met(geometry, turned[0], turned[1])
            slopes.append(((moved - still) * normals).sum(axis=1) / _NUDGE)
    return np.stack(slopes, axis=1)


def _met(geometry: Rectification, left: Floats, right: Floats) -> Floats:
    """Points (M, 3) on rays (M, 3) of the left view, as deep as their disparity to the right says.

    The left view is the reference: a right ray that passes above or below still matches by column.
    """
    first, second = left @ geometry.rotation.T, right @ geometry.rotation.T
    slant = first[:, 0] / first[:, 2] - second[:, 0] / second[:, 2]
    depth = geometry.baseline_mm / slant / first[:, 2]
    points: Floats = geometry.left.centre + depth[:, None] * left
    return points


def _normal_equations(
    seen: Sequence[_Seen], weights: Sequence[Floats], unknowns: int, count: int
) -> tuple[Floats, Floats]:
    """The system of the turns, every point's own place along its normal eliminated."""
    system, target = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    total, offsets = np.zeros(count), np.zeros(count)
    slopes = np.zeros((count, unknowns))
    for entry, weight in zip(seen, weights, strict=True):
        weighted = weight[:, None] * entry.slope
        total[entry.point] += weight
        offsets[entry.point] += weight * entry.offset
        for k, column in enumerate(entry.columns):
            slopes[entry.point, column] += weighted[:, k]
        system[np.ix_(entry.columns, entry.columns)] += weighted.T @ entry.slope
        target[entry.columns] += weighted.T @ entry.offset
    total = np.maximum(total, 1e-300)
    system -= (slopes / total[:, None]).T @ slopes
    target -= slopes.T @ (offsets / total)
    return system, target


def _disagreement(
    seen: Sequence[_Seen], weights: Sequence[Floats], turns: Floats, count: int
) -> list[Floats]:
    """Deviation of every measurement from the consensus of its point, in its own sigmas."""
    moved = [entry.offset + entry.slope @ turns[entry.columns] for entry in seen]
    total, mean = np.zeros(count), np.zeros(count)
    for entry, weight, offset in zip(seen, weights, moved, strict=True):
        total[entry.point] += weight
        mean[entry.point] += weight * offset
    mean /= np.maximum(total, 1e-300)
    return [
        (offset - mean[entry.point]) / entry.sigma
        for entry, offset in zip(seen, moved, strict=True)
    ]


def _typical(deviations: Sequence[Floats]) -> float:
    """Median size, as a standard deviation."""
    return float(np.median(np.abs(np.concatenate(deviations))) / 0.6745)
