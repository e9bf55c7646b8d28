"""An array compared with the same array of a previous session: one world, and what has changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from capture.arrays import Bools, Floats
from capture.camera import Camera, CameraArray
from capture.errors import CameraError
from capture.pose import Pose
from recon.calibration.geometry import nearest_to_axes, rigid_fit

_FEWEST = 3  # devices that both sessions know
_STEPS = 30
_TUKEY = 4.685
_MAD = 1.4826
_BALL = 0.12  # radius of the compared volume over the working distance
_CHANGED_PX, _CHANGED_TIMES = 0.5, 5.0  # a device is named beyond both
_SCALED = 5e-4  # a change of scale worth a word
_SURE = 4.0  # if it is beyond so many standard deviations
_SAME_PLACE = 0.25  # of the distance between two places: near enough to be there
_LENS_MARGIN = 3.0  # one pairing of lenses must be this many times nearer than the other


@dataclass(frozen=True, eq=False, kw_only=True)
class Alignment:
    """How an array stands to itself in a previous session.

    Attributes:
        world_from_array: rigid motion of the found array's space into the previous world.
        scale: lengths found over lengths then, of the devices that kept their places.
        scale_sigma: its standard deviation, by leaving out one device after the other.
        moved: by name, how far the device's centre moved (mm) and by what angle it turned (deg),
            after the motion and the scale are taken out; an exchanged device is compared with the
            place it has taken.
        effect_px: by name, rms difference of the two projections of the working volume, px; lens
            and place together, so that what they trade with each other does not show.
        swapped: cycles of names, each of which stands where the next stood; an exchange of two is
            a pair.
        lens_went_along: by the first name of a cycle, whether the lenses too have changed names
            (None where they are too alike to tell).
        unknown: names that the previous session does not have.
        missing: names that only the previous session has.
    """

    world_from_array: Pose
    scale: float
    scale_sigma: float
    moved: dict[str, tuple[float, float]]
    effect_px: dict[str, float]
    swapped: tuple[tuple[str, ...], ...]
    lens_went_along: dict[str, bool | None]
    unknown: tuple[str, ...]
    missing: tuple[str, ...]


def align_to_previous(found: CameraArray, previous: CameraArray) -> Alignment:
    """Bring a new calibration into the world of a previous one, whichever few devices moved.

    The motion that most devices agree on starts a weighted rigid alignment of the centres and of
    points on the optical axes at working distance; weights fall to none for what has moved.

    Args:
        found: in any space, mm.
        previous: in the world that is wanted, mm.

    Raises:
        CameraError: when fewer than 3 names are in both.

    References:
        Umeyama 1991, the rotation and translation of two point sets; Beaton and Tukey 1974, the
        weights; Kuhn 1955, the assignment of devices to places.
    """
    names = [name for name in found.names if name in previous.names]
    if len(names) < _FEWEST:
        raise CameraError(
            f"{len(names)} names are in both sessions ({', '.join(names) or 'none'}); at least "
            f"{_FEWEST} are needed to align them (found {', '.join(found.names)}; previous "
            f"{', '.join(previous.names)})"
        )
    now = [found.by_name(name) for name in names]
    then = [previous.by_name(name) for name in names]
    reach = _working_distance(then)
    scale = _rough_scale(now, then)
    for _ in range(2):  # the scale once more, from the devices that kept their places
        motion, kept = _align(now, then, scale, reach)
        scale = _exact_scale(now, then, kept, scale)
    motion, kept = _align(now, then, scale, reach)
    places = _places(now, then, motion, scale, reach)
    taken = [_in_previous(camera, motion, scale) for camera in now]
    goal = [then[place] for place in places]
    plain, _ = _align(now, then, 1.0, reach, kept)
    cycles = _cycles(places)
    volume = _volume(then, reach)
    return Alignment(
        world_from_array=plain,
        scale=scale,
        scale_sigma=_scale_sigma(now, then, kept),
        moved={n: _change(a, b) for n, a, b in zip(names, taken, goal, strict=True)},
        effect_px={n: _effect(a, b, volume) for n, a, b in zip(names, taken, goal, strict=True)},
        swapped=tuple(tuple(names[index] for index in cycle) for cycle in cycles),
        lens_went_along={names[cycle[0]]: _lens_went(now, then, cycle) for cycle in cycles},
        unknown=tuple(name for name in found.names if name not in previous.names),
        missing=tuple(name for name in previous.names if name not in found.names),
    )


def size_words(alignment: Alignment, square_mm: float | None = None) -> list[str]:
    """That the whole array has another size than before, in a line, if it has."""
    off = alignment.scale - 1.0
    if abs(off) <= max(_SCALED, _SURE * alignment.scale_sigma):
        return []
    way = "further" if off > 0 else "less far"
    ask = "is the size of the board in its file right?"
    if square_mm is not None:
        ask = f"is square_mm = {square_mm:.5g} right? {square_mm / alignment.scale:.4g} would fit"
    return [
        f"all devices stand {100 * abs(off):.2g} % {way} apart than in the previous session: {ask}"
    ]


def exchange_words(alignment: Alignment) -> list[str]:
    """Which devices stand where others stood, a line each exchange."""
    lines = []
    for cycle in alignment.swapped:
        stands = ", and ".join(
            f"{a} {'stands ' if i == 0 else ''}where {b} stood"
            for i, (a, b) in enumerate(zip(cycle, (*cycle[1:], cycle[0]), strict=True))
        )
        lines.append(f"{stands}: {_cause(alignment.lens_went_along[cycle[0]])}")
    return lines


def alignment_problems(alignment: Alignment, square_mm: float | None = None) -> list[str]:
    """What an operator should look at, one line each; empty when the sessions agree.

    Args:
        alignment: of the two sessions.
        square_mm: side of the board's squares in its file, to tell which one would fit.
    """
    lines = [*size_words(alignment, square_mm), *exchange_words(alignment)]
    exchanged = {name for cycle in alignment.swapped for name in cycle}
    typical = float(np.median(list(alignment.effect_px.values())))
    limit = max(_CHANGED_PX, _CHANGED_TIMES * typical)
    for name, (shift_mm, turn_deg) in alignment.moved.items():
        effect = alignment.effect_px[name]
        if not effect <= limit:
            where = " (beside the place it has taken)" if name in exchanged else ""
            told = f"{effect:.1f} px" if np.isfinite(effect) else "many px"
            lines.append(
                f"{name} has moved by {shift_mm:.2g} mm and turned by {turn_deg:.2g} deg since the "
                f"previous session{where}: {told} in its image, {typical:.1f} px for the others"
            )
    if alignment.unknown:
        lines.append(f"{', '.join(alignment.unknown)}: not in the previous session")
    if alignment.missing:
        lines.append(f"{', '.join(alignment.missing)}: in the previous session only")
    return lines


def _cause(lens_went_along: bool | None) -> str:
    if lens_went_along is None:
        return "their cables or names are swapped, or the devices themselves"
    if lens_went_along:
        return "their cables or names are swapped"
    return "the devices have changed places (each has kept its lens)"


def _axes(cameras: Sequence[Camera]) -> Floats:
    return np.stack([camera.camera_from_world.rotation[2] for camera in cameras])


def _centres(cameras: Sequence[Camera]) -> Floats:
    return np.stack([camera.centre for camera in cameras])


def _meeting_point(cameras: Sequence[Camera]) -> Floats | None:
    """The point nearest to all optical axes, or None where they do not converge."""
    centres, axes = _centres(cameras), _axes(cameras)
    point = nearest_to_axes(centres, axes)
    if point is None:
        return None
    ahead = np.einsum("ci,ci->c", point - centres, axes) > 0
    return point if ahead.mean() > 0.5 else None


def _working_distance(cameras: Sequence[Camera]) -> float:
    """How far before the devices their subject is; where axes are parallel, the array's extent."""
    centres = _centres(cameras)
    point = _meeting_point(cameras)
    if point is not None:
        return float(np.median(np.linalg.norm(centres - point, axis=1)))
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    return extent if extent > 0 else 1000.0


