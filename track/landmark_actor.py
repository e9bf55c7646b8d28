"""Landmark predictors trained for one actor and one array: a predictor for each view."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Floats, Floats32, Image
from capture.camera import CameraArray
from capture.documents import read_json
from capture.errors import SolveError, TakeError
from capture.product import hash_file, replacing
from recon.images import mono
from recon.mesh import Mesh
from track.appearance import ActorSkin
from track.face_landmarks import LANDMARK_NAMES, LANDMARKS, Detection, Missed
from track.landmark_box import FaceBox, shades
from track.landmark_dlib import ShapePredictor, TreeSettings, train_predictor
from track.landmark_map import LandmarkMap
from track.landmark_points import LandmarkPoints, meet_landmarks
from track.landmark_training import Act, Jitter, training_sheet, view_landmarks
from track.raster import Rasterizer
from track.rigid import fit_similarity

_MODEL = "model.json"
_FEWEST = 6  # landmarks that a view must tell to be worth a predictor
_STEADY = [*range(17, 37), 39, 42, 45]  # brows, nose, corners of the eyes: they tell the head
_LEAST_STEADY = 6
_SCALE_MM = 4.0
_HONEST = 1.5  # how much further off real pictures are than made-up ones
_LEAST_PX = 0.6  # whole pixels are told


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewModel:
    """What a view's predictor tells.

    Attributes:
        names: K landmarks.
        sigma_px: (K,) how far off each was on pictures kept out of training, px of the picture.
        file: the predictor.
    """

    names: tuple[str, ...]
    sigma_px: Floats
    file: Path


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameFound:
    """The landmarks of one frame.

    Attributes:
        detections: by view; those that do not agree with the others are left out of them.
        points: where they meet.
        head: (4, 4) rigid motion of the head from the neutral.
    """

    detections: Mapping[str, Detection]
    points: LandmarkPoints
    head: Floats


class ActorDetector:
    """Finds the landmarks of the actor it was trained for."""

    def __init__(self, cameras: CameraArray, rest: Floats, views: Mapping[str, ViewModel]) -> None:
        """Take the array, the neutral's landmarks (68, 3), NaN where unknown, and the views."""
        self._cameras, self._rest, self._views = cameras, rest, views
        self._index = {
            name: np.array([LANDMARK_NAMES.index(n) for n in view.names])
            for name, view in views.items()
        }
        self._predictors = {name: ShapePredictor(view.file) for name, view in views.items()}

    def detect(self, image: Image, view: str) -> Detection | Missed:
        """Find the landmarks in one view, the head about where it was in the neutral."""
        return self._detect(mono(image), view, np.eye(4))

    def detect_frame(
        self, images: Mapping[str, Image], head: Floats | None = None, passes: int = 3
    ) -> FrameFound:
        """Find the landmarks in all views together: they tell the head, and it the boxes.

        Args:
            images: by view; views without a predictor are left out.
            head: (4, 4) where the head is thought to be; at the neutral when not given.
            passes: how often the boxes are laid.

        Raises:
            SolveError: when the views do not agree on where the head is.
        """
        plain = {name: mono(images[name]) for name in self._views if name in images}
        at = np.eye(4) if head is None else head
        for _ in range(passes):
            found = {}
            for name, image in plain.items():
                one = self._detect(image, name, at)
                if isinstance(one, Detection):
                    found[name] = one
            points = meet_landmarks(self._cameras, found, scale_mm=_SCALE_MM)
            at = self._head(points)
        agreed = {name: self._agreed(name, one, points) for name, one in found.items()}
        return FrameFound(detections=agreed, points=points, head=at)

    def _detect(self, image: Floats32, view: str, head: Floats) -> Detection | Missed:
        if view not in self._views:
            return Missed(reason=f"{view}: it shows too little of the face for a predictor")
        camera, index = self._cameras.by_name(view), self._index[view]
        pixels = camera.project(self._rest[index] @ head[:3, :3].T + head[:3, 3])
        if not camera.contains(pixels).any():
            return Missed(reason=f"{view}: the head is not in the image")
        box = FaceBox.around(pixels)
        found = self._predictors[view].predict(shades(box.picture(image)), FaceBox.inner())
        whole = np.full((LANDMARKS, 2), np.nan)
        whole[index] = box.whole(found)
        sigma = np.full(LANDMARKS, np.nan)
        sigma[index] = self._views[view].sigma_px / box.scale
        return Detection(pixels=whole, sigma_px=sigma)

    def _head(self, points: LandmarkPoints) -> Floats:
        """The rigid motion that most of the steady landmarks tell."""
        steady = np.array(_STEADY)
        known = np.isfinite(points.positions[steady]).all(axis=1)
        known &= np.isfinite(self._rest[steady]).all(axis=1)
        chosen = steady[known]
        if len(chosen) < _LEAST_STEADY:
            raise SolveError(
                f"landmarks: the views agree on {len(chosen)} of {len(steady)} steady landmarks; "
                f"{_LEAST_STEADY} are needed to tell the head"
            )
        source, target = self._rest[chosen], points.positions[chosen]
        weight = np.ones(len(chosen))
        for _ in range(8):
            motion = fit_similarity(source, target, weight)
            miss = np.linalg.norm(motion.apply(source) - target, axis=1)
            weight = 1.0 / (1.0 + (miss / _SCALE_MM) ** 2) ** 2
        return motion.matrix()

    def _agreed(self, view: str, found: Detection, points: LandmarkPoints) -> Detection:
        """The detection without the points whose rays pass by where the views meet."""
        camera = self._cameras.by_name(view)
        there = camera.project(points.positions)
        depth = camera.depths(points.positions)
        gap = np.linalg.norm(found.pixels - there, axis=1) * depth / camera.fx
        kept = gap < _SCALE_MM
        return Detection(
            pixels=np.where(kept[:, None], found.pixels, np.nan), sigma_px=found.sigma_px
        )


