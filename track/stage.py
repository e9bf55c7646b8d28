"""The tracking stage: the neutral mesh through every frame of a take.

::

    TAKE/products/track/performance.npz      the product
    TAKE/products/track/report.json          figures by frame
    TAKE/products/track/frames/*.npz         finished frames, kept so that work can be resumed
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.archive import read_archive, write_archive
from capture.arrays import Bools, Floats, Floats32
from capture.camera import CameraArray
from capture.errors import ShapeError, TakeError
from capture.product import hash_file, is_current, replacing, stage_record, write_record
from capture.progress import Progress, silent
from capture.settings import check_ranges
from capture.take import Take
from recon.images import mono
from recon.mesh import Mesh
from recon.scan import load_scan
from track.evidence import EVIDENCE_KEYS, FrameEvidence
from track.face_reference import ReferenceWindows
from track.head_motion import damped_motion, head_motion
from track.landmark_file import Landmarks, read_landmarks
from track.performance import Performance, read_performance, write_performance
from track.pyramid import level_count
from track.registration import FrameAids, FrameResult, Registrar, RegistrarOptions
from track.rigid import fit_similarity
from track.schedule import schedule
from track.skin import skin_heights
from track.surface_model import SurfaceModel

_FIGURES = ("samples", "correlation", "residual_px", "views", "seconds")
_MIN_VIEWS = 2
_SPANNING = 100  # confident vertices from which a motion is told
_SKIN_LIMIT_MM = 1.0  # a scan farther from the neutral shows something else


@dataclass(frozen=True, kw_only=True)
class TrackSettings:
    """Settings of the tracking stage.

    Attributes:
        spacing_mm: triangles wider than this get samples inside; every vertex is one anyway.
        search_mm: how far skin may move from one frame to the next beyond the head's motion.
        passes: rounds of guide, match, lift and solve at full resolution.
        half_window_px: matching windows have 2 half + 1 px a side at full resolution.
        half_window_coarse_px: the same at the coarser pyramid levels.
        bending_coarse_mm: stiffness of the first round; bumps shorter than about six times this
            are left for later rounds.
        bending_mm: stiffness of the last round.
        min_cosine: least cosine between the skin's normal and the view.
        min_correlation: least correlation of a match.
        search_stride: in the first round every how manieth sample is matched.
        rotation_iterations: updates of the local frames in each solve.
        extrapolation: share of the head's last motion expected again.
        use_scan: use the scans that `likeness recon` made. The first frame's tells how far the
            skin lies over the neutral, which matters where the neutral is not quite on it; that
            of any other frame the depth of skin that one or two views alone see there.
    """

    spacing_mm: float = 6.0
    search_mm: float = 12.0
    passes: int = 2
    half_window_px: int = 6
    half_window_coarse_px: int = 4
    bending_coarse_mm: float = 4.0
    bending_mm: float = 2.0
    min_cosine: float = 0.35
    min_correlation: float = 0.6
    search_stride: int = 3
    rotation_iterations: int = 2
    extrapolation: float = 0.7
    use_scan: bool = True

    def __post_init__(self) -> None:
        check_ranges(
            "track", self, spacing_mm=(0.2, 100.0), search_mm=(0.1, 50.0), passes=(1, 10),
            half_window_px=(3, 20), half_window_coarse_px=(3, 20),
            bending_coarse_mm=(0.05, 100.0), bending_mm=(0.05, 100.0), min_cosine=(0.05, 0.95),
            min_correlation=(0.0, 0.99), search_stride=(1, 100), rotation_iterations=(1, 10),
            extrapolation=(0.0, 1.0),
        )  # fmt: skip


def track(
    take: Take,
    neutral: Mesh,
    settings: TrackSettings,
    *,
    landmarks: Path | None = None,
    progress: Progress = silent,
) -> Performance:
    """Track a mesh, registered to the first frame, through all frames of a take.

    Every frame is matched to the first one, so that errors do not add up; the frame before it
    only says where to look. Finished frames are kept in TAKE/products/track/frames and used again
    while take, neutral, settings and code are the same.

    Args:
        take: it needs cameras.
        neutral: world mm, on the skin at the first frame; any topology.
        settings: see `TrackSettings`.
        landmarks: hand marks of the first frame, three or more; see docs/neutral.md. The neutral
            is moved rigidly onto them first: for a take whose head is not where the neutral is.
        progress: told after each frame.

    Returns:
        What TAKE/products/track/performance.npz holds. `head_from_neutral` is measured on the
        skin that moves least; `reference` is -1 throughout.

    Raises:
        CameraError: when the take has no cameras, or they do not fit.
        TakeError: when the take has no frames, too few views of the first one, or no view sees
            the neutral; or when the landmarks cannot be read, or are fewer than three.
        SolveError: when a solve does not reach an answer.
    """
    out = take.products / "track" / "performance.npz"
    frames = _frames(take)
    scans = _scans(take) if settings.use_scan else {}
    if landmarks is not None:
        marks = read_landmarks(landmarks, len(neutral.vertices), take.cameras())
        neutral = _laid_on(neutral, marks, landmarks)
    records = _records(settings, _inputs(take, neutral), frames, scans)
    record = records[frames[-1]]
    if is_current(out, record):
        return read_performance(out)
    work = _Work(take, neutral, take.cameras(), settings, scans)
    shelf = _FrameShelf(out.parent / "frames", records)
    results = [work.reference(frames[0])]
    progress(1, len(frames), "track")
    for done, frame in enumerate(frames[1:], start=2):
        found = shelf.load(frame, len(neutral.vertices))
        if found is None:
            found = work.follow(frame, results)
            shelf.save(frame, found)
        results.append(found)
        progress(done, len(frames), "track")
    performance, report = _assemble(neutral, frames, results)
    write_performance(out, performance)
    with replacing(out.with_name("report.json")) as partial:
        partial.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    write_record(out, record)
    return performance


@dataclass(frozen=True, eq=False, kw_only=True)
class _Tracked:
    """One finished frame: arrays as stored (float32), figures by name."""

    vertices: Floats32
    confidence: Floats32
    figures: Mapping[str, float]
    evidence: FrameEvidence


class _FrameShelf:
    """Finished frames on disk, each valid for its record."""

    def __init__(self, folder: Path, records: Mapping[int, Mapping[str, Any]]) -> None:
        self._folder, self._records = folder, records

    def load(self, frame: int, vertex_count: int) -> _Tracked | None:
        """The stored frame, or None when there is none that was made this way."""
        path = self._path(frame)
        if not is_current(path, self._records[frame]):
            return None
        try:
            keys = ("vertices", "confidence", "figures", *EVIDENCE_KEYS)
            held = read_archive(path, required=keys, gaps=EVIDENCE_KEYS)
        except ShapeError:
            return None  # damaged: made again
        if held["vertices"].shape != (vertex_count, 3):
            return None
        return _Tracked(
            vertices=held["vertices"],
            confidence=held["confidence"],
            figures=dict(zip(_FIGURES, held["figures"].tolist(), strict=True)),
            evidence=FrameEvidence(**{key: held[key] for key in EVIDENCE_KEYS}),
        )

    def save(self, frame: int, tracked: _Tracked) -> None:
        """Store a frame, whole or not at all."""
        path = self._path(frame)
        figures = np.array([tracked.figures[name] for name in _FIGURES])
        shape = {"vertices": tracked.vertices, "confidence": tracked.confidence}
        write_archive(path, {**shape, "figures": figures, **tracked.evidence.arrays()})
        write_record(path, self._records[frame])

    def _path(self, frame: int) -> Path:
        return self._folder / f"frame_{frame:04d}.npz"


class _Work:
    """The registrar of a take, made when a frame is first asked for."""

    def __init__(
        self,
        take: Take,
        neutral: Mesh,
        cameras: CameraArray,
        settings: TrackSettings,
        scans: Mapping[int, Path],
    ) -> None:
        self._take, self._neutral, self._settings = take, neutral, settings
        self._cameras, self._scans = cameras, scans
        self._registrar: Registrar | None = None

    def reference(self, frame: int) -> _Tracked:
        """The first frame: the neutral itself."""
        began = time.perf_counter()
        registrar = self._made()
        confidence = registrar.vertex_views()
        if not confidence.any():
            names = ", ".join(self._cameras.names)
            raise TakeError(
                f"{self._take.folder}: no two views see the neutral at frame {frame}; its vertices "
                f"lie about {np.round(self._neutral.vertices.mean(axis=0), 1).tolist()} mm; is it "
                f"in world millimetres of the cameras {names}?"
            )
        seen = registrar.views_of_samples
        figures = {
            "samples": float((seen >= _MIN_VIEWS).sum()),
            "correlation": 1.0,
            "residual_px": 0.0,
            "views": float(seen[seen >= _MIN_VIEWS].mean()),
            "seconds": time.perf_counter() - began,
        }
        return _Tracked(
            vertices=self._neutral.vertices.astype(np.float32),
            confidence=confidence.astype(np.float32),
            figures=figures,
            evidence=FrameEvidence.nothing(len(confidence), len(self._cameras)),
        )

    def follow(self, frame: int, before: list[_Tracked]) -> _Tracked:
        """Register one frame, beginning where the last ones lead."""
        began = time.perf_counter()
        start = self._predict(before)
        images = self._images(frame)
        if len(images) < _MIN_VIEWS:
            result = FrameResult.lost(start, len(self._cameras))
        else:
            registrar = self._made()
            sure = before[-1].confidence.astype(np.float64)
            scan = load_scan(self._scans[frame]) if frame in self._scans else None
            starts = [registrar.carried(start, sure), *self._other_starts(start, before)]
            result = registrar.register(
                registrar.best_start(starts, sure, images), images, FrameAids(scan=scan)
            )
        figures = {
            "samples": float(result.samples),
            "correlation": result.correlation,
            "residual_px": result.residual_px,
            "views": result.views,
            "seconds": time.perf_counter() - began,
        }
        return _Tracked(
            vertices=result.vertices.astype(np.float32),
            confidence=result.confidence.astype(np.float32),
            figures=figures,
            evidence=result.evidence,
        )

    def _predict(self, before: list[_Tracked]) -> Floats:
        last = before[-1].vertices.astype(np.float64)
        if len(before) < 2 or self._settings.extrapolation == 0.0:
            return last
        weights = (before[-1].confidence * before[-2].confidence).astype(np.float64)
        if (weights > 0).sum() < _SPANNING:
            return last
        earlier = before[-2].vertices.astype(np.float64)
        return damped_motion(earlier, last, weights, self._settings.extrapolation).apply(last)

    def _other_starts(self, start: Floats, before: list[_Tracked]) -> list[Floats]:
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

    def _made(self) -> Registrar:
        if self._registrar is None:
            first = self._take.frames[0]
            images = self._images(first)
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
            options = _options(self._settings, self._cameras, mesh)
            self._registrar = Registrar(surface, cameras, images, options)
        return self._registrar

    def _heights(self) -> Floats | None:
        """How far the first frame's scan lies over the neutral, where there is such a scan."""
        first = self._take.frames[0]
        if first not in self._scans:
            return None
        mesh = self._neutral
        scan = load_scan(self._scans[first])
        return skin_heights(mesh.vertices, mesh.triangles, scan, _SKIN_LIMIT_MM)

    def _images(self, frame: int) -> dict[str, Floats32]:
        take = self._take
        names = [name for name in take.device_names if take.present(name, frame)]
        return {name: mono(take.image(name, frame)) for name in names}


