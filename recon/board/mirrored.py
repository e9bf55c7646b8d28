"""Which devices deliver mirrored images, told from the corners alone."""

from __future__ import annotations

import cv2
import numpy as np

from capture.arrays import Floats
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape

_LEAST_CORNERS = 4
_NEAR = 8  # corners whose neighbours are looked at for their distance
_BENT = 0.5  # of the corners' distance: further off than this, a view is of no flat board


def mirrored_devices(observations: BoardObservations, shape: BoardShape) -> list[str]:
    """Devices that see the boards as in a mirror in most of their views.

    A printed board is seen from its front alone, so that its +X and +Y turn the same way in every
    image as they do on the board. Where they turn the other way the image, or the board file, is
    mirrored. A view that no flat board gives, as with a wrong board file, tells nothing. Detectors
    that read markers find nothing in mirrored images; sightings of plain
    chessboards, or of other programs, can be mirrored without a sign.

    Args:
        observations: sightings of the corners.
        shape: the boards.

    Returns:
        Their names, in the order of the devices.
    """
    votes = np.zeros((len(observations.device_names), 2), dtype=np.int64)
    for device, _, rows in observations.views():
        corners, pixels = observations.corner[rows], observations.pixels[rows]
        face = shape.face[corners]
        for one in np.unique(face):
            turn = _turn(shape.flat[corners[face == one]], pixels[face == one])
            if turn:
                votes[device, int(turn < 0)] += 1
    names = observations.device_names
    return [name for name, (same, other) in zip(names, votes, strict=True) if other > same]


def _turn(flat: Floats, pixels: Floats) -> float:
    """Signed area of the board's unit square in the image; 0 when the corners do not tell.

    Args:
        flat: (N, 2) corners on their board.
        pixels: (N, 2) the same in the image.
    """
    flat = flat - flat.mean(axis=0)
    spread = np.linalg.svd(flat, compute_uv=False)
    if len(flat) < _LEAST_CORNERS or spread[1] < 0.02 * spread[0]:
        return 0.0
    apart = np.linalg.norm(flat[:_NEAR, None] - flat, axis=2)
    back, _ = cv2.findHomography(pixels, flat, 0)
    if back is None or not np.isfinite(back).all():
        return 0.0
    off = np.linalg.norm(cv2.perspectiveTransform(pixels[None], back)[0] - flat, axis=1)
    if not np.median(off) <= _BENT * apart[apart > 0].min():  # NaN too
        return 0.0
    affine, _, _, _ = np.linalg.lstsq(flat, pixels - pixels.mean(axis=0), rcond=None)
    return float(np.linalg.det(affine))
