"""The landmark stage: predictors trained for an actor, and his landmarks in every frame of a take.

::

    TAKE/products/landmarks/predictor/     model.json and a predictor for each view
    TAKE/products/landmarks/frame_0000.json    what was found, as `track.landmark_frames` reads it
    TAKE/products/landmarks/report.json    figures by frame
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Floats
from capture.errors import SolveError, TakeError
from capture.product import hash_file, is_current, replacing, stage_record, write_record
from capture.progress import Progress, silent
from capture.settings import check_ranges
from capture.take import Take
from recon.images import mono
from recon.mesh import Mesh
from track.appearance import ActorSkin
from track.face_landmarks import LANDMARK_NAMES, LANDMARKS, Detection, surface_landmarks
from track.landmark_actor import (
    ActorDetector,
    FrameFound,
    Lesson,
    ViewModel,
    landmark_rest,
    read_model,
    train_view,
    write_model,
)
from track.landmark_dlib import TreeSettings
from track.landmark_expressions import landmark_shapes
from track.landmark_frames import (
    FrameLandmarks,
    detected_views,
    read_frame_landmarks,
    write_frame_landmarks,
)
from track.landmark_map import LandmarkMap
from track.landmark_training import Jitter, made_up_acts
from track.sightings import Sightings

_FOLDER = "landmarks"


@dataclass(frozen=True, kw_only=True)
class LandmarkSettings:
    """Settings of the landmark stage.

    Attributes:
        pictures: made-up moments each view is trained on; a fourth more are drawn to measure on.
        turn_deg: how far the head turns in them, one standard deviation about each axis.
        shift_mm: how far it moves, likewise.
        passes: how often the boxes of a frame are laid anew.
        seed: of all that is drawn.
        cascades: stages of each predictor.
        trees: in each stage; predictors grow with them.
        depth: of a tree.
    """

    pictures: int = 120
    turn_deg: float = 5.0
    shift_mm: float = 8.0
    passes: int = 3
    seed: int = 1
    cascades: int = 15
    trees: int = 40
    depth: int = 2

    def __post_init__(self) -> None:
        check_ranges(
            "landmarks", self, pictures=(8, 2000), turn_deg=(0.0, 40.0), shift_mm=(0.0, 200.0),
            passes=(1, 20), seed=(0, 2**31), cascades=(1, 30), trees=(1, 1000), depth=(1, 8),
        )  # fmt: skip


def train_landmarks(
    take: Take,
    mesh: Mesh,
    where: LandmarkMap,
    settings: LandmarkSettings,
    *,
    shapes: Mapping[str, Floats] | None = None,
    progress: Progress = silent,
) -> ActorDetector:
    """Train landmark predictors for the actor of a take, one for each view that shows his face.

    He is drawn with the skin that the first frame's own images show, in made-up expressions and
    head poses, so that every label is exact. Trained predictors are kept and used again while
    take, mesh, landmarks, expressions, settings and code are the same.

    Args:
        take: its first frame is the neutral; it has cameras.
        mesh: the neutral, registered to that frame, world mm.
        where: its landmarks.
        settings: see `LandmarkSettings`.
        shapes: expressions, (V, 3) mm by name; generic ones are made of the landmarks otherwise.
        progress: told after each view.

    Raises:
        CameraError: when the take has no cameras.
        ExtraError: when dlib is not installed.
        TakeError: when the landmarks do not suffice, or no view shows the face.
    """
    cameras = take.cameras()
    folder = take.products / _FOLDER / "predictor"
    inputs = {
        "take": take.input_hash(),
        "mesh": _digest(mesh.vertices, mesh.polygons),
        "landmarks": _digest(where.surface.corners, where.surface.barycentric)
        + " ".join(where.names),
        "shapes": "made" if shapes is None else _digest(*(shapes[k] for k in sorted(shapes))),
    }
    record = stage_record("landmarks", settings, inputs)
    if is_current(folder / "model.json", record):
        return read_model(folder, cameras)
    first = take.frames[0]
    images = {n: mono(take.image(n, first)) for n in take.device_names if take.present(n, first)}
    jitter = Jitter(turn_deg=settings.turn_deg, shift_mm=settings.shift_mm)
    progress(0, len(images), "train")
    every = shapes if shapes is not None else landmark_shapes(mesh, where)
    count = settings.pictures * 4 // 3
    trees = TreeSettings(cascades=settings.cascades, trees=settings.trees, depth=settings.depth)
    lesson = Lesson(
        mesh=mesh, where=where, jitter=jitter, trees=trees, seed=settings.seed,
        acts=made_up_acts(mesh, every, count, jitter, settings.seed),
    )  # fmt: skip
    lenses = {camera.name: camera for camera in cameras if camera.name in images}
    skin = ActorSkin(mesh.vertices, mesh.triangles, lenses, images)
    views: dict[str, ViewModel] = {}
    for done, name in enumerate(images, start=1):
        made = train_view(lesson, skin, cameras, name, folder)
        if isinstance(made, ViewModel):
            views[name] = made
        progress(done, len(images), "train")
    if len(views) < 2:
        raise TakeError(f"{take.folder}: {len(views)} views show the face; two or more are needed")
    write_record(write_model(folder, landmark_rest(where, mesh.vertices), views), record)
    return read_model(folder, cameras)


def detect_landmarks(
    take: Take,
    detector: ActorDetector,
    where: LandmarkMap,
    settings: LandmarkSettings,
    frames: Sequence[int],
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Find the landmarks of frames and write them where tracking looks for them.

    The jaw's 17 are found, but not told: they lie on smooth skin, and wander over it.

    The head is looked for where the frame before has it. A frame whose views do not agree is
    left without landmarks, and the report says why.

    Args:
        take: the take.
        detector: trained for it.
        where: the landmarks on the mesh that is tracked.
        settings: see `LandmarkSettings`.
        frames: which.
        progress: told after each frame.

    Returns:
        The report: by frame, how many views and landmarks agree and how well.
    """
    folder = take.products / _FOLDER
    sure = {LANDMARK_NAMES[index] for index in surface_landmarks().tolist()}
    told = where.select([name for name in where.names if name in sure])
    head: Floats | None = None
    figures: dict[str, Any] = {}
    for done, frame in enumerate(frames, start=1):
        images = {n: take.image(n, frame) for n in take.device_names if take.present(n, frame)}
        path = _frame_path(take, frame)
        try:
            found = detector.detect_frame(images, head, settings.passes)
        except SolveError as error:
            head = None
            path.unlink(missing_ok=True)
            figures[str(frame)] = {"found": False, "why": str(error)}
        else:
            head = found.head
            figures[str(frame)] = _write_frame(path, frame, found, told)
        progress(done, len(frames), "landmarks")
    report = {"frames": figures}
    with replacing(folder / "report.json") as partial:
        partial.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return report


