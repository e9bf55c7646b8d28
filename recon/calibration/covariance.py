"""How well a board take determines the array: the covariance of the bundle adjustment.

COLMAP's own covariance wants every image to be the reference of its rig, so it is computed here.
Board poses are eliminated first; what may move freely without any corner moving in any image (the
space of the array, the space of the board, and the scale between them) is fixed by inner
constraints, so that no device and no corner is favoured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse

from capture.arrays import Bools, Floats, Ints, check_shape
from capture.camera import Camera, CameraArray
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.calibration.geometry import rigid_basis

LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
_LENS = len(LENS)
_RIGID = 6
_RANK = 1e-13  # an eigenvalue below this part of the largest is rounding
_LITTLE = 1e-10  # of what a parameter would tell if the board poses were known
_OFTEN = 4  # a corner seen less often may not be determined itself, and tells nothing then


@dataclass(frozen=True, eq=False, kw_only=True)
class ArrayCovariance:
    """What noise in the corners does to a calibrated array, to first order.

    Attributes:
        cameras: the calibrated array, world mm.
        root: (14 C + 3 K, r) a factor of the covariance of the parameters: for each device fx fy cx
            cy k1 k2 p1 p2, then for each device the turn (radians) and shift (mm) of the world
            before it, then the free corners, mm.
        corner_ids: (K,) ids of the free corners; empty when the board was held.
        corner_count: corners the board has.
        sigma_px: standard deviation of a corner in an image, per coordinate.
    """

    cameras: CameraArray
    root: Floats
    corner_ids: Ints
    corner_count: int
    sigma_px: float

    @property
    def lens_sigma(self) -> Floats:
        """Standard deviations (C, 8) of fx fy cx cy, px, and k1 k2 p1 p2."""
        count = len(self.cameras)
        spread: Floats = np.sqrt((self.root[: _LENS * count] ** 2).sum(axis=1))
        return spread.reshape(count, _LENS)

    @property
    def place_sigma_mm(self) -> Floats:
        """Standard deviations (C, 3) of the camera centres, world mm, the array aligned rigidly."""
        moved = _centre_shifts(self.cameras, self._aligned())
        spread: Floats = np.sqrt((moved**2).sum(axis=2))
        return spread

    @property
    def turn_sigma(self) -> Floats:
        """Standard deviations (C, 3) of turns about the camera axes, radians, array aligned."""
        turns = self._aligned()[:, :3]
        axes = np.stack([camera.camera_from_world.rotation for camera in self.cameras])
        spread: Floats = np.sqrt(((axes @ turns) ** 2).sum(axis=2))
        return spread

    @property
    def shape_sigma_mm(self) -> Floats:
        """Standard deviations (N, 3) of the board's corners, board space, mm; NaN when held."""
        out = np.full((self.corner_count, 3), np.nan)
        rows = self.root[(_LENS + _RIGID) * len(self.cameras) :]
        out[self.corner_ids] = np.sqrt((rows**2).sum(axis=1)).reshape(-1, 3)
        return out

    def triangulation_sigma(self, points: Floats, aligned_on: Floats | None = None) -> Floats:
        """What the uncertainty of the calibration alone does to triangulated points.

        Args:
            points: (N, 3) world, mm.
            aligned_on: (A, 3) points on which the wrong and the right world are aligned rigidly,
                without scale; `points` themselves when None.

        Returns:
            (N, 3, 3) covariances, mm^2, for points seen without noise by every device that has them
            on its image; NaN where fewer than two have.

        References:
            Triggs et al. 2000, Bundle Adjustment - A Modern Synthesis, section 9.2: covariances in
            another gauge.
        """
        reference = points if aligned_on is None else aligned_on
        moved = self._moved(reference)
        good = np.isfinite(moved).all(axis=(1, 2))
        shift = self._moved(points)
        if good.any():
            rigid = rigid_basis(reference[good]).reshape(-1, _RIGID)
            motion, _, _, _ = np.linalg.lstsq(rigid, moved[good].reshape(len(rigid), -1), None)
            shift = shift - rigid_basis(points) @ motion
        covariance: Floats = shift @ shift.transpose(0, 2, 1)
        return covariance

    def noise_sigma(self, points: Floats) -> Floats:
        """Covariances (N, 3, 3), mm^2, of points (N, 3) seen with noise by the true array.

        The noise is `sigma_px` per coordinate in every image that has the point; NaN where fewer
        than two have.
        """
        inverse, _ = _point_normal(self.cameras, points)
        covariance: Floats = self.sigma_px**2 * inverse
        return covariance

    def _moved(self, points: Floats) -> Floats:
        """Shifts (N, 3, r) of triangulated points by each column of the root, mm."""
        check_shape(points=(points, "N 3"))
        count = len(self.cameras)
        inverse, slopes = _point_normal(self.cameras, points)
        pulled = np.zeros((len(points), 3, self.root.shape[1]))
        for index, camera in enumerate(self.cameras):
            seen = np.flatnonzero(np.isfinite(slopes[index]).all(axis=(1, 2)))
            if not len(seen):
                continue
            by_point = slopes[index][seen]
            by_place = by_point @ rigid_basis(points[seen])
            lens = self.root[_LENS * index : _LENS * (index + 1)]
            first = _LENS * count + _RIGID * index
            place = self.root[first : first + _RIGID]
            missed = lens_jacobian(camera, points[seen]) @ lens + by_place @ place
            pulled[seen] += by_point.transpose(0, 2, 1) @ missed
        shift: Floats = -inverse @ pulled
        return shift

    def _aligned(self) -> Floats:
        """Turns and shifts (C, 6, r) of the devices after rigid alignment of their centres."""
        count = len(self.cameras)
        rows = self.root[_LENS * count : (_LENS + _RIGID) * count].reshape(count, _RIGID, -1)
        centres = np.stack([camera.centre for camera in self.cameras])
        rigid = -rigid_basis(centres).reshape(-1, _RIGID)
        scaled = rigid / np.maximum(np.linalg.norm(rigid, axis=0), 1e-12)
        if np.linalg.svd(scaled, compute_uv=False)[-1] < 1e-3:
            return rows  # centres on one line do not fix the turn about it
        moved = _centre_shifts(self.cameras, rows).reshape(len(rigid), -1)
        motion, _, _, _ = np.linalg.lstsq(rigid, moved, None)
        aligned: Floats = rows - motion[None]
        return aligned


