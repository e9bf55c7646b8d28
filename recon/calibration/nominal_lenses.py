"""Nominal lenses: square pixels, centred, focal length and k1 from each device's own views."""

from __future__ import annotations

import cv2
import numpy as np

from capture.arrays import Ints
from capture.camera import Camera
from capture.pose import Pose
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape

LEAST_CORNERS = 4  # of a flat board in one view that give its pose
_FOCAL_RANGE = (0.3, 30.0)  # focal length over image size that a device can have
_ROUGH_FIT_PX = 3.0  # rms of a plausible one-device fit, at 640 px of image
_REFERENCE_PX = 640.0
_MOST_VIEWS = 12  # views of one device that its own rough fit uses
_ONE_DEVICE_FLAGS = (
    cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
)  # fmt: skip


def nominal_lenses(
    observations: BoardObservations, shape: BoardShape, focal_guess: float | None
) -> list[Camera]:
    """One rough lens a device: square pixels, centred, and k1 where the views show it.

    Args:
        observations: corner sightings.
        shape: the nominal board.
        focal_guess: focal length over image width for all devices, or None to find each.
    """
    sizes = np.array(observations.sizes, dtype=np.float64)
    if focal_guess is not None:
        return [_lens(observations, c, focal_guess * sizes[c, 0], 0.0) for c in range(len(sizes))]
    longest = sizes.max(axis=1)
    linear = np.array([_linear_focal(observations, shape, c) for c in range(len(sizes))]) / longest
    pooled = float(np.nanmedian(linear)) if np.isfinite(linear).any() else 1.5
    fits = [
        _one_device_fit(observations, shape, c, (x if np.isfinite(x) else pooled) * longest[c])
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


def _device_views(observations: BoardObservations, shape: BoardShape, device: int) -> list[Ints]:
    """Rows of each flat board in each view of one device."""
    views = [rows for c, _, rows in observations.views() if c == device]
    return [part for rows in views for _, part in face_rows(observations, shape, rows)]


def face_rows(
    observations: BoardObservations, shape: BoardShape, rows: slice
) -> list[tuple[int, Ints]]:
    """The flat boards with four corners or more in one view, and their rows."""
    face = shape.face[observations.corner[rows]]
    parts = [(int(f), rows.start + np.flatnonzero(face == f)) for f in np.unique(face)]
    return [(f, part) for f, part in parts if len(part) >= LEAST_CORNERS]


def _linear_focal(observations: BoardObservations, shape: BoardShape, device: int) -> float:
    """Focal length, px, from the orthogonality of the homographies' columns; NaN if none shows it.

    References:
        Zhang 2000, equations 3 and 4, with square pixels and the principal point at the centre.
    """
    width, height = observations.sizes[device]
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    flat, tilt = [], []
    for rows in _device_views(observations, shape, device):
        xy = shape.flat[observations.corner[rows]]
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
    observations: BoardObservations, shape: BoardShape, device: int, focal_px: float
) -> tuple[float, float]:
    """Focal length, px, and k1 of one device alone; NaN and 0 where its views do not tell."""
    width, height = observations.sizes[device]
    views = sorted(_device_views(observations, shape, device), key=lambda rows: -len(rows))[
        :_MOST_VIEWS
    ]
    flat = np.concatenate([shape.flat, np.zeros((len(shape.flat), 1))], axis=1)
    objects = [flat[observations.corner[rows]].astype(np.float32) for rows in views]
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
