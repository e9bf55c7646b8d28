"""A first guess of the array: nominal lenses, IPPE poses, medoid relative poses along a tree."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from capture.arrays import Floats, Ints
from capture.camera import Camera, CameraArray
from capture.errors import SolveError
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.observations import BoardObservations

_FOCAL_RANGE = (0.3, 30.0)  # focal length over image size that a device can have
_ROUGH_FIT_PX = 3.0  # rms of a plausible one-device fit, at 640 px of image
_REFERENCE_PX = 640.0
_MOST_VIEWS = 12  # views of one device that its own rough fit uses
_CAP = 0.1  # a relative pose off by more than this (radians, or fraction of distance) is just wrong
_ONE_DEVICE_FLAGS = (
    cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class _View:
    """One device's sight of one board pose: the one or two poses IPPE offers, best first."""

    device: int
    pose: int
    candidates: tuple[Pose, ...]
    corners: int


def initial_state(
    observations: BoardObservations, corners: Floats, focal_guess: float | None = None
) -> ArrayState:
    """Estimate lenses, camera places and board poses well enough to start a bundle adjustment.

    Args:
        observations: corner sightings.
        corners: (N, 3) nominal board, board space, mm, flat at Z = 0.
        focal_guess: focal length over image width, or None to find it from the views.

    Returns:
        An estimate in the camera space of the best-connected device.

    Raises:
        SolveError: when the devices do not hang together through shared board poses.

    References:
        Zhang 2000, section 3.1 (focal length from homographies); Collins and Bartoli 2014 (IPPE);
        OpenCV's multiview calibration tutorial (maximum spanning tree over pairs).
    """
    lenses = nominal_lenses(observations, corners, focal_guess)
    views = _pose_candidates(observations, corners, lenses)
    by_place = {(view.device, view.pose): view for view in views}
    parent, order = _spanning_tree(observations)
    camera_from_array = {order[0]: Pose.identity()}
    for child in order[1:]:
        child_from_parent = _medoid_relative(
            by_place, child, parent[child], len(observations.frames)
        )
        camera_from_array[child] = child_from_parent @ camera_from_array[parent[child]]
    cameras = CameraArray(
        tuple(lens.posed(camera_from_array[index]) for index, lens in enumerate(lenses))
    )
    poses = _board_poses(observations, corners, cameras, views)
    return ArrayState(cameras, poses, np.array(corners, dtype=np.float64))


def nominal_lenses(
    observations: BoardObservations, corners: Floats, focal_guess: float | None
) -> list[Camera]:
    """One rough lens a device: square pixels, centred, and k1 where the views show it.

    Args:
        observations: corner sightings.
        corners: (N, 3) nominal board, mm.
        focal_guess: focal length over image width for all devices, or None to find each.
    """
    sizes = np.array(observations.sizes, dtype=np.float64)
    if focal_guess is not None:
        return [_lens(observations, c, focal_guess * sizes[c, 0], 0.0) for c in range(len(sizes))]
    longest = sizes.max(axis=1)
    linear = (
        np.array([_linear_focal(observations, corners, c) for c in range(len(sizes))]) / longest
    )
    pooled = float(np.nanmedian(linear)) if np.isfinite(linear).any() else 1.5
    fits = [
        _one_device_fit(observations, corners, c, (x if np.isfinite(x) else pooled) * longest[c])
        for c, x in enumerate(linear)
    ]
    good = np.array([focal for focal, _ in fits]) / longest
    pooled = float(np.nanmedian(good)) if np.isfinite(good).any() else pooled
    return [
        _lens(observations, c, focal if np.isfinite(focal) else pooled * longest[c], k1)
        for c, (focal, k1) in enumerate(fits)
    ]


def _lens(observations: BoardObservations, device: int, focal_px: float, k1: float) -> Camera:
    width, height = observations.sizes[device]
    return Camera(
        name=observations.device_names[device], width=width, height=height, fx=float(focal_px),
        fy=float(focal_px), cx=(width - 1) / 2, cy=(height - 1) / 2,
        distortion=np.array([k1, 0.0, 0.0, 0.0, 0.0]), camera_from_world=Pose.identity(),
    )  # fmt: skip


