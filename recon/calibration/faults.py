"""Devices whose pictures do not fit those of the others: which, and what is wrong with them.

A device is suspected when the others agree among themselves where they stand and not with it. The
board's motion, as the others saw it, is then laid before the suspect: as it is, some frames earlier
or later, and in two parts, to tell a device that was started late from one that was moved, or one
whose pictures were exchanged with those of another.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.optimize

from capture.arrays import Bools, Floats, Ints
from capture.camera import Camera, CameraArray
from capture.pose import Pose
from recon.calibration.chain import Links

_STRONG = 0.6  # share of the board poses two devices share that must agree
_LEAST_SHARED = 4  # board poses two devices must share before they are compared
_LONGEST_SHIFT = 90  # frames a device may be early or late
_ROUGH = 0.01  # of the image: how near a corner must come to count, lenses being rough
_FITS = 0.6  # share of the corners that must come near
_SAMPLE = 400  # corners a place is fitted to
_LEAST_EACH = 4  # of each frame at least so many
_LEAST_FRAMES = 4
_LEAST_PX = 0.5  # a median miss below this is no fault
_FINE = 0.0005  # of the image: nor is one below this
_NEARLY_ALL = 0.95  # share of the frames of a device in step that fit
_CLEARLY = 0.5  # a shift must bring the median miss below this part of what it is without
_SAME_PLACE = 0.05  # of the distance to the board: two devices exchanged stand where the other did
_MOVED = 0.2  # of the distance to the board: nobody knocks a device further than this
_TRIES = 100
_MOSTLY = 0.8  # share of the frames of either stretch that must fit
_CUTS = 12  # places of a change that are tried first
_STRIDE = 3  # frames between the shifts that are tried first
_FINALISTS = 6  # shifts that are looked at closely


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviceViews:
    """What one device saw, frame by frame, and where the others had the board then.

    Attributes:
        lens: rough or solved lens; its place is not used.
        frame: (M,) frame number of each corner sighting.
        board: (M, 3) the corner in board space, mm.
        pixels: (M, 2) px.
    """

    lens: Camera
    frame: Ints
    board: Floats
    pixels: Floats


@dataclass(frozen=True, eq=False)
class _Fit:
    """A place of a device against the board poses of the others."""

    camera: Camera
    miss_px: float
    near: Bools
    frame: Ints


def odd_devices(links: Links, enough: int = _LEAST_SHARED) -> list[int]:
    """Devices that agree with none of the majority although they saw the board together.

    Args:
        links: how well the devices agree, two by two.
        enough: board poses two devices must share before they are compared.
    """
    shared = links.shared >= enough
    strong = shared & (links.agreeing >= _STRONG * np.maximum(links.shared, 1))
    groups = _components(strong)
    main = max(groups, key=lambda group: (len(group), -min(group)))
    if 2 * len(main) <= len(strong):
        return []  # no majority: nobody can be called odd
    outside = [device for group in groups if group is not main for device in group]
    return sorted(device for device in outside if shared[device, main].any())


def explain_odd(
    views: Mapping[str, DeviceViews],
    others: CameraArray,
    board_poses: dict[int, Pose],
    noise_px: float,
) -> dict[str, str]:
    """What is wrong with the suspects, in words; a suspect that fits after all is left out.

    Args:
        views: by the name of the suspect, what it saw in every frame.
        others: the devices beyond suspicion, array space.
        board_poses: by frame, where they had the board, array space, mm.
        noise_px: standard deviation of a corner, per coordinate.
    """
    if not board_poses:
        return {}
    said: dict[str, str] = {}
    split: dict[str, tuple[_Fit, _Fit, int]] = {}
    for name, seen in sorted(views.items()):
        limit = _limit(seen.lens, noise_px)
        plain = _fit(seen, board_poses, 0)
        if plain is not None:
            in_step = plain.miss_px <= limit
            if in_step and _fitting_frames(plain).mean() >= _NEARLY_ALL:
                continue
            parts = _two_places(seen, board_poses, limit)
            if parts is not None and not (
                in_step and _stray(parts[0], parts[1]) > _CLEARLY * _stray(plain)
            ):
                split[name] = parts
                continue
            if in_step:
                continue  # single frames are off, wherever it is cut: these were dropped
        shifted = _best_shift(seen, board_poses, plain, limit)
        if shifted is not None:
            frames, what = abs(shifted), "late" if shifted < 0 else "early"
            said[name] = (
                f"{name}: its pictures are {frames} frame{'s' * (frames != 1)} {what}: what it "
                f"shows at frame N the others saw at frame N {'+' if shifted > 0 else '-'} {frames}"
                "; check its trigger cable, or cut its first frames"
            )
            continue
        if np.isin(np.unique(seen.frame), list(board_poses)).sum() < _LEAST_FRAMES:
            continue  # too few to tell
        if plain is not None and _fitting_frames(plain).mean() >= _NEARLY_ALL:
            continue  # noisy, or of another lens model: it is in step, and the verdict tells it
        said[name] = (
            f"{name}: its pictures fit those of no other device, at any shift up to "
            f"{_LONGEST_SHIFT} frames: was it triggered with the others, and did its lens keep "
            "focus and zoom?"
        )
    said.update(_exchanged(split, others, board_poses))
    return said


def _components(joined: Bools) -> list[list[int]]:
    left, groups = set(range(len(joined))), []
    while left:
        group, grown = set(), {min(left)}
        while grown:
            group |= grown
            grown = {int(n) for d in grown for n in np.flatnonzero(joined[d])} - group
        groups.append(sorted(group))
        left -= group
    return groups


def _limit(lens: Camera, noise_px: float) -> float:
    """Median miss, px, that a device in step may show."""
    return max(_LEAST_PX, 6.0 * noise_px, _FINE * max(lens.width, lens.height))


def _fit(
    seen: DeviceViews,
    board_poses: dict[int, Pose],
    shift: int,
    only: Bools | None = None,
    *,
    fine: bool = True,
) -> _Fit | None:
    """The place that puts most corners near, the board taken `shift` frames later; refined."""
    there = np.isin(seen.frame + shift, list(board_poses))
    if only is not None:
        there &= only
    frames = np.unique(seen.frame[there])
    if len(frames) < _LEAST_FRAMES:
        return None
    rows = np.flatnonzero(there)
    rows = _spread(seen.frame[rows], rows)
    points = np.concatenate(
        [
            board_poses[int(frame) + shift].apply(seen.board[rows[seen.frame[rows] == frame]])
            for frame in frames
        ]
    )
    place = _ransac(seen.lens, points, seen.pixels[rows])
    if place is None:
        return None
    camera = seen.lens.posed(place)
    size = _ROUGH * max(camera.width, camera.height)
    near = _misses(camera, points, seen.pixels[rows]) < size
    if fine and near.sum() >= 12:
        camera = _refined(camera, points[near], seen.pixels[rows][near])
    miss = _misses(camera, points, seen.pixels[rows])
    return _Fit(camera, float(np.median(miss)), miss < size, seen.frame[rows])


def _spread(frame: Ints, rows: Ints) -> Ints:
    """Rows of every frame alike, about as many as are wanted in all."""
    each = max(_LEAST_EACH, _SAMPLE // len(np.unique(frame)))
    chosen = []
    for one in np.unique(frame):
        own = rows[frame == one]
        chosen.append(own[np.linspace(0, len(own) - 1, min(each, len(own))).round().astype(int)])
    return np.concatenate(chosen)


def _misses(camera: Camera, points: Floats, pixels: Floats) -> Floats:
    gap: Floats = np.linalg.norm(camera.project(points) - pixels, axis=1)
    return np.nan_to_num(gap, nan=1e6)


def _ransac(lens: Camera, points: Floats, pixels: Floats) -> Pose | None:
    ideal = lens.undistort(pixels)
    good = np.isfinite(ideal).all(axis=1)
    if good.sum() < 6:
        return None
    cv2.setRNGSeed(0)
    reach = _ROUGH * max(lens.width, lens.height) / lens.fx
    try:
        found, turn, shift, _ = cv2.solvePnPRansac(
            points[good], ideal[good], np.eye(3), None, iterationsCount=_TRIES,
            reprojectionError=float(reach), confidence=0.9999, flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
    except cv2.error:  # points that fix no pose
        return None
    if not found or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return None
    return Pose.from_rotation_vector(np.ravel(turn), np.ravel(shift))


def _refined(camera: Camera, points: Floats, pixels: Floats) -> Camera:
    """Place, focal length, principal point and k1 by robust least squares."""
    start = camera.camera_from_world

    def moved(x: Floats) -> Camera:
        place = Pose.from_rotation_vector(x[:3], 100.0 * x[3:6]) @ start
        focal = float(np.exp(np.clip(x[6], -0.5, 0.5)))
        return Camera(
            name=camera.name, width=camera.width, height=camera.height, fx=camera.fx * focal,
            fy=camera.fy * focal, cx=camera.cx + 10.0 * x[8], cy=camera.cy + 10.0 * x[9],
            distortion=camera.distortion + np.array([x[7], 0.0, 0.0, 0.0, 0.0]),
            camera_from_world=place,
        )  # fmt: skip

    def miss(x: Floats) -> Floats:
        gap = moved(x).project(points) - pixels
        return np.nan_to_num(gap, nan=1e3).ravel()

    found = scipy.optimize.least_squares(miss, np.zeros(10), loss="soft_l1", max_nfev=30)
    return moved(found.x)


def _best_shift(
    seen: DeviceViews, board_poses: dict[int, Pose], plain: _Fit | None, limit_px: float
) -> int | None:
    """By how many frames later the board must be taken to fit; None when no shift convinces."""
    span = int(np.ptp(list(board_poses))) if board_poses else 0
    reach = min(_LONGEST_SHIFT, max(span - _LEAST_FRAMES, 0))
    least = 0.4 * len(np.unique(seen.frame))
    shares: dict[int, float] = {}

    def share(shift: int) -> float:
        if shift not in shares:
            fit = _fit(seen, board_poses, shift, fine=False) if abs(shift) <= reach else None
            enough = fit is not None and len(np.unique(fit.frame)) >= least
            shares[shift] = float(fit.near.mean()) if fit is not None and enough else -1.0
        return shares[shift]

    coarse = sorted(range(-reach, reach + 1, _STRIDE), key=lambda s: (-share(s), abs(s)))
    for middle in coarse[:_FINALISTS]:
        for shift in range(middle - _STRIDE + 1, middle + _STRIDE):
            share(shift)
    best: tuple[float, int] | None = None
    for shift in sorted(shares, key=lambda s: (-shares[s], abs(s)))[:_FINALISTS]:
        fit = _fit(seen, board_poses, shift) if shift != 0 and shares[shift] >= _FITS else None
        if fit is not None and (best is None or fit.miss_px < best[0]):
            best = (fit.miss_px, shift)
    if best is None or best[0] > limit_px:
        return None
    if plain is not None and best[0] > _CLEARLY * plain.miss_px:
        return None
    return best[1]


def _fitting_frames(fit: _Fit) -> Bools:
    """Whether most corners of each frame, ascending, come near."""
    return np.array(
        [fit.near[fit.frame == frame].mean() >= _FITS for frame in np.unique(fit.frame)]
    )


def _stray(*fits: _Fit) -> int:
    """How many frames do not fit."""
    return int(sum((~_fitting_frames(fit)).sum() for fit in fits))


def _two_places(
    seen: DeviceViews, board_poses: dict[int, Pose], limit_px: float
) -> tuple[_Fit, _Fit, int] | None:
    """Two places that each explain one stretch of the frames, and the frame of the change."""
    frames = np.unique(seen.frame[np.isin(seen.frame, list(board_poses))])
    cuts = np.arange(_LEAST_FRAMES, len(frames) - _LEAST_FRAMES + 1)
    if not len(cuts):
        return None
    change, best = 0, -1.0
    for stride in (max(1, len(cuts) // _CUTS), 1):
        near = cuts[::stride] if stride > 1 or best < 0 else _around(frames, cuts, change)
        for cut in near.tolist():
            fits = _split_fits(seen, board_poses, int(frames[cut]), fine=False)
            agreed = float(sum(_fitting_frames(fit).sum() for fit in fits))
            if len(fits) == 2 and agreed > best:
                change, best = int(frames[cut]), agreed
    if best < 0:
        return None
    fits = _split_fits(seen, board_poses, change, fine=True)
    if len(fits) < 2 or max(fit.miss_px for fit in fits) > limit_px:
        return None
    if min(_fitting_frames(fit).mean() for fit in fits) < _MOSTLY:
        return None
    return fits[0], fits[1], change


def _around(frames: Ints, cuts: Ints, change: int) -> Ints:
    """The cuts next to a change found on a coarse grid."""
    reach = max(1, len(cuts) // _CUTS)
    near: Ints = cuts[np.abs(cuts - np.searchsorted(frames, change)) < reach]
    return near


def _split_fits(
    seen: DeviceViews, board_poses: dict[int, Pose], change: int, *, fine: bool
) -> list[_Fit]:
    parts = [
        _fit(seen, board_poses, 0, only, fine=fine)
        for only in (seen.frame < change, seen.frame >= change)
    ]
    return [fit for fit in parts if fit is not None]


def _exchanged(
    split: dict[str, tuple[_Fit, _Fit, int]], others: CameraArray, board_poses: dict[int, Pose]
) -> dict[str, str]:
    """Words for devices with two places: exchanged with another, or moved."""
    middle = np.mean([pose.translation for pose in board_poses.values()], axis=0)
    stands = {name: (before, after) for name, (before, after, _) in split.items()}
    said: dict[str, str] = {}
    for name, (before, after, change) in split.items():
        reach = _SAME_PLACE * float(np.linalg.norm(before.camera.centre - middle))
        partners = [
            other for other, (first, second) in stands.items()
            if other != name and (_gap(after, first.camera) < reach)
            and (_gap(before, second.camera) < reach)
        ]  # fmt: skip
        partners += [
            camera.name
            for camera in others
            if min(_gap(before, camera), _gap(after, camera)) < reach
        ]
        if partners:
            pair = sorted((name, partners[0]))
            when = min(split[device][2] for device in pair if device in split)
            said[name] = (
                f"{pair[0]} and {pair[1]}: their pictures are exchanged from frame {when} on: "
                "put each device's files back under its own name"
            )
            continue
        far = float(np.linalg.norm(before.camera.centre - after.camera.centre))
        turn = after.camera.camera_from_world @ before.camera.camera_from_world.inverse()
        degrees = float(np.degrees(np.linalg.norm(turn.rotation_vector())))
        if far > _MOVED * float(np.linalg.norm(before.camera.centre - middle)):
            said[name] = (
                f"{name}: from frame {change} on its pictures fit a place {far:.0f} mm away: were "
                "they exchanged with those of another device?"
            )
            continue
        said[name] = (
            f"{name}: it was moved at frame {change}, by {far:.1f} mm and {degrees:.2f} degrees: "
            "fasten it and take the board again"
        )
    return said


def _gap(fit: _Fit, camera: Camera) -> float:
    return float(np.linalg.norm(fit.camera.centre - camera.centre))
