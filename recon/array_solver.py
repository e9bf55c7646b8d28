"""From corner sightings to a calibrated array: guess, adjustment, outliers, board shape, check."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, check_shape
from capture.errors import SettingsError, SolveError, TakeError, raise_all
from capture.progress import Progress, silent
from capture.settings import check_ranges
from recon.array_covariance import focal_sigma
from recon.array_state import ArrayState
from recon.array_world import IMAGE_UP, ArrayWorld, array_world
from recon.board_chain import initial_state
from recon.colmap import Adjustment, AdjustOptions, adjust_array, held_corners
from recon.observations import BoardObservations

_NORMAL_MAD = 1.4826  # standard deviation over median absolute deviation, for normal noise
_LEAST_SIGMA_PX = 0.01  # noise-free corners must not all become outliers
_HELD_PHASE = 3  # the held-out poses are every k-th, from this one
_STAGES = 6


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings:
    """How a board take is turned into cameras.

    Attributes:
        focal_guess: focal length over image width, of all devices; None finds it from the views.
        min_corners: views with fewer corners are refused.
        max_blur_px: views with wider edges (standard deviation, px) are refused.
        still_px: frames where no corner moved by more than this since the last are left out.
        max_poses: of more board poses, so many are used, evenly spread over the take.
        least_views: a device that used the board in fewer frames is refused.
        least_poses: a take with fewer board poses is refused.
        loss_px: scale of the Cauchy loss.
        outlier_sigmas: corners further off than this many robust standard deviations are dropped.
        free_board: whether the board's shape is solved for as well, three corners held.
        held_out: fraction of the poses left out of a second solve to check the first.
        image_up: the side of the images that is up: "top", "bottom", "left", "right".
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
    image_up: str = "top"

    def __post_init__(self) -> None:
        check_ranges(
            "calibrate", self, min_corners=(4, 1000), max_blur_px=(0.5, 100.0),
            still_px=(0.0, 100.0), max_poses=(3, 10000), least_views=(2, 10000),
            least_poses=(3, 10000), loss_px=(0.01, 100.0), outlier_sigmas=(2.0, 100.0),
            held_out=(0.0, 0.5),
        )  # fmt: skip
        problems: list[str] = []
        if self.focal_guess is not None and not 0.2 <= self.focal_guess <= 50.0:
            problems.append(
                "focal_guess: focal length over image width must lie in 0.2..50, "
                f"found {self.focal_guess}"
            )
        if self.image_up not in IMAGE_UP:
            problems.append(f"image_up: one of {', '.join(IMAGE_UP)}, found {self.image_up!r}")
        raise_all("calibrate settings", problems, SettingsError)


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOut:
    """How poses that a solve has not seen fit it, only their board pose being refitted.

    Attributes:
        poses: indices of the poses left out; empty when the check was not made.
        training_px: per-coordinate rms of the poses that were solved for.
        held_out_px: per-coordinate rms of those left out.
        remark: why the check was not made, or "".
    """

    poses: tuple[int, ...]
    training_px: float
    held_out_px: float
    remark: str = ""

    @property
    def ratio(self) -> float:
        """Held-out over training rms; NaN when the check was not made."""
        return self.held_out_px / self.training_px if self.poses else float("nan")


@dataclass(frozen=True, eq=False, kw_only=True)
class ArraySolution:
    """A calibrated array and all that its report tells.

    Attributes:
        state: cameras and board poses in the world, and the shape of the board, mm.
        observations: every sighting that was offered.
        kept: (M,) which of them the final solve used.
        residuals: (M, 2) predicted minus observed, px; NaN behind a camera.
        sigma_px: robust standard deviation of a residual, per coordinate.
        focal_sigma: (C, 2) standard deviations of fx and fy, px; NaN when not determined.
        held_out: the check with poses left out.
        world: how the world was chosen.
        converged: whether the last adjustment met its stopping rule.
    """

    state: ArrayState
    observations: BoardObservations
    kept: Bools
    residuals: Floats
    sigma_px: float
    focal_sigma: Floats
    held_out: HeldOut
    world: ArrayWorld
    converged: bool


