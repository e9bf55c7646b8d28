"""Does an array still stand as it was calibrated: a check from a few new board poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from capture.arrays import Floats
from capture.camera import CameraArray
from capture.errors import CameraError, TakeError, raise_all
from capture.names import known_hint
from capture.pose import Pose
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.calibration.drift_fit import (
    FEWEST,
    DriftFit,
    DriftSettings,
    board_factor,
    check_counts,
    fit_drift,
    matched,
)
from recon.calibration.drift_report import DeviceDrift, DeviceVerdict, DriftReport, device_remark
from recon.calibration.drift_system import MOTION, moved_camera
from recon.colmap import AdjustOptions, adjust_array

__all__ = ["DriftSettings", "check_drift", "resolve_devices"]

_FOCAL = 6  # place of the focal length in a motion
_SAME_PLACE = 0.1  # radians, or of the way moved, by which a device stands beside another's place
_ALONG, _FEW = 0.98, 3.0  # share of a shift that is along the axis; deviations that are few


def check_drift(
    cameras: CameraArray,
    observations: BoardObservations,
    shape: BoardShape,
    settings: DriftSettings | None = None,
) -> DriftReport:
    """Compare an array with its calibration, from a few new poses of a board.

    Every device may have turned and moved, every board pose is unknown, and the board's shape may
    depart from the nominal one. Lenses are known. The largest group of devices that agree with
    each other, at least half of all, is the reference for the others, and each member of it is
    compared with the rest of it.

    Args:
        cameras: as calibrated.
        observations: corner sightings of the new take; devices are matched by name.
        shape: the board, nominal.
        settings: limits.

    Raises:
        TakeError: when poses or devices are too few, or an image has another size than calibrated.
    """
    settings = settings or DriftSettings()
    known, strangers = matched(cameras, observations, shape)
    check_counts(cameras, known, settings)
    fit = fit_drift(cameras, known, shape.corners, settings)
    factor = 1.0
    if fit.verdict == "anew":
        other = board_factor(cameras, known, shape.corners, settings)
        again = fit_drift(cameras, known, shape.corners * other, settings)
        if again.verdict != "anew":
            fit, factor = again, other
    tests = fit.system.tests(fit.still)
    focal_tests = fit.system.tests(fit.still, MOTION)
    devices = tuple(
        _device(fit, index, tests[index], focal_tests[index], settings)
        for index in range(len(cameras))
    )
    base = fit.still & fit.eligible
    growth, growth_sigma = (
        fit.system.growth(base) if base.sum() >= FEWEST else (float("nan"), float("nan"))
    )
    return DriftReport(
        verdict=fit.verdict, devices=devices, poses=len(np.unique(fit.observations.pose)),
        sigma_px=float(np.median(fit.sigma_px)), inflation=fit.inflation,
        growth=(1.0 + growth) / factor - 1.0,
        growth_sigma=growth_sigma * fit.inflation, board_factor=factor,
        limits=(settings.significant, settings.least_px), strangers=strangers,
        corners=fit.system.state.corners,
    )  # fmt: skip


def resolve_devices(
    cameras: CameraArray,
    names: Sequence[str],
    observations: BoardObservations,
    shape: BoardShape,
    settings: DriftSettings | None = None,
    *,
    lens: bool = False,
) -> CameraArray:
    """Solve the named devices anew against the others, which stay as they are to the last bit.

    Devices that are not named and have moved all the same have no say.

    Args:
        cameras: as calibrated.
        names: of the devices to solve; how far they moved does not matter.
        observations: corner sightings of the new take; devices are matched by name.
        shape: the board, nominal.
        settings: limits.
        lens: whether their lenses are solved anew as well.

    Raises:
        CameraError: for a name that the array does not have.
        TakeError: naming every device that saw too little, or when too few others are left.
        SolveError: when the adjustment fails.
    """
    settings = settings or DriftSettings()
    problems = [f"{n}: {known_hint(n, cameras.names)}" for n in names if n not in cameras.names]
    raise_all("no such camera", problems, CameraError)
    chosen = tuple(sorted({cameras.names.index(name) for name in names}))
    known, _ = matched(cameras, observations, shape)
    check_counts(cameras, known, settings)
    fit = fit_drift(cameras, known, shape.corners, settings, chosen)
    need = settings.lens_views if lens else settings.least_views
    problems = [
        f"{cameras.names[index]}: saw the board at {fit.views[index]} poses together with "
        f"others; at least {need} are needed to solve its {'lens' if lens else 'place'}"
        for index in chosen
        if fit.views[index] < need
    ]
    base = fit.still & fit.eligible
    if base.sum() < 2 or fit.verdict == "anew":
        problems.append(
            f"only {int(base.sum())} of the {int(fit.eligible.sum())} other devices that saw the "
            "board agree with each other: calibrate anew, or check the size of the board"
        )
    raise_all("cannot solve devices anew", problems, TakeError)
    part = base.copy()
    part[list(chosen)] = True
    used = fit.observations.select(part[fit.observations.device])
    state = fit.system.state
    start = dataclasses.replace(state, motions=state.motions * ~base[:, None]).array_state()
    options = AdjustOptions(free_lenses=lens, moving=chosen)
    found = adjust_array(start, used, options).state.cameras
    return CameraArray(
        tuple(found[i] if i in chosen else camera for i, camera in enumerate(cameras))
    )


def _device(
    fit: DriftFit,
    index: int,
    test: tuple[Floats, Floats],
    focal_test: tuple[Floats, Floats],
    settings: DriftSettings,
) -> DeviceDrift:
    system, camera = fit.system, fit.system.state.cameras[index]
    rows = fit.observations.device == index
    motion, covariance = focal_test if fit.lens[index] else test
    whole = np.concatenate([motion, np.zeros(MOTION - len(motion))])
    spread = np.sqrt(np.diag(focal_test[1]))[_FOCAL]
    own = fit.observations.select(rows)
    points = system.state.array_state().points(own)
    misses = [one.project(points) - own.pixels for one in (camera, moved_camera(camera, whole))]
    before, after = (_rms(miss) for miss in misses)
    shift, shift_sigma = _size(motion[3:6], covariance[3:6, 3:6])
    turn, turn_sigma = _size(motion[:3], covariance[:3, :3])
    verdict: DeviceVerdict = "still"
    remark = ""
    if not fit.eligible[index]:
        verdict = "unchecked"
        remark = (
            f"it saw the board at {fit.views[index]} poses together with another device; at least "
            f"{settings.least_views} are needed"
        )
    else:
        if not fit.still[index]:
            verdict = "lens" if fit.lens[index] else "moved"
        remark = device_remark(1e3 * shift_sigma, after, float(fit.sigma_px[index]))
        straight = abs(motion[5]) > _ALONG * shift and turn < _FEW * turn_sigma
        other = "" if verdict == "still" else _in_place_of(system.state.cameras, index, whole)
        if other:
            remark = (
                f"it stands where {other} was calibrated to stand: are the names or cables of the "
                "two exchanged?"
            )
        elif verdict == "moved" and straight and not remark:
            focal = -camera.fx * motion[5] / float(np.median(camera.depths(points)))
            remark = (
                f"it went straight along its axis, so its focus may have been touched instead "
                f"({focal:+.1f} px of focal length would look alike)"
            )
    wider = fit.inflation
    alone = not np.isfinite(covariance).all()  # the only still device is compared with nothing
    square = 0.0 if alone else float(motion @ np.linalg.solve(covariance, motion))
    return DeviceDrift(
        name=camera.name, verdict=verdict, views=int(fit.views[index]), corners=len(own),
        motion=Pose.from_rotation_vector(motion[:3], motion[3:6]), shift_um=1e3 * shift,
        shift_sigma_um=1e3 * wider * shift_sigma, turn_mdeg=1e3 * float(np.degrees(turn)),
        turn_sigma_mdeg=1e3 * wider * float(np.degrees(turn_sigma)),
        significance=float(np.sqrt(max(square, 0.0))) / wider,
        effect_px=system.effect_px(index, motion),
        focal_change_px=camera.fx * float(np.expm1(focal_test[0][_FOCAL])),
        focal_sigma_px=camera.fx * wider * float(spread), sigma_px=float(fit.sigma_px[index]),
        before_px=before, after_px=after, remark=remark,
    )  # fmt: skip


def _in_place_of(cameras: CameraArray, index: int, motion: Floats) -> str:
    """The device in whose place one stands after a motion (7,), or ""."""
    now = moved_camera(cameras[index], motion)
    way = float(np.linalg.norm(now.centre - cameras[index].centre))
    for other in cameras:
        turned = now.camera_from_world @ other.camera_from_world.inverse()
        near = np.linalg.norm(now.centre - other.centre) < _SAME_PLACE * way
        if other.name != now.name and near and _angle(turned) < _SAME_PLACE:
            return other.name
    return ""


def _angle(motion: Pose) -> float:
    return float(np.linalg.norm(motion.rotation_vector()))


def _rms(miss: Floats) -> float:
    """Root mean square of what is known; NaN when nothing is."""
    known = miss[np.isfinite(miss)]
    return float(np.sqrt((known**2).mean())) if len(known) else float("nan")


def _size(vector: Floats, covariance: Floats) -> tuple[float, float]:
    """Length of a vector, and the deviation along it."""
    length = float(np.linalg.norm(vector))
    if not np.isfinite(covariance).all():
        return length, float("inf")
    along = vector / length if length > 0 else np.array([1.0, 0.0, 0.0])
    return length, float(np.sqrt(max(float(along @ covariance @ along), 0.0)))
