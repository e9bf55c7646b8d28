"""From corner sightings to a calibrated array: guess, adjustment, outliers, board shape, check."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats
from capture.errors import SettingsError, SolveError, TakeError, raise_all
from capture.progress import Progress, silent
from capture.settings import check_ranges
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.board.view_check import check_upright, check_views
from recon.calibration.board_places import place_boards
from recon.calibration.chain import first_guess
from recon.calibration.covariance import ArrayCovariance, array_covariance
from recon.calibration.exchanged import find_exchange
from recon.calibration.faults import odd_devices
from recon.calibration.gauge import regauged
from recon.calibration.geometry import ball_points
from recon.calibration.held_out import HeldOut, held_out
from recon.calibration.nominal_lenses import nominal_lenses
from recon.calibration.split_half import SplitHalf, split_half
from recon.calibration.suspects import explain_suspects
from recon.calibration.world import BOARD_STANDS, IMAGE_UP, ArrayWorld, array_world
from recon.colmap import Adjustment, AdjustOptions, adjust_array

_NORMAL_MAD = 1.4826  # standard deviation over median absolute deviation, for normal noise
_LEAST_SIGMA_PX = 0.01  # noise-free corners must not all become outliers
_POOR = 0.5  # a view of which fewer corners fit the rest is bad
_BAD_VIEWS, _BAD_SHARE = 2, 0.1  # a device with so many of them is looked into
_ODD = 3.0  # so is one whose residual is this many times the median of the devices
_ODD_PX = 1.0  # unless it is below this
_MOST_ODD = 4  # devices that are left out one after the other
_STAGES = 6
_APART = "devices do not fit the others"

Adjuster = Callable[[ArrayState, BoardObservations], ArrayState]


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings:
    """How a board take is turned into cameras.

    Attributes:
        focal_guess: focal length over image width, of all devices; None finds it from the views.
        min_corners: views with fewer corners are refused.
        max_blur_px: views with wider edges (standard deviation, px) are refused.
        still_px: frames where no corner moved by more than this since the last are left out.
        max_poses: of more board poses, so many are used: those that cover the devices best.
        least_views: a device that used the board in fewer frames is refused.
        least_poses: a take with fewer board poses is refused.
        loss_px: scale of the Cauchy loss.
        outlier_sigmas: corners further off than this many robust standard deviations are dropped.
        free_board: whether the board's shape is solved for as well; its size stays nominal.
        held_out: fraction of the poses left out of a second solve to check the first.
        halves: whether two halves of the poses are solved apart and compared.
        volume_mm: radius of the face volume, a ball about the point the array looks at.
        image_up: the side of the images that is up: "top", "bottom", "left", "right".
        world_frame: the frame in which the board itself stands where the world is to be; None
            takes the world from the array.
        world_board: how it stands there: "upright" on a stand, facing the array, or "lying".
        bar_tolerance: a scale bar further off its length than this fraction refuses the board file.
        leave_out: devices that are not to be calibrated.
    """

    focal_guess: float | None = None
    min_corners: int = 6
    max_blur_px: float = 3.0
    still_px: float = 0.5
    max_poses: int = 60
    least_views: int = 4
    least_poses: int = 5
    loss_px: float = 0.5
    outlier_sigmas: float = 4.0
    free_board: bool = True
    held_out: float = 0.15
    halves: bool = True
    volume_mm: float = 120.0
    image_up: str = "top"
    world_frame: int | None = None
    world_board: str = "upright"
    bar_tolerance: float = 1e-3
    leave_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_ranges(
            "calibrate", self, min_corners=(4, 1000), max_blur_px=(0.5, 100.0),
            still_px=(0.0, 100.0), max_poses=(3, 10000), least_views=(2, 10000),
            least_poses=(3, 10000), loss_px=(0.01, 100.0), outlier_sigmas=(2.0, 100.0),
            held_out=(0.0, 0.5), volume_mm=(1.0, 10000.0), bar_tolerance=(0.0, 1.0),
        )  # fmt: skip
        problems: list[str] = []
        if self.focal_guess is not None and not 0.2 <= self.focal_guess <= 50.0:
            problems.append(
                "focal_guess: focal length over image width must lie in 0.2..50, "
                f"found {self.focal_guess}"
            )
        if self.max_poses < self.least_poses:
            problems.append(
                f"max_poses: {self.max_poses} is below least_poses = {self.least_poses}"
            )
        if self.image_up not in IMAGE_UP:
            problems.append(f"image_up: one of {', '.join(IMAGE_UP)}, found {self.image_up!r}")
        if self.world_board not in BOARD_STANDS:
            problems.append(
                f"world_board: one of {', '.join(BOARD_STANDS)}, found {self.world_board!r}"
            )
        raise_all("calibrate settings", problems, SettingsError)


@dataclass(frozen=True, eq=False, kw_only=True)
class ArraySolution:
    """A calibrated array and all that its report tells.

    Attributes:
        state: cameras and board poses in the world, and the shape of the board, mm.
        observations: every sighting that was offered.
        kept: (M,) which of them the final solve used.
        residuals: (M, 2) predicted minus observed, px; NaN behind a camera.
        sigma_px: robust standard deviation of a residual, per coordinate.
        shape: the nominal board.
        limit_px: (M,) the size of residual beyond which a sighting was dropped.
        covariance: of lenses, places and board shape; None when they are not determined.
        split_half: how two solves from disjoint halves of the poses differ.
        held_out: the check with poses left out.
        world: how the world was chosen.
        converged: whether the last adjustment met its stopping rule.
    """

    state: ArrayState
    observations: BoardObservations
    kept: Bools
    residuals: Floats
    sigma_px: float
    shape: BoardShape
    limit_px: Floats
    covariance: ArrayCovariance | None
    held_out: HeldOut
    split_half: SplitHalf
    world: ArrayWorld
    converged: bool

    @property
    def focal_sigma(self) -> Floats:
        """Standard deviations (C, 2) of fx and fy, px; NaN when not determined."""
        if self.covariance is None:
            return np.full((len(self.state.cameras), 2), np.nan)
        return self.covariance.lens_sigma[:, :2]


def solve_array(
    observations: BoardObservations,
    shape: BoardShape | Floats,
    settings: CalibrateSettings,
    *,
    every: BoardObservations | None = None,
    progress: Progress = silent,
) -> ArraySolution:
    """Calibrate lenses and places of an array from sightings of a moving board.

    Nominal lenses and a chain of board poses start a bundle adjustment with the board held flat;
    what does not fit is dropped, the board's shape is released, and everything is adjusted again.

    Args:
        observations: corner sightings.
        shape: the nominal board; corners (N, 3), mm, at Z = 0 stand for one flat board.
        settings: of the stage.
        every: sightings of all frames, to tell by how many frames a device is late; the
            observations themselves when None.
        progress: told after each step.

    Raises:
        TakeError: naming every device that saw too little of the board, whose images are mirrored,
            that is out of step, moved or exchanged with another.
        SolveError: when the devices do not hang together, or the solve fails.
    """
    shape = shape if isinstance(shape, BoardShape) else BoardShape.flat_board(shape)
    every = observations if every is None else every
    check_views(observations, settings.least_poses, settings.least_views)
    check_upright(observations, shape)
    progress(0, _STAGES, "array")
    guess = first_guess(observations, shape, settings.focal_guess)
    odd = odd_devices(guess.links)
    if odd:
        _look_into(odd, observations, every, shape, settings)
    progress(1, _STAGES, "array")
    found, kept = _settled(guess.state, observations, shape, settings, progress)
    kept, limit, sigma = _inliers(found.state, observations, settings.outlier_sigmas)
    poor = [c for c in _poor_devices(found.state, observations, kept) if c not in odd]
    if poor:
        _look_into(poor[:1], observations, every, shape, settings)
    used = observations.select(kept)
    middle = shape.corners.mean(axis=0)[None]
    poses = [found.state.array_from_board[pose] for pose in np.unique(used.pose).tolist()]
    places = np.concatenate([pose.apply(middle) for pose in poses])
    world = array_world(found.state.cameras, places, settings.image_up)
    final = found.state.moved(world.world_from_array)
    adjust, refit = _adjusters(shape, settings)
    check = held_out(final, used, adjust, refit, settings.held_out, settings.least_views)
    progress(5, _STAGES, "array")
    halves = SplitHalf(remark="switched off")
    if settings.halves:
        volume = ball_points(np.zeros(3), settings.volume_mm)
        halves = split_half(final, used, adjust, volume, settings.least_views)
    covariance = array_covariance(final, used, shape if settings.free_board else None, sigma)
    progress(_STAGES, _STAGES, "array")
    return ArraySolution(
        state=final, observations=observations, kept=kept, residuals=final.residuals(observations),
        sigma_px=sigma, shape=shape, limit_px=limit, covariance=covariance, held_out=check,
        split_half=halves, world=world, converged=found.converged,
    )  # fmt: skip


def _settled(
    state: ArrayState,
    observations: BoardObservations,
    shape: BoardShape,
    settings: CalibrateSettings,
    progress: Progress = silent,
) -> tuple[Adjustment, Bools]:
    """From a first guess to the adjusted array, and the sightings it used."""
    rough = _typical(state.residuals(observations))
    if not np.isfinite(rough):
        raise SolveError("no start was found that puts the board before the devices that saw it")
    wide = AdjustOptions(loss_px=max(settings.loss_px, _NORMAL_MAD * rough))
    state = adjust_array(state, observations, wide).state
    progress(2, _STAGES, "array")
    options = AdjustOptions(loss_px=settings.loss_px, free_board=settings.free_board)
    for step in (3, 4):
        kept, _, _ = _inliers(state, observations, settings.outlier_sigmas)
        found = _adjust(state, observations.select(kept), options, shape)
        state = found.state
        progress(step, _STAGES, "array")
    return found, kept


def _look_into(
    odd: list[int],
    observations: BoardObservations,
    every: BoardObservations,
    shape: BoardShape,
    settings: CalibrateSettings,
) -> None:
    """Solve the devices that agree alone, and say what is wrong with the others.

    Raises:
        TakeError: naming every one of them that does not fit the others.
    """
    lenses = nominal_lenses(observations, shape, settings.focal_guess)
    exchange = find_exchange(lenses, every, shape)
    if exchange is not None:
        raise TakeError(f"{_APART}: {exchange.words(observations.device_names)}")
    odd = list(odd)
    for _ in range(_MOST_ODD):
        fine = [c for c in range(len(observations.device_names)) if c not in odd]
        healthy = observations.of_devices(fine)
        guess = first_guess(healthy, shape, settings.focal_guess)
        found, _ = _settled(guess.state, healthy, shape, settings)
        kept, _, sigma = _inliers(found.state, healthy, settings.outlier_sigmas)
        poor = _poor_devices(found.state, healthy, kept)
        if not poor or 2 * len(odd) >= len(fine):
            break
        odd.append(fine[poor[0]])
    said = explain_suspects(found.state, lenses, every, sigma, shape)
    raise_all(_APART, list(dict.fromkeys(said.values())), TakeError)


def _poor_devices(state: ArrayState, observations: BoardObservations, kept: Bools) -> list[int]:
    """Devices some of whose views do not fit, or far worse than the others', worst first."""
    residuals = state.residuals(observations)
    rows = [observations.device == c for c in range(len(observations.device_names))]
    sizes = np.array([_typical(residuals[own]) for own in rows])
    bad, views = np.zeros((2, len(rows)))
    for device, _, own in observations.views():
        views[device] += 1
        bad[device] += kept[own].mean() < _POOR
    odd = sizes > max(_ODD * float(np.median(sizes)), _ODD_PX)
    poor = np.flatnonzero(odd | (bad >= np.maximum(_BAD_VIEWS, _BAD_SHARE * views)))
    if 2 * len(poor) >= len(rows):
        return []
    worst: list[int] = poor[np.argsort(-(bad / views + odd)[poor], kind="stable")].tolist()
    return worst


