"""One least-squares system for the motions of all devices, and which of them have kept still.

Unknown are the pose of the board at each place, its shape, and by device a turn, a shift and a
change of focal length. Poses and shape are eliminated once; what is left, seven numbers a device,
answers every question of the kind "how far has this one moved if those stood still".
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse

from capture.arrays import Bools, Floats, check_shape
from capture.camera import Camera, CameraArray
from capture.errors import SolveError
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations
from recon.calibration.view_poses import rigid_columns

MOTION = 7  # turn (rad) and shift (mm) in the camera's own space, log of the factor of its focal
_RIGID = 6
_LOOSE = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3, 1.0])  # deviations before anything is seen
_SCALE_SIGMA = 2e-5  # the size of a board is known to this: its shape may bend, hardly grow
_CHI2_MEDIAN = 5.348  # of six degrees of freedom
_STEPS = 20


@dataclass(frozen=True, eq=False, kw_only=True)
class DriftState:
    """An estimate of what has changed since a calibration.

    Attributes:
        cameras: as calibrated.
        motions: (C, 7) by device; turn (3) rad and shift (3) mm of now_from_then in the camera's
            own space, and the log of the factor of its focal length.
        array_from_board: (P) pose of the board at each place, mm.
        corners: (N, 3) its shape, mm.
    """

    cameras: CameraArray
    motions: Floats
    array_from_board: tuple[Pose, ...]
    corners: Floats

    def array_state(self) -> ArrayState:
        """The array as it would stand now."""
        moved = [moved_camera(c, m) for c, m in zip(self.cameras, self.motions, strict=True)]
        return ArrayState(CameraArray(tuple(moved)), self.array_from_board, self.corners)


@dataclass(frozen=True, kw_only=True)
class DriftLimits:
    """When a motion counts: both must be passed.

    Attributes:
        significant: Mahalanobis distance of the motion from none, in its own deviations.
        least_px: rms of how far it displaces the corners in the device's own image.
    """

    significant: float
    least_px: float


@dataclass(frozen=True, eq=False, kw_only=True)
class DriftSystem:
    """The normal equations of all motions, poses and shape eliminated, around an estimate.

    Attributes:
        matrix: (7C, 7C) weighted by the noise.
        right: (7C,) so that matrix @ motions = right, for whole motions, not for steps.
        direct: (C, 7, 7) mean over a device's corners of the products of derivatives, px^2.
        factor: of the eliminated unknowns.
        mixed: (X, 7C) eliminated unknowns by motions.
        rest: (X,) right side of the eliminated unknowns.
        state: the estimate.
    """

    matrix: Floats
    right: Floats
    direct: Floats
    factor: tuple[Floats, bool]
    mixed: Floats
    rest: Floats
    state: DriftState

    def motions(self, free: Bools) -> Floats:
        """Motions (C, 7) when those of `free` (C, 7) may move and all others are none."""
        at = np.flatnonzero(free.ravel())
        out = np.zeros(self.right.shape)
        if len(at):
            out[at] = _inverse(self.matrix[np.ix_(at, at)]) @ self.right[at]
        return out.reshape(-1, MOTION)

    def stepped(self, motions: Floats, share: float = 1.0) -> DriftState:
        """The estimate with these motions (C, 7) and the poses and shape that suit them.

        Args:
            motions: where to go.
            share: how much of the way is gone.
        """
        step = motions - self.state.motions
        whole = scipy.linalg.cho_solve(self.factor, self.rest - self.mixed @ step.ravel())
        loose = share * whole
        count = len(self.state.array_from_board)
        turns = loose[: _RIGID * count].reshape(-1, _RIGID)
        poses = tuple(
            Pose.from_rotation_vector(part[:3], part[3:]) @ pose
            for part, pose in zip(turns, self.state.array_from_board, strict=True)
        )
        corners = self.state.corners + loose[_RIGID * count :].reshape(-1, 3)
        return DriftState(
            cameras=self.state.cameras, motions=self.state.motions + share * step,
            array_from_board=poses, corners=corners,
        )  # fmt: skip

    def tests(self, still: Bools, size: int = _RIGID) -> list[tuple[Floats, Floats]]:
        """By device, its motion (size,) and covariance were all others of `still` (C) still.

        With size 7 the focal length of the device in question moves as well. The only still
        device is compared with nothing: its motion is none and its covariance infinite.
        """
        count = len(still)
        free = np.zeros((count, MOTION), dtype=np.bool_)
        free[~still, :_RIGID] = True
        at = np.flatnonzero(free.ravel())
        inverse = _inverse(self.matrix[np.ix_(at, at)])
        moved = inverse @ self.right[at]
        out = []
        for device in range(count):
            own = MOTION * device + np.arange(size)
            if still[device]:
                if still.sum() == 1:
                    out.append((np.zeros(size), np.full((size, size), np.inf)))
                    continue
                inside, others, shift = inverse, at, moved
            else:  # what it would have been without this device
                mine = at // MOTION == device
                others = at[~mine]
                cross = inverse[np.ix_(~mine, mine)]
                core = np.linalg.solve(inverse[np.ix_(mine, mine)], cross.T)
                inside = inverse[np.ix_(~mine, ~mine)] - cross @ core
                shift = inside @ self.right[others]
            across = self.matrix[np.ix_(others, own)]
            block = self.matrix[np.ix_(own, own)] - across.T @ inside @ across
            covariance = _inverse(block)
            out.append((covariance @ (self.right[own] - across.T @ shift), covariance))
        return out

    def effect_px(self, device: int, motion: Floats) -> float:
        """How far a motion (6,) or (7,) displaces the device's corners in its image, rms, px."""
        block = self.direct[device][: len(motion), : len(motion)]
        return float(np.sqrt(max(float(motion @ block @ motion), 0.0)))

    def growth(self, still: Bools) -> tuple[float, float]:
        """By how much the array has grown about its middle, as a fraction, and its deviation.

        Args:
            still: (C,) devices that move only with that growth; the others move as they like.
        """
        centres = np.stack([camera.centre for camera in self.state.cameras])
        away = centres - centres[still].mean(axis=0)
        turned = np.stack([c.camera_from_world.rotation for c in self.state.cameras])
        along = np.zeros((len(centres), MOTION))
        along[:, 3:6] = -np.einsum("cij,cj->ci", turned, away) * still[:, None]
        free = np.repeat(~still, MOTION).reshape(-1, MOTION)
        free[:, _RIGID] = False
        base = np.column_stack([along.ravel(), np.eye(along.size)[:, free.ravel()]])
        normal = base.T @ self.matrix @ base
        inverse = _inverse(normal)
        found = inverse @ (base.T @ self.right)
        return float(found[0]), float(np.sqrt(inverse[0, 0]))


