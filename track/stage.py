"""The tracking stage: the neutral mesh through every frame of a take.

::

    TAKE/products/track/performance.npz      the product
    TAKE/products/track/stabilised.npz       the same in the neutral's head space
    TAKE/products/track/report.json          figures by frame
    TAKE/products/track/quality.npz, .csv    quality by frame and vertex; see track/quality_report
    TAKE/products/track/anchors.json         where the take was cut
    TAKE/products/track/frames/*.npz         finished frames, kept so that work can be resumed
    TAKE/products/track/corrected/*.npz      frames solved again for TAKE/corrections.json
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from capture.arrays import Bools, Floats
from capture.documents import read_json
from capture.errors import SettingsError, TakeError
from capture.product import hash_file, is_current, replacing, stage_record, write_record
from capture.progress import Progress, silent
from capture.take import Take
from recon.mesh import Mesh
from track.anchors import Segment, choose_anchors, segments
from track.corrections.replay import Corrections, read_corrections
from track.face_tracker import FaceTracker
from track.frame_store import FrameStore, TrackedFrame
from track.head_motion import head_motion
from track.landmark_file import Landmarks, read_landmarks
from track.landmark_stage import stored_hash
from track.performance import Performance, read_performance, write_performance
from track.quality_report import write_quality_report
from track.resolve import ResolveSettings, corrected, resolve, runs_of
from track.rigid import fit_similarity
from track.sweep import SweepStores, sweep
from track.track_settings import TrackSettings as TrackSettings

_MAX_WORKERS = 64


def track(
    take: Take,
    neutral: Mesh,
    settings: TrackSettings,
    *,
    landmarks: Path | None = None,
    again: tuple[int, int] | None = None,
    workers: int = 1,
    progress: Progress = silent,
) -> Performance:
    """Track a mesh, registered to the first frame, through all frames of a take.

    Every frame is matched to the first one, so that errors do not add up. The take is cut where
    the face comes back to the neutral (anchors, registered directly); between, it is followed
    forwards and looked at again backwards. TAKE/corrections.json is worked in afterwards. Finished
    frames are kept in TAKE/products/track/frames and used again while take, neutral, settings and
    code are the same.

    Args:
        take: it needs cameras.
        neutral: world mm, on the skin at the first frame; any topology.
        settings: see `TrackSettings`.
        landmarks: hand marks of the first frame, three or more; see docs/neutral.md. The neutral
            is moved rigidly onto them first: for a take whose head is not where the neutral is.
        again: first and last frame to solve again with their corrections, the whole range being
            carried by them; None: corrections reach as far as the settings say.
        workers: processes among which segments are shared; the result does not depend on it.
        progress: told after each frame.

    Returns:
        What TAKE/products/track/performance.npz holds. `head_from_neutral` is measured on the
        skin that moves least.

    Raises:
        CameraError: when the take has no cameras, or they do not fit.
        TakeError: when the take has no frames, too few views of the first one, or no view sees
            the neutral; when the landmarks cannot be read, or are fewer than three; or listing
            what does not fit in the corrections.
        SettingsError: when `workers` is out of range.
        SolveError: when a solve does not reach an answer.
    """
    if not 1 <= workers <= _MAX_WORKERS:
        raise SettingsError(f"workers: expected 1..{_MAX_WORKERS}, found {workers}")
    frames = _frames(take)
    if landmarks is not None:
        marks = read_landmarks(landmarks, len(neutral.vertices), take.cameras())
        neutral = _laid_on(neutral, marks, landmarks)
    plan = _Plan(take, neutral, settings)
    corrections = read_corrections(take, neutral)
    reach = ResolveSettings(
        reach_frames=settings.correction_reach, ease_frames=settings.correction_ease
    )
    run = runs_of(frames, corrections, reach, again)
    record = plan.whole_record(corrections, run)
    out = plan.folder / "performance.npz"
    if is_current(out, record):
        return read_performance(out)
    tracker = FaceTracker(take, neutral, settings, plan.scans)
    anchors = _cut(plan, tracker, corrections.anchors, progress)
    found = _follow(plan, tracker, anchors, workers, progress)
    store = plan.corrected_store(corrections, run, list(anchors))
    counted = _Counter(progress, len(run), "correct")
    solved = resolve(tracker, found, corrections, run, store, counted)
    final = corrected(frames, found, solved, corrections, reach)
    performance, report = _assemble(neutral, frames, final)
    report["anchors"] = list(anchors)
    report["solved_again"] = list(run)
    evidence, cameras = [result.evidence for result in final], take.cameras()
    told = write_quality_report(plan.folder, neutral, performance, evidence, cameras, plan.scans)
    write_performance(out, performance)
    write_performance(out.with_name("stabilised.npz"), performance.stabilised())
    with replacing(out.with_name("report.json")) as partial:
        partial.write_text(json.dumps(told.joined(report), indent=1) + "\n", encoding="utf-8")
    write_record(out, record)
    return performance


class _Plan:
    """What a take's frames are made from, and where they are kept."""

    def __init__(self, take: Take, neutral: Mesh, settings: TrackSettings) -> None:
        self.take, self.neutral, self.settings = take, neutral, settings
        self.folder = take.products / "track"
        self.scans = _scans(take) if settings.use_scan else {}
        shape = hashlib.sha256(neutral.vertices.tobytes() + neutral.polygons.tobytes()).hexdigest()
        self._inputs = {"take": take.input_hash(), "neutral": shape}
        self._hashes = {
            frame: f"{hash_file(self.scans[frame]) if frame in self.scans else 'none'} "
            f"{stored_hash(take, frame)}"
            for frame in take.frames
        }

    def record(self, what: str, frames: Sequence[int]) -> dict[str, Any]:
        """The record of a product of these frames: their scans and landmarks, and the first's."""
        first = self.take.frames[0]
        told = "\n".join(f"{f} {self._hashes[f]}" for f in [first, *frames])
        digest = hashlib.sha256(told.encode()).hexdigest()
        return stage_record("track", self.settings, {**self._inputs, what: digest})

    def whole_record(self, corrections: Corrections, run: Mapping[int, int]) -> dict[str, Any]:
        """The record of the performance."""
        keys = [f"{frame} {corrections.key(frame)}" for frame in self.take.frames]
        keys += [f"{frame} from {source}" for frame, source in run.items()]
        record = self.record("scans", self.take.frames)
        record["inputs"]["corrections"] = hashlib.sha256("\n".join(keys).encode()).hexdigest()
        return record

    def stores(self, segment: Segment) -> SweepStores:
        """Where a segment's frames are kept; they hang on all of it."""
        ends = [segment.left] if segment.right is None else [segment.left, segment.right]
        record = self.record("segment", [*ends, *segment.frames])
        records = dict.fromkeys(segment.frames, record)
        count = len(self.neutral.vertices)
        return SweepStores(
            forward=FrameStore(self.folder / "forward", records, count),
            final=FrameStore(self.folder / "frames", records, count),
        )

    def anchor_store(self, anchors: Sequence[int]) -> FrameStore:
        """Where the anchors are kept."""
        records = {frame: self.record("anchor", [frame]) for frame in anchors}
        return FrameStore(self.folder / "frames", records, len(self.neutral.vertices))

    def corrected_store(
        self, corrections: Corrections, run: Mapping[int, int], anchors: Sequence[int]
    ) -> FrameStore:
        """Where frames that were solved again are kept: each hangs on what its own run is told.

        It begins from the frames as tracked, which hang on where the take was cut.
        """
        runs: dict[int, list[str]] = {}
        for frame, source in run.items():
            runs.setdefault(source, [f"from {source}, cut at {list(anchors)}"]).append(
                f"{frame} {corrections.key(frame)}"
            )
        records = {}
        for frame, source in run.items():
            record = self.record("scans", self.take.frames)
            keys = "\n".join(runs[source])
            record["inputs"]["corrections"] = hashlib.sha256(keys.encode()).hexdigest()
            records[frame] = record
        return FrameStore(self.folder / "corrected", records, len(self.neutral.vertices))


