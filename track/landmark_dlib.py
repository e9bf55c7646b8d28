"""Landmarks by dlib: the generic 68-point model, and predictors trained for one actor.

dlib is an optional extra, imported when it is needed and nowhere else. The file of the generic
model excludes commercial use (docs/licences.md); predictors trained here owe nothing to it.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Floats, Image, check_shape
from capture.errors import ExtraError, TakeError
from capture.product import replacing
from capture.settings import check_ranges
from recon.images import mono
from track.face_landmarks import LANDMARKS, Detection, Missed
from track.landmark_box import shades

_GENERIC_SHARE = 0.03  # of the face's box: how far off the generic model's points are
_MODELS = "face_recognition_models"
_MODEL_FILE = "shape_predictor_68_face_landmarks.dat"

Gray = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class TreeSettings:
    """Settings of an ensemble of regression trees.

    Attributes:
        cascades: stages of the regression, each of which begins where the last one ended.
        trees: in each stage; file and time grow with them.
        depth: of a tree.
        samples: starts drawn for each training image.
        shift_share: starts are shifted by up to this share of the box.
        pixels: of which pairs are compared, drawn anew for each stage.
        shrinkage: how much of a tree's answer is believed.

    References:
        Kazemi and Sullivan 2014, "One millisecond face alignment with an ensemble of regression
        trees".
    """

    cascades: int = 15
    trees: int = 40
    depth: int = 2
    samples: int = 12
    shift_share: float = 0.08
    pixels: int = 300
    shrinkage: float = 0.15

    def __post_init__(self) -> None:
        check_ranges(
            "landmarks.trees", self, cascades=(1, 30), trees=(1, 1000), depth=(1, 8),
            samples=(1, 500), shift_share=(0.0, 0.5), pixels=(10, 2000), shrinkage=(0.01, 1.0),
        )  # fmt: skip


class ShapePredictor:
    """A trained ensemble of regression trees: points of a face in a box of an image."""

    def __init__(self, path: Path) -> None:
        """Load the file.

        Raises:
            ExtraError: when dlib is not installed.
            TakeError: when the file is not such a predictor.
        """
        dlib = _dlib("a trained landmark predictor")
        try:
            self._predictor = dlib.shape_predictor(str(path))
        except RuntimeError as error:
            raise TakeError(f"{path}: expected a dlib shape predictor: {error}") from error
        self._dlib = dlib

    def predict(self, image: Gray, box: Floats) -> Floats:
        """The points (K, 2), px, of the face in a box (left, top, right, bottom) of an image."""
        check_shape(image=(image, "H W"), box=(box, "4"))
        shape = self._predictor(np.ascontiguousarray(image), _rectangle(self._dlib, box))
        return np.array([[part.x, part.y] for part in shape.parts()], dtype=np.float64)


def train_predictor(
    path: Path,
    images: Sequence[Gray],
    boxes: Floats,
    points: Floats,
    settings: TreeSettings,
    seed: str,
) -> None:
    """Train a predictor and write it, whole or not at all; the same input gives the same bytes.

    Args:
        path: the file.
        images: N of (H, W) uint8.
        boxes: (N, 4) left, top, right, bottom of the face, px.
        points: (N, K, 2) where the points are in each, px; dlib keeps whole pixels.
        settings: of the trees.
        seed: of all that is drawn.

    Raises:
        ExtraError: when dlib is not installed.
    """
    check_shape(boxes=(boxes, "N 4"), points=(points, "N K 2"))
    dlib = _dlib("training a landmark predictor")
    options = dlib.shape_predictor_training_options()
    options.cascade_depth, options.num_trees_per_cascade_level = settings.cascades, settings.trees
    options.tree_depth, options.nu = settings.depth, settings.shrinkage
    options.oversampling_amount = settings.samples
    options.oversampling_translation_jitter = settings.shift_share
    options.feature_pool_size = settings.pixels
    options.random_seed, options.num_threads, options.be_verbose = seed, 1, False
    shapes = [
        [
            dlib.full_object_detection(
                _rectangle(dlib, box), [dlib.point(*row) for row in np.rint(own).astype(int)]
            )
        ]
        for box, own in zip(boxes, points, strict=True)
    ]
    trained = dlib.train_shape_predictor(list(images), shapes, options)
    with replacing(path) as partial:
        trained.save(str(partial))


class GenericDetector:
    """dlib's frontal face detector and the 68-point model of iBUG 300-W.

    Coarse: some millimetres off in frontal views, and it finds nothing or nonsense in profiles;
    `track.landmark_points.meet_landmarks` tells which views agree.

    References:
        Kazemi and Sullivan 2014; Sagonas et al. 2016, "300 faces in-the-wild challenge".
    """

    def __init__(self, model: Path | None = None) -> None:
        """Load the model; that of the package face_recognition_models when none is given.

        Raises:
            ExtraError: when dlib, or the model, is not installed.
        """
        dlib = _dlib("the 68-point landmark detector")
        self._faces = dlib.get_frontal_face_detector()
        self._points = ShapePredictor(_installed_model() if model is None else model)

    def detect(self, image: Image, view: str) -> Detection | Missed:
        """Find the landmarks of the largest frontal face; every view is treated alike."""
        gray = shades(mono(image))
        faces = list(self._faces(gray, 0))
        if not faces:
            return Missed(reason=f"{view}: no frontal face found")
        face = max(faces, key=lambda found: (found.width(), -found.left()))
        box = np.array([face.left(), face.top(), face.right(), face.bottom()], dtype=np.float64)
        pixels = self._points.predict(gray, box)
        if len(pixels) != LANDMARKS:
            return Missed(reason=f"the model has {len(pixels)} points, not {LANDMARKS}")
        sigma = np.full(LANDMARKS, _GENERIC_SHARE * face.width())
        return Detection(pixels=pixels, sigma_px=sigma)


def _installed_model() -> Path:
    found = importlib.util.find_spec(_MODELS)
    if found is None or found.origin is None:
        raise ExtraError("the generic 68-point landmark detector", _MODELS, "landmarks")
    return Path(found.origin).parent / "models" / _MODEL_FILE


def _dlib(feature: str) -> ModuleType:
    try:
        import dlib
    except ModuleNotFoundError as error:
        raise ExtraError(feature, "dlib-bin", "landmarks") from error
    module: ModuleType = dlib
    return module


def _rectangle(dlib: Any, box: Floats) -> Any:
    return dlib.rectangle(*[round(float(side)) for side in box])