def moved_camera(camera: Camera, motion: Floats) -> Camera:
    """The camera after a motion (7,): turn, shift in its own space, log of the focal factor."""
    check_shape(motion=(motion, "7"))
    now_from_then = Pose.from_rotation_vector(motion[:3], motion[3:6])
    factor = float(np.exp(motion[6]))
    if factor != 1.0:
        camera = dataclasses.replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    return camera.posed(now_from_then @ camera.camera_from_world)


def drift_system(
    state: DriftState,
    observations: BoardObservations,
    sigma_px: Floats,
    nominal: Floats,
    board_sigma_mm: float,
) -> DriftSystem:
    """Derivatives around an estimate, poses and shape of the board eliminated.

    Args:
        state: the estimate.
        observations: the sightings to use, devices in the order of the cameras.
        sigma_px: (C,) noise by device, per coordinate.
        nominal: (N, 3) what the board was meant to be, mm.
        board_sigma_mm: how far a corner may stand from there; its size as a whole may hardly.

    Raises:
        SolveError: when poses and shape are not determined, the cameras being far from true.

    References:
        Triggs et al. 2000, Bundle Adjustment - A Modern Synthesis, section 6.1 (elimination).
    """
    check_shape(sigma_px=(sigma_px, "C"), nominal=(nominal, "N 3"))
    count, poses = len(state.cameras), len(state.array_from_board)
    own, table, miss = _derivatives(state, observations)
    weight = 1.0 / sigma_px[observations.device]
    loose_size, total = _RIGID * poses + nominal.size, MOTION * count
    size = loose_size + total
    normal = (table.T @ scipy.sparse.diags_array(np.repeat(weight**2, 2)) @ table).toarray()
    right = -(table.T @ (np.repeat(weight**2, 2) * miss.ravel()))
    shape = np.arange(_RIGID * poses, loose_size)
    away = (state.corners - nominal).ravel()
    board_prior = np.eye(nominal.size) / board_sigma_mm**2
    radial = (nominal - nominal.mean(axis=0)).ravel()
    radial /= radial @ radial
    board_prior += np.outer(radial, radial) / _SCALE_SIGMA**2
    normal[np.ix_(shape, shape)] += board_prior
    right[shape] -= board_prior @ away
    at, own_at = np.arange(loose_size), np.arange(loose_size, size)
    unseen = np.flatnonzero(np.diag(normal)[: _RIGID * poses] == 0)  # poses that nobody used
    normal[unseen, unseen] = 1.0
    try:
        factor = scipy.linalg.cho_factor(normal[np.ix_(at, at)], lower=True)
    except np.linalg.LinAlgError as error:
        raise SolveError(
            "drift: what the devices see of the board does not fit the cameras at all: are they "
            "those of this array?"
        ) from error
    mixed = normal[np.ix_(at, own_at)]
    solved = scipy.linalg.cho_solve(factor, np.column_stack([mixed, right[at]]))
    matrix = normal[np.ix_(own_at, own_at)] - mixed.T @ solved[:, :-1]
    reduced = right[own_at] - mixed.T @ solved[:, -1] + matrix @ state.motions.ravel()
    matrix[np.arange(total), np.arange(total)] += np.tile(1.0 / _LOOSE**2, count)
    direct = np.zeros((count, MOTION, MOTION))
    for device in range(count):
        block = own[observations.device == device].reshape(-1, MOTION)
        direct[device] = 2.0 * block.T @ block / max(len(block), 1)
    return DriftSystem(
        matrix=matrix, right=reduced, direct=direct, factor=factor, mixed=mixed, rest=right[at],
        state=state,
    )  # fmt: skip


