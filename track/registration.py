"""Registration of one frame: guide, match, lift and solve, from coarse to fine.

The mesh is carried from its last place; each step warps every view into the reference by the
mesh's motion field, measures what is left, triangulates it and solves for the mesh again, stiff
first and supple last. Every measurement is against the reference frame, so errors of one frame
are not handed to the next: the last place only says where to look.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from capture.arrays import Bools, Floats, Floats32, Ints32
from capture.camera import Camera
from capture.errors import SettingsError, SolveError
from track.flow import FlowMatches, refine_flow, search_flow
from track.guide import GuidedView, guided_view
from track.laplacian import Constraints, LaplacianDeformer, Stiffness
from track.lift import Lifted, Observations, triangulate
from track.pyramid import camera_at_level, image_pyramid
from track.raster import Rasterizer
from track.reference import ReferenceLevel, facing_normals, reference_level, visible_samples
from track.surface_samples import SurfaceSamples, sample_surface, vertex_rings

_WINDOW_GAIN = 50.0  # independent pixels of a window, about: turns the windows' shape into px^-2
_PRIOR_MM = 1.0
_RINGS = 3  # edges within which two triangles count as one piece of surface


@dataclass(frozen=True, kw_only=True)
class Step:
    """One round of guide, match, lift and solve.

    Attributes:
        level: pyramid level, 0 the finest.
        search_px: half side of the whole-pixel search, px of the level; 0 refines only.
        iterations: Gauss-Newton steps of the sub-pixel refinement.
        limit_px: longest displacement believed, px of the level.
        scale_px: robust scale of the triangulation, px of the level.
        bending_mm: stiffness of the solve.
    """

    level: int
    search_px: int
    iterations: int
    limit_px: float
    scale_px: float
    bending_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameResult:
    """One registered frame.

    Attributes:
        vertices: (V, 3) world mm.
        confidence: (V,) 0..1.
        samples: how many samples two or more views agree on.
        correlation: mean NCC of the matches of the last step.
        residual_px: median distance between matches and the projected lifted points.
        views: mean number of views that agree on a sample.
    """

    vertices: Floats
    confidence: Floats
    samples: int
    correlation: float
    residual_px: float
    views: float

    @classmethod
    def lost(cls, vertices: Floats) -> FrameResult:
        """A frame that could not be measured: the prediction, with confidence 0."""
        blank = np.zeros(len(vertices))
        return cls(
            vertices=vertices,
            confidence=blank,
            samples=0,
            correlation=0.0,
            residual_px=0.0,
            views=0.0,
        )


class Registrar:
    """Registers frames of one take to its neutral.

    Args:
        neutral: (V, 3) vertices at the reference frame, world mm.
        triangles: (T, 3).
        cameras: of the views, by device name.
        images: the reference images, float32 mono, of the views that have one.
        options: see `track.stage.TrackSettings`.
    """

    def __init__(
        self,
        neutral: Floats,
        triangles: Ints32,
        cameras: Mapping[str, Camera],
        images: Mapping[str, Floats32],
        options: RegistrarOptions,
    ) -> None:
        self._neutral, self._triangles = neutral, triangles
        self._options = options
        self._samples = sample_surface(neutral, triangles, options.spacing_mm)
        self._raster = Rasterizer(triangles, len(neutral))
        self._rings = vertex_rings(triangles, len(neutral), _RINGS)
        self._levels = max(step.level for step in options.steps) + 1
        self._views = {
            name: self._reference(cameras[name], image) for name, image in images.items()
        }
        seen = np.zeros(len(self._samples), np.int64)
        for levels in self._views.values():
            seen[levels[0].samples] += 1
        self._seen = seen
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

    def register(self, start: Floats, images: Mapping[str, Floats32]) -> FrameResult:
        """Find the mesh in a frame.

        Args:
            start: (V, 3) where to begin, world mm.
            images: the frame's images, float32 mono; views without a reference are not used.

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
        for index, step in enumerate(self._options.steps):
            if index == 1 or index == len(self._options.steps) - 1:
                occluders = {name: self._depth(name, vertices) for name in usable}
            scaled = {
                name: (depth, scale / 2**step.level) for name, (depth, scale) in occluders.items()
            }
            views = {name: pyramids[name][step.level] for name in usable}
            lifted, score = self._measure(step, vertices, views, scaled)
            vertices, weights = self._solve(step, vertices, lifted)
        return self._result(vertices, lifted, weights, score)

    def _reference(self, camera: Camera, image: Floats32) -> list[ReferenceLevel]:
        normals = facing_normals(self._neutral, self._triangles)
        out: list[ReferenceLevel] = []
        chosen = np.empty(0, np.int32)
        for level, picture in enumerate(image_pyramid(image, self._levels)):
            small = camera_at_level(camera, level)
            buffers = self._raster.render(small, self._neutral)
            if level == 0:
                chosen = visible_samples(
                    self._samples, self._neutral, normals, camera, buffers,
                    self._options.min_cosine,
                )  # fmt: skip
            pixels = small.project(self._samples.points(self._neutral)[chosen])
            surface = (self._triangles, self._samples.triangle[chosen], self._rings)
            half = self._options.half_window if level == 0 else self._options.half_window_coarse
            out.append(reference_level(small, picture, buffers, pixels, chosen, surface, half))
        return out

    def _depth(self, name: str, vertices: Floats) -> tuple[Floats32, float]:
        """A coarse depth map of the mesh, and how many finest pixels one of its pixels spans."""
        level = min(1, self._levels - 1)
        camera = self._views[name][level].camera
        return self._raster.render(camera, vertices).depth, float(2**level)

    def _measure(
        self,
        step: Step,
        vertices: Floats,
        images: Mapping[str, Floats32],
        occluders: Mapping[str, tuple[Floats32, float]],
    ) -> tuple[Lifted, float]:
        points = self._samples.points(vertices)
        parts: list[Observations] = []
        scores: list[Floats] = []
        for name, image in images.items():
            level = self._views[name][step.level]
            view = guided_view(level, self._triangles, vertices, image, occluders.get(name))
            matches = self._match(step, level, view)
            found, kept = _observations(level, view, matches, points, self._limits(step))
            parts.append(found)
            scores.append(matches.correlation[kept])
        every = np.concatenate(scores)
        merged = Observations(
            sample=np.concatenate([part.sample for part in parts]),
            offset=np.concatenate([part.offset for part in parts]),
            jacobian=np.concatenate([part.jacobian for part in parts]),
            information=np.concatenate([part.information for part in parts]),
        )
        lifted = triangulate(merged, len(self._samples), step.scale_px, _PRIOR_MM)
        return lifted, float(every.mean()) if len(every) else 0.0

    def _limits(self, step: Step) -> tuple[float, float]:
        return self._options.min_correlation, step.limit_px

    def _match(self, step: Step, level: ReferenceLevel, view: GuidedView) -> FlowMatches:
        start = np.zeros((len(level.samples), 2))
        if step.search_px > 0:
            chosen = level.samples % self._options.search_stride == 0
            found = search_flow(level, view, chosen, step.search_px)
            start = found.displacement
        return refine_flow(level, view, start, step.iterations)

    def _solve(self, step: Step, vertices: Floats, lifted: Lifted) -> tuple[Floats, Floats]:
        weights = lifted.information / (lifted.information + _typical(lifted.information))
        weights = np.where(lifted.views >= 2, weights, 0.05 * weights)
        weights = np.where(lifted.views >= 1, weights, 0.0)
        weights *= _agreement(self._neighbours, lifted.motion, weights)
        used = np.flatnonzero(weights > 1e-4)
        if len(used) < 12:
            return vertices, weights
        chosen = self._samples.select(used.astype(np.int32))
        targets = chosen.points(vertices) + lifted.motion[used]
        constraints = Constraints(
            corners=chosen.corners,
            barycentric=chosen.barycentric,
            targets=targets,
            weights=weights[used] / weights[used].mean(),
        )
        solved = self._deformers[step.bending_mm].solve(
            constraints, start=vertices, rotation_iterations=self._options.rotation_iterations
        )
        return solved, weights

    def _result(
        self, vertices: Floats, lifted: Lifted, weights: Floats, score: float
    ) -> FrameResult:
        agreed = lifted.views >= 2
        residual = lifted.residual_px[agreed]
        sure = np.clip(weights / max(_typical(weights), 1e-9), 0.0, 1.0)
        return FrameResult(
            vertices=vertices,
            confidence=self._to_vertices(sure),
            samples=int(agreed.sum()),
            correlation=score,
            residual_px=float(np.median(residual)) if len(residual) else float("nan"),
            views=float(lifted.views[agreed].mean()) if agreed.any() else 0.0,
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


def _observations(
    level: ReferenceLevel,
    view: GuidedView,
    matches: FlowMatches,
    points: Floats,
    limits: tuple[float, float],
) -> tuple[Observations, Bools]:
    """A view's believable matches as observations, and which they are."""
    least, longest = limits
    kept = (matches.correlation > least) & (
        np.abs(np.nan_to_num(matches.displacement, nan=1e9)).max(axis=1) < longest
    )
    slope = _slopes(view.place, level.centres)
    kept &= np.isfinite(slope).all(axis=(1, 2))
    slope = slope[kept]
    offset = np.einsum("lxy,ly->lx", slope, matches.displacement[kept])
    xx, xy, yy = matches.information[kept].T
    shape = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    back = np.linalg.inv(slope)
    shape = back.transpose(0, 2, 1) @ shape @ back
    noise = 2.0 * (1.0 - matches.correlation[kept]) + 0.02
    shape *= (_WINDOW_GAIN / noise)[:, None, None]
    which = level.samples[kept]
    found = Observations(
        sample=which,
        offset=offset,
        jacobian=level.camera.project_jacobian(points[which]),
        information=np.stack([shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]], axis=1),
    )
    return found, kept


