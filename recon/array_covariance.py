"""How well a board take determines the focal lengths: the covariance of the bundle adjustment.

COLMAP's own covariance wants every image to be the reference of its rig, so it is computed here.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse

from capture.arrays import Floats, Ints
from capture.camera import Camera
from recon.array_state import ArrayState
from recon.observations import BoardObservations

_LENS = 8  # fx fy cx cy k1 k2 p1 p2
_RIGID = 6


def focal_sigma(
    state: ArrayState, observations: BoardObservations, held: Ints | None, sigma_px: float
) -> Floats:
    """Standard deviations (C, 2) of fx and fy, px; NaN for all when the problem is singular.

    Args:
        state: the adjusted array.
        observations: the sightings used, each row as good as the other.
        held: ids of the corners held while the board's shape was free; None when all were.
        sigma_px: standard deviation of a corner, per coordinate.

    References:
        Triggs et al. 2000, Bundle Adjustment - A Modern Synthesis, section 8 and appendix C.
    """
    jacobian = _jacobian(state, observations, held)
    normal = (jacobian.T @ jacobian).toarray()
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    try:
        factor = scipy.linalg.cho_factor(normal * scale[:, None] * scale[None, :], lower=True)
        inverse = scipy.linalg.cho_solve(factor, np.eye(len(scale)))
    except np.linalg.LinAlgError:
        return np.full((len(state.cameras), 2), np.nan)
    variance = np.diag(inverse) * scale**2
    places = _LENS * np.arange(len(state.cameras))[:, None] + np.array([0, 1])
    spread: Floats = sigma_px * np.sqrt(variance[places])
    return spread


def _jacobian(
    state: ArrayState, observations: BoardObservations, held: Ints | None
) -> scipy.sparse.csr_array:
    """Derivative (2M, parameters) of pixels by lenses, all devices but one, poses, free corners."""
    count, total = len(state.cameras), len(observations)
    points = state.points(observations)
    lens, moved = np.zeros((total, 2, _LENS)), np.zeros((total, 2, 3))
    for index, camera in enumerate(state.cameras):
        rows = observations.device == index
        lens[rows] = _lens_jacobian(camera, points[rows])
        moved[rows] = camera.project_jacobian(points[rows])
    rigid = np.concatenate([np.cross(points[:, None, :], moved), moved], axis=2)
    turns = np.stack([pose.rotation for pose in state.array_from_board])[observations.pose]
    used, pose = np.unique(observations.pose, return_inverse=True)
    start = _LENS * count
    blocks = [
        (lens, _LENS * observations.device, np.ones(total, bool)),
        (rigid, start + _RIGID * (observations.device - 1), observations.device > 0),
        (rigid, start + _RIGID * (count - 1) + _RIGID * pose, np.ones(total, bool)),
    ]
    width = start + _RIGID * (count - 1) + _RIGID * len(used)
    if held is not None:
        free = np.setdiff1d(np.unique(observations.corner), held)
        place = np.searchsorted(free, observations.corner)
        blocks.append((moved @ turns, width + 3 * place, np.isin(observations.corner, free)))
        width += 3 * len(free)
    return _assemble(blocks, total, width)


def _assemble(
    blocks: list[tuple[Floats, Ints, np.ndarray[tuple[int], np.dtype[np.bool_]]]],
    total: int,
    width: int,
) -> scipy.sparse.csr_array:
    rows, columns, values = [], [], []
    for block, first, used in blocks:
        size = block.shape[2]
        row = 2 * np.flatnonzero(used)[:, None, None] + np.arange(2)[None, :, None]
        column = first[used][:, None, None] + np.arange(size)[None, None, :]
        rows.append(np.broadcast_to(row, (used.sum(), 2, size)).ravel())
        columns.append(np.broadcast_to(column, (used.sum(), 2, size)).ravel())
        values.append(block[used].ravel())
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return scipy.sparse.csr_array(entries, shape=(2 * total, width))


def _lens_jacobian(camera: Camera, points: Floats) -> Floats:
    """Derivative (N, 2, 8) of the pixels of points (N, 3) by fx fy cx cy k1 k2 p1 p2."""
    local = camera.camera_from_world.apply(points)
    flat = local[:, :2] / local[:, 2:]
    x, y = flat[:, 0], flat[:, 1]
    r2 = x * x + y * y
    bent = camera.distort(flat)
    out = np.zeros((len(points), 2, _LENS))
    out[:, 0, 0], out[:, 1, 1] = bent[:, 0], bent[:, 1]
    out[:, 0, 2] = out[:, 1, 3] = 1.0
    out[:, 0, 4], out[:, 1, 4] = camera.fx * x * r2, camera.fy * y * r2
    out[:, 0, 5], out[:, 1, 5] = camera.fx * x * r2 * r2, camera.fy * y * r2 * r2
    out[:, 0, 6], out[:, 1, 6] = camera.fx * 2 * x * y, camera.fy * (r2 + 2 * y * y)
    out[:, 0, 7], out[:, 1, 7] = camera.fx * (r2 + 2 * x * x), camera.fy * 2 * x * y
    return out
