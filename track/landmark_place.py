"""Where detected landmarks lay a template: a start for its placement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.arrays import Floats, Image
from capture.camera import CameraArray
from track.face_landmarks import LANDMARK_NAMES, Detection, LandmarkDetector, surface_landmarks
from track.landmark_map import LandmarkMap
from track.landmark_points import meet_landmarks
from track.rigid import Similarity, fit_similarity

_FEWEST = 12
_ROUNDS = 8
_SCALE_MM = 8.0  # between a generic detector's landmark and the template's


@dataclass(frozen=True, eq=False, kw_only=True)
class DetectedPlace:
    """What a detector says of where a template belongs.

    Attributes:
        world_from_template: where; None when too few landmarks met.
        report: views, landmarks and their miss, fit for JSON.
    """

    world_from_template: Similarity | None
    report: Mapping[str, Any]


def place_detected(
    detector: LandmarkDetector,
    images: Mapping[str, Image],
    cameras: CameraArray,
    vertices: Floats,
    where: LandmarkMap,
) -> DetectedPlace:
    """Find the landmarks of a frame and lay a template's (V, 3) onto them, robustly.

    Args:
        detector: any.
        images: of the frame, by view.
        cameras: the array's.
        vertices: the template's, mm.
        where: its landmarks.
    """
    found: dict[str, Detection] = {}
    missed: dict[str, str] = {}
    for name, image in images.items():
        one = detector.detect(image, name)
        if isinstance(one, Detection):
            found[name] = one
        else:
            missed[name] = one.reason
    points = meet_landmarks(cameras, found)
    sure = {LANDMARK_NAMES[i]: i for i in surface_landmarks().tolist()}
    known = [n for n in where.names if n in sure and np.isfinite(points.positions[sure[n]]).all()]
    chosen = [sure[name] for name in known]
    report: dict[str, Any] = {
        "views": len(found),
        "landmarks": len(known),
        "missed": list(missed.values()),
    }
    if len(known) < _FEWEST:
        return DetectedPlace(world_from_template=None, report=report)
    report["miss_mm"] = round(float(np.median(points.miss_mm[chosen])), 3)
    source = where.select(known).surface.points(vertices)
    motion, gap = _laid(source, points.positions[chosen])
    report["gap_mm"] = round(gap, 3)
    return DetectedPlace(world_from_template=motion, report=report)


def _laid(source: Floats, target: Floats) -> tuple[Similarity, float]:
    """The similarity that most landmarks agree on, and their median distance after it."""
    weight = np.ones(len(source))
    for _ in range(_ROUNDS):
        motion = fit_similarity(source, target, weight, with_scale=True)
        gap = np.linalg.norm(motion.apply(source) - target, axis=1)
        weight = 1.0 / (1.0 + (gap / _SCALE_MM) ** 2) ** 2
    return motion, float(np.median(gap))