def landmark_rest(where: LandmarkMap, vertices: Floats) -> Floats:
    """The 68 landmarks (68, 3) on a mesh, world mm; NaN where the map has none."""
    rest = np.full((LANDMARKS, 3), np.nan)
    points = where.surface.points(vertices)
    for name, point in zip(where.names, points, strict=True):
        if name in LANDMARK_NAMES:
            rest[LANDMARK_NAMES.index(name)] = point
    return rest


@dataclass(frozen=True, eq=False, kw_only=True)
class Lesson:
    """What predictors are trained on.

    Attributes:
        mesh: the neutral.
        where: its landmarks.
        acts: training moments; every fourth is kept out and measured on.
        jitter: of boxes and light.
        trees: of the predictors.
        seed: of all that is drawn.
    """

    mesh: Mesh
    where: LandmarkMap
    acts: Sequence[Act]
    jitter: Jitter
    trees: TreeSettings
    seed: int


def train_view(
    lesson: Lesson, skin: ActorSkin, cameras: CameraArray, view: str, folder: Path
) -> ViewModel | Missed:
    """Train and measure the predictor of one view, and write it to FOLDER/<view>.dat.

    Args:
        lesson: what to train on.
        skin: the actor's.
        cameras: the array's.
        view: the camera's name.
        folder: where the file goes.
    """
    camera, mesh = cameras.by_name(view), lesson.mesh
    drawn = Rasterizer(mesh.triangles, len(mesh.vertices)).render(camera, mesh.vertices)
    names = view_landmarks(lesson.where, mesh.vertices, camera, drawn)
    if len(names) < _FEWEST:
        return Missed(reason=f"{view}: it shows {len(names)} landmarks of the neutral")
    where = lesson.where.select(names)
    rest = where.surface.points(mesh.vertices)
    seed = int.from_bytes(hashlib.sha256(f"{lesson.seed} {view}".encode()).digest()[:4], "big")
    sheet = training_sheet(skin, camera, lesson.acts, rest, where, lesson.jitter, seed)
    kept_out = np.arange(len(sheet.images)) % 4 == 3
    learn, check = np.flatnonzero(~kept_out), np.flatnonzero(kept_out)
    path = folder / f"{view}.dat"
    images = [sheet.images[k] for k in learn]
    train_predictor(
        path, images, sheet.boxes[learn], sheet.points[learn], lesson.trees, f"likeness {seed}"
    )
    predictor = ShapePredictor(path)
    told = np.array([predictor.predict(sheet.images[k], sheet.boxes[k]) for k in check])
    square = ((told - sheet.points[check]) ** 2).mean(axis=(0, 2))
    sigma = np.maximum(_HONEST * np.sqrt(square), _LEAST_PX)
    return ViewModel(names=names, sigma_px=sigma, file=path)


def write_model(folder: Path, rest: Floats, views: Mapping[str, ViewModel]) -> Path:
    """Write FOLDER/model.json, which seals the predictors beside it; return its path."""
    document = {
        "rest_mm": [None if np.isnan(p).any() else p.round(4).tolist() for p in rest],
        "views": {
            name: {
                "landmarks": list(view.names),
                "sigma_px": view.sigma_px.round(3).tolist(),
                "sha256": hash_file(view.file),
            }
            for name, view in views.items()
        },
    }
    path = folder / _MODEL
    with replacing(path) as partial:
        partial.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return path


def read_model(folder: Path, cameras: CameraArray) -> ActorDetector:
    """Load what `write_model` wrote.

    Raises:
        TakeError: when a file is missing, damaged, or not the one that was trained.
    """
    path = folder / _MODEL
    document = read_json(path, TakeError, absent="no trained landmark model")
    try:
        rest = np.array(
            [[np.nan] * 3 if p is None else p for p in document["rest_mm"]], dtype=np.float64
        )
        views = {name: _view_model(folder, name, view) for name, view in document["views"].items()}
    except (KeyError, TypeError, ValueError) as error:
        raise TakeError(f"{path}: expected a trained landmark model: {error!r}") from error
    stray = [name for name in views if name not in cameras.names]
    if stray or rest.shape != (LANDMARKS, 3):
        raise TakeError(f"{path}: it was trained for other cameras ({', '.join(stray)})")
    return ActorDetector(cameras, rest, views)


def _view_model(folder: Path, name: str, view: Mapping[str, Any]) -> ViewModel:
    file = folder / f"{name}.dat"
    if not file.is_file() or hash_file(file) != view["sha256"]:
        raise TakeError(f"{file}: missing, or not the predictor that was trained; train again")
    return ViewModel(
        names=tuple(view["landmarks"]),
        sigma_px=np.array(view["sigma_px"], dtype=np.float64),
        file=file,
    )