def _device_views(observations: BoardObservations, device: int) -> list[slice]:
    return [rows for c, _, rows in observations.views() if c == device]


def _linear_focal(observations: BoardObservations, corners: Floats, device: int) -> float:
    """Focal length, px, from the orthogonality of the homographies' columns; NaN if none shows it.

    References:
        Zhang 2000, equations 3 and 4, with square pixels and the principal point at the centre.
    """
    width, height = observations.sizes[device]
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    flat, tilt = [], []
    for rows in _device_views(observations, device):
        xy = corners[observations.corner[rows], :2]
        found, _ = cv2.findHomography(xy, observations.pixels[rows] - centre, 0)
        homography = np.asarray(found, dtype=np.float64)  # OpenCV's None becomes NaN
        if not np.isfinite(homography).all():
            continue
        first, second = homography[:, 0], homography[:, 1]
        scale = first[:2] @ first[:2] + second[:2] @ second[:2]
        flat += [
            first[:2] @ second[:2] / scale,
            (first[:2] @ first[:2] - second[:2] @ second[:2]) / scale,
        ]
        tilt += [first[2] * second[2] / scale, (first[2] ** 2 - second[2] ** 2) / scale]
    a, b = np.array(flat), np.array(tilt)
    inverse_square = -float(a @ b) / float(a @ a) if len(a) and a @ a > 0 else -1.0
    focal = inverse_square**-0.5 if inverse_square > 0 else np.nan
    low, high = (limit * max(width, height) for limit in _FOCAL_RANGE)
    return float(focal) if low <= focal <= high else float("nan")


def _one_device_fit(
    observations: BoardObservations, corners: Floats, device: int, focal_px: float
) -> tuple[float, float]:
    """Focal length, px, and k1 of one device alone; NaN and 0 where its views do not tell."""
    width, height = observations.sizes[device]
    views = sorted(_device_views(observations, device), key=lambda s: s.start - s.stop)[
        :_MOST_VIEWS
    ]
    objects = [corners[observations.corner[rows]].astype(np.float32) for rows in views]
    pixels = [observations.pixels[rows].astype(np.float32) for rows in views]
    matrix = np.array(
        [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1.0]]
    )
    try:
        rms, found, bend, _, _ = cv2.calibrateCamera(
            objects, pixels, (width, height), matrix, np.zeros(5), flags=_ONE_DEVICE_FLAGS
        )
    except cv2.error:  # degenerate views: the pooled focal length serves
        return float("nan"), 0.0
    focal, k1 = float(found[0, 0]), float(np.ravel(bend)[0])
    size = max(width, height)
    plausible = _FOCAL_RANGE[0] <= focal / size <= _FOCAL_RANGE[1] and abs(k1) < 2.0
    if not plausible or rms > _ROUGH_FIT_PX * max(1.0, size / _REFERENCE_PX):
        return float("nan"), 0.0
    # OpenCV sums residuals in the order its threads finish: the last digits do not repeat.
    return round(focal, 2), round(k1, 4)