def _slopes(place: Floats32, centres: Ints32) -> Floats:
    """Derivative (M, 2, 2) of the guide at the centres: frame px per reference px; NaN unknown."""
    height, width = place.shape[:2]
    x = np.clip(centres[:, 0], 1, width - 2)
    y = np.clip(centres[:, 1], 1, height - 2)
    out = np.empty((len(centres), 2, 2))
    here = place[y, x].astype(np.float64)
    for axis, (v, u) in enumerate(((0, 1), (1, 0))):
        after = place[y + v, x + u].astype(np.float64) - here
        before = here - place[y - v, x - u].astype(np.float64)
        both = np.stack([after, before])
        known = np.isfinite(both).all(axis=2)
        total = np.where(known[..., None], both, 0.0).sum(axis=0)
        count = known.sum(axis=0)
        mean = total / np.maximum(count, 1)[:, None]
        out[:, :, axis] = np.where(count[:, None] > 0, mean, np.nan)
    area: Floats = out[:, 0, 0] * out[:, 1, 1] - out[:, 0, 1] * out[:, 1, 0]
    folded: Bools = np.less(np.abs(np.nan_to_num(area)), 0.05)  # or turned away
    out[folded] = np.nan
    return out


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


def _agreement(neighbours: sparse.csr_matrix, motion: Floats, weights: Floats) -> Floats:
    """Weights (N,) 0..1 that fall where a sample moves otherwise than its neighbours."""
    trust = weights.copy()
    factor: Floats = np.ones(len(weights))
    for _ in range(2):
        total = neighbours @ trust
        mean = (neighbours @ (trust[:, None] * motion)) / np.maximum(total, 1e-9)[:, None]
        away = np.linalg.norm(motion - mean, axis=1)
        scale = 3.0 * 1.4826 * _typical(away[weights > 0]) + 0.05
        factor = 1.0 / (1.0 + (away / scale) ** 2) ** 2
        factor[total < 1e-6] = 0.25
        trust = weights * factor
    return factor


