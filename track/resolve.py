"""What an artist says of a take, worked into its performance: frames solved again, and blended."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Bools
from track.corrections.blend import blend, blend_confidence, ease_to_held, interpolate
from track.corrections.replay import Corrections
from track.face_tracker import FaceTracker
from track.frame_store import FrameStore, TrackedFrame


@dataclass(frozen=True, kw_only=True)
class ResolveSettings:
    """How far a correction reaches.

    Attributes:
        reach_frames: frames on each side of a corrected one that are followed from it.
        ease_frames: frames at each end of a solved run that are eased into what was there.
    """

    reach_frames: int
    ease_frames: int


def runs_of(
    frames: Sequence[int],
    corrections: Corrections,
    settings: ResolveSettings,
    chosen: tuple[int, int] | None = None,
) -> dict[int, int]:
    """Which frames are solved again, and from which corrected frame each is followed.

    A pinned frame carries `reach_frames` on each side, as far as the next one or a locked frame;
    one marked as an anchor carries all frames up to the next. With a chosen range, every frame of
    it is carried by the nearest corrected one in it, and no other is touched.

    Args:
        frames: of the take, ascending.
        corrections: see `track.corrections.replay`.
        settings: of the reach.
        chosen: first and last frame to solve again; None: as far as corrections reach.

    Returns:
        By frame, ascending, the corrected frame it is followed from; that one itself for itself.
    """
    first, last = (frames[0], frames[-1]) if chosen is None else chosen
    fixed = set(corrections.locked)
    told = {frame: corrections.for_frame(frame) for frame in frames if first <= frame <= last}
    sources = [
        frame
        for frame, what in told.items()
        if frame not in fixed and (what.sightings or what.anchor)
    ]
    lone = [frame for frame, what in told.items() if frame not in fixed and what.excluded_views]
    out: dict[int, int] = {frame: frame for frame in lone}
    place = {frame: index for index, frame in enumerate(frames)}
    nearest: dict[int, tuple[int, int]] = {}
    for source in sources:
        far = len(frames) if chosen is not None or told[source].anchor else settings.reach_frames
        for step in (-1, 1):
            for index in range(1, far + 1):
                spot = place[source] + step * index
                if not 0 <= spot < len(frames) or frames[spot] not in told:
                    break
                frame = frames[spot]
                if frame in fixed or frame in sources:
                    break
                nearest[frame] = min(nearest.get(frame, (index, source)), (index, source))
    out |= {frame: source for frame, (_, source) in nearest.items()}
    out |= {source: source for source in sources}
    return dict(sorted(out.items()))


def resolve(
    tracker: FaceTracker,
    found: Mapping[int, TrackedFrame],
    corrections: Corrections,
    run: Mapping[int, int],
    store: FrameStore,
    told: Callable[[int], None],
) -> dict[int, TrackedFrame]:
    """Solve the corrected frames and those they carry.

    Args:
        tracker: of the take.
        found: the performance as tracked, by frame.
        corrections: what is said of it.
        run: see `runs_of`.
        store: frames found there are not solved again.
        told: told each frame when it is done.

    Returns:
        The frames of the run.
    """
    solved: dict[int, TrackedFrame] = {}
    order = sorted(run, key=lambda frame: (run[frame], abs(frame - run[frame]), frame))
    for frame in order:
        kept = store.load(frame)
        if kept is None:
            what, source = corrections.for_frame(frame), run[frame]
            if frame == source:
                start = found[frame].vertices.astype(np.float64)
                kept = tracker.refined(start, what)
            else:
                step = 1 if frame > source else -1
                behind = [f for f in sorted(solved, reverse=step < 0) if (frame - f) * step > 0]
                chain = [solved[f] for f in behind if (f - source) * step >= 0]
                kept = tracker.follow(frame, chain, what.excluded_views)
            store.save(frame, kept)
        solved[frame] = kept
        told(frame)
    return solved


def corrected(
    frames: Sequence[int],
    found: Mapping[int, TrackedFrame],
    solved: Mapping[int, TrackedFrame],
    corrections: Corrections,
    settings: ResolveSettings,
) -> list[TrackedFrame]:
    """The performance with its corrections: eased in, locked frames exact, excluded ones filled.

    Args:
        frames: of the take, ascending.
        found: as tracked, by frame.
        solved: frames solved again.
        corrections: what is said of the take.
        settings: how far corrections reach; locked frames draw those around along as far.
    """
    ease_frames = settings.ease_frames
    base = [found[frame] for frame in frames]
    anew: Bools = np.array([frame in solved for frame in frames])
    other = [solved.get(frame, found[frame]) for frame in frames]
    old = _stacked(base)
    new = _stacked(other)
    vertices = blend(old[0], new[0], anew, ease_frames)
    confidence = blend_confidence(old, new, anew, ease_frames)
    held: dict[int, NDArray[np.float32]] = {}
    for index, frame in enumerate(frames):
        said = corrections.for_frame(frame)
        if said.locked is not None:
            held[index], confidence[index] = said.locked.vertices, said.locked.confidence
        elif said.sightings and frame in solved:
            held[index] = vertices[index]
    if corrections.locked:
        vertices = ease_to_held(vertices, held, settings.reach_frames)
    gone = set(corrections.excluded)
    known: Bools = np.array([frame not in gone for frame in frames])
    if gone and known.any():
        vertices = interpolate(vertices, known, np.array(frames, dtype=np.int64))
        confidence[~known] = 0.0
    return [
        replace(one, vertices=vertices[index], confidence=confidence[index])
        for index, one in enumerate(other)
    ]


def _stacked(
    tracked: Sequence[TrackedFrame],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    return (
        np.stack([one.vertices for one in tracked]),
        np.stack([one.confidence for one in tracked]),
    )