def _rough_scale(now: Sequence[Camera], then: Sequence[Camera]) -> float:
    """Median ratio of the distances between two devices."""
    one, other = _centres(now), _centres(then)
    a, b = np.triu_indices(len(one), 1)
    lengths = np.linalg.norm(one[a] - one[b], axis=1), np.linalg.norm(other[a] - other[b], axis=1)
    apart = lengths[1] > 0.1 * lengths[1].max()
    return float(np.median(lengths[0][apart] / lengths[1][apart])) if apart.any() else 1.0


def _exact_scale(now: Sequence[Camera], then: Sequence[Camera], kept: Bools, rough: float) -> float:
    """Ratio of the spreads of the centres of the devices that kept their places."""
    if kept.sum() < 2:
        return rough
    one, other = _centres(now)[kept], _centres(then)[kept]
    spread = [np.sqrt(((x - x.mean(axis=0)) ** 2).sum()) for x in (one, other)]
    return float(spread[0] / spread[1]) if spread[1] > 0 else rough


def _scale_sigma(now: Sequence[Camera], then: Sequence[Camera], kept: Bools) -> float:
    """Standard deviation of the scale; infinity where too few devices kept their places.

    References:
        Efron 1979, the jackknife.
    """
    places = np.flatnonzero(kept)
    if len(places) < _FEWEST:
        return float("inf")
    without = np.array(
        [_exact_scale(now, then, kept & (np.arange(len(kept)) != one), 1.0) for one in places]
    )
    return float(np.sqrt((len(places) - 1) * np.mean((without - without.mean()) ** 2)))