class _Counter:
    """Tells progress of frames that are done in any order."""

    def __init__(self, progress: Progress, total: int, what: str) -> None:
        self._progress, self._total, self._what, self._done = progress, total, what, 0

    def __call__(self, frame: int) -> None:
        self._done += 1
        self._progress(self._done, self._total, self._what)


def _cut(
    plan: _Plan, tracker: FaceTracker, wanted: Sequence[int], progress: Progress
) -> dict[int, Floats]:
    """The anchors, and where the head puts the neutral (V, 3) in each."""
    path, frames = plan.folder / "anchors.json", plan.take.frames
    if not plan.settings.anchors and not wanted:
        return {frames[0]: plan.neutral.vertices.astype(np.float64)}
    record = plan.record("anchors", ())
    if not is_current(path, record):
        start, rows = plan.neutral.vertices.astype(np.float64), []
        tracker.first(frames[0])
        rest = start
        for done, frame in enumerate(frames[1:], start=1):
            start, unrest = tracker.scout(frame, start)
            motion = fit_similarity(rest, start)
            told = unrest if np.isfinite(unrest) else None
            rows.append({"frame": frame, "unrest_mm": told, "head": motion.matrix().tolist()})
            progress(done, len(frames) - 1, "scout")
        with replacing(path) as partial:
            partial.write_text(json.dumps({"frames": rows}, indent=1) + "\n", encoding="utf-8")
        write_record(path, record)
    rows = read_json(path, TakeError, absent="no anchors")["frames"]
    unrest_mm = {frames[0]: 0.0}
    for row in rows:
        told = row["unrest_mm"]
        unrest_mm[int(row["frame"])] = float("inf") if told is None else float(told)
    heads = {int(row["frame"]): np.array(row["head"]) for row in rows}
    rest = plan.neutral.vertices.astype(np.float64)
    placed = {frame: rest @ head[:3, :3].T + head[:3, 3] for frame, head in heads.items()}
    if not plan.settings.anchors:
        unrest_mm = dict.fromkeys(unrest_mm, float("inf"))
    return {frame: placed.get(frame, rest) for frame in choose_anchors(unrest_mm, wanted)}


