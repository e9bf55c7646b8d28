"""The frames of one take, registered one at a time."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import sparse

from capture.arrays import Bools, Floats, Floats32
from capture.camera import CameraArray
from capture.errors import TakeError
from capture.take import Take
from recon.images import mono
from recon.mesh import Mesh
from recon.scan import load_scan
from track.corrections.replay import FrameCorrections
from track.evidence import FrameEvidence, blended_evidence
from track.face_reference import FaceReference, ReferenceWindows
from track.features import FeatureReference, feature_rounds
from track.features_follow import FeatureFollower, lost_skin
from track.flow_backend import make_flow
from track.frame_store import TrackedFrame
from track.head_motion import damped_motion, head_motion
from track.landmark_stage import stored_sightings
from track.pyramid import level_count
from track.registration import FrameAids, FrameResult, Registrar, RegistrarOptions
from track.schedule import schedule
from track.skin import skin_heights
from track.surface_model import SurfaceModel
from track.track_settings import TrackSettings

_MIN_VIEWS = 2
_SPANNING = 100  # confident vertices from which a motion is told
_SKIN_LIMIT_MM = 1.0  # a scan farther from the neutral shows something else
_UNSURE = 0.3  # confidence below which skin that views could see is doubted
_DOUBTED = 0.01  # share of the seen skin from which a frame is looked at again
_OPEN_VIEWS = 4  # that could see skin of which a match is expected
_FITS = 0.85  # correlation below which skin is matched badly
_LEANS = 0.5  # share of a vertex's matches that were to a second reference
_WORTH = 12  # badly matched vertices that are worth a second reference
_AROUND = 2  # rings: what counts as a region, and how far a second reference reaches beyond it
_FIXED = 0.5  # confidence of skin that features need not move
_RETURN_PX = 0.5  # how far a match may miss its way back
_FEATURES_PX = 256  # least side of the level that features are found at
_GAIN = 0.1  # confidence that a second solve must add to be taken


class FaceTracker:
    """Registers the frames of a take; made ready when a frame is first asked for.

    Args:
        take: it has cameras and frames.
        neutral: on the skin at the first frame, world mm.
        settings: of the stage.
        scans: paths of the scans to use, by frame.
        threads: over the views; 0: as many as there are processors.
    """

    def __init__(
        self,
        take: Take,
        neutral: Mesh,
        settings: TrackSettings,
        scans: Mapping[int, Path],
        threads: int = 0,
    ) -> None:
        self._take, self._neutral, self._settings = take, neutral, settings
        self._cameras, self._scans, self._threads = take.cameras(), scans, threads
        self._made: Registrar | None = None
        self._smooth: sparse.csr_matrix | None = None
        self._follower: FeatureFollower | None = None
        self._held: tuple[TrackedFrame, FaceReference] | None = None

    def first(self, frame: int) -> TrackedFrame:
        """The first frame: the neutral itself.

        Raises:
            TakeError: when fewer than two views show it.
        """
        began = time.perf_counter()
        registrar = self.registrar()
        confidence = registrar.vertex_views()
        if not confidence.any():
            names = ", ".join(self._cameras.names)
            raise TakeError(
                f"{self._take.folder}: no two views see the neutral at frame {frame}; its vertices "
                f"lie about {np.round(self._neutral.vertices.mean(axis=0), 1).tolist()} mm; is it "
                f"in world millimetres of the cameras {names}?"
            )
        seen = registrar.views_of_samples
        return TrackedFrame(
            frame=frame,
            vertices=self._neutral.vertices.astype(np.float32),
            confidence=confidence.astype(np.float32),
            figures={
                "samples": float((seen >= _MIN_VIEWS).sum()),
                "correlation": 1.0,
                "residual_px": 0.0,
                "views": float(seen[seen >= _MIN_VIEWS].mean()),
                "seconds": time.perf_counter() - began,
            },
            evidence=FrameEvidence.nothing(len(confidence), len(self._cameras)),
        )

    def scout(self, frame: int, start: Floats) -> tuple[Floats, float]:
        """Where the head is, coarsely and as one rigid piece, and how still the face is in it.

        Args:
            frame: which.
            start: (V, 3) the neutral, moved with the head of a frame nearby, world mm.

        Returns:
            (V, 3) the neutral, moved with this frame's head; and how far some region of the seen
            skin has left it, mm. The start and inf for a frame of fewer than two views.
        """
        images = self.images(frame)
        if len(images) < _MIN_VIEWS:
            return start, float("inf")
        return self.registrar().scout(start, images)

    def direct(self, frame: int, start: Floats) -> TrackedFrame:
        """Register a frame from the neutral, moved with the head (V, 3): nothing is handed on."""
        began = time.perf_counter()
        images = self.images(frame)
        if len(images) < _MIN_VIEWS:
            return self._stored(frame, FrameResult.lost(start, len(self._cameras)), began)
        return self._found(frame, start, images, self._aids(frame), began)

    def follow(
        self, frame: int, before: Sequence[TrackedFrame], without: frozenset[str] = frozenset()
    ) -> TrackedFrame:
        """Register a frame, beginning where others lead.

        Args:
            frame: which.
            before: finished frames on one side of it; the last is nearest.
            without: views not to look at.
        """
        began = time.perf_counter()
        start = self._predict(before)
        images = self.images(frame, without)
        if len(images) < _MIN_VIEWS:
            return self._stored(frame, FrameResult.lost(start, len(self._cameras)), began)
        registrar = self.registrar()
        sure = before[-1].confidence.astype(np.float64)
        starts = [registrar.carried(start, sure), *self._other_starts(start, before)]
        begin = registrar.best_start(starts, sure, images)
        aids = replace(self._aids(frame), second=self._second(before))
        return self._found(frame, begin, images, aids, began)

    def again(self, frame: int, found: TrackedFrame, after: Sequence[TrackedFrame]) -> TrackedFrame:
        """Look at a frame once more from its other side, where its first solve was unsure.

        Args:
            frame: which.
            found: its first solve.
            after: finished frames on its other side; the last is nearest.

        Returns:
            Both solves, blended by confidence; `found` itself where nothing is to be gained.
        """
        doubted = (found.evidence.views_open >= _MIN_VIEWS) & (found.confidence < _UNSURE)
        better = doubted & (after[-1].confidence > found.confidence + _GAIN)
        open_skin = max(int((found.evidence.views_open >= _MIN_VIEWS).sum()), 1)
        if not self._settings.second_look or better.sum() < _DOUBTED * open_skin:
            return found
        began = time.perf_counter()
        images = self.images(frame)
        registrar = self.registrar()
        sure = after[-1].confidence.astype(np.float64)
        mine = found.vertices.astype(np.float64)
        other = registrar.carried(self._predict(after), sure)
        begin = registrar.best_start([mine, other], found.confidence.astype(np.float64), images)
        if begin is mine:
            return found
        aids = replace(self._aids(frame), second=self._second(after))
        second = self._stored(frame, registrar.register(begin, images, aids), began)
        return self._blended(found, second)

    def refined(self, start: Floats, said: FrameCorrections) -> TrackedFrame:
        """Register a frame with what an artist says of it.

        Args:
            start: (V, 3) where to begin, world mm.
            said: pins, curves, and views not to look at.
        """
        frame = said.frame
        began = time.perf_counter()
        images = self.images(frame, said.excluded_views)
        if len(images) < _MIN_VIEWS:
            return self._stored(frame, FrameResult.lost(start, len(self._cameras)), began)
        aids = replace(self._aids(frame), sightings=said.sightings)
        registrar = self.registrar()
        result = registrar.register(registrar.pulled(start, said.sightings), images, aids)
        assured = np.maximum(result.confidence, said.assured(len(start)))
        return self._stored(frame, replace(result, confidence=assured), began)

    def _found(
        self,
        frame: int,
        start: Floats,
        images: Mapping[str, Floats32],
        aids: FrameAids,
        began: float,
    ) -> TrackedFrame:
        """Register a frame; what of it is lost is looked for by features, farther than flow."""
        registrar = self.registrar()
        result = registrar.register(start, images, aids)
        found = self._stored(frame, result, began)
        lost = lost_skin(registrar.surface, result.confidence, registrar.vertex_views())
        if not lost.any():
            return found
        told = tuple(stored_sightings(self._take, self._neutral, frame))
        if not self._settings.features and not told:
            return found
        moved = result.vertices
        if self._settings.features:
            held: Bools = result.confidence > _FIXED
            moved = self._features().follow(moved, images, wanted=lost, held=held)
        sought = registrar.register(moved, images, replace(aids, sightings=aids.sightings + told))
        return self._blended(found, self._stored(frame, sought, began), lost)

    def _second(self, before: Sequence[TrackedFrame]) -> FaceReference | None:
        """Whom to ask about skin that the neutral does not tell of any more, if there is such skin.

        Skin that stretches, folds or turns looks unlike the neutral before it is lost. When a
        region of the last frame matches badly, that frame becomes the reference of it, while it
        is still known there; and it stays so until it matches badly itself, or until the region
        matches the neutral again. So few links lie between any frame and the neutral.
        """
        if not self._settings.second_reference:
            return None
        last = before[-1]
        weak = self._weak(last)
        source: TrackedFrame | None = None
        if int(weak.sum()) >= _WORTH:
            source = last
        elif last.reference >= 0 and bool((last.evidence.leaning > _LEANS).any()):
            source = next((b for b in before if b.frame == last.reference), None)
        if source is None:
            return None
        if self._held is None or self._held[0] is not source:
            only = self._weak(source) | (source.evidence.leaning > _LEANS)
            for _ in range(_AROUND):
                only = self._ring() @ only.astype(np.float64) > 0.0
            images, mesh = self.images(source.frame), source.vertices.astype(np.float64)
            made = self.registrar().reference(source.frame, mesh, images, only)
            self._held = (source, made)
        return self._held[1]

    def _weak(self, tracked: TrackedFrame) -> Bools:
        """Vertices (V,) in regions that are open to view and yet match badly."""
        told = tracked.evidence
        seen = told.views_open >= _OPEN_VIEWS
        poor = seen & ~(
            (np.nan_to_num(told.correlation) >= _FITS) & (told.views >= 0.5 * told.views_open)
        )
        share, total = poor.astype(np.float64), seen.astype(np.float64)
        for _ in range(_AROUND):
            share, total = self._ring() @ share, self._ring() @ total
        weak: Bools = poor & (share > 0.5 * total)
        return weak

    def _blended(
        self, one: TrackedFrame, other: TrackedFrame, where: Bools | None = None
    ) -> TrackedFrame:
        """Two solves of a frame, each where it is surer, with soft seams along the surface.

        With `where` (V,) the second is taken nowhere but there.
        """
        ring = self._ring()
        gain = other.confidence.astype(np.float64) - one.confidence
        wins = (gain > _GAIN) if where is None else (gain > _GAIN) & where
        share = (ring @ wins.astype(np.float64) > 0.0).astype(np.float64)
        for _ in range(3):
            share = ring @ share
        first, second = (1.0 - share) * one.confidence, share * other.confidence
        total = first + second
        share = np.divide(second, total, out=(share > 0.0).astype(np.float64), where=total > 0.0)
        mixed = one.vertices + share[:, None] * (other.vertices.astype(np.float64) - one.vertices)
        sure = one.confidence + share * gain
        return replace(
            other if float(share.mean()) > 0.5 else one,
            vertices=mixed.astype(np.float32),
            confidence=sure.astype(np.float32),
            evidence=blended_evidence(one.evidence, other.evidence, share),
        )

    def _ring(self) -> sparse.csr_matrix:
        """Means over the vertices next to each (V, V)."""
        if self._smooth is None:
            near = self.registrar().surface.near
            count = np.asarray(near.sum(axis=1)).ravel()
            self._smooth = sparse.csr_matrix(sparse.diags(1.0 / np.maximum(count, 1.0)) @ near)
        return self._smooth

    def _stored(self, frame: int, result: FrameResult, began: float) -> TrackedFrame:
        return TrackedFrame(
            frame=frame,
            reference=result.reference,
            vertices=result.vertices.astype(np.float32),
            confidence=result.confidence.astype(np.float32),
            figures={
                "samples": float(result.samples),
                "correlation": result.correlation,
                "residual_px": result.residual_px,
                "views": result.views,
                "seconds": time.perf_counter() - began,
            },
            evidence=result.evidence,
        )

    def _predict(self, before: Sequence[TrackedFrame]) -> Floats:
        last = before[-1].vertices.astype(np.float64)
        if len(before) < 2 or self._settings.extrapolation == 0.0:
            return last
        weights = (before[-1].confidence * before[-2].confidence).astype(np.float64)
        if (weights > 0).sum() < _SPANNING:
            return last
        earlier = before[-2].vertices.astype(np.float64)
        return damped_motion(earlier, last, weights, self._settings.extrapolation).apply(last)

    def _other_starts(self, start: Floats, before: Sequence[TrackedFrame]) -> list[Floats]:
        """Beside the carried mesh: the neutral with the head, and the motion going on."""
        neutral = self._neutral.vertices.astype(np.float64)
        sure = before[-1].confidence.astype(np.float64)
        if (sure > 0).sum() < _SPANNING:
            return []
        head = head_motion(neutral, start[None], sure[None]).head_from_neutral[0]
        out = [neutral @ head[:3, :3].T + head[:3, 3]]
        weights = sure * before[-2].confidence if len(before) > 1 else np.zeros(len(sure))
        if (weights > 0).sum() >= _SPANNING:
            last, earlier = (b.vertices.astype(np.float64) for b in (before[-1], before[-2]))
            out.append(start + last - damped_motion(earlier, last, weights, 1.0).apply(earlier))
        return out

    def registrar(self) -> Registrar:
        """What registers frames to the neutral; made when it is first asked for.

        Raises:
            TakeError: when fewer than two views have the first frame.
        """
        if self._made is None:
            first = self._take.frames[0]
            images = self.images(first)
            if len(images) < _MIN_VIEWS:
                raise TakeError(
                    f"{self._take.folder}: frame {first} has {len(images)} of "
                    f"{len(self._cameras)} views; the reference needs at least {_MIN_VIEWS}"
                )
            mesh = self._neutral
            surface = SurfaceModel.of(
                mesh.vertices, mesh.triangles, self._settings.spacing_mm, self._heights()
            )
            cameras = {camera.name: camera for camera in self._cameras}
            options = _options(self._settings, self._cameras, mesh, self._threads)
            flow = make_flow(self._settings.flow)
            self._made = Registrar(surface, cameras, images, options, flow)
        return self._made

    def _features(self) -> FeatureFollower:
        """Finds lost skin; made when some is lost for the first time."""
        if self._follower is None:
            surface = self.registrar().surface
            cameras = {camera.name: camera for camera in self._cameras}
            known = FeatureReference(
                surface.skin(surface.neutral), surface.triangles, cameras,
                self.images(self._take.frames[0]),
            )  # fmt: skip
            sizes = [(camera.width, camera.height) for camera in self._cameras]
            levels = min(level_count(*size, _FEATURES_PX) for size in sizes)
            rounds = feature_rounds(max(0, levels - 1))
            self._follower = FeatureFollower(surface, known, rounds)
        return self._follower

    def _heights(self) -> Floats | None:
        """How far the first frame's scan lies over the neutral, where there is such a scan."""
        first = self._take.frames[0]
        if first not in self._scans:
            return None
        mesh = self._neutral
        scan = load_scan(self._scans[first])
        return skin_heights(mesh.vertices, mesh.triangles, scan, _SKIN_LIMIT_MM)

    def _aids(self, frame: int) -> FrameAids:
        return FrameAids(scan=load_scan(self._scans[frame]) if frame in self._scans else None)

    def images(self, frame: int, without: frozenset[str] = frozenset()) -> dict[str, Floats32]:
        """The views that a frame has but for some, float32 mono 0..1, by device name."""
        take = self._take
        names = [name for name in take.device_names if name not in without]
        return {name: mono(take.image(name, frame)) for name in names if take.present(name, frame)}


def _options(
    settings: TrackSettings, cameras: CameraArray, neutral: Mesh, threads: int
) -> RegistrarOptions:
    centre = neutral.vertices.mean(axis=0)[None]
    scales = [camera.fx / abs(float(camera.depths(centre)[0])) for camera in cameras]
    px_per_mm = float(np.median(scales))
    levels = min(level_count(camera.width, camera.height) for camera in cameras)
    bending = (settings.bending_coarse_mm, settings.bending_mm)
    return RegistrarOptions(
        steps=schedule(levels, settings.search_mm * px_per_mm, settings.passes, bending),
        windows=ReferenceWindows(
            levels=levels,
            half=settings.half_window_px,
            half_coarse=settings.half_window_coarse_px,
            min_cosine=settings.min_cosine,
        ),
        min_correlation=settings.min_correlation,
        search_stride=settings.search_stride,
        rotation_iterations=settings.rotation_iterations,
        threads=threads,
        contact=settings.contact,
        return_px=_RETURN_PX if settings.follow_back else np.inf,
    )
