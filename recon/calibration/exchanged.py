"""Two devices whose pictures were exchanged from some frame on, told from pairs of devices alone.

Two devices that stand still see the board under one relative pose in all frames that both see.
Where pictures were exchanged, pairs with one of the two have two relative poses, one before and
one after; put back under their own names, they have one again. No array need be solved for that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from capture.camera import Camera
from capture.pose import Pose
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.calibration.chain import shared_motion, view_candidates

_MOST_SHARED = 40  # frames of a pair that are compared, spread over those shared
_LEAST_WRONG = 3  # frames in which pairs must disagree before anything is tried
_MENDED = 0.25  # share of the disagreement that the true exchange may leave
_CLEARLY = 0.5  # the true exchange leaves at most this part of what the next best pair leaves
_CUTS = 12  # frames at which an exchange may begin that are tried first
_FINALISTS = 4  # pairs of which every frame about the best is tried

_Seen = Mapping[int, tuple[Pose, ...]]


@dataclass(frozen=True)
class Exchange:
    """Two devices, by index, whose pictures are exchanged from a frame on."""

    one: int
    other: int
    frame: int

    def words(self, names: Sequence[str]) -> str:
        """What an operator should know."""
        pair = sorted((names[self.one], names[self.other]))
        return (
            f"{pair[0]} and {pair[1]}: their pictures are exchanged from frame {self.frame} on: "
            "put each device's files back under its own name"
        )


def find_exchange(
    lenses: Sequence[Camera], every: BoardObservations, shape: BoardShape
) -> Exchange | None:
    """The one exchange of two devices that makes all pairs agree; None when there is none.

    Args:
        lenses: a rough lens of every device.
        every: sightings of all frames.
        shape: the board; one with faces whose place is not known tells nothing.
    """
    if not shape.placed.all():
        return None
    seen: list[dict[int, tuple[Pose, ...]]] = [{} for _ in lenses]
    for view in view_candidates(every, shape, list(lenses)):
        seen[view.device][every.frames[view.pose]] = view.candidates
    pairs = list(combinations(range(len(seen)), 2))
    wrong = {pair: _disagreeing(seen[pair[0]], seen[pair[1]]) for pair in pairs}
    total = sum(wrong.values())
    if total < _LEAST_WRONG:
        return None
    suspects = {device for pair, count in wrong.items() if count for device in pair}
    rest = {
        pair: sum(count for other, count in wrong.items() if not set(pair) & set(other))
        for pair in pairs
        if set(pair) & suspects
    }
    likely = [p for p in rest if rest[p] <= _MENDED * total and _frames(seen, p)]
    rough = [_best(seen, pair, _cuts(seen, pair)) for pair in likely]
    rough = sorted(rough, key=lambda found: (rest[found[1:3]] + found[0], found[1:]))
    fine = [_best(seen, (one, other), _about(seen, (one, other), cut))
            for _, one, other, cut in rough[:_FINALISTS]]  # fmt: skip
    left = sorted((rest[one, other] + count, one, other, cut) for count, one, other, cut in fine)
    if not left or left[0][0] > _MENDED * total:
        return None
    if len(left) > 1 and left[0][0] + 1 > _CLEARLY * left[1][0]:
        return None
    return Exchange(*left[0][1:])


def _best(
    seen: Sequence[_Seen], pair: tuple[int, int], cuts: Sequence[int]
) -> tuple[int, int, int, int]:
    """Disagreement left by the best of these cuts, the pair, the cut."""
    return min((_left(seen, *pair, cut), *pair, cut) for cut in cuts)


def _frames(seen: Sequence[_Seen], pair: tuple[int, int]) -> list[int]:
    return sorted(seen[pair[0]].keys() | seen[pair[1]].keys())


def _cuts(seen: Sequence[_Seen], pair: tuple[int, int]) -> list[int]:
    """Frames at which an exchange may begin, spread over those either device saw."""
    frames = _frames(seen, pair)
    places = np.linspace(0, len(frames) - 1, min(_CUTS + 2, len(frames))).round().astype(int)
    return [frames[place] for place in places.tolist()]


def _about(seen: Sequence[_Seen], pair: tuple[int, int], cut: int) -> list[int]:
    """All frames from the cut before to the cut after one of the coarse choice."""
    frames = _frames(seen, pair)
    reach = -(-len(frames) // _CUTS)
    place = frames.index(cut)
    return frames[max(place - reach, 0) : place + reach + 1]


def _left(seen: Sequence[_Seen], one: int, other: int, cut: int) -> int:
    """Disagreement of all pairs with one of the two, their pictures put back from `cut` on."""
    first = {f: c for f, c in seen[one].items() if f < cut}
    first |= {f: c for f, c in seen[other].items() if f >= cut}
    second = {f: c for f, c in seen[other].items() if f < cut}
    second |= {f: c for f, c in seen[one].items() if f >= cut}
    others = [views for device, views in enumerate(seen) if device not in (one, other)]
    total = _disagreeing(first, second)
    return total + sum(_disagreeing(mine, views) for mine in (first, second) for views in others)


def _disagreeing(one: _Seen, other: _Seen) -> int:
    """Of the frames that both saw, how many do not agree with the relative pose of most."""
    both = sorted(one.keys() & other.keys())
    if len(both) < 2:
        return 0
    places = np.linspace(0, len(both) - 1, min(_MOST_SHARED, len(both))).round().astype(int)
    frames = [both[place] for place in places.tolist()]
    _, near = shared_motion([one[f] for f in frames], [other[f] for f in frames])
    return int((~near).sum())
