"""Registration of one frame: guide, match, lift and solve, from coarse to fine.

The mesh is carried from its last place; each step warps every view into the reference by the
mesh's motion field, measures what is left, triangulates it and solves for the mesh again, stiff
first and supple last. Every measurement is against the reference frame, so errors of one frame
are not handed to the next: the last place only says where to look.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from capture.arrays import Bools, Floats, Floats32, Ints
from capture.camera import Camera
from capture.errors import SettingsError, SolveError
from recon.surface import Scan
from track.evidence import FrameEvidence, frame_evidence
from track.face_reference import FaceReference, ReferenceWindows, face_reference
from track.flow_backend import CpuFlow, FlowBackend
from track.guide import guided_view
from track.laplacian import Constraints, LaplacianDeformer, Stiffness
from track.lift import Lifted
from track.matching import Matcher, RoundImages
from track.pyramid import image_pyramid
from track.rigid import fit_similarity
from track.scan_depth import ScanDepth
from track.schedule import Step
from track.scout import HeadScout
from track.separation import Separation
from track.sightings import Sightings
from track.start import blended_start, place_scores
from track.surface_model import SurfaceModel

_SURE = 0.25  # confidence from which a vertex carries its neighbours into the next frame
_HELD = 0.8  # confidence from which skin is not looked for elsewhere in the next frame
_SINGLE_VIEW = 0.02  # weight of a sample that one view alone sees, and no scan: of unknown depth
_HELD_WEIGHT = 0.02  # of every vertex, when what is sighted pulls the mesh
_PULLS = 3
_ENOUGH = 12  # samples that a mesh is solved for from
_AGREED = 2  # witnesses, views or a view and the scan, that fix a sample's place


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameResult:
    """One registered frame.

    Attributes:
        vertices: (V, 3) world mm.
        confidence: (V,) 0..1.
        samples: how many samples two or more views, or a view and the scan, agree on.
        correlation: mean NCC of the matches of the last step.
        residual_px: median distance between matches and the projected lifted points.
        views: mean number of views that agree on a sample.
        evidence: what the last step measured, by vertex and by view.
        reference: the frame that it was matched to beside the neutral; -1: none.
    """

    vertices: Floats
    confidence: Floats
    samples: int
    correlation: float
    residual_px: float
    views: float
    evidence: FrameEvidence
    reference: int = -1

    @classmethod
    def lost(cls, vertices: Floats, views: int) -> FrameResult:
        """A frame that could not be measured: the prediction, with confidence 0."""
        blank = np.zeros(len(vertices))
        return cls(
            vertices=vertices,
            confidence=blank,
            samples=0,
            correlation=0.0,
            residual_px=0.0,
            views=0.0,
            evidence=FrameEvidence.nothing(len(vertices), views),
        )


class Registrar:
    """Registers frames of one take to its neutral.

    Args:
        surface: what is tracked.
        cameras: of the views, by device name.
        images: the reference images, float32 mono, of the views that have one.
        options: see `track.stage.TrackSettings`.
        flow: who measures it; None: the processor.
    """

    def __init__(
        self,
        surface: SurfaceModel,
        cameras: Mapping[str, Camera],
        images: Mapping[str, Floats32],
        options: RegistrarOptions,
        flow: FlowBackend | None = None,
    ) -> None:
        self._flow = flow if flow is not None else CpuFlow()
        self._surface, self._cameras, self._options = surface, cameras, options
        self._levels = options.windows.levels
        self._pool = ThreadPoolExecutor(options.threads or os.cpu_count() or 1)
        self._mm_per_px = _pixel_size(cameras, surface.neutral)
        self._deformers = {
            mm: LaplacianDeformer(surface.neutral, surface.triangles, Stiffness(bending_mm=mm))
            for mm in sorted({step.bending_mm for step in options.steps})
        }
        self._separation = Separation(surface.neutral, surface.triangles)
        self._neutral = self.reference(-1, surface.neutral, images)
        self._scout = HeadScout(
            self._matcher(None), options.steps[:2], options.search_stride, images
        )

    def reference(
        self,
        frame: int,
        vertices: Floats,
        images: Mapping[str, Floats32],
        only: Bools | None = None,
    ) -> FaceReference:
        """What a frame showed, its mesh being known, for others to be matched to.

        Args:
            frame: its number; -1 the neutral.
            vertices: (V, 3) world mm.
            images: float32 mono, of the views that have one.
            only: (V,) vertices around which it is wanted; None: all.
        """
        around: Bools | None = None
        if only is not None:
            around = np.asarray(only[self._surface.samples.corners].any(axis=1))
        return face_reference(
            self._surface, (frame, vertices), self._cameras, images, self._options.windows,
            self._pool, around,
        )  # fmt: skip

    @property
    def surface(self) -> SurfaceModel:
        """What is tracked."""
        return self._surface

    @property
    def views_of_samples(self) -> Ints:
        """How many views of the neutral see each sample, (N,)."""
        return self._neutral.seen

    def vertex_views(self) -> Floats:
        """Confidence (V,) of the reference itself: 1 where two views see the skin, 0 where none."""
        return self._surface.to_vertices(np.minimum(self._neutral.seen / 2.0, 1.0))

    def carried(self, vertices: Floats, confidence: Floats) -> Floats:
        """The mesh (V, 3) again from its confident vertices alone.

        What was not seen follows what was, from the neutral's own shape: so a lip that slipped
        behind the other one while it was hidden does not stay there, where nothing could see it.

        Args:
            vertices: (V, 3) world mm.
            confidence: (V,) 0..1.
        """
        sure = np.flatnonzero(confidence > _SURE)
        if len(sure) < 12:
            return vertices
        constraints = Constraints(
            corners=np.repeat(sure[:, None], 3, axis=1),
            barycentric=np.tile([1.0, 0.0, 0.0], (len(sure), 1)),
            targets=vertices[sure],
            weights=np.ones(len(sure)),
        )
        rest = self._surface.neutral
        rigid = fit_similarity(rest[sure], vertices[sure])
        supple = min(self._deformers)
        return self._deformers[supple].solve(
            constraints, start=rigid.apply(rest), data_weight=10.0, rotation_iterations=3
        )

    def pulled(self, start: Floats, sightings: Sequence[Sightings]) -> Floats:
        """The mesh (V, 3), world mm, brought to what is sighted, smoothly and near by only."""
        if not sightings:
            return start
        every = np.arange(len(start))
        held = Constraints(
            corners=np.repeat(every[:, None], 3, axis=1),
            barycentric=np.tile([1.0, 0.0, 0.0], (len(start), 1)),
            targets=start,
            weights=np.full(len(start), _HELD_WEIGHT),
        )
        supple, out = self._deformers[min(self._deformers)], start
        for _ in range(_PULLS):  # lifting is linear about the estimate
            skin = self._surface.skin(out)
            told = [one.constraints(out, skin, self._cameras) for one in sightings]
            joined = Constraints.joined([held, *told])
            out = supple.solve(joined, start=out, about=(out, np.ones(len(out))))
        return out

    def best_start(
        self, starts: Sequence[Floats], confidence: Floats, images: Mapping[str, Floats32]
    ) -> Floats:
        """Where to begin a frame: of several meshes, the one that the images fit, by region.

        Args:
            starts: (V, 3) each, world mm; the first is kept wherever no other is clearly better,
                and wherever the last frame was sure.
            confidence: (V,) of the last frame, 0..1.
            images: the frame's images, float32 mono.

        Returns:
            (V, 3) world mm; `starts[0]` itself when no other is better anywhere.
        """
        last = self._levels - 1
        views = self._neutral.views
        usable = [name for name in views if name in images]
        coarse = {name: image_pyramid(images[name], self._levels)[last] for name in usable}
        surface = self._surface
        skins = [surface.skin(start) for start in starts]

        def score(name: str) -> Floats:
            level = views[name][last]
            seen = [guided_view(level, surface.triangles, skin, coarse[name]) for skin in skins]
            return place_scores(level, seen, len(surface.samples))

        scores = np.stack(list(self._pool.map(score, usable)), axis=2)
        samples = surface.samples
        sure = (confidence[samples.corners] * samples.barycentric).sum(axis=1) > _HELD
        scores[1:, sure] = np.nan
        supple = self._deformers[min(self._deformers)]
        return blended_start(starts, scores, samples, surface.neighbours, supple)

    def scout(self, start: Floats, images: Mapping[str, Floats32]) -> tuple[Floats, float]:
        """Find the head as one rigid piece, and how far the face has left it: `HeadScout.find`."""
        return self._scout.find(start, images)

    def register(
        self, start: Floats, images: Mapping[str, Floats32], aids: FrameAids | None = None
    ) -> FrameResult:
        """Find the mesh in a frame.

        Args:
            start: (V, 3) where to begin, world mm.
            images: the frame's images, float32 mono; views without a reference are not used.
            aids: what else is known of the frame; None: nothing.

        Returns:
            The registered mesh and its figures.

        Raises:
            SolveError: when no view of the frame has a reference.
        """
        known = aids if aids is not None else FrameAids()
        usable = [name for name in self._neutral.views if name in images]
        if not usable:
            raise SolveError("no view of the frame has a reference image")
        pyramids = {name: image_pyramid(images[name], self._levels) for name in usable}
        matcher = self._matcher(known.second)
        vertices = start
        occluders: dict[str, tuple[Floats32, float]] = {}
        depth: ScanDepth | None = None
        agreed = self._neutral.seen
        for index, step in enumerate(self._options.steps):
            if index == 1:  # the first round has brought the mesh within the tolerance
                occluders = {name: self._depth(name, vertices) for name in usable}
            if known.scan is not None and depth is None and index > 0 and step.level == 0:
                depth = matcher.scan_depth(known.scan, vertices, agreed)
            seen = RoundImages(
                views={name: pyramids[name][step.level] for name in usable},
                occluders={
                    name: (drawn, scale / 2**step.level)
                    for name, (drawn, scale) in occluders.items()
                },
                depth=depth,
                stride=1 if index > 0 else self._options.search_stride,
                last=index == len(self._options.steps) - 1,
            )
            lifted, matches = matcher.measure(step, vertices, seen)
            before = vertices
            vertices, weights, agreement = self._solve(step, vertices, lifted, known.sightings)
            agreed = lifted.views
        samples = self._surface.samples
        moved = samples.points(vertices) - samples.points(before)
        told = frame_evidence(
            samples, len(vertices), matches, list(self._cameras), lifted, (agreement, moved)
        )
        found = self._result(vertices, lifted, weights, told)
        if self._options.contact:
            parted = self._separation.parted(found.vertices, found.confidence)
            found = replace(found, vertices=parted)
        return found if known.second is None else replace(found, reference=known.second.frame)

    def _matcher(self, second: FaceReference | None) -> Matcher:
        return Matcher(
            surface=self._surface,
            neutral=self._neutral,
            second=second,
            min_correlation=self._options.min_correlation,
            pool=self._pool,
            flow=self._flow,
            return_px=self._options.return_px,
        )

    def _depth(self, name: str, vertices: Floats) -> tuple[Floats32, float]:
        """A coarse depth map of the mesh, and how many finest pixels one of its pixels spans."""
        level = min(1, self._levels - 1)
        camera = self._neutral.views[name][level].camera
        surface = self._surface
        return surface.raster.render(camera, surface.skin(vertices)).depth, float(2**level)

    def _solve(
        self, step: Step, vertices: Floats, lifted: Lifted, sightings: Sequence[Sightings]
    ) -> tuple[Floats, Floats, Floats]:
        weights = lifted.information / (lifted.information + _typical(lifted.information))
        weights = np.where(lifted.views == 1, _SINGLE_VIEW, weights)
        floor_mm = step.scale_px * 2**step.level * self._mm_per_px
        agreement = _agreement(self._surface.neighbours, lifted.motion, weights, floor_mm)
        weights *= agreement
        constraints = self._flow_constraints(vertices, lifted, weights)
        deformer, turns = self._deformers[step.bending_mm], self._options.rotation_iterations
        solved = vertices
        if len(constraints.weights) >= _ENOUGH:
            solved = deformer.solve(constraints, start=vertices, rotation_iterations=turns)
        if near := [one for one in sightings if one.accuracy_px <= 2**step.level]:
            # What one view or a curve leaves open is left where the flow alone puts it.
            skin = self._surface.skin(solved)
            every = [constraints, *(one.constraints(solved, skin, self._cameras) for one in near)]
            solved = deformer.solve(
                Constraints.joined(every), start=solved, rotation_iterations=turns
            )
        return solved, weights, agreement

    def _flow_constraints(self, vertices: Floats, lifted: Lifted, weights: Floats) -> Constraints:
        """Where the lifted samples put the mesh; their weights (N,) are 1 in the mean."""
        used = np.flatnonzero(weights > 1e-4)
        chosen = self._surface.samples.select(used.astype(np.int32))
        return Constraints(
            corners=chosen.corners,
            barycentric=chosen.barycentric,
            targets=chosen.points(vertices) + lifted.motion[used],  # c = u - h n: Ma et al. 2.2
            weights=weights[used] / weights[used].mean() if len(used) else weights[used],
        )

    def _result(
        self, vertices: Floats, lifted: Lifted, weights: Floats, told: FrameEvidence
    ) -> FrameResult:
        agreed = lifted.views >= _AGREED
        residual = lifted.residual_px[agreed]
        sure = np.clip(weights / max(_typical(weights), 1e-9), 0.0, 1.0)
        return FrameResult(
            vertices=vertices,
            confidence=self._surface.to_vertices(sure),
            samples=int(agreed.sum()),
            correlation=told.mean_correlation(),
            residual_px=float(np.median(residual)) if len(residual) else float("nan"),
            views=float(lifted.views[agreed].mean()) if agreed.any() else 0.0,
            evidence=told,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameAids:
    """What else is known of a frame than its images.

    Attributes:
        scan: its own, world mm: it tells the depth of samples that one or two views alone see.
        second: another frame than the neutral, whose mesh is known, to match it to where the
            neutral serves no more.
        sightings: surface points whose pixels are known.
    """

    scan: Scan | None = None
    second: FaceReference | None = None
    sightings: tuple[Sightings, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RegistrarOptions:
    """What `Registrar` needs of the stage's settings.

    Attributes:
        steps: the rounds, coarse to fine.
        windows: how references are cut.
        min_correlation: least NCC believed.
        search_stride: in the first round every how manieth sample is matched.
        rotation_iterations: updates of the local frames in each solve.
        threads: over the views; 0: as many as there are processors. Results do not depend on it.
        contact: whether surfaces that crossed are pushed apart at the end.
        return_px: of the last round, how far a match may miss its way back.
    """

    steps: tuple[Step, ...]
    windows: ReferenceWindows
    min_correlation: float
    search_stride: int
    rotation_iterations: int
    threads: int = 0
    contact: bool = True
    return_px: float = np.inf

    def __post_init__(self) -> None:
        if not self.steps:
            raise SettingsError("steps: expected at least one")


def _agreement(
    neighbours: sparse.csr_matrix, motion: Floats, weights: Floats, floor_mm: float
) -> Floats:
    """Weights (N,) 0..1 that fall where a sample leaves the spread of its neighbours' motions.

    The spread is local: where the surface stretches or folds, neighbours move differently in
    earnest, and only a sample outside their range is an outlier.
    """
    factor: Floats = np.ones(len(weights))
    for _ in range(2):
        trust = weights * factor
        total = neighbours @ trust
        share = np.maximum(total, 1e-12)
        mean = (neighbours @ (trust[:, None] * motion)) / share[:, None]
        square = (neighbours @ (trust * (motion**2).sum(axis=1))) / share
        spread = np.sqrt(np.maximum(square - (mean**2).sum(axis=1), 0.0))
        away = np.linalg.norm(motion - mean, axis=1)
        factor = 1.0 / (1.0 + (away / (2.0 * spread + floor_mm)) ** 2) ** 2
        factor[total < 1e-6] = 0.25  # nobody beside it to ask
    return factor


def _pixel_size(cameras: Mapping[str, Camera], vertices: Floats) -> float:
    """How many mm a pixel spans at the mesh, in the middle of the cameras."""
    centre = vertices.mean(axis=0)[None]
    sizes = [abs(float(camera.depths(centre)[0])) / camera.fx for camera in cameras.values()]
    return float(np.median(sizes))


def _typical(values: Floats) -> float:
    positive = values[values > 0]
    return float(np.median(positive)) if len(positive) else 1.0