def still_devices(system: DriftSystem, eligible: Bools, limits: DriftLimits) -> tuple[Bools, float]:
    """Which devices have kept their places to each other, whatever less than half of them did.

    From every device as the only fixed one, the half that moved least is fixed next, until that
    half stays the same; the most concordant of these halves is taken. Then devices whose motion
    does not count join, the least moved first, and those that do not bear the test leave.

    Args:
        system: normal equations.
        eligible: (C,) devices that saw enough to be judged.
        limits: when a motion counts.

    Returns:
        (C,) the still devices, and by how much motions scatter beyond their deviations.

    References:
        Rousseeuw and Van Driessen 1999 (concentration steps of least trimmed squares); Pelzer 1971
        (congruence test of geodetic networks).
    """
    able = np.flatnonzero(eligible)
    half = len(able) // 2 + 1
    best, least = eligible.copy(), np.inf
    known: set[bytes] = set()
    for seed in able.tolist():
        still = np.zeros(len(eligible), dtype=np.bool_)
        still[seed] = True
        for _ in range(_STEPS):
            distance = _distances(system, still)[able]
            chosen = np.zeros_like(still)
            chosen[able[np.argsort(distance, kind="stable")[:half]]] = True
            if np.array_equal(chosen, still) or chosen.tobytes() in known:
                break  # settled, or another seed has been here
            known.add(chosen.tobytes())
            still = chosen
        discord = _discord(system, still)
        if discord < least - 1e-9 * abs(least if np.isfinite(least) else 0.0):
            best, least = still, discord
    return _grown(system, best, able, limits)


def inflation(system: DriftSystem, still: Bools, eligible: Bools, least_px: float) -> float:
    """By how much motions scatter beyond their deviations; at least 1.

    A calibration is not perfect either: the median device tells by how much more than noise all
    motions scatter, as far as they do not displace corners by more than `least_px`.
    """
    tests = system.tests(still)
    squares = []
    for device in np.flatnonzero(eligible).tolist():
        motion, covariance = tests[device]
        size = system.effect_px(device, motion)
        share = min(1.0, least_px / size) if size > 0 else 1.0
        squares.append((share * _distance(motion, covariance)) ** 2)
    return float(np.sqrt(max(1.0, float(np.median(squares)) / _CHI2_MEDIAN)))