def _options(settings: TrackSettings, cameras: CameraArray, neutral: Mesh) -> RegistrarOptions:
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
    )


def _frames(take: Take) -> tuple[int, ...]:
    if not take.frames:
        raise TakeError(f"{take.folder}: the take has no frames")
    return take.frames


def _scans(take: Take) -> dict[int, Path]:
    """The scans that there are, by frame."""
    folder = take.products / "recon"
    paths = {frame: folder / f"frame_{frame:04d}.ply" for frame in take.frames}
    return {frame: path for frame, path in paths.items() if path.is_file()}


def _inputs(take: Take, neutral: Mesh) -> dict[str, str]:
    """Hashes of what every frame is made from."""
    shape = hashlib.sha256(neutral.vertices.tobytes() + neutral.polygons.tobytes()).hexdigest()
    return {"take": take.input_hash(), "neutral": shape}


def _laid_on(neutral: Mesh, marks: Landmarks, path: Path) -> Mesh:
    """The neutral moved rigidly onto marks of the first frame."""
    if len(marks.vertices) < 3:
        raise TakeError(f"{path}: placing the neutral needs 3 marks, found {len(marks.vertices)}")
    motion = fit_similarity(neutral.vertices[marks.vertices], marks.positions)
    return neutral.with_vertices(motion.apply(neutral.vertices))


