"""Two solves from disjoint halves of the board poses, compared where a face will be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from capture.arrays import Floats, check_shape
from capture.camera import CameraArray
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations
from recon.calibration.geometry import rigid_fit, triangulate


@dataclass(frozen=True, eq=False, kw_only=True)
class SplitHalf:
    """How two solves from disjoint halves of the poses differ in the images.

    Attributes:
        p95_px: 95th percentile, over devices and points of the face volume, of the difference of
            projections, px; NaN when the comparison was not made.
        median_px: its median.
        by_device: 95th percentile of each device.
        remark: why the comparison was not made, or "".
    """

    p95_px: float = float("nan")
    median_px: float = float("nan")
    by_device: dict[str, float] = field(default_factory=dict)
    remark: str = ""


def split_half(
    state: ArrayState,
    used: BoardObservations,
    adjust: Callable[[ArrayState, BoardObservations], ArrayState],
    volume: Floats,
    least_views: int,
) -> SplitHalf:
    """Solve the odd and the even board poses apart and compare what they project.

    Args:
        state: the whole solution, from which both solves start.
        used: the sightings it used.
        adjust: solves from a start and sightings.
        volume: (N, 3) points of the face volume, in the space of `state`, mm.
        least_views: views every device must have in both halves.

    References:
        mrcal, "A tour: cross-validation": the projection difference of two solves.
    """
    poses = np.unique(used.pose)
    halves = [used.select(np.isin(used.pose, poses[first::2])) for first in (0, 1)]
    for half in halves:
        if ((half.view_counts() > 0).sum(axis=1) < least_views).any():
            return SplitHalf(remark="too few poses to split them")
        if not _hangs_together(half):
            return SplitHalf(remark="half of the poses do not tie all devices together")
    one, other = (adjust(state, half) for half in halves)
    return projection_difference(one.cameras, other.cameras, volume)


def _hangs_together(half: BoardObservations) -> bool:
    """Whether every device is tied to every other by board poses that two see."""
    seen = half.view_counts() > 0
    joined = (seen.astype(np.int64) @ seen.T.astype(np.int64)) > 0
    reached = joined[0]
    for _ in range(len(joined)):
        reached = joined[reached].any(axis=0)
    return bool(reached.all())


def projection_difference(one: CameraArray, other: CameraArray, volume: Floats) -> SplitHalf:
    """Where two arrays, each in a space of its own, see the points of a volume.

    Args:
        one: an array.
        other: the same devices solved anew; its space may differ by a rigid motion.
        volume: (N, 3) points in the space of `one`, mm.
    """
    check_shape(volume=(volume, "N 3"))
    seen = [camera.project(volume) for camera in one]
    inside = [
        camera.contains(np.nan_to_num(pixels, nan=-1e9))
        for camera, pixels in zip(one, seen, strict=True)
    ]
    enough = np.sum(inside, axis=0) >= 2
    if enough.sum() < 3:
        return SplitHalf(remark="fewer than three points of the face volume are seen by two")
    found = triangulate(other, [pixels[enough] for pixels in seen], [i[enough] for i in inside])
    other_from_one = rigid_fit(volume[enough], found)
    moved = other_from_one.apply(volume)
    by_device, every = {}, []
    for camera, twin, pixels, there in zip(one, other, seen, inside, strict=True):
        if there.any():
            gap = np.linalg.norm(twin.project(moved[there]) - pixels[there], axis=1)
            gap = np.nan_to_num(gap, nan=float(np.hypot(camera.width, camera.height)))
            by_device[camera.name] = float(np.percentile(gap, 95))
            every.append(gap)
    together = np.concatenate(every)
    return SplitHalf(
        p95_px=float(np.percentile(together, 95)), median_px=float(np.median(together)),
        by_device=by_device,
    )  # fmt: skip