def _follow(
    plan: _Plan,
    tracker: FaceTracker,
    anchors: Mapping[int, Floats],
    workers: int,
    progress: Progress,
) -> dict[int, TrackedFrame]:
    """All frames: anchors directly, segments between them."""
    frames = plan.take.frames
    store = plan.anchor_store(list(anchors))
    counted = _Counter(progress, len(frames), "track")
    ends: dict[int, TrackedFrame] = {}
    for frame, start in anchors.items():
        kept = store.load(frame)
        if kept is None:
            first = frame == frames[0]
            kept = tracker.first(frame) if first else tracker.direct(frame, start)
            store.save(frame, kept)
        ends[frame] = kept
        counted(frame)
    parts = segments(frames, list(anchors))
    if min(workers, len(parts)) > 1:
        _side_by_side(plan, parts, ends, min(workers, len(parts)), counted)
    else:
        for part in parts:
            sweep(tracker, part, ends, plan.stores(part), counted)
    found = dict(ends)
    for part in parts:
        stores = plan.stores(part)
        for frame in part.frames:
            kept = stores.final.load(frame)
            if kept is None:
                raise TakeError(f"{plan.folder}: frame {frame} was finished, but is not there")
            found[frame] = kept
    return found


def _side_by_side(
    plan: _Plan,
    parts: Sequence[Segment],
    ends: Mapping[int, TrackedFrame],
    workers: int,
    told: Callable[[int], None],
) -> None:
    """Sweep segments in processes of their own; each reads the take, and makes ready, once."""
    given = (plan.take.folder, plan.neutral, plan.settings)
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _SweepProcess.begin, given)
    try:
        jobs = {pool.submit(_SweepProcess.sweep, part, _ends(part, ends)): part for part in parts}
        for job in as_completed(jobs):
            job.result()
            for frame in jobs[job].frames:
                told(frame)
    finally:
        pool.shutdown(cancel_futures=True)


def _ends(part: Segment, anchors: Mapping[int, TrackedFrame]) -> dict[int, TrackedFrame]:
    """The anchors at a segment's ends."""
    return {frame: anchors[frame] for frame in (part.left, part.right) if frame is not None}


class _SweepProcess:
    """What a process of `_side_by_side` keeps from one segment to the next."""

    _plan: ClassVar[_Plan]
    _tracker: ClassVar[FaceTracker]

    @classmethod
    def begin(cls, folder: Path, neutral: Mesh, settings: TrackSettings) -> None:
        """Open the take; called once, when the process starts."""
        cls._plan = _Plan(Take.open(folder), neutral, settings)
        cls._tracker = FaceTracker(cls._plan.take, neutral, settings, cls._plan.scans, threads=1)

    @classmethod
    def sweep(cls, part: Segment, ends: dict[int, TrackedFrame]) -> None:
        """Follow one segment; its frames are left in the stores."""
        sweep(cls._tracker, part, ends, cls._plan.stores(part), lambda frame: None)


def _frames(take: Take) -> tuple[int, ...]:
    if not take.frames:
        raise TakeError(f"{take.folder}: the take has no frames")
    return take.frames


def _scans(take: Take) -> dict[int, Path]:
    """The scans that there are, by frame."""
    folder = take.products / "recon"
    paths = {frame: folder / f"frame_{frame:04d}.ply" for frame in take.frames}
    return {frame: path for frame, path in paths.items() if path.is_file()}


def _laid_on(neutral: Mesh, marks: Landmarks, path: Path) -> Mesh:
    """The neutral moved rigidly onto marks of the first frame."""
    if len(marks.vertices) < 3:
        raise TakeError(f"{path}: placing the neutral needs 3 marks, found {len(marks.vertices)}")
    motion = fit_similarity(neutral.vertices[marks.vertices], marks.positions)
    return neutral.with_vertices(motion.apply(neutral.vertices))


def _assemble(
    neutral: Mesh, frames: tuple[int, ...], results: Sequence[TrackedFrame]
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
        reference=np.array([result.reference for result in results], dtype=np.int64),
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