def _records(
    settings: TrackSettings,
    inputs: Mapping[str, str],
    frames: tuple[int, ...],
    scans: Mapping[int, Path],
) -> dict[int, dict[str, Any]]:
    """What each frame is made from: its scan and those before it, since it begins from them.

    A new scan thus makes its frame and the later ones again, as if it had been there at first. The
    last frame's record is that of the performance.
    """
    digest = hashlib.sha256()
    out = {}
    for frame in frames:
        if frame in scans:
            digest.update(f"{frame} {hash_file(scans[frame])}\n".encode())
        out[frame] = stage_record("track", settings, {**inputs, "scans": digest.hexdigest()})
    return out


def _assemble(
    neutral: Mesh, frames: tuple[int, ...], results: list[_Tracked]
) -> tuple[Performance, dict[str, Any]]:
    vertices = np.stack([result.vertices for result in results])
    confidence = np.stack([result.confidence for result in results])
    counted: Bools = np.greater(confidence.max(axis=1), 0.0)  # lost frames have no say
    head = head_motion(
        neutral.vertices,
        vertices[counted].astype(np.float64),
        confidence[counted].astype(np.float64),
    )
    motions = _carried(head.head_from_neutral, counted)
    performance = Performance(
        vertices=vertices,
        confidence=confidence,
        polygons=neutral.polygons,
        frames=np.array(frames, dtype=np.int64),
        head_from_neutral=motions,
        reference=np.full(len(frames), -1, dtype=np.int64),
    )
    rows = [
        {
            "frame": int(frame),
            **{name: round(float(value), 5) for name, value in result.figures.items()},
            "mean_confidence": round(float(result.confidence.mean()), 4),
            "head_from_neutral": np.round(motion, 6).tolist(),
            "lost": not bool(result.confidence.any()),
        }
        for frame, result, motion in zip(frames, results, motions, strict=True)
    ]
    report = {
        "frames": rows,
        "rigid_vertices": int((head.rigid_weights > 0.25).sum()),
        "rigid_spread_mm": round(float(np.median(head.spread_mm[head.rigid_weights > 0.25])), 4),
    }
    return performance, report


def _carried(motions: Floats, counted: Bools) -> Floats:
    """Motions of all frames: a lost frame has that of the last frame that is not."""
    place = np.maximum.accumulate(np.where(counted, np.arange(len(counted)), 0))
    row = np.cumsum(counted) - 1
    carried: Floats = motions[row[place]]
    return carried
