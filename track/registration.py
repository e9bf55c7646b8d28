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
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from capture.arrays import Floats, Floats32, Ints, Ints32
from capture.camera import Camera
from capture.errors import SettingsError, SolveError
from recon.surface import Scan
from track.beyond import search_beyond
from track.evidence import FrameEvidence, ViewMatches, frame_evidence, view_matches
from track.flow import ALIGNED, FlowMatches, better, refine_flow, search_flow
from track.guide import GuidedView, guided_view
from track.laplacian import Constraints, LaplacianDeformer, Stiffness
from track.lift import Lifted, Observations, merged, triangulate
from track.observe import believable, observe
from track.pyramid import camera_at_level, image_pyramid
from track.raster import Rasterizer
from track.reference import ReferenceLevel, facing_normals, reference_level, visible_samples
from track.rigid import fit_similarity
from track.scan_depth import ScanDepth, depth_observations
from track.schedule import Step
from track.start import blended_start, place_scores
from track.surface_samples import SurfaceSamples, sample_surface, vertex_rings

_PRIOR_MM = 1.0
_SURE = 0.25  # confidence from which a vertex carries its neighbours into the next frame
_HELD = 0.8  # confidence from which skin is not looked for elsewhere in the next frame
_SINGLE_VIEW = 0.02  # weight of a sample that one view alone sees, and no scan: of unknown depth
_AGREED = 2  # witnesses, views or a view and the scan, that fix a sample's place
_FEW = 2  # a sample that no more views than this see gets its depth from the scan too
_RINGS = 3  # edges within which two triangles count as one piece of surface


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
    """

    vertices: Floats
    confidence: Floats
    samples: int
    correlation: float
    residual_px: float
    views: float
    evidence: FrameEvidence

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
        neutral: (V, 3) vertices at the reference frame, world mm.
        triangles: (T, 3).
        cameras: of the views, by device name.
        images: the reference images, float32 mono, of the views that have one.
        options: see `track.stage.TrackSettings`.
        heights_mm: (V,) how far the skin lies over the neutral, along its normals; None: on it.
            What is matched is the skin, b + h n; what is solved for is the mesh, b.
    """

    def __init__(
        self,
        neutral: Floats,
        triangles: Ints32,
        cameras: Mapping[str, Camera],
        images: Mapping[str, Floats32],
        options: RegistrarOptions,
        heights_mm: Floats | None = None,
    ) -> None:
        self._neutral, self._triangles = neutral, triangles
        self._heights, self._cameras = heights_mm, cameras
        self._options = options
        self._samples = sample_surface(neutral, triangles, options.spacing_mm)
        self._raster = Rasterizer(triangles, len(neutral))
        self._rings = vertex_rings(triangles, len(neutral), _RINGS)
        self._levels = max(step.level for step in options.steps) + 1
        self._pool = ThreadPoolExecutor(os.cpu_count() or 1)  # the kernels let go of the GIL
        self._views = {name: self._reference(cameras[name], images[name]) for name in images}
        seen = np.zeros(len(self._samples), np.int64)
        for levels in self._views.values():
            seen[levels[0].samples] += 1
        self._seen = seen
        self._mm_per_px = _pixel_size(cameras, neutral)
        self._deformers = {
            mm: LaplacianDeformer(neutral, triangles, Stiffness(bending_mm=mm))
            for mm in sorted({step.bending_mm for step in options.steps})
        }
        self._neighbours = _neighbour_matrix(self._samples, triangles, len(neutral))

    @property
    def views_of_samples(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """How many reference views see each sample, (N,)."""
        return self._seen

    def vertex_views(self) -> Floats:
        """Confidence (V,) of the reference itself: 1 where two views see the skin, 0 where none."""
        return self._to_vertices(np.minimum(self._seen / 2.0, 1.0))

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
        rigid = fit_similarity(self._neutral[sure], vertices[sure])
        supple = min(self._deformers)
        return self._deformers[supple].solve(
            constraints, start=rigid.apply(self._neutral), data_weight=10.0, rotation_iterations=3
        )

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
            (V, 3) world mm.
        """
        last = self._levels - 1
        usable = [name for name in self._views if name in images]
        coarse = {name: image_pyramid(images[name], self._levels)[last] for name in usable}
        skins = [self._skin(start) for start in starts]

        def score(name: str) -> Floats:
            level = self._views[name][last]
            seen = [guided_view(level, self._triangles, skin, coarse[name]) for skin in skins]
            return place_scores(level, seen, len(self._samples))

        scores = np.stack(list(self._pool.map(score, usable)), axis=2)
        sure = (confidence[self._samples.corners] * self._samples.barycentric).sum(axis=1) > _HELD
        scores[1:, sure] = np.nan
        supple = self._deformers[min(self._deformers)]
        return blended_start(starts, scores, self._samples, self._neighbours, supple)

    def register(
        self, start: Floats, images: Mapping[str, Floats32], scan: Scan | None = None
    ) -> FrameResult:
        """Find the mesh in a frame.

        Args:
            start: (V, 3) where to begin, world mm.
            images: the frame's images, float32 mono; views without a reference are not used.
            scan: the frame's own, world mm, where there is one: it tells the depth of samples
                that one or two views alone see.

        Returns:
            The registered mesh and its figures.

        Raises:
            SolveError: when no view of the frame has a reference.
        """
        usable = [name for name in self._views if name in images]
        if not usable:
            raise SolveError("no view of the frame has a reference image")
        pyramids = {name: image_pyramid(images[name], self._levels) for name in usable}
        vertices = start
        occluders: dict[str, tuple[Floats32, float]] = {}
        depth: ScanDepth | None = None
        agreed = self._seen
        for index, step in enumerate(self._options.steps):
            if index == 1:  # the first round has brought the mesh within the tolerance
                occluders = {name: self._depth(name, vertices) for name in usable}
            if scan is not None and depth is None and index > 0 and step.level == 0:
                depth = self._scan_depth(scan, vertices, agreed)
            scaled = {
                name: (depth, scale / 2**step.level) for name, (depth, scale) in occluders.items()
            }
            views = {name: pyramids[name][step.level] for name in usable}
            lifted, matches = self._measure(step, vertices, views, scaled, depth)
            before = vertices
            vertices, weights, agreement = self._solve(step, vertices, lifted)
            agreed = lifted.views
        moved = self._samples.points(vertices) - self._samples.points(before)
        told = frame_evidence(
            self._samples, len(vertices), matches, list(self._cameras), lifted, (agreement, moved)
        )
        return self._result(vertices, lifted, weights, told)

    def _reference(self, camera: Camera, image: Floats32) -> list[ReferenceLevel]:
        skin = self._skin(self._neutral)
        points = self._samples.points(skin)
        lenses = [camera_at_level(camera, level) for level in range(self._levels)]
        drawn = [self._raster.render(lens, skin) for lens in lenses]
        normals = facing_normals(self._neutral, self._triangles)
        chosen = visible_samples(
            self._samples, skin, normals, camera, drawn[0], self._options.min_cosine
        )
        surface = (self._triangles, self._samples.triangle[chosen], self._rings)
        fine, coarse = self._options.half_window, self._options.half_window_coarse

        def build(level: int, picture: Floats32) -> ReferenceLevel:
            pixels = lenses[level].project(points[chosen])
            half = fine if level == 0 else coarse
            return reference_level(
                lenses[level], picture, drawn[level], pixels, chosen, surface, half
            )

        pyramid = image_pyramid(image, self._levels)
        return list(self._pool.map(build, range(self._levels), pyramid))

    def _depth(self, name: str, vertices: Floats) -> tuple[Floats32, float]:
        """A coarse depth map of the mesh, and how many finest pixels one of its pixels spans."""
        level = min(1, self._levels - 1)
        camera = self._views[name][level].camera
        return self._raster.render(camera, self._skin(vertices)).depth, float(2**level)

    def _skin(self, vertices: Floats) -> Floats:
        """The skin (V, 3) over a mesh: normal displacements ride on its own normals."""
        if self._heights is None:
            return vertices
        lifted: Floats = vertices + self._heights[:, None] * facing_normals(
            vertices, self._triangles
        )
        return lifted

    def _measure(
        self,
        step: Step,
        vertices: Floats,
        images: Mapping[str, Floats32],
        occluders: Mapping[str, tuple[Floats32, float]],
        depth: ScanDepth | None,
    ) -> tuple[Lifted, dict[str, ViewMatches]]:
        skin = self._skin(vertices)
        points = self._samples.points(skin)

        def measure(name: str) -> ViewMatches:
            level = self._views[name][step.level]
            view = guided_view(level, self._triangles, skin, images[name], occluders.get(name))
            matches = self._match(step, level, view, images[name])
            believed = believable(matches, self._options.min_correlation, step.limit_px)
            seen = observe(level, view, matches, points, believed)
            return view_matches(level, view, matches.correlation, seen)

        measured = dict(zip(images, self._pool.map(measure, images), strict=True))
        parts = [matches.observations for matches in measured.values()]
        if depth is not None:
            parts += self._depths(depth, dict(zip(images, parts, strict=True)), skin)
        lifted = triangulate(merged(parts), len(self._samples), step.scale_px, _PRIOR_MM)
        return lifted, measured

    def _scan_depth(self, scan: Scan, vertices: Floats, agreed: Ints) -> ScanDepth:
        """The scan around samples that few views agreed on (N,), and any view can see."""
        poor = (self._seen > 0) & (agreed <= _FEW)
        return ScanDepth(scan, self._samples.points(self._skin(vertices))[poor])

    def _depths(
        self, depth: ScanDepth, seen: Mapping[str, Observations], skin: Floats
    ) -> list[Observations]:
        """What the scan adds to the matches of samples that few views see."""
        times = np.zeros(len(self._samples), np.int64)
        for part in seen.values():
            times[part.sample] += 1
        normals = self._samples.points(facing_normals(skin, self._triangles))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        estimate = (self._samples.points(skin), normals)
        return [
            depth_observations(
                depth, self._views[name][0].camera, part, times[part.sample] <= _FEW, estimate
            )
            for name, part in seen.items()
        ]

    def _match(
        self, step: Step, level: ReferenceLevel, view: GuidedView, image: Floats32
    ) -> FlowMatches:
        stride = self._options.search_stride if step is self._options.steps[0] else 1
        chosen = level.samples % stride == 0
        found = search_flow(level, view, chosen, step.search_px)
        matches = refine_flow(level, view, found.displacement, step.iterations)
        lost = chosen & level.at_edge & (matches.correlation < ALIGNED)
        return better(
            matches, search_beyond(level, view, image, lost, (step.search_px, step.iterations))
        )

    def _solve(self, step: Step, vertices: Floats, lifted: Lifted) -> tuple[Floats, Floats, Floats]:
        weights = lifted.information / (lifted.information + _typical(lifted.information))
        weights = np.where(lifted.views == 1, _SINGLE_VIEW, weights)
        floor_mm = step.scale_px * 2**step.level * self._mm_per_px
        agreement = _agreement(self._neighbours, lifted.motion, weights, floor_mm)
        weights *= agreement
        used = np.flatnonzero(weights > 1e-4)
        if len(used) < 12:
            return vertices, weights, agreement
        chosen = self._samples.select(used.astype(np.int32))
        targets = chosen.points(vertices) + lifted.motion[used]  # c = u - h n: Ma et al. 2.2
        constraints = Constraints(
            corners=chosen.corners,
            barycentric=chosen.barycentric,
            targets=targets,
            weights=weights[used] / weights[used].mean(),
        )
        solved = self._deformers[step.bending_mm].solve(
            constraints, start=vertices, rotation_iterations=self._options.rotation_iterations
        )
        return solved, weights, agreement

    def _result(
        self, vertices: Floats, lifted: Lifted, weights: Floats, told: FrameEvidence
    ) -> FrameResult:
        agreed = lifted.views >= _AGREED
        residual = lifted.residual_px[agreed]
        sure = np.clip(weights / max(_typical(weights), 1e-9), 0.0, 1.0)
        return FrameResult(
            vertices=vertices,
            confidence=self._to_vertices(sure),
            samples=int(agreed.sum()),
            correlation=told.mean_correlation(),
            residual_px=float(np.median(residual)) if len(residual) else float("nan"),
            views=float(lifted.views[agreed].mean()) if agreed.any() else 0.0,
            evidence=told,
        )

    def _to_vertices(self, values: Floats) -> Floats:
        """Mean (V,) of the samples' values (N,) around each vertex; 0 where there is none."""
        corners, share = self._samples.corners.ravel(), self._samples.barycentric.ravel()
        count = len(self._neutral)
        total = np.bincount(corners, share, minlength=count)
        mixed = np.bincount(corners, share * np.repeat(values, 3), minlength=count)
        mean: Floats = np.divide(mixed, total, out=np.zeros(count), where=total > 0)
        return mean


@dataclass(frozen=True, kw_only=True)
class RegistrarOptions:
    """What `Registrar` needs of the stage's settings.

    Attributes:
        steps: the rounds, coarse to fine.
        spacing_mm: distance between samples.
        half_window: windows have 2 half + 1 px a side at the finest level.
        half_window_coarse: the same at the other levels.
        min_cosine: least cosine between normal and view.
        min_correlation: least NCC believed.
        search_stride: every how manieth sample is searched by whole pixels.
        rotation_iterations: updates of the local frames in each solve.
    """

    steps: tuple[Step, ...]
    spacing_mm: float
    half_window: int
    half_window_coarse: int
    min_cosine: float
    min_correlation: float
    search_stride: int
    rotation_iterations: int

    def __post_init__(self) -> None:
        if not self.steps:
            raise SettingsError("steps: expected at least one")


def _neighbour_matrix(
    samples: SurfaceSamples, triangles: Ints32, vertex_count: int
) -> sparse.csr_matrix:
    """Which samples lie around the same vertices, (N, N) csr of ones without the diagonal."""
    rows = np.arange(len(samples))
    own = samples.corners[rows, samples.barycentric.argmax(axis=1)]
    pick = sparse.csr_matrix((np.ones(len(rows)), (rows, own)), (len(rows), vertex_count))
    near = pick @ vertex_rings(triangles, vertex_count, 1) @ pick.T
    near.setdiag(0)
    near.eliminate_zeros()
    near.data[:] = 1.0
    return sparse.csr_matrix(near)


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