def solve_array(
    observations: BoardObservations,
    corners: Floats,
    settings: CalibrateSettings,
    *,
    progress: Progress = silent,
) -> ArraySolution:
    """Calibrate lenses and places of an array from sightings of a moving board.

    Nominal lenses and a chain of board poses start a bundle adjustment with the board held flat;
    what does not fit is dropped, the board's shape is released, and everything is adjusted again.

    Args:
        observations: corner sightings.
        corners: (N, 3) nominal corners of the board, board space, mm, flat at Z = 0.
        settings: of the stage.
        progress: told after each step.

    Raises:
        TakeError: naming every device that saw too little of the board.
        SolveError: when the devices do not hang together, or the solve fails.
    """
    check_shape(corners=(corners, "N 3"))
    check_views(observations, settings)
    progress(0, _STAGES, "array")
    state = initial_state(observations, corners, settings.focal_guess)
    rough = _typical(state.residuals(observations))
    progress(1, _STAGES, "array")
    if not np.isfinite(rough):
        raise SolveError("no start was found that puts the board before the devices that saw it")
    wide = AdjustOptions(loss_px=max(settings.loss_px, _NORMAL_MAD * rough))
    state = adjust_array(state, observations, wide).state
    progress(2, _STAGES, "array")
    kept, _ = _inliers(state, observations, settings.outlier_sigmas)
    options = AdjustOptions(loss_px=settings.loss_px, free_board=settings.free_board)
    found = _adjust(state, observations, kept, options, corners)
    progress(3, _STAGES, "array")
    kept, _ = _inliers(found.state, observations, settings.outlier_sigmas)
    found = _adjust(found.state, observations, kept, options, corners)
    progress(4, _STAGES, "array")
    kept, sigma = _inliers(found.state, observations, settings.outlier_sigmas)
    used = observations.select(kept)
    check = _held_out(found.state, used, settings, options)
    progress(5, _STAGES, "array")
    held = held_corners(used, corners) if settings.free_board else None
    spread = focal_sigma(found.state, used, held, sigma)
    middle = corners.mean(axis=0)[None]
    places = np.concatenate([pose.apply(middle) for pose in found.state.array_from_board])
    world = array_world(found.state.cameras, places, settings.image_up)
    final = found.state.moved(world.world_from_array)
    progress(_STAGES, _STAGES, "array")
    return ArraySolution(
        state=final, observations=observations, kept=kept, residuals=final.residuals(observations),
        sigma_px=sigma, focal_sigma=spread, held_out=check, world=world, converged=found.converged,
    )  # fmt: skip


def check_views(
    observations: BoardObservations,
    settings: CalibrateSettings,
    tally: dict[str, dict[str, int]] | None = None,
) -> None:
    """Refuse a take in which a device, or all of them, saw too little of the board.

    Args:
        observations: usable corner sightings.
        settings: of the stage.
        tally: by device, frames used and refused by reason, for the message.

    Raises:
        TakeError: naming every such device with its counts.
    """
    poses = len(np.unique(observations.pose))
    views = (observations.view_counts() > 0).sum(axis=1)
    problems = []
    if poses < settings.least_poses:
        problems.append(
            f"the board was used at {poses} poses of {len(observations.frames)}; "
            f"at least {settings.least_poses} are needed, 15 to 40 are good"
        )
    for name, count in zip(observations.device_names, views.tolist(), strict=True):
        if count < settings.least_views:
            reasons = (tally or {}).get(name, {})
            told = ", ".join(f"{number} {reason}" for reason, number in reasons.items() if number)
            corners = int((observations.device == observations.device_names.index(name)).sum())
            problems.append(
                f"{name}: used the board in {count} frames with {corners} corners"
                + (f" ({told})" if told else "")
                + f"; at least {settings.least_views} are needed: hold the board before this device"
            )
    raise_all("devices saw too little of the board", problems, TakeError)