def import_landmarks(
    take: Take, mesh: Mesh, path: Path, where: LandmarkMap | None = None
) -> dict[str, Any]:
    """Take over landmarks of any detector: checked, and a file for each frame of the take.

    Args:
        take: it has cameras.
        mesh: the one that is tracked.
        path: see `track.landmark_frames`.
        where: the landmarks on the mesh, when the file does not tell.

    Returns:
        By frame, how many views.

    Raises:
        TakeError: listing what does not fit, by its place in the file.
    """
    given = read_frame_landmarks(path, mesh, take.cameras(), where)
    stray = sorted(set(given.frames) - set(take.frames))
    if stray:
        raise TakeError(f"{path}: frames.{stray[0]}: the take has frames 0..{len(take.frames) - 1}")
    for frame, views in given.frames.items():
        write_frame_landmarks(
            _frame_path(take, frame),
            FrameLandmarks(where=given.where, accuracy_px=given.accuracy_px, frames={frame: views}),
        )
    return {str(frame): len(views) for frame, views in sorted(given.frames.items())}


def stored_sightings(take: Take, mesh: Mesh, frame: int) -> list[Sightings]:
    """The landmarks that were found in a frame, as registration takes them; none when none were.

    Raises:
        TakeError: when the file does not fit the mesh or the cameras.
    """
    path = _frame_path(take, frame)
    if not path.is_file():
        return []
    return read_frame_landmarks(path, mesh, take.cameras()).sightings(frame)


def stored_hash(take: Take, frame: int) -> str:
    """What a stage's record says of the landmarks of a frame."""
    path = _frame_path(take, frame)
    return hash_file(path) if path.is_file() else "none"


def _frame_path(take: Take, frame: int) -> Path:
    return take.products / _FOLDER / f"frame_{frame:04d}.json"


def _write_frame(path: Path, frame: int, found: FrameFound, where: LandmarkMap) -> dict[str, Any]:
    sigma = np.concatenate([one.sigma_px[_told(one)] for one in found.detections.values()])
    accuracy = round(float(np.median(sigma)), 3)
    views = detected_views(found.detections, where, accuracy)
    write_frame_landmarks(
        path, FrameLandmarks(where=where, accuracy_px=accuracy, frames={frame: views})
    )
    met = found.points.views >= 2
    return {
        "found": True,
        "views": sum(bool(view) for view in views.values()),
        "landmarks": int(met.sum()),
        "of": LANDMARKS,
        "miss_mm": round(float(np.median(found.points.miss_mm[met])), 3),
        "accuracy_px": accuracy,
    }


def _told(found: Detection) -> Any:
    return np.isfinite(found.pixels).all(axis=1) & np.isfinite(found.sigma_px)


def _digest(*arrays: Any) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