def array_covariance(
    state: ArrayState, observations: BoardObservations, shape: BoardShape | None, sigma_px: float
) -> ArrayCovariance | None:
    """The covariance of lenses, places and board shape, or None when they are not determined.

    Args:
        state: the adjusted array, in the world.
        observations: the sightings used, each row as good as the other.
        shape: the nominal board, whose sizes give the scale, when its corners were free; None when
            they were held.
        sigma_px: standard deviation of a corner, per coordinate.

    References:
        Triggs et al. 2000, Bundle Adjustment - A Modern Synthesis, section 6.1 (elimination), 8 and
        appendix C (covariance), 9.3 (inner constraints).
    """
    free = np.zeros(0, np.int64)
    if shape is not None:
        seen = np.bincount(observations.corner, minlength=len(state.corners))
        observations = observations.select(seen[observations.corner] >= _OFTEN)
        free = np.unique(observations.corner)
        if not len(free):
            return None
    normal, before = _reduced_normal(state, observations, free)
    null, fixing = _gauge(state, shape, free)
    # The place of a lone device goes with the board poses: nothing is left to scale it by.
    size = np.maximum(np.diag(normal), _LITTLE * before)
    if not size.min() > 0.0:  # no corner depends on it
        return None
    scale = 1.0 / np.sqrt(size)
    loose, _ = np.linalg.qr(null / scale[:, None])
    scaled = normal * scale[:, None] * scale[None]
    values, vectors = scipy.linalg.eigh(scaled + np.trace(scaled) * (loose @ loose.T))
    if not values[0] > _RANK * values[-1]:
        return None
    root = scale[:, None] * (vectors / np.sqrt(values))
    # Inner constraints: no part of what is left moves along the gauge.
    root = root - null @ np.linalg.solve(fixing @ null, fixing @ root)
    return ArrayCovariance(
        cameras=state.cameras, root=sigma_px * root, corner_ids=free,
        corner_count=len(state.corners), sigma_px=sigma_px,
    )  # fmt: skip