def _points(cameras: Sequence[Camera], scale: float, reach: float) -> Floats:
    """Centre, and points on the axis and above it at working distance (C, 3, 3)."""
    centres = _centres(cameras) / scale
    up = np.stack([camera.camera_from_world.rotation[1] for camera in cameras])
    ahead = centres + reach * _axes(cameras)
    return np.stack([centres, ahead, ahead + 0.3 * reach * up], axis=1)


def _align(
    now: Sequence[Camera],
    then: Sequence[Camera],
    scale: float,
    reach: float,
    only: Bools | None = None,
) -> tuple[Pose, Bools]:
    """Motion previous_from_found of lengths divided by `scale`, and which devices kept to it."""
    one, other = _points(now, scale, reach), _points(then, 1.0, reach)
    if only is not None:
        return _fitted(one, other, only.astype(np.float64)), only
    best, least = Pose.identity(), np.inf
    for a, b in zip(now, then, strict=True):
        rotation = b.camera_from_world.rotation.T @ a.camera_from_world.rotation
        option = Pose(rotation, b.centre - rotation @ (a.centre / scale))
        middle = float(np.median(_misses(option, one, other)))
        if middle < least:
            best, least = option, middle
    motion = best
    weight = np.ones(len(one))
    for _ in range(_STEPS):
        miss = _misses(motion, one, other)
        half = np.sort(miss)[: len(miss) // 2 + 1]
        width = _TUKEY * _MAD * max(float(half[-1]), 1e-9 * reach)
        weight = np.clip(1.0 - (miss / width) ** 2, 0.0, None) ** 2
        motion = _fitted(one, other, weight)
    return motion, weight > 0


def _misses(motion: Pose, one: Floats, other: Floats) -> Floats:
    """Root mean square distance (C,) of each device's points, mm."""
    gap = motion.apply(one) - other
    size: Floats = np.sqrt((gap**2).sum(axis=2).mean(axis=1))
    return size


def _fitted(one: Floats, other: Floats, weight: Floats) -> Pose:
    """Rigid motion other_from_one of point sets (C, 3, 3) with weights (C,) of their owners."""
    return rigid_fit(one.reshape(-1, 3), other.reshape(-1, 3), np.repeat(weight, 3))


def _in_previous(camera: Camera, motion: Pose, scale: float) -> Camera:
    """The found camera at the size and in the world of the previous session."""
    place = camera.camera_from_world
    shrunk = Pose(place.rotation, place.translation / scale)
    return camera.posed(shrunk @ motion.inverse())


def _change(now: Camera, then: Camera) -> tuple[float, float]:
    shift = float(np.linalg.norm(now.centre - then.centre))
    turn = now.camera_from_world @ then.camera_from_world.inverse()
    return shift, float(np.degrees(np.linalg.norm(turn.rotation_vector())))


def _volume(cameras: Sequence[Camera], reach: float) -> Floats | None:
    """Points of a ball about where the axes meet; None where they do not."""
    point = _meeting_point(cameras)
    if point is None:
        return None
    steps = np.linspace(-1.0, 1.0, 5)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    inside: Floats = point + _BALL * reach * grid[np.linalg.norm(grid, axis=1) <= 1.0]
    return inside


def _effect(now: Camera, then: Camera, volume: Floats | None) -> float:
    """Rms difference of two projections of the volume, px; infinite where one does not see it."""
    if volume is None:  # parallel axes: what lies before the device itself
        steps = np.linspace(-0.8, 0.8, 5)
        flat = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        pixels = 0.5 * (flat + 1.0) * [then.width - 1, then.height - 1]
        volume = then.centre + 1000.0 * then.rays(pixels)
    gap = now.project(volume) - then.project(volume)
    seen = np.isfinite(gap).all(axis=1)
    return float(np.sqrt((gap[seen] ** 2).sum(axis=1).mean())) if seen.all() else float("inf")


def _places(
    now: Sequence[Camera], then: Sequence[Camera], motion: Pose, scale: float, reach: float
) -> list[int]:
    """For each device, whose place of the previous session it has; its own unless that is clear."""
    one = motion.apply(_points(now, scale, reach))
    other = _points(then, 1.0, reach)
    gap = np.sqrt(((one[:, None] - other[None]) ** 2).sum(axis=3).mean(axis=2))
    apart = np.sqrt(((other[:, None] - other[None]) ** 2).sum(axis=3).mean(axis=2))
    cost = gap.copy()
    for index in range(len(cost)):  # only a place that is clearly nearer than its own competes
        far = gap[index] > _SAME_PLACE * apart[index]
        far[index] = False
        cost[index, far] = np.inf
    cost = np.where(np.isfinite(cost), cost, 1e6 * reach)
    _, chosen = scipy.optimize.linear_sum_assignment(cost)
    places = [int(place) for place in chosen]
    unclear = [i for i, p in enumerate(places) if cost[i, p] >= 1e6 * reach]
    return list(range(len(places))) if unclear else places


def _cycles(places: Sequence[int]) -> list[tuple[int, ...]]:
    """Cycles of two and more of a permutation, each beginning with its least member."""
    out, done = [], set()
    for start in range(len(places)):
        cycle, at = [], start
        while at not in done:
            done.add(at)
            cycle.append(at)
            at = places[at]
        if len(cycle) > 1:
            out.append(tuple(cycle))
    return out


def _lens_went(
    now: Sequence[Camera], then: Sequence[Camera], cycle: tuple[int, ...]
) -> bool | None:
    """Whether the lenses in a cycle went with the places rather than with the names."""
    after = (*cycle[1:], cycle[0])
    along = sum(_lens_gap(now[a], then[b]) for a, b in zip(cycle, after, strict=True))
    kept = sum(_lens_gap(now[a], then[a]) for a in cycle)
    if along * _LENS_MARGIN < kept:
        return True
    return False if kept * _LENS_MARGIN < along else None


def _lens_gap(one: Camera, other: Camera) -> float:
    """How different two lenses draw, px at the corners of the image."""
    size = np.array([other.width, other.height])
    corners = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.9, 0.9], [0.5, 0.5]]) * size
    flat = other.undistort(corners)
    drawn = one.distort(flat) * [one.fx, one.fy] + [one.cx, one.cy]
    gap = np.linalg.norm(drawn - corners, axis=1) + abs(one.width - other.width)
    return float(np.nanmean(gap))
