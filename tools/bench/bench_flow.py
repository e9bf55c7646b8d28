"""Flow by ours and by OpenCV's methods between the same guide, lift and solve.

    python -m tools.bench.bench_flow TAKE [--frames 5 6] [--views 8] [--methods ours LK]

Of a visiting take with truth, each frame is registered from where its last one truly was, by the
tracker's rounds: every view warped into the first frame by the mesh's motion field, its flow
measured by one method, lifted and solved. The same pairs, rounds, windows and weights for all.
One JSON line a method:

    epe_median_px, epe_p95_px   endpoint error of the last round's flow against the projected truth,
                                at samples truly seen in both pictures of a pair
    within_03px                 share of these samples within 0.3 px; unmatched ones are not
    rmse_mm, median_mm          of the vertices on face that two cameras see
    flow_s_per_mp               processor seconds of flow, all rounds, a megapixel and view pair
    guide_s_per_mp              the same of the warp, which all share

`ours, rigid guide` is ours with views warped by the rigid motion of the head alone, the flow begun
where the mesh is: what following the surface's own motion earns.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture.archive import read_archive
from capture.arrays import Bools, Floats, Floats32, Ints
from capture.camera import Camera
from capture.camera_file import read_cameras
from recon.images import mono
from recon.mesh import read_obj
from tools.bench.flow_methods import FlowMethod, methods
from track.face_reference import FaceReference, ReferenceWindows, face_reference
from track.flow import FlowMatches, refine_flow
from track.guide import GuidedView, guided_view
from track.laplacian import Constraints, LaplacianDeformer, Stiffness
from track.lift import Lifted, Observations, merged, triangulate
from track.observe import believable, observe
from track.pyramid import image_pyramid, level_count
from track.reference import ReferenceLevel, facing_normals, visible_samples
from track.rigid import fit_similarity
from track.schedule import Step, schedule
from track.stage import TrackSettings
from track.surface_model import SurfaceModel
from track.visibility import count_views

RIGID = "ours, rigid guide"
_PRIOR_MM, _SINGLE_VIEW = 1.0, 0.02  # as the tracker's
_CLOSE_PX = 0.3
_NARROW = 6706  # vertices of the face in takes of the ICT head, which name no face_region


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A take's first frame, ready to match others to, and its truth.

    Attributes:
        cameras: by device name.
        images: reader of a frame's images.
        truth: (F, V, 3) world mm.
        face: indices of the vertices scored.
        surface: the neutral and its samples.
        reference: what each view showed first.
        steps: the rounds.
        settings: the tracker's.
    """

    source: Path
    cameras: Mapping[str, Camera]
    truth: Floats
    face: Ints
    surface: SurfaceModel
    reference: FaceReference
    steps: tuple[Step, ...]
    settings: TrackSettings

    def images(self, frame: int) -> dict[str, Floats32]:
        """A frame's images, 0..1."""
        return _images(self.source, self.cameras, frame)


@dataclass
class Tally:
    """What a method did over several frames."""

    flow_s: float = 0.0
    guide_s: float = 0.0
    megapixels: float = 0.0
    endpoint_px: list[Floats] = field(default_factory=list)
    vertex_mm: list[Floats] = field(default_factory=list)

    def row(self) -> dict[str, float]:
        """Figures, as the module says."""
        endpoint, vertex = np.concatenate(self.endpoint_px), np.concatenate(self.vertex_mm)
        matched = endpoint[np.isfinite(endpoint)]
        figures = {
            "epe_median_px": np.median(matched),
            "epe_p95_px": np.percentile(matched, 95),
            "within_03px": (endpoint < _CLOSE_PX).mean(),
            "matched": np.isfinite(endpoint).mean(),
            "rmse_mm": np.sqrt((vertex**2).mean()),
            "median_mm": np.median(vertex),
            "p95_mm": np.percentile(vertex, 95),
            "flow_s_per_mp": self.flow_s / self.megapixels,
            "guide_s_per_mp": self.guide_s / self.megapixels,
        }
        return {name: round(float(value), 4) for name, value in figures.items()}