def _pose_candidates(
    observations: BoardObservations, corners: Floats, lenses: list[Camera]
) -> list[_View]:
    views = []
    for device, pose, rows in observations.views():
        flat = lenses[device].undistort(observations.pixels[rows])
        seen = np.isfinite(flat).all(axis=1)
        if seen.sum() < 4:
            continue
        board = corners[observations.corner[rows]][seen]
        middle = board.mean(axis=0)
        found, turns, shifts, _ = cv2.solvePnPGeneric(
            board - middle, flat[seen], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
        candidates = []
        for turn, shift in zip(turns[:found], shifts[:found], strict=True):
            if np.isfinite(turn).all() and np.isfinite(shift).all() and shift[2, 0] > 0:
                moved = Pose.from_rotation_vector(
                    turn[:, 0].astype(np.float64), shift[:, 0].astype(np.float64)
                )
                candidates.append(moved @ Pose(np.eye(3), -middle))
        if candidates:
            views.append(_View(device, pose, tuple(candidates), int(seen.sum())))
    return views


def _spanning_tree(observations: BoardObservations) -> tuple[dict[int, int], list[int]]:
    """Maximum spanning tree over devices by shared corners: parents, and root-first order."""
    counts = observations.view_counts().astype(np.float64)
    shared = np.array([[np.minimum(a, b).sum() for b in counts] for a in counts])
    np.fill_diagonal(shared, 0.0)
    root = int(np.argmax(shared.sum(axis=1)))
    order, parent = [root], {}
    while len(order) < len(counts):
        outside = [c for c in range(len(counts)) if c not in order]
        links = shared[np.ix_(order, outside)]
        best = int(np.argmax(links))
        start, stop = divmod(best, len(outside))
        if links[start, stop] <= 0:
            names = observations.device_names
            raise SolveError(
                f"{', '.join(names[c] for c in outside)}: never saw the board together with "
                f"{', '.join(names[c] for c in order)}; hold the board where both groups see it"
            )
        parent[outside[stop]] = order[start]
        order.append(outside[stop])
    return parent, order


def _medoid_relative(
    views: dict[tuple[int, int], _View], child: int, parent: int, poses: int
) -> Pose:
    """The relative pose child_from_parent that most shared board poses agree with."""
    options: list[Pose] = []
    owners: list[int] = []
    for pose in range(poses):
        if (child, pose) not in views or (parent, pose) not in views:
            continue
        for of_child in views[child, pose].candidates:
            for of_parent in views[parent, pose].candidates:
                options.append(of_child @ of_parent.inverse())
                owners.append(pose)
    if not options:
        raise SolveError(
            "two devices share board poses, and none of them gives a pose of the board"
        )
    turns = np.stack([option.rotation for option in options])
    shifts = np.stack([option.translation for option in options])
    trace = np.einsum("aij,bij->ab", turns, turns)
    angle = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    reach = max(float(np.median(np.linalg.norm(shifts, axis=1))), 1e-9)
    gap = np.linalg.norm(shifts[:, None] - shifts[None], axis=2) / reach
    distance = np.minimum(angle + gap, _CAP)
    owner = np.array(owners)
    cost = sum(distance[:, owner == pose].min(axis=1) for pose in sorted(set(owners)))
    return options[int(np.argmin(cost))]


def _board_poses(
    observations: BoardObservations, corners: Floats, cameras: CameraArray, views: list[_View]
) -> tuple[Pose, ...]:
    """For each board pose, the candidate of any device that all devices together like best."""
    rows_of = [np.flatnonzero(observations.pose == p) for p in range(len(observations.frames))]
    poses = []
    for index, rows in enumerate(rows_of):
        best, least = Pose.identity(), np.inf
        for view in (v for v in views if v.pose == index):
            array_from_camera = cameras[view.device].camera_from_world.inverse()
            for candidate in view.candidates:
                option = array_from_camera @ candidate
                cost = _disagreement(observations, rows, cameras, option.apply(corners))
                if cost < least:
                    best, least = option, cost
        poses.append(best)
    return tuple(poses)


def _disagreement(
    observations: BoardObservations, rows: Ints, cameras: CameraArray, points: Floats
) -> float:
    """Mean capped reprojection error of one board pose over all devices, in image sizes."""
    total = 0.0
    for device in np.unique(observations.device[rows]):
        mine = rows[observations.device[rows] == device]
        miss = (
            cameras[device].project(points[observations.corner[mine]]) - observations.pixels[mine]
        )
        size = max(observations.sizes[device])
        error = np.nan_to_num(np.linalg.norm(miss, axis=1) / size, nan=_CAP)
        total += float(np.minimum(error, _CAP).sum())
    return total / max(len(rows), 1)
