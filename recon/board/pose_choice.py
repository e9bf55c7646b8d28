"""Which board poses to solve with, when a take has more than are needed."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from capture.arrays import Floats, Ints

_CELLS = 4  # cells along each side of an image
_FLAT = 0.03  # depth from edge to edge, over its mean, below which a board counts as frontal
_SEEN, _CELL, _TILT = 1.0, 0.15, 1.0  # what the first view, cell and tilt of a device are worth
MARK_COUNT = 1 + _CELLS * _CELLS + 5


def view_marks(flat: Floats, pixels: Floats, size: tuple[int, int]) -> Ints:
    """What one view of a flat board adds to the coverage of its device, as indices of marks.

    Mark 0: the device sees the board at all. Then one for each cell of the image with a corner in
    it; then one for how the board is tilted: frontal, or which side of the image is nearer.

    Args:
        flat: (N, 2) corners on their board, mm.
        pixels: (N, 2) the same in the image, px.
        size: (width, height) of the image, px.
    """
    cells = np.clip((pixels + 0.5) / np.array(size) * _CELLS, 0, _CELLS - 1).astype(np.int64)
    marks = {0, *(1 + cells[:, 0] + _CELLS * cells[:, 1]).tolist()}
    return np.array(sorted({*marks, 1 + _CELLS * _CELLS + _tilt(flat, pixels)}), dtype=np.int64)


def choose_poses(marks: Sequence[Sequence[tuple[int, Ints]]], devices: int, most: int) -> list[int]:
    """The poses that together cover every device best: its number of views, its image, its tilts.

    Greedy: each step takes the pose that adds most, where the k-th repetition of a mark on the
    same device is worth a k-th of the first. So devices with few views are served first. Of poses
    that add the same the earlier one is taken.

    Args:
        marks: of each pose, for each device that has a view, its index and its marks.
        devices: how many devices there are.
        most: how many poses to take.

    Returns:
        Their places, ascending.

    References:
        Nemhauser, Wolsey and Fisher 1978: greedy choice under diminishing returns is within
        1 - 1/e of the best.
    """
    if len(marks) <= most:
        return list(range(len(marks)))
    has = np.zeros((len(marks), devices * MARK_COUNT))
    for place, views in enumerate(marks):
        for device, own in views:
            has[place, device * MARK_COUNT + own] = 1.0
    worth = np.full(MARK_COUNT, _CELL)
    worth[0], worth[-5:] = _SEEN, _TILT
    worths = np.tile(worth, devices)
    count = np.zeros(devices * MARK_COUNT)
    left = np.ones(len(marks), dtype=np.bool_)
    for _ in range(most):
        gains = np.where(left, np.round(has @ (worths / (1.0 + count)), 9), -1.0)
        best = int(np.argmax(gains))
        left[best] = False
        count += has[best]
    return np.flatnonzero(~left).tolist()


def _tilt(flat: Floats, pixels: Floats) -> int:
    """0 frontal; 1 to 4: the right, lower, left, upper side of the image is nearer."""
    middle, centre = flat.mean(axis=0), pixels.mean(axis=0)
    if len(flat) < 4:
        return 0
    homography, _ = cv2.findHomography(flat - middle, pixels - centre, 0)
    if homography is None or not np.isfinite(homography).all() or homography[2, 2] == 0.0:
        return 0
    at = homography / homography[2, 2]
    jacobian = at[:2, :2] - np.outer(at[:2, 2], at[2, :2])
    if abs(np.linalg.det(jacobian)) < 1e-9:
        return 0
    farther = np.linalg.solve(jacobian.T, at[2, :2])  # relative depth a pixel
    across = (pixels - centre) @ farther
    if float(np.ptp(across)) < _FLAT:
        return 0
    angle = np.arctan2(-farther[1], -farther[0])
    return 1 + int(np.round(angle / (np.pi / 2))) % 4