def load_scene(source: Path, view_count: int, settings: TrackSettings) -> Scene:
    """Read a visiting take's cameras, neutral, truth and first frame.

    Args:
        source: the take.
        view_count: how many views from the middle of the array are used; 0 for all.
        settings: the tracker's.
    """
    array = read_cameras(source / "cameras.json")
    middle = len(array) // 2
    first = max(middle - view_count // 2, 0) if view_count else 0
    chosen = list(array)[first : first + view_count if view_count else None]
    cameras = {camera.name: camera for camera in chosen}
    truth = read_archive(source / "truth.npz", ["vertices"], ["face_region"])
    placed = truth["vertices"].astype(np.float64)
    triangles = read_obj(source / "neutral.obj").triangles
    surface = SurfaceModel.of(placed[0], triangles, settings.spacing_mm, None)
    levels = min(level_count(camera.width, camera.height) for camera in chosen)
    windows = ReferenceWindows(
        levels=levels,
        half=settings.half_window_px,
        half_coarse=settings.half_window_coarse_px,
        min_cosine=settings.min_cosine,
    )
    centre = placed[0].mean(axis=0)[None]
    px_per_mm = np.median([camera.fx / float(camera.depths(centre)[0]) for camera in chosen])
    bending = (settings.bending_coarse_mm, settings.bending_mm)
    with ThreadPoolExecutor(1) as pool:
        images = _images(source, cameras, 0)
        reference = face_reference(surface, (-1, placed[0]), cameras, images, windows, pool)
    return Scene(
        source=source,
        cameras=cameras,
        truth=placed,
        face=truth.get("face_region", np.arange(min(_NARROW, placed.shape[1]))),
        surface=surface,
        reference=reference,
        steps=schedule(levels, settings.search_mm * float(px_per_mm), settings.passes, bending),
        settings=settings,
    )


class Rounds:
    """Registers frames by the tracker's rounds with one method of flow.

    Args:
        scene: the take.
        method: of flow.
        rigid: guide by the head's rigid motion alone.
    """

    def __init__(self, scene: Scene, method: FlowMethod, rigid: bool) -> None:
        self._scene, self._method, self._rigid = scene, method, rigid
        neutral, triangles = scene.surface.neutral, scene.surface.triangles
        self._deformers = {
            step.bending_mm: LaplacianDeformer(
                neutral, triangles, Stiffness(bending_mm=step.bending_mm)
            )
            for step in scene.steps
        }

    def frame(self, number: int, tally: Tally) -> None:
        """Register a frame from where its last one was, and add to the tally."""
        scene = self._scene
        images = scene.images(number)
        levels = 1 + max(step.level for step in scene.steps)
        pyramids = {name: image_pyramid(image, levels) for name, image in images.items()}
        vertices = scene.truth[number - 1]
        occluders: dict[str, tuple[Floats32, float]] = {}
        for index, step in enumerate(scene.steps):
            if index == 1:
                occluders = {name: self._depth(name, vertices) for name in images}
            seen: dict[str, Observations] = {}
            for name in images:
                hidden = None
                if name in occluders:
                    hidden = (occluders[name][0], occluders[name][1] / 2**step.level)
                shown = (name, pyramids[name][step.level], hidden)
                told, raw = self._view(index, vertices, shown, tally)
                seen[name] = told
                if index == len(scene.steps) - 1:
                    tally.endpoint_px.append(self._endpoints(name, number, vertices, raw))
            parts = [seen[name] for name in images]
            count = len(scene.surface.samples)
            lifted = triangulate(merged(parts), count, step.scale_px, _PRIOR_MM)
            vertices = self._solve(step, vertices, lifted)
        tally.megapixels += sum(image.size for image in images.values()) / 1e6
        tally.vertex_mm.append(self._vertex_errors(number, vertices))

    def _view(
        self,
        index: int,
        vertices: Floats,
        shown: tuple[str, Floats32, tuple[Floats32, float] | None],
        tally: Tally,
    ) -> tuple[Observations, Observations]:
        """One view's matches: those believed, and all, as offsets from the mesh's estimate."""
        name, image, hidden = shown
        scene, step = self._scene, self._scene.steps[index]
        level = scene.reference.views[name][step.level]
        surface = scene.surface
        carrier = vertices
        if self._rigid:
            carrier = fit_similarity(surface.neutral, vertices).apply(surface.neutral)
        began = time.process_time()
        view = guided_view(level, surface.triangles, carrier, image, hidden)
        tally.guide_s += time.process_time() - began
        points, carried = surface.samples.points(vertices), surface.samples.points(carrier)
        ahead = level.camera.project(points[level.samples])
        ahead -= level.camera.project(carried[level.samples])
        chosen = level.samples % (scene.settings.search_stride if index == 0 else 1) == 0
        began = time.process_time()
        matches = self._matched(level, view, image, chosen, (step, ahead))
        tally.flow_s += time.process_time() - began
        left = replace(matches, displacement=matches.displacement - ahead)
        believed = believable(left, scene.settings.min_correlation, step.limit_px)
        every: Bools = np.asarray(np.isfinite(matches.displacement).all(axis=1))
        told = [observe(level, view, matches, carried, which) for which in (believed, every)]
        shift = np.zeros((len(points), 2))
        shift[level.samples] = ahead
        jacobians = [level.camera.project_jacobian(points[each.sample]) for each in told]
        one, other = (
            replace(each, offset=each.offset - shift[each.sample], jacobian=jacobian)
            for each, jacobian in zip(told, jacobians, strict=True)
        )
        return one, other

    def _matched(
        self,
        level: ReferenceLevel,
        view: GuidedView,
        image: Floats32,
        chosen: Bools,
        round_: tuple[Step, Floats],
    ) -> FlowMatches:
        step, ahead = round_
        if self._rigid and step is not self._scene.steps[0]:
            return refine_flow(level, view, ahead, 2 * step.iterations)
        return self._method.match(level, view, image, chosen, step)

    def _solve(self, step: Step, vertices: Floats, lifted: Lifted) -> Floats:
        positive = lifted.information[lifted.information > 0]
        typical = float(np.median(positive)) if len(positive) else 1.0
        weights = lifted.information / (lifted.information + typical)
        weights = np.where(lifted.views == 1, _SINGLE_VIEW, weights)
        used = np.flatnonzero(weights > 1e-4)
        if len(used) < 12:
            return vertices
        chosen = self._scene.surface.samples.select(used.astype(np.int32))
        constraints = Constraints(
            corners=chosen.corners,
            barycentric=chosen.barycentric,
            targets=chosen.points(vertices) + lifted.motion[used],
            weights=weights[used] / weights[used].mean(),
        )
        return self._deformers[step.bending_mm].solve(
            constraints,
            start=vertices,
            rotation_iterations=self._scene.settings.rotation_iterations,
        )

    def _depth(self, name: str, vertices: Floats) -> tuple[Floats32, float]:
        levels = self._scene.reference.views[name]
        level = min(1, len(levels) - 1)
        drawn = self._scene.surface.raster.render(levels[level].camera, vertices)
        return drawn.depth, float(2**level)

    def _endpoints(self, name: str, number: int, vertices: Floats, found: Observations) -> Floats:
        """Endpoint errors, px, at samples truly seen in both pictures; infinite: unmatched."""
        scene, samples = self._scene, self._scene.surface.samples
        camera, true = scene.cameras[name], scene.truth[number]
        drawn = scene.surface.raster.render(camera, true)
        normals = facing_normals(true, scene.surface.triangles)
        now = visible_samples(samples, true, normals, camera, drawn, scene.settings.min_cosine)
        both = np.intersect1d(now, scene.reference.views[name][0].samples)
        error = np.full(len(samples), np.inf)
        place = camera.project(samples.points(vertices)[found.sample]) + found.offset
        away = place - camera.project(samples.points(true)[found.sample])
        error[found.sample] = np.linalg.norm(away, axis=1)
        return error[both]

    def _vertex_errors(self, number: int, vertices: Floats) -> Floats:
        scene = self._scene
        eyes = np.array([camera.centre for camera in scene.cameras.values()])
        triangles = scene.surface.triangles
        seen: Bools = np.ones(len(scene.face), np.bool_)
        for frame in (0, number):
            views = count_views(scene.truth[frame], triangles, eyes)[scene.face]
            seen = np.logical_and(seen, views >= 2)
        away = np.linalg.norm(vertices - scene.truth[number], axis=1)[scene.face]
        errors: Floats = away[seen]
        return errors


def rows(scene: Scene, frames: list[int], names: list[str]) -> Iterator[dict[str, Any]]:
    """A row for each method."""
    known = methods()
    Rounds(scene, known["ours"], False).frame(frames[0], Tally())  # compiled before it is timed
    for name in names:
        rounds = Rounds(scene, known["ours" if name == RIGID else name], name == RIGID)
        tally = Tally()
        for frame in frames:
            rounds.frame(frame, tally)
        yield {"flow": name, **tally.row()}


def main() -> None:
    """Print the table, a JSON object a line."""
    names = [*methods(), RIGID]
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("take", type=Path, help="a visiting take with neutral.obj and truth.npz")
    parser.add_argument("--frames", type=int, nargs="+", default=[5])
    parser.add_argument("--views", type=int, default=0, help="how many, from the middle; 0: all")
    parser.add_argument("--half-window", type=int, default=TrackSettings().half_window_px)
    parser.add_argument("--methods", nargs="+", default=names, choices=names)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)  # processor seconds of one core
    settings = TrackSettings(half_window_px=arguments.half_window)
    scene = load_scene(arguments.take, arguments.views, settings)
    for row in rows(scene, arguments.frames, arguments.methods):
        print(json.dumps(row), flush=True)


def _images(source: Path, cameras: Mapping[str, Camera], frame: int) -> dict[str, Floats32]:
    out: dict[str, Floats32] = {}
    for name in cameras:
        found = cv2.imread(str(source / name / f"{frame:04d}.png"), cv2.IMREAD_UNCHANGED)
        out[name] = mono(np.asarray(found))
    return out


if __name__ == "__main__":
    main()