def _typical(values: Floats) -> float:
    positive = values[values > 0]
    return float(np.median(positive)) if len(positive) else 1.0


def schedule(
    levels: int, search_px: float, passes: int, bending_mm: Sequence[float]
) -> tuple[Step, ...]:
    """The steps of a frame: search at the coarsest level, refine at the others.

    Args:
        levels: how many pyramid levels.
        search_px: half side of the search, px of the finest level.
        passes: rounds at the finest level.
        bending_mm: stiffness at the coarsest level and in the last round; between, geometric.
    """
    coarse, fine = bending_mm
    order = [*range(levels - 1, 0, -1), *[0] * passes]
    share = np.linspace(0.0, 1.0, len(order)) if len(order) > 1 else np.ones(1)
    out = []
    for index, level in enumerate(order):
        radius = max(1, round(search_px / 2**level)) if index == 0 else 0
        last = index == len(order) - 1
        out.append(
            Step(
                level=level,
                search_px=radius,
                iterations=3 if not last else 2,
                limit_px=radius + 1.5 if index == 0 else 3.0 if not last else 1.5,
                scale_px=1.5 if index == 0 else 1.0 if not last else 0.7,
                bending_mm=float(coarse * (fine / coarse) ** share[index]),
            )
        )
    return tuple(out)
