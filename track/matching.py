"""One round's measurements: every view warped into its reference, matched, and lifted to 3D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Floats32, Ints
from recon.surface import Scan
from track.beyond import search_beyond
from track.evidence import ViewMatches, preferred, view_matches
from track.face_reference import FaceReference
from track.flow import ALIGNED, FlowMatches, better
from track.flow_backend import FlowBackend
from track.guide import GuidedView
from track.lift import Lifted, Observations, merged, triangulate
from track.observe import believable, observe
from track.reference import ReferenceLevel
from track.round_trip import return_miss
from track.scan_depth import ScanDepth, depth_observations
from track.schedule import Step
from track.surface_model import SurfaceModel

_PRIOR_MM = 1.0
_FEW = 2  # a sample that no more views than this see gets its depth from the scan too
_MARGIN = 0.1  # of correlation, by which a match to the second reference beats one to the neutral
_SECOND_HAND = 0.25  # information of a match to another frame than the neutral: it has erred itself


@dataclass(frozen=True, eq=False, kw_only=True)
class RoundImages:
    """What a round sees of the frame.

    Attributes:
        views: the frame's images at the round's level, by device name.
        occluders: a depth map of the mesh in the frame for each view, and how many of the level's
            pixels one of its pixels spans; empty when nothing is known to be hidden.
        depth: the frame's scan, where it is wanted.
        stride: every how manieth sample is matched.
        last: whether this is the frame's last round, whose matches are followed back.
    """

    views: Mapping[str, Floats32]
    occluders: Mapping[str, tuple[Floats32, float]]
    depth: ScanDepth | None
    stride: int
    last: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class Matcher:
    """Matches frames to references.

    Attributes:
        surface: what is tracked.
        neutral: what the neutral showed.
        second: a frame that serves samples which the neutral serves no more, or None.
        min_correlation: least NCC believed.
        pool: threads over the views; the kernels let go of the interpreter.
        flow: who warps, searches and refines.
        return_px: a match that misses its way back by more is not believed; inf: none is tried.
    """

    surface: SurfaceModel
    neutral: FaceReference
    second: FaceReference | None
    min_correlation: float
    pool: ThreadPoolExecutor
    flow: FlowBackend
    return_px: float = np.inf

    def measure(
        self, step: Step, vertices: Floats, seen: RoundImages
    ) -> tuple[Lifted, dict[str, ViewMatches]]:
        """Match every view at one level and lift the samples.

        Args:
            step: the round.
            vertices: (V, 3) the mesh's estimate, world mm.
            seen: the frame.

        Returns:
            The samples' motions from the estimate, and each view's matches.
        """
        skin = self.surface.skin(vertices)
        points = self.surface.samples.points(skin)

        def measure(name: str) -> ViewMatches:
            return self._view(step, name, (skin, points), seen)

        measured = list(self.pool.map(measure, seen.views))  # in the order of the views
        matches = dict(zip(seen.views, measured, strict=True))
        told = [part.observations for part in measured]
        if seen.depth is not None:
            told += self._depths(seen.depth, dict(zip(seen.views, told, strict=True)), skin)
        lifted = triangulate(merged(told), len(self.surface.samples), step.scale_px, _PRIOR_MM)
        return lifted, matches

    def scan_depth(self, scan: Scan, vertices: Floats, agreed: Ints) -> ScanDepth:
        """The scan around samples that few views agreed on (N,), and any view can see."""
        poor = (self.neutral.seen > 0) & (agreed <= _FEW)
        return ScanDepth(scan, self.surface.samples.points(self.surface.skin(vertices))[poor])

    def _view(
        self, step: Step, name: str, estimate: tuple[Floats, Floats], seen: RoundImages
    ) -> ViewMatches:
        """One view matched to the neutral, and to the second reference what fits that better."""
        matched = self._against(step, self.neutral.views[name], (name, estimate), seen, None)
        if self.second is None or name not in self.second.views:
            return matched
        level = self.second.views[name]
        known = np.full(len(estimate[1]), -1.0)
        known[matched.observations.sample] = matched.believed
        other = self._against(step, level, (name, estimate), seen, known < ALIGNED)
        return preferred(matched, other.at(_SECOND_HAND), _MARGIN)

    def _against(
        self,
        step: Step,
        levels: Sequence[ReferenceLevel],
        what: tuple[str, tuple[Floats, Floats]],
        seen: RoundImages,
        wanted: Bools | None,
    ) -> ViewMatches:
        """One view matched to one reference: all of its samples, or those wanted (N,)."""
        name, (skin, points) = what
        level, image = levels[step.level], seen.views[name]
        chosen = level.samples % seen.stride == 0
        if wanted is not None:
            chosen &= wanted[level.samples]
        hidden = seen.occluders.get(name)
        view = self.flow.warp(level, self.surface.triangles, skin, image, hidden)
        matches = self._match(step, level, (view, image), chosen)
        believed = believable(matches, self.min_correlation, step.limit_px)
        if seen.last and self.return_px < np.inf:
            miss = return_miss(level, view, matches, believed, step.iterations)
            believed &= ~(miss > self.return_px)
        told = observe(level, view, matches, points, believed)
        return view_matches(level, view, matches.correlation, told)

    def _depths(
        self, depth: ScanDepth, seen: Mapping[str, Observations], skin: Floats
    ) -> list[Observations]:
        """What the scan adds to the matches of samples that few views see."""
        samples = self.surface.samples
        times = np.zeros(len(samples), np.int64)
        for part in seen.values():
            times[part.sample] += 1
        normals = samples.points(self.surface.normals(skin))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        estimate = (samples.points(skin), normals)
        views = self.neutral.views
        return [
            depth_observations(
                depth, views[name][0].camera, part, times[part.sample] <= _FEW, estimate
            )
            for name, part in seen.items()
        ]

    def _match(
        self,
        step: Step,
        level: ReferenceLevel,
        shown: tuple[GuidedView, Floats32],
        chosen: Bools,
    ) -> FlowMatches:
        view, image = shown
        found = self.flow.search(level, view, chosen, step.search_px)
        matches = self.flow.refine(level, view, found.displacement, step.iterations)
        lost = chosen & level.at_edge & (matches.correlation < ALIGNED)
        if not lost.any():
            return matches
        reach = (step.search_px, step.iterations)
        return better(matches, search_beyond(level, view, image, lost, reach))