def _grown(
    system: DriftSystem, still: Bools, able: np.ndarray[tuple[int], np.dtype[np.int64]],
    limits: DriftLimits,
) -> tuple[Bools, float]:  # fmt: skip
    still = still.copy()
    eligible = np.isin(np.arange(len(still)), able)
    wider = inflation(system, still, eligible, limits.least_px)

    def tested(devices: list[int]) -> list[tuple[float, bool, int]]:
        tests = system.tests(still)
        out = []
        for device in devices:
            motion, covariance = tests[device]
            distance = _distance(motion, covariance) / wider
            seen = system.effect_px(device, motion) > limits.least_px
            out.append((distance, distance > limits.significant and seen, device))
        return sorted(out)

    while True:
        outside = [device for device in able.tolist() if not still[device]]
        joining = [device for _, moved, device in tested(outside) if not moved]
        if not joining:
            break
        still[joining[0]] = True
    while still.sum() > 1:
        leaving = [device for _, moved, device in tested(np.flatnonzero(still).tolist()) if moved]
        if not leaving:
            break
        still[leaving[-1]] = False
    return still, wider


def _distances(system: DriftSystem, still: Bools) -> Floats:
    """Mahalanobis distance (C,) of each device's motion from none, all others of `still` still."""
    return np.array([_distance(*test) for test in system.tests(still)])


def _inverse(matrix: Floats) -> Floats:
    unit = 1.0 / np.sqrt(np.diag(matrix))  # radians beside millimetres: brought to one size first
    scaled = unit[:, None] * (0.5 * (matrix + matrix.T)) * unit
    return np.asarray(unit[:, None] * np.linalg.inv(scaled) * unit, dtype=np.float64)


def _distance(motion: Floats, covariance: Floats) -> float:
    if not np.isfinite(covariance).all():
        return 0.0
    return float(np.sqrt(max(float(motion @ np.linalg.solve(covariance, motion)), 0.0)))


def _discord(system: DriftSystem, still: Bools) -> float:
    """Misfit that stays when the others move as they like, up to a constant."""
    free = np.repeat(~still, MOTION).reshape(-1, MOTION)
    free[:, _RIGID] = False
    return -float(system.right @ system.motions(free).ravel())


def _derivatives(
    state: DriftState, observations: BoardObservations
) -> tuple[Floats, scipy.sparse.csr_array, Floats]:
    """Derivatives by the device's own motion (M, 2, 7), by all unknowns (2M, X + 7C); residuals."""
    array = state.array_state()
    points = array.points(observations)
    total = len(observations)
    by_point, own, miss = (
        np.zeros((total, 2, 3)),
        np.zeros((total, 2, MOTION)),
        np.zeros((total, 2)),
    )
    for device, camera in enumerate(array.cameras):
        rows = np.flatnonzero(observations.device == device)
        if not len(rows):
            continue
        pixels = camera.project(points[rows])
        by_point[rows] = camera.project_jacobian(points[rows])
        local = camera.camera_from_world.apply(points[rows])
        own[rows, :, :_RIGID] = rigid_columns(
            local, by_point[rows] @ camera.camera_from_world.rotation.T
        )
        own[rows, :, _RIGID] = pixels - [camera.cx, camera.cy]
        miss[rows] = pixels - observations.pixels[rows]
    behind = ~np.isfinite(miss).all(axis=1)
    for values in (by_point, own, miss):
        values[behind] = 0.0
    turns = np.stack([pose.rotation for pose in state.array_from_board])[observations.pose]
    start = _RIGID * len(state.array_from_board)
    blocks = [
        (rigid_columns(points, by_point), _RIGID * observations.pose),
        (by_point @ turns, start + 3 * observations.corner),
        (own, start + state.corners.size + MOTION * observations.device),
    ]
    rows_of, columns, values_of = [], [], []
    for block, first in blocks:
        size = block.shape[2]
        row = 2 * np.arange(total)[:, None, None] + np.arange(2)[None, :, None]
        column = first[:, None, None] + np.arange(size)[None, None, :]
        rows_of.append(np.broadcast_to(row, block.shape).ravel())
        columns.append(np.broadcast_to(column, block.shape).ravel())
        values_of.append(block.ravel())
    entries = (np.concatenate(values_of), (np.concatenate(rows_of), np.concatenate(columns)))
    width = start + state.corners.size + MOTION * len(state.cameras)
    return own, scipy.sparse.csr_array(entries, shape=(2 * total, width)), miss
