"""Anchor frames: those that show the neutral again, where a take can be cut into segments.

A frame that shows the neutral, however the head has moved, is registered directly: nothing that
went wrong before can reach it. Between two anchors a segment is followed from both its ends.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

REST_MM = 0.8  # unrest up to which a frame shows the neutral; coarse matching errs by a half


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Frames between two anchors.

    Attributes:
        left: the anchor before them.
        frames: the frames themselves, ascending, without anchors.
        right: the anchor after them; None at the end of a take that ends elsewhere.
    """

    left: int
    frames: tuple[int, ...]
    right: int | None


def choose_anchors(unrest_mm: Mapping[int, float], wanted: Iterable[int] = ()) -> tuple[int, ...]:
    """The first frame, the stillest of every later run of frames at rest, and those wanted.

    Args:
        unrest_mm: of every frame, how far skin has left the place where the neutral, moved with
            the head, has it; inf where that is not known.
        wanted: frames that are anchors whatever they show.

    Returns:
        Frames, ascending.
    """
    frames = sorted(unrest_mm)
    anchors = {frames[0], *(set(wanted) & set(frames))}
    run: list[int] = []
    first = True
    for frame in [*frames, None]:
        if frame is not None and (unrest_mm[frame] <= REST_MM or frame == frames[0]):
            run.append(frame)
            continue
        if run and not first:
            anchors.add(min(run, key=lambda f: (unrest_mm[f], -f)))
        first = first and not run
        run = []
    return tuple(sorted(anchors))


def segments(frames: Sequence[int], anchors: Sequence[int]) -> tuple[Segment, ...]:
    """Cut frames at the anchors; anchors side by side have nothing between them.

    Args:
        frames: ascending; the first is an anchor.
        anchors: ascending, some of the frames.
    """
    out = []
    for index, left in enumerate(anchors):
        right = anchors[index + 1] if index + 1 < len(anchors) else None
        between = tuple(
            frame for frame in frames if frame > left and (right is None or frame < right)
        )
        if between:
            out.append(Segment(left=left, frames=between, right=right))
    return tuple(out)
