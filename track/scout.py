"""The scout: where the head is in a frame, and whether the face in it is at rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from capture.arrays import Bools, Floats, Floats32
from track.lift import Lifted
from track.matching import Matcher, RoundImages
from track.pyramid import image_pyramid
from track.rigid import Similarity, fit_similarity
from track.schedule import Step

_AGREED = 2  # views that fix a sample's place
_SPANNING = 30  # samples from which a rigid motion is told
_MOTION_ROUNDS = 8
_STILL_MM = 0.7  # skin that is this near to where the head carries it has hardly moved in it
_GONE_MM = 3.0  # what counts for a region that is not found where the head carries it
_GONE_SHARE = 0.4  # of a region's samples that must be found for it to be there
_UNREST_ROUNDS = 2  # of summing over neighbours: the size of a region


class HeadScout:
    """Finds the head as one rigid piece, by a frame's coarsest rounds.

    Args:
        matcher: of the take, to the neutral alone.
        steps: the rounds, coarse to fine.
        stride: every how manieth sample is matched.
        images: the neutral's own, float32 mono, by device name: what cannot be matched even there
            is not expected in a frame.
    """

    def __init__(
        self, matcher: Matcher, steps: Sequence[Step], stride: int, images: Mapping[str, Floats32]
    ) -> None:
        self._matcher, self._steps, self._stride = matcher, tuple(steps), stride
        itself, able = self._round(self._steps[-1], matcher.surface.neutral, images)
        self._tellable: Bools = able & (itself.views >= _AGREED)

    def find(self, start: Floats, images: Mapping[str, Floats32]) -> tuple[Floats, float]:
        """Find the head.

        Args:
            start: (V, 3) the neutral, about where the head is, world mm.
            images: the frame's images, float32 mono.

        Returns:
            (V, 3) the neutral with the head; and the unrest, mm: how far skin that two views see
            has left it, in the region that has done so most; inf, and the start, where too little
            is found.
        """
        samples = self._matcher.surface.samples
        vertices, told = start, np.zeros(len(samples), np.bool_)
        away, able = np.zeros(len(samples)), told
        for step in self._steps:
            lifted, able = self._round(step, vertices, images)
            told = lifted.views >= _AGREED
            if int(told.sum()) < _SPANNING:
                return start, float("inf")
            places = samples.points(vertices)
            motion = _robust_motion(places[told], places[told] + lifted.motion[told])
            away = np.linalg.norm(places + lifted.motion - motion.apply(places), axis=1)
            vertices = motion.apply(vertices)
        return vertices, self._unrest(away, told, able & self._tellable)

    def _round(
        self, step: Step, vertices: Floats, images: Mapping[str, Floats32]
    ) -> tuple[Lifted, Bools]:
        """A coarse round, and which samples (N,) two views could see in it."""
        usable = [name for name in self._matcher.neutral.views if name in images]
        seen = RoundImages(
            views={n: image_pyramid(images[n], step.level + 1)[step.level] for n in usable},
            occluders={},
            depth=None,
            stride=self._stride,
        )
        lifted, matches = self._matcher.measure(step, vertices, seen)
        able = np.zeros(len(self._matcher.surface.samples), np.int64)
        for view in matches.values():
            able[view.seen] += 1
        tried = np.arange(len(able)) % self._stride == 0
        return lifted, np.asarray(tried & (able >= _AGREED))

    def _unrest(self, away: Floats, told: Bools, able: Bools) -> float:
        """The largest mean of distances (N,) over a region, mm; skin that is gone counts as far."""
        if not able.any():
            return float("inf")
        near = self._matcher.surface.neighbours
        share = (told & able).astype(np.float64)
        mean, whole = share * away, able.astype(np.float64)
        for _ in range(_UNREST_ROUNDS):
            share, mean, whole = (near @ value + value for value in (share, mean, whole))
        known = whole > 0.5 * float(np.median(whole[able]))
        gone = share < _GONE_SHARE * whole
        region = np.where(gone, _GONE_MM, mean / np.maximum(share, 1e-9))
        return float(region[known].max())


def _robust_motion(before: Floats, after: Floats) -> Similarity:
    """The rigid motion that most points (n, 3) follow."""
    weights = np.ones(len(before))
    for _ in range(_MOTION_ROUNDS):
        motion = fit_similarity(before, after, weights)
        away: Floats = np.linalg.norm(motion.apply(before) - after, axis=1)
        scale = max(_STILL_MM, float(np.median(away)))
        weights = 1.0 / (1.0 + (away / scale) ** 2) ** 2
    return motion