def _reduced_normal(
    state: ArrayState, observations: BoardObservations, free: Ints
) -> tuple[Floats, Floats]:
    """Normal matrix of lenses, devices, free corners without the board poses; its diagonal with."""
    count, total = len(state.cameras), len(observations)
    points = state.points(observations)
    lens, moved = np.zeros((total, 2, _LENS)), np.zeros((total, 2, 3))
    for index, camera in enumerate(state.cameras):
        rows = observations.device == index
        lens[rows] = lens_jacobian(camera, points[rows])
        moved[rows] = camera.project_jacobian(points[rows])
    rigid = moved @ rigid_basis(points)
    turns = np.stack([pose.rotation for pose in state.array_from_board])[observations.pose]
    start = (_LENS + _RIGID) * count
    width = start + 3 * len(free)
    used, pose = np.unique(observations.pose, return_inverse=True)
    corner = np.searchsorted(free, observations.corner)
    blocks = [
        (lens, _LENS * observations.device),
        (rigid, _LENS * count + _RIGID * observations.device),
    ]
    if len(free):
        blocks.append((moved @ turns, start + 3 * corner))
    jacobian = _sparse(blocks, width)
    by_pose = _sparse([(rigid, _RIGID * pose)], _RIGID * len(used))
    normal: Floats = (jacobian.T @ jacobian).toarray()
    before = np.diag(normal).copy()
    coupling = (by_pose.T @ jacobian).toarray().reshape(len(used), _RIGID, width)
    own = np.zeros((len(used), _RIGID, _RIGID))
    np.add.at(own, pose, rigid.transpose(0, 2, 1) @ rigid)
    sizes = np.sqrt(np.einsum("pii->pi", own))
    values, axes = np.linalg.eigh(own / (sizes[:, :, None] * sizes[:, None, :]))
    known = values > _RANK * values[:, -1:]  # one or two corners leave ways in which a pose is free
    across = axes * np.where(known, 1.0 / np.sqrt(np.where(known, values, 1.0)), 0.0)[:, None, :]
    told = across.transpose(0, 2, 1) @ (coupling / sizes[:, :, None])
    told = told.reshape(-1, width)
    normal -= told.T @ told
    return 0.5 * (normal + normal.T), before


def _sparse(blocks: list[tuple[Floats, Ints]], width: int) -> scipy.sparse.csr_array:
    """A matrix (2 M, width) of blocks (M, 2, k) that start at columns (M,)."""
    rows, columns, values = [], [], []
    for block, first in blocks:
        total, _, size = block.shape
        row = 2 * np.arange(total)[:, None, None] + np.arange(2)[None, :, None]
        column = first[:, None, None] + np.arange(size)[None, None, :]
        rows.append(np.broadcast_to(row, block.shape).ravel())
        columns.append(np.broadcast_to(column, block.shape).ravel())
        values.append(block.ravel())
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return scipy.sparse.csr_array(entries, shape=(2 * len(blocks[0][0]), width))


def _gauge(state: ArrayState, shape: BoardShape | None, free: Ints) -> tuple[Floats, Floats]:
    """Directions that no image shows (n, g), and constraints (g, n), orthonormal rows, on them."""
    count = len(state.cameras)
    start = (_LENS + _RIGID) * count
    width = start + 3 * len(free)
    array = np.zeros((width, _RIGID))
    for index in range(count):
        first = _LENS * count + _RIGID * index
        array[first : first + _RIGID] = np.eye(_RIGID)
    if shape is None:
        return array, _rows_on(array)
    corners = state.corners[free]
    board = np.zeros((width, _RIGID))
    board[start:] = rigid_basis(corners - corners.mean(axis=0)).reshape(-1, _RIGID)
    scale = np.zeros((width, 1))
    for index, camera in enumerate(state.cameras):
        first = _LENS * count + _RIGID * index
        scale[first + 3 : first + _RIGID, 0] = -camera.centre
    scale[start:, 0] = corners.ravel()
    size = np.zeros((width, 1))  # the sum of squares about each face's middle stays nominal
    face = shape.face[free]
    for number in np.unique(face):
        own = corners[face == number]
        size[start:, 0].reshape(-1, 3)[face == number] = own - own.mean(axis=0)
    null = np.concatenate([array, board, scale], axis=1)
    return null, np.concatenate([_rows_on(array), _rows_on(board), _rows_on(size)])


def _rows_on(columns: Floats) -> Floats:
    sized: Floats = (columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)).T
    return sized


def _centre_shifts(cameras: CameraArray, motions: Floats) -> Floats:
    """Shifts (C, 3, r) of the centres by turns and shifts (C, 6, r) of the world before them."""
    centres = np.stack([camera.centre for camera in cameras])
    moved: Floats = -rigid_basis(centres) @ motions
    return moved


def _point_normal(cameras: CameraArray, points: Floats) -> tuple[Floats, list[Floats]]:
    """Inverse normal matrices (N, 3, 3) of points, mm^2/px^2, and each camera's (N, 2, 3) slopes.

    Slopes are NaN where a camera does not have the point on its image; inverses are NaN where fewer
    than two have.
    """
    normal, views, slopes = np.zeros((len(points), 3, 3)), np.zeros(len(points)), []
    for camera in cameras:
        pixels = camera.project(points)
        seen: Bools = camera.contains(np.nan_to_num(pixels, nan=-1e9))
        slope = camera.project_jacobian(points)
        slope[~seen] = np.nan
        slopes.append(slope)
        own = np.nan_to_num(slope)
        normal += own.transpose(0, 2, 1) @ own
        views += seen
    good = views >= 2
    inverse = np.full((len(points), 3, 3), np.nan)
    inverse[good] = np.linalg.inv(normal[good])
    return inverse, slopes


def lens_jacobian(camera: Camera, points: Floats) -> Floats:
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