def _adjusters(shape: BoardShape, settings: CalibrateSettings) -> tuple[Adjuster, Adjuster]:
    """How to solve everything, and board poses alone, from a start and sightings."""
    options = AdjustOptions(loss_px=settings.loss_px, free_board=settings.free_board)

    def refit(start: ArrayState, seen: BoardObservations) -> ArrayState:
        placed = np.ones(shape.face_count, dtype=np.bool_)
        solved = dataclasses.replace(shape, corners=start.corners, placed=placed)
        poses = list(start.array_from_board)
        for place in place_boards(seen, solved, start.cameras, poses):
            poses[place.pose] = place.world_from_board
        return ArrayState(start.cameras, tuple(poses), start.corners)

    return lambda start, seen: _adjust(start, seen, options, shape).state, refit


def _adjust(
    state: ArrayState, used: BoardObservations, options: AdjustOptions, shape: BoardShape
) -> Adjustment:
    """Adjust on these sightings; the board keeps its nominal size and place."""
    counts = (used.view_counts() > 0).sum(axis=1)
    lost = [name for name, n in zip(used.device_names, counts, strict=True) if n < 2]
    if lost:
        raise SolveError(
            f"{', '.join(lost)}: nearly no corner agrees with the rest of the array; "
            "were all devices triggered together, and is the board file that of this board?"
        )
    found = adjust_array(state, used, options)
    if not options.free_board:
        return found
    return Adjustment(regauged(found.state, shape, np.unique(used.corner)), found.converged)


def _inliers(
    state: ArrayState, observations: BoardObservations, sigmas: float
) -> tuple[Bools, Floats, float]:
    """Which residuals lie within the robust limit of their device, the limits, and the sigma."""
    residuals = state.residuals(observations)
    size = np.linalg.norm(residuals, axis=1)
    whole = _NORMAL_MAD * _typical(residuals)
    limit = np.empty(len(observations))
    for device in range(len(observations.device_names)):
        rows = observations.device == device
        own = _NORMAL_MAD * _typical(residuals[rows])
        limit[rows] = sigmas * max(min(own, 3.0 * whole), _LEAST_SIGMA_PX)
    return size <= limit, limit, whole


def _typical(residuals: Floats) -> float:
    """Median size of a coordinate, px; infinity when every corner fell behind its camera."""
    finite = np.abs(residuals[np.isfinite(residuals)])
    return float(np.median(finite)) if len(finite) else float("inf")
