"""The fit behind a drift check: board poses, its shape, and motions of the devices not still."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Ints
from capture.camera import CameraArray
from capture.errors import TakeError, raise_all
from capture.pose import Pose
from capture.settings import check_ranges
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.calibration.drift_report import Verdict
from recon.calibration.drift_system import (
    MOTION,
    DriftLimits,
    DriftState,
    DriftSystem,
    drift_system,
    inflation,
    still_devices,
)
from recon.calibration.view_poses import ViewPose, view_noise, view_poses

FEWEST = 3  # devices, to tell which one has moved
_STEPS = 12
_CHOICES = 5  # steps at most at which the still devices are chosen anew ...
_CHOICE_PX = 0.01  # ... as long as steps are larger than this
_SETTLED_PX = 3e-4
_FAR_PX = 10.0  # a device further off than this starts where its own views put it
_LEAST_SHARE = 1e-3  # a step after which the residual is larger than at the start is shortened
_FOCAL = 6  # place of the focal length in a motion


@dataclass(frozen=True, kw_only=True)
class DriftSettings:
    """How an array is compared with its calibration.

    Attributes:
        max_blur_px: views with wider edges (standard deviation, px) are refused.
        max_poses: of more board poses, so many are used.
        least_poses: a take with fewer usable board poses is refused; 3 to 10 are good.
        least_views: a device that saw the board at fewer poses is not judged.
        lens_views: a lens is solved anew from no fewer board poses than this.
        outlier_sigmas: corners further off than this many robust deviations are dropped.
        board_sigma_mm: how far a corner of the board may stand from its nominal place.
        significant: a motion this many of its deviations from none counts (Mahalanobis, 6 degrees
            of freedom) ...
        least_px: ... if it also displaces the device's corners in its image by this much, rms.
    """

    max_blur_px: float = 3.0
    max_poses: int = 30
    least_poses: int = 3
    least_views: int = 2
    lens_views: int = 8
    outlier_sigmas: float = 4.5
    board_sigma_mm: float = 0.2
    significant: float = 6.5
    least_px: float = 0.05

    def __post_init__(self) -> None:
        check_ranges(
            "drift", self, max_blur_px=(0.5, 100.0), max_poses=(3, 1000), least_poses=(1, 1000),
            least_views=(1, 1000), lens_views=(3, 1000), outlier_sigmas=(2.0, 100.0),
            board_sigma_mm=(1e-4, 10.0), significant=(3.0, 1000.0), least_px=(0.0, 100.0),
        )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class DriftFit:
    """The array as it stands now, and which devices kept still.

    Attributes:
        system: normal equations around the answer, which is its `state`.
        observations: sightings used, devices in the order of the cameras.
        still: (C,) devices that the others are compared with.
        eligible: (C,) devices that saw enough to be judged.
        lens: (C,) moved devices whose focal length has changed.
        views: (C,) poses at which each saw the board together with another.
        sigma_px: (C,) noise of a corner, per coordinate.
        inflation: by how much motions scatter beyond their deviations.
    """

    system: DriftSystem
    observations: BoardObservations
    still: Bools
    eligible: Bools
    lens: Bools
    views: Ints
    sigma_px: Floats
    inflation: float

    @property
    def verdict(self) -> Verdict:
        """Whether all kept still, fewer than half moved, or none can be called the moved one."""
        still, able = int((self.still & self.eligible).sum()), int(self.eligible.sum())
        return "still" if still == able else "moved" if 2 * still > able else "anew"


def matched(
    cameras: CameraArray, observations: BoardObservations, shape: BoardShape
) -> tuple[BoardObservations, tuple[str, ...]]:
    """The sightings with devices in the order of the cameras, and the names that have no camera.

    Corners of a flat board whose place on the body is not known beforehand are left out.

    Raises:
        TakeError: naming every device whose images have another size than calibrated, or both
            lists of names when nearly none is in both.
    """
    names = observations.device_names
    common = [name for name in names if name in cameras.names]
    if len(common) < FEWEST:
        raise TakeError(
            f"the take does not fit the cameras: {len(common)} of its devices "
            f"({', '.join(names)}) are among the calibrated ones ({', '.join(cameras.names)}); at "
            f"least {FEWEST} are needed: are they those of this array?"
        )
    problems = [
        f"{name}: images are {size[0]} x {size[1]} px, calibrated were "
        f"{cameras.by_name(name).width} x {cameras.by_name(name).height}"
        for name, size in zip(names, observations.sizes, strict=True)
        if name in cameras.names
        and size != (cameras.by_name(name).width, cameras.by_name(name).height)
    ]
    raise_all("the take does not fit the cameras", problems, TakeError)
    place = np.array([cameras.names.index(n) if n in cameras.names else -1 for n in names])
    keep = place[observations.device] >= 0
    keep &= shape.placed[shape.face[observations.corner]]  # of a board whose place is known
    return BoardObservations(
        device_names=cameras.names, sizes=tuple((c.width, c.height) for c in cameras),
        frames=observations.frames, device=place[observations.device[keep]],
        pose=observations.pose[keep], corner=observations.corner[keep],
        pixels=observations.pixels[keep],
    ), tuple(n for n in names if n not in cameras.names)  # fmt: skip


def check_counts(
    cameras: CameraArray, observations: BoardObservations, settings: DriftSettings
) -> None:
    """Refuse sightings that cannot tell which device has moved.

    Raises:
        TakeError: with the poses by device.
    """
    views = _linked_views(observations)
    seen = observations.view_counts() > 0
    poses = int((seen.sum(axis=0) > 1).sum())
    problems = []
    if poses < settings.least_poses:
        problems.append(
            f"two devices or more saw the board at {poses} poses; at least {settings.least_poses} "
            "are needed, 5 to 10 are good"
        )
    able = int((views >= settings.least_views).sum())
    if able < FEWEST:
        told = ", ".join(f"{n} {v}" for n, v in zip(cameras.names, views.tolist(), strict=True))
        problems.append(
            f"{able} devices saw the board together with others at {settings.least_views} poses "
            f"or more; at least {FEWEST} are needed to tell which has moved (poses by device: "
            f"{told})"
        )
    raise_all("too little of the board was seen to check the array", problems, TakeError)


def fit_drift(
    cameras: CameraArray,
    observations: BoardObservations,
    nominal: Floats,
    settings: DriftSettings,
    forced: tuple[int, ...] = (),
) -> DriftFit:
    """Fit poses, shape and motions; twice, as the shape found tells outliers from a bent board.

    Args:
        cameras: as calibrated.
        observations: sightings, devices in the order of the cameras.
        nominal: (N, 3) the board, mm.
        settings: limits.
        forced: devices that may move in any case and have no say.

    Raises:
        TakeError: when too little is left after outliers.
    """
    shape, state = nominal, None
    views: list[ViewPose] = []
    for _ in range(2):
        views = view_poses(cameras, observations, shape, views)
        noise = view_noise(views, observations, settings.outlier_sigmas)
        used = observations.select(noise.kept)
        linked = _linked_views(used)
        eligible = linked >= settings.least_views
        eligible[list(forced)] = False
        if eligible.sum() < 2 or len(np.unique(used.pose)) < settings.least_poses:
            check_counts(cameras, used, settings)
            others = ", ".join(cameras.names[index] for index in forced)
            raise TakeError(
                f"{int(eligible.sum())} devices beside {others} saw enough of the board; at least "
                "2 are needed"
            )
        sigma = np.fmax(noise.sigma_px, np.nanmedian(noise.sigma_px))
        if state is None:
            state = _start(cameras, views, used, nominal)
        settled = _settled(state, used, sigma, eligible, (nominal, settings))
        state, shape = settled.system.state, settled.system.state.corners
    return dataclasses.replace(settled, views=linked)


def board_factor(
    cameras: CameraArray,
    observations: BoardObservations,
    nominal: Floats,
    settings: DriftSettings,
) -> float:
    """The size of the board, over that in its file, at which all devices agree best."""
    factor = 1.0
    everyone = np.ones(len(cameras), dtype=np.bool_)
    for _ in range(4):
        views = view_poses(cameras, observations, factor * nominal)
        noise = view_noise(views, observations, settings.outlier_sigmas)
        used = observations.select(noise.kept)
        sigma = np.fmax(noise.sigma_px, np.nanmedian(noise.sigma_px))
        state = _start(cameras, views, used, factor * nominal)
        state = dataclasses.replace(state, motions=np.zeros_like(state.motions))
        limit_px = max(_typical_px(state, used), _FAR_PX)
        for _ in range(3):
            system = drift_system(state, used, sigma, factor * nominal, settings.board_sigma_mm)
            state = _stepped(system, np.zeros_like(state.motions), used, limit_px)
        growth, _ = system.growth(everyone)
        factor /= float(np.clip(1.0 + growth, 0.5, 2.0))
    return factor


def _settled(
    state: DriftState,
    used: BoardObservations,
    sigma: Floats,
    eligible: Bools,
    terms: tuple[Floats, DriftSettings],
) -> DriftFit:
    """Gauss-Newton steps, choosing the still devices anew at the first of them."""
    nominal, settings = terms
    limits = DriftLimits(significant=settings.significant, least_px=settings.least_px)
    lens = np.zeros(len(eligible), dtype=np.bool_)
    still, change = eligible, np.inf
    limit_px = max(_typical_px(state, used), _FAR_PX)
    for step in range(_STEPS):
        system = drift_system(state, used, sigma, nominal, settings.board_sigma_mm)
        if step < _CHOICES and change > _CHOICE_PX:
            still, _ = still_devices(system, eligible, limits)
            wider = inflation(system, still, eligible, settings.least_px)
            lens = _changed_lenses(system, eligible & ~still, still, wider * settings.significant)
        free = np.repeat(~still, MOTION).reshape(-1, MOTION)
        free[:, _FOCAL] = lens
        motions = system.motions(free)
        change = max(
            system.effect_px(index, motions[index] - state.motions[index])
            for index in range(len(eligible))
        )
        state = _stepped(system, motions, used, limit_px)
        if state is system.state or (step >= 1 and change < _SETTLED_PX):
            break
    system = drift_system(state, used, sigma, nominal, settings.board_sigma_mm)
    return DriftFit(
        system=system, observations=used, still=still, eligible=eligible, lens=lens,
        views=np.zeros(len(eligible), dtype=np.int64), sigma_px=sigma,
        inflation=inflation(system, still, eligible, settings.least_px),
    )  # fmt: skip


def _stepped(
    system: DriftSystem, motions: Floats, used: BoardObservations, limit_px: float
) -> DriftState:
    """As far towards these motions (C, 7) as the usual residual stays below a limit: mostly all."""
    share = 1.0
    while share > _LEAST_SHARE:
        state = system.stepped(motions, share)
        if _typical_px(state, used) <= limit_px:
            return state
        share *= 0.5
    return system.state


def _typical_px(state: DriftState, used: BoardObservations) -> float:
    size = np.linalg.norm(state.array_state().residuals(used), axis=1)
    return float(np.median(np.nan_to_num(size, nan=np.inf)))


def _changed_lenses(system: DriftSystem, moved: Bools, still: Bools, limit_sigmas: float) -> Bools:
    """Moved devices whose focal length has changed for certain."""
    tests = system.tests(still, MOTION)
    sure = [abs(m[_FOCAL]) > limit_sigmas * np.sqrt(c[_FOCAL, _FOCAL]) for m, c in tests]
    return moved & np.array(sure, dtype=np.bool_)


def _start(
    cameras: CameraArray, views: list[ViewPose], used: BoardObservations, corners: Floats
) -> DriftState:
    """Board poses that most devices agree with, and motions of those that do not at all."""
    poses = []
    for pose in range(len(used.frames)):
        mine = [view for view in views if view.pose == pose]
        best, least = Pose.identity(), np.inf
        for view in mine:
            array_from_camera = cameras[view.device].camera_from_world.inverse()
            for candidate in view.candidates:
                option = array_from_camera @ candidate
                points = option.apply(corners)
                misses = sorted(_miss(cameras, other, points, used) for other in mine)
                if misses[len(misses) // 2] < least:
                    best, least = option, misses[len(misses) // 2]
        poses.append(best)
    motions = np.zeros((len(cameras), MOTION))
    state = DriftState(
        cameras=cameras, motions=motions, array_from_board=tuple(poses), corners=corners
    )
    points = state.array_state().points(used)
    for device, camera in enumerate(cameras):
        rows = used.device == device
        options = [Pose.identity()] + [
            candidate @ (camera.camera_from_world @ poses[view.pose]).inverse()
            for view in views
            if view.device == device
            for candidate in view.candidates
        ]
        costs = []
        for now_from_then in options if rows.any() else []:
            seen = camera.posed(now_from_then @ camera.camera_from_world).project(points[rows])
            miss = np.linalg.norm(seen - used.pixels[rows], axis=1)
            costs.append(float(np.median(np.nan_to_num(miss, nan=np.inf))))
        if costs and costs[0] > _FAR_PX:
            nearest = options[int(np.argmin(costs))]
            motions[device, :3] = nearest.rotation_vector()
            motions[device, 3:6] = nearest.translation
    return dataclasses.replace(state, motions=motions)


def _miss(
    cameras: CameraArray, view: ViewPose, points: Floats, observations: BoardObservations
) -> float:
    rows = (observations.device == view.device) & (observations.pose == view.pose)
    if not rows.any():
        return float("inf")
    seen = cameras[view.device].project(points[observations.corner[rows]])
    size = np.linalg.norm(seen - observations.pixels[rows], axis=1)
    return float(np.median(np.nan_to_num(size, nan=np.inf)))


def _linked_views(observations: BoardObservations) -> Ints:
    """At how many poses (C,) each device saw the board together with another device."""
    seen = observations.view_counts() > 0
    together: Ints = (seen & (seen.sum(axis=0) > 1)).sum(axis=1)
    return together
