"""Where one device alone, its lens known, sees the board: candidates, outliers, its own noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from capture.arrays import Bools, Floats, check_shape
from capture.camera import Camera, CameraArray
from capture.pose import Pose
from recon.board.observations import BoardObservations
from recon.calibration.geometry import rigid_basis

_THIN = 0.02  # thickness over extent of corners that count as flat
_ONE_LINE = 1e-3
_RIVAL = 5.0  # a second pose that fits this many times worse is no candidate
_STEPS = 8
_CAUCHY = 2.385  # Cauchy's scale over the standard deviation: 95 % efficient
_MAD = 1.4826
_LEAST_PX = 0.01
_TURN, _SHIFT_MM = 1e-6, 1e-3  # a step below these is none: some thousandths of a pixel
_LEAST_CORNERS = 6


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewPose:
    """One device's sight of one board pose.

    Attributes:
        device: index of the device.
        pose: index of the board pose.
        rows: of the sightings.
        candidates: camera_from_board, mm, the one that fits best first; never empty.
        residuals: (n, 2) of the first candidate, predicted minus observed, px.
    """

    device: int
    pose: int
    rows: slice
    candidates: tuple[Pose, ...]
    residuals: Floats


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewNoise:
    """What views fitted each by itself tell of corners and noise, wherever the devices stand.

    Attributes:
        kept: (M,) sightings of usable views that are no outliers.
        sigma_px: (C,) standard deviation of a corner by device, per coordinate; NaN without views.
    """

    kept: Bools
    sigma_px: Floats


def view_poses(
    cameras: CameraArray,
    observations: BoardObservations,
    corners: Floats,
    before: Sequence[ViewPose] = (),
) -> list[ViewPose]:
    """Pose of the board in every view by itself, from known lenses, robustly.

    Args:
        cameras: one a device of `observations`, whose lenses are used and whose places are not.
        observations: corner sightings.
        corners: (N, 3) shape of the board, mm.
        before: what was found of the same sightings with nearly the same shape, to start from.

    Returns:
        One entry a view; views of fewer than 6 corners, or that no pose explains, are left out.

    References:
        Collins and Bartoli 2014 (IPPE) for flat sets of corners, Terzakis and Lourakis 2020 (SQPNP)
        for others; refined by Gauss-Newton steps under Cauchy's weights.
    """
    check_shape(corners=(corners, "N 3"))
    known = {(view.device, view.pose): view.candidates for view in before}
    out = []
    for device, pose, rows in observations.views():
        lens = cameras[device].posed(Pose.identity())
        board, pixels = corners[observations.corner[rows]], observations.pixels[rows]
        flat = lens.undistort(pixels)
        if np.isfinite(flat).all(axis=1).sum() < _LEAST_CORNERS:
            continue
        guesses = known.get((device, pose)) or _starts(board, flat)
        starts = [(one, _median_miss(lens, one, board, pixels)) for one in guesses]
        near = _RIVAL * min((miss for _, miss in starts), default=0.0)
        found = [_refined(lens, one, board, pixels) for one, miss in starts if miss <= near]
        fits = [(one, lens.project(one.apply(board)) - pixels) for one in found]
        fits = [(one, miss) for one, miss in fits if np.isfinite(miss).mean() > 0.5]
        fits.sort(key=lambda fit: float(np.nanmedian(np.abs(fit[1]))))
        if fits:
            poses = tuple(one for one, _ in fits)
            out.append(
                ViewPose(
                    device=device, pose=pose, rows=rows, candidates=poses, residuals=fits[0][1]
                )
            )
    return out


def view_noise(
    views: list[ViewPose], observations: BoardObservations, outlier_sigmas: float
) -> ViewNoise:
    """Outliers and noise from the residuals of views that were fitted each by itself.

    Neither depends on where the devices stand: a device that moved keeps its corners.

    Args:
        views: of `view_poses`.
        observations: the same sightings.
        outlier_sigmas: corners further off than this many robust deviations of their device go.
    """
    count = len(observations.device_names)
    kept = np.zeros(len(observations), dtype=np.bool_)
    robust = np.full(count, np.nan)
    for device in range(count):
        mine = [view.residuals for view in views if view.device == device]
        if mine:
            spread = np.abs(np.concatenate(mine))
            robust[device] = max(_MAD * float(np.nanmedian(spread)), _LEAST_PX)
    whole = float(np.nanmedian(robust)) if np.isfinite(robust).any() else _LEAST_PX
    squares, free = np.zeros(count), np.zeros(count)
    for view in views:
        limit = outlier_sigmas * min(float(robust[view.device]), 3.0 * whole)
        good = np.linalg.norm(np.nan_to_num(view.residuals, nan=np.inf), axis=1) <= limit
        if good.sum() < _LEAST_CORNERS:
            continue
        kept[view.rows] = good
        squares[view.device] += float((view.residuals[good] ** 2).sum())
        free[view.device] += 2 * int(good.sum()) - 6
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = np.where(free > 0, np.sqrt(squares / free), np.nan)
    return ViewNoise(kept=kept, sigma_px=np.maximum(sigma, _LEAST_PX))


def rigid_columns(points: Floats, by_point: Floats) -> Floats:
    """Derivative (M, 2, 6) of pixels by a small turn (rad) and shift (mm) of points in their space.

    Args:
        points: (M, 3) points, mm, about whose origin is turned.
        by_point: (M, 2, 3) derivative of the pixels by the point, px per mm.
    """
    check_shape(points=(points, "M 3"), by_point=(by_point, "M 2 3"))
    turned: Floats = by_point @ rigid_basis(points)
    return turned


def _starts(board: Floats, flat: Floats) -> list[Pose]:
    """Rough poses from ideal image points; two where a flat board may tilt either way."""
    seen = np.isfinite(flat).all(axis=1)
    board, flat = board[seen], flat[seen]
    middle = board.mean(axis=0)
    _, extent, axes = np.linalg.svd(board - middle, full_matrices=False)
    if extent[1] <= _ONE_LINE * extent[0]:
        return []
    plane = np.stack([axes[0], axes[1], np.cross(axes[0], axes[1])])
    local = (board - middle) @ plane.T
    thin = extent[2] <= _THIN * extent[1]
    if thin:
        local[:, 2] = 0.0
    method = cv2.SOLVEPNP_IPPE if thin else cv2.SOLVEPNP_SQPNP
    try:
        found, turns, shifts, _ = cv2.solvePnPGeneric(local, flat, np.eye(3), None, flags=method)
    except cv2.error:  # degenerate views have no pose
        return []
    plane_from_board = Pose(plane, -plane @ middle)
    return [
        Pose.from_rotation_vector(np.ravel(turn).astype(np.float64), np.ravel(shift))
        @ plane_from_board
        for turn, shift in zip(turns[:found], shifts[:found], strict=True)
        if np.isfinite(turn).all() and np.isfinite(shift).all() and shift[2, 0] > 0
    ]


def _median_miss(lens: Camera, pose: Pose, board: Floats, pixels: Floats) -> float:
    miss = np.abs(lens.project(pose.apply(board)) - pixels)
    return float(np.median(np.nan_to_num(miss, nan=1e9)))


def _refined(lens: Camera, start: Pose, board: Floats, pixels: Floats) -> Pose:
    """Gauss-Newton steps under Cauchy's weights, as wide as the residuals are."""
    pose = start
    for _ in range(_STEPS):
        points = pose.apply(board)
        miss = lens.project(points) - pixels
        good = np.isfinite(miss).all(axis=1)
        if good.sum() < _LEAST_CORNERS:
            break
        miss, points = miss[good], points[good]
        width = _CAUCHY * max(_MAD * float(np.median(np.abs(miss))), _LEAST_PX)
        weight = 1.0 / (1.0 + (miss**2).sum(axis=1) / width**2)
        columns = rigid_columns(points, lens.project_jacobian(points))
        normal = np.einsum("m,mij,mik->jk", weight, columns, columns)
        right = -np.einsum("m,mij,mi->j", weight, columns, miss)
        step = np.linalg.lstsq(normal, right, rcond=None)[0]
        pose = Pose.from_rotation_vector(step[:3], step[3:]) @ pose
        if np.abs(step[:3]).max() < _TURN and np.abs(step[3:]).max() < _SHIFT_MM:
            break
    return pose
