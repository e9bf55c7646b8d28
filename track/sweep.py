"""Segments of a take, followed from both their ends."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from track.anchors import Segment
from track.face_tracker import FaceTracker
from track.frame_store import FrameStore, TrackedFrame


@dataclass(frozen=True, eq=False, kw_only=True)
class SweepStores:
    """Where a sweep keeps its frames.

    Attributes:
        forward: those followed from the left, until the segment is done.
        final: those that are done.
    """

    forward: FrameStore
    final: FrameStore


def sweep(
    tracker: FaceTracker,
    segment: Segment,
    anchors: Mapping[int, TrackedFrame],
    stores: SweepStores,
    told: Callable[[int], None],
) -> None:
    """Follow a segment from its left anchor, then look again from its right one.

    From the left every frame is registered, beginning where the last ones lead. From the right,
    frames whose first solve was unsure of skin that their right neighbour is sure of are
    registered again from there, and blended by confidence: what the first sweep lost, for having
    moved too fast or been hidden, is found by the second. Both are matched to the same reference.

    Args:
        tracker: of the take.
        segment: frames between two anchors.
        anchors: finished frames at its ends.
        stores: frames found there are not made again.
        told: told each frame when the first sweep has passed it.
    """
    done = {frame: stores.final.load(frame) for frame in segment.frames}
    if all(found is not None for found in done.values()):
        for frame in segment.frames:
            told(frame)
        return
    chain = [anchors[segment.left]]
    for frame in segment.frames:
        found = stores.forward.load(frame)
        if found is None:
            found = tracker.follow(frame, chain)
            stores.forward.save(frame, found)
        chain.append(found)
        told(frame)
    forward = dict(zip(segment.frames, chain[1:], strict=True))
    after = [] if segment.right is None else [anchors[segment.right]]
    for frame in reversed(segment.frames):
        final = done[frame]
        if final is None:
            final = tracker.again(frame, forward[frame], after) if after else forward[frame]
            stores.final.save(frame, final)
        if after:
            after.append(final)
    for frame in segment.frames:
        stores.forward.drop(frame)