def _adjust(
    state: ArrayState,
    observations: BoardObservations,
    kept: Bools,
    options: AdjustOptions,
    corners: Floats,
) -> Adjustment:
    """Adjust on the kept sightings; scale then rests on all corners, not only on the held ones."""
    used = observations.select(kept)
    counts = (used.view_counts() > 0).sum(axis=1)
    lost = [name for name, n in zip(used.device_names, counts, strict=True) if n < 2]
    if lost:
        raise SolveError(
            f"{', '.join(lost)}: nearly no corner agrees with the rest of the array; "
            "were all devices triggered together, and is the board file that of this board?"
        )
    found = adjust_array(state, used, options)
    factor = board_scale(found.state.corners, corners, np.unique(used.corner))
    return Adjustment(found.state.scaled(factor), found.converged)


def board_scale(
    found: Floats, nominal: Floats, seen: np.ndarray[tuple[int], np.dtype[np.int64]]
) -> float:
    """The factor that brings the found board shape (N, 3) to the size of the nominal one (N, 3).

    Args:
        found: solved corners, mm.
        nominal: corners as measured with a ruler, mm.
        seen: ids of the corners that were solved for.

    References:
        Horn 1987, symmetric scale: the ratio of the root mean square distances from the centroids.
    """
    check_shape(found=(found, "N 3"), nominal=(nominal, "N 3"))
    spread = [np.sqrt(((x[seen] - x[seen].mean(axis=0)) ** 2).sum()) for x in (nominal, found)]
    return float(spread[0] / spread[1])


def _inliers(
    state: ArrayState, observations: BoardObservations, sigmas: float
) -> tuple[Bools, float]:
    """Which residuals lie within the robust limit of their device, and the sigma of the array."""
    residuals = state.residuals(observations)
    size = np.linalg.norm(residuals, axis=1)
    whole = _NORMAL_MAD * _typical(residuals)
    limit = np.empty(len(observations))
    for device in range(len(observations.device_names)):
        rows = observations.device == device
        own = _NORMAL_MAD * _typical(residuals[rows])
        limit[rows] = sigmas * max(min(own, 3.0 * whole), _LEAST_SIGMA_PX)
    return size <= limit, whole


def _typical(residuals: Floats) -> float:
    """Median size of a coordinate, px; infinity when every corner fell behind its camera."""
    finite = np.abs(residuals[np.isfinite(residuals)])
    return float(np.median(finite)) if len(finite) else float("inf")


def _held_out(
    state: ArrayState, used: BoardObservations, settings: CalibrateSettings, options: AdjustOptions
) -> HeldOut:
    """Solve again without every k-th pose, from the answer, and refit only those poses to it."""
    none = float("nan")
    if settings.held_out == 0:
        return HeldOut(poses=(), training_px=none, held_out_px=none, remark="switched off")
    step = max(2, round(1.0 / settings.held_out))
    poses = np.unique(used.pose)
    left = poses[min(_HELD_PHASE, step - 1) :: step]
    out = np.isin(used.pose, left)
    training, test = used.select(~out), used.select(out)
    if len(left) == 0 or ((training.view_counts() > 0).sum(axis=1) < settings.least_views).any():
        return HeldOut(
            poses=(), training_px=none, held_out_px=none, remark="too few poses to leave any out"
        )
    found = adjust_array(state, training, options).state
    fixed = AdjustOptions(loss_px=settings.loss_px, free_lenses=False, free_cameras=False)
    refit = adjust_array(found, test, fixed).state
    return HeldOut(
        poses=tuple(left.tolist()),
        training_px=_rms(found.residuals(training)),
        held_out_px=_rms(refit.residuals(test)),
    )


def _rms(residuals: Floats) -> float:
    return float(np.sqrt(np.nanmean(residuals**2)))
