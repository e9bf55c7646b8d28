"""`BoardSightings`: what all devices saw of the board, and of the scale bar, in a whole take."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, Ints
from capture.progress import Progress, silent
from recon.board.body import BoardBody, FlatBoard
from recon.board.corner_cache import CornerCache
from recon.board.corners import (
    LOST,
    SPARE,
    STILL,
    USED,
    BoardTake,
    CornerDetector,
    CornerFinds,
    CornerLimits,
    CornerView,
)
from recon.board.observations import BoardObservations
from recon.board.pose_choice import choose_poses, view_marks
from recon.board.shape import BoardShape

_STILL_SHARE = 0.9  # of the corners: when so many have moved less, the view has not moved
_WITNESSES = 2  # devices that must see the board move, where that many share it
_MOST_WORKERS = 8  # each holds an image of 16 bytes a pixel or so


@dataclass(frozen=True, eq=False, kw_only=True)
class BarSightings:
    """Where the markers of the scale bar were seen, one row each, by frame, device, end.

    Attributes:
        device_names: (C) the devices.
        device: (M,) index of the device.
        frame: (M,) frame number.
        end: (M,) 0 or 1: which of the bar's `markers`.
        pixels: (M, 2) the centre of the marker in the image, px.
    """

    device_names: tuple[str, ...]
    device: Ints
    frame: Ints
    end: Ints
    pixels: Floats

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardSightings:
    """What all devices saw of the board in a take.

    Attributes:
        observations: sightings at the board poses to solve with.
        every: sightings of all usable views of every frame, those included in which the board had
            not moved and those of poses to spare. Its poses are all frames with a usable view.
        tally: by device, how many frames were used, or not, for each reason.
        bar: sightings of the scale bar, in all frames.
        blur_px: by device, the median width of the board's edges in its views, blurred ones
            included, px; NaN for one that saw none.
    """

    observations: BoardObservations
    every: BoardObservations
    tally: dict[str, dict[str, int]]
    bar: BarSightings
    blur_px: dict[str, float]


Views = Mapping[str, CornerView]


def observe_board(
    take: BoardTake,
    board: FlatBoard | BoardBody,
    limits: CornerLimits,
    *,
    cache: CornerCache | None = None,
    progress: Progress = silent,
) -> BoardSightings:
    """Find the board in every image of a take.

    Args:
        take: the board take.
        board: what is waved in it.
        limits: which views to refuse.
        cache: keeps what is found in each image: an interrupted run goes on where it stopped.
        progress: told after each frame.

    Returns:
        The sightings. A frame in which no device but one sees that the board moved is no new
        pose; of the frames of a rest the one that shows most corners is used.
    """
    detector = CornerDetector(board, limits)
    tally: dict[str, dict[str, int]] = {name: {} for name in take.device_names}
    blurs: dict[str, list[float]] = {name: [] for name in take.device_names}
    poses: list[tuple[int, Views]] = []
    every: list[tuple[int, Views]] = []
    bar: list[tuple[int, int, int, float, float]] = []
    for done, (frame, found) in enumerate(_search(take, detector, cache), start=1):
        views: dict[str, CornerView] = {}
        for index, name in enumerate(take.device_names):
            reason = LOST
            if name in found:
                view = detector.judge(found[name])
                reason = view.refusal or USED
                if not view.refusal:
                    views[name] = view
                if not np.isnan(view.blur_px):
                    blurs[name].append(view.blur_px)
                ends = zip(found[name].ends, found[name].end_pixels, strict=True)
                bar += [(index, frame, int(end), *pixel.tolist()) for end, pixel in ends]
            tally[name][reason] = tally[name].get(reason, 0) + 1
        if views:
            every.append((frame, views))
            _add_pose(poses, (frame, views), limits.still_px, tally)
        progress(done, len(take.frames), "corners")
    chosen = _chosen(take, poses, limits.max_poses, detector.body.shape())
    for _, spare in (pose for place, pose in enumerate(poses) if place not in set(chosen)):
        _move(tally, spare, SPARE)
    return BoardSightings(
        observations=_collect(take, [poses[place] for place in chosen]),
        every=_collect(take, every),
        tally=tally,
        bar=_bar(take, bar),
        blur_px={n: float(np.median(b)) if b else float("nan") for n, b in blurs.items()},
    )


def _search(
    take: BoardTake, detector: CornerDetector, cache: CornerCache | None
) -> Iterator[tuple[int, dict[str, CornerFinds]]]:
    """What is found in each frame, by device; images are searched side by side, told in order."""
    images = [
        (frame, name)
        for frame in take.frames
        for name in take.device_names
        if take.present(name, frame)
    ]

    def look(job: tuple[int, str]) -> CornerFinds:
        frame, name = job
        known = None if cache is None else cache.load(name, frame)
        if known is not None:
            return known
        finds = detector.find(take.image(name, frame))
        if cache is not None:
            cache.store(name, frame, finds)
        return finds

    pool = ThreadPoolExecutor(min(_MOST_WORKERS, len(os.sched_getaffinity(0))))
    try:
        results = zip(images, pool.map(look, images), strict=True)
        pending = next(results, None)
        for frame in take.frames:
            found: dict[str, CornerFinds] = {}
            while pending is not None and pending[0][0] == frame:
                found[pending[0][1]] = pending[1]
                pending = next(results, None)
            yield frame, found
    finally:  # on Ctrl-C or an error what has begun is finished and kept, and no more is begun
        pool.shutdown(wait=True, cancel_futures=True)


def _add_pose(
    poses: list[tuple[int, Views]],
    pose: tuple[int, Views],
    still_px: float,
    tally: dict[str, dict[str, int]],
) -> None:
    """Add a pose, unless the board rests: then keep of the two frames the one that shows more."""
    if not poses or not _still(poses[-1][1], pose[1], still_px):
        poses.append(pose)
        return
    fuller = _corner_total(pose[1]) > _corner_total(poses[-1][1])
    _move(tally, poses[-1][1] if fuller else pose[1], STILL)
    if fuller:
        poses[-1] = pose


def _corner_total(views: Views) -> int:
    return sum(len(view.ids) for view in views.values())


def _move(tally: dict[str, dict[str, int]], views: Views, reason: str) -> None:
    """Count these used views under another reason."""
    for name in views:
        tally[name][USED] -= 1
        tally[name][reason] = tally[name].get(reason, 0) + 1


def _still(before: Views, now: Views, still_px: float) -> bool:
    """Whether the devices that saw the board twice saw it at the same place.

    A device that alone sees it move is out of step, and does not count where others share it.
    """
    shared = moving = 0
    for name in before.keys() & now.keys():
        _, first, second = np.intersect1d(before[name].ids, now[name].ids, return_indices=True)
        if len(first):
            shared += 1
            moved = np.linalg.norm(before[name].pixels[first] - now[name].pixels[second], axis=1)
            moving += int(float(np.quantile(moved, _STILL_SHARE)) > still_px)
    return shared > 0 and moving < (_WITNESSES if shared > _WITNESSES else 1)


def _chosen(
    take: BoardTake, poses: Sequence[tuple[int, Views]], most: int, shape: BoardShape
) -> list[int]:
    """Places of the poses to solve with."""
    if len(poses) <= most:
        return list(range(len(poses)))
    marks = []
    for _, views in poses:
        own = []
        for index, name in enumerate(take.device_names):
            if name in views:
                ids, pixels = views[name].ids, views[name].pixels
                widest = shape.face[ids] == np.bincount(shape.face[ids]).argmax()
                flat = shape.flat[ids[widest]]
                own.append((index, view_marks(flat, pixels[widest], take.size(name))))
        marks.append(own)
    return choose_poses(marks, len(take.device_names), most)


def _collect(take: BoardTake, poses: Sequence[tuple[int, Views]]) -> BoardObservations:
    device, pose, corner, pixels = [], [], [], [np.zeros((0, 2))]
    for place, (_, views) in enumerate(poses):
        for index, name in enumerate(take.device_names):
            if name in views:
                count = len(views[name].ids)
                device += [index] * count
                pose += [place] * count
                corner += views[name].ids.tolist()
                pixels.append(views[name].pixels)
    return BoardObservations(
        device_names=tuple(take.device_names),
        sizes=tuple(take.size(name) for name in take.device_names),
        frames=tuple(frame for frame, _ in poses),
        device=np.array(device, dtype=np.int64),
        pose=np.array(pose, dtype=np.int64),
        corner=np.array(corner, dtype=np.int64),
        pixels=np.concatenate(pixels),
    )


def _bar(take: BoardTake, rows: Sequence[tuple[int, int, int, float, float]]) -> BarSightings:
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return BarSightings(
        device_names=tuple(take.device_names),
        device=table[:, 0].astype(np.int64),
        frame=table[:, 1].astype(np.int64),
        end=table[:, 2].astype(np.int64),
        pixels=table[:, 3:],
    )
