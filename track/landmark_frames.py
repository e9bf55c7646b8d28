"""Landmarks of the frames of a take, as any detector may have found them, in a JSON file.

::

    {"vertices": {"lip_outer_0": 5708, "mole": 812},
     "accuracy_px": 4.0,
     "frames": {"12": {"cam03": {"lip_outer_0": [511.2, 388.0, 0.8], "mole": [402.9, 391.5]},
                       "cam07": [[511.2, 388.0], null, ...]}}}

`vertices` (or `points`, see `track.landmark_map`) tell where the names are on the mesh; they may
stand in a map of their own. A view has an object of names, or a list of the 68 of the layout with
null for those not found. The third number is a score of 0..1; 1 is meant when it is absent. Pixels
are (column, row), integers at pixel centres.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.camera import CameraArray
from capture.documents import read_json
from capture.errors import TakeError, raise_all
from capture.names import known_hint
from capture.product import replacing
from recon.mesh import Mesh
from track.face_landmarks import LANDMARK_NAMES, LANDMARKS, Detection, surface_landmarks
from track.landmark_map import LandmarkMap, parse_landmark_map
from track.sightings import Sightings

_KEYS = {"vertices", "points", "accuracy_px", "frames"}
_ACCURACY_PX = 4.0
_ROBUST = 3.0  # the scale at which a sighting loses its weight, in standard deviations
_MOST_TOLD = 20  # problems of one file

View = Mapping[str, tuple[float, float, float]]
"""By landmark: column and row, px, and score 0..1."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameLandmarks:
    """Landmarks seen in the frames of a take.

    Attributes:
        where: the landmarks on the mesh.
        accuracy_px: standard deviation of a landmark of score 1, px a coordinate.
        frames: by frame, by camera, what was seen.
    """

    where: LandmarkMap
    accuracy_px: float
    frames: Mapping[int, Mapping[str, View]]

    def sightings(self, frame: int) -> list[Sightings]:
        """What was seen in a frame, as registration takes it: one entry, or none."""
        views = self.frames.get(frame, {})
        cameras = tuple(name for name in views if views[name])
        rows = [
            (self.where.names.index(name), cameras.index(camera), *seen)
            for camera in cameras
            for name, seen in views[camera].items()
        ]
        if not rows:
            return []
        table = np.array(rows, dtype=np.float64)
        strength = table[:, 4] / self.accuracy_px**2
        return [
            Sightings(
                surface=self.where.surface,
                cameras=cameras,
                point=table[:, 0].astype(np.int32),
                view=table[:, 1].astype(np.int32),
                pixel=table[:, 2:4],
                information=np.stack([strength, 0.0 * strength, strength], axis=1),
                scale_px=_ROBUST * self.accuracy_px,
                accuracy_px=self.accuracy_px,
            )
        ]


def detected_views(
    detections: Mapping[str, Detection], where: LandmarkMap, accuracy_px: float
) -> dict[str, View]:
    """Detections as a file holds them: those of the map, scored against `accuracy_px`."""
    index = {name: LANDMARK_NAMES.index(name) for name in where.names if name in LANDMARK_NAMES}
    out: dict[str, View] = {}
    for camera, found in detections.items():
        score = np.minimum((accuracy_px / np.maximum(found.sigma_px, 1e-6)) ** 2, 1.0)
        there = np.isfinite(found.pixels).all(axis=1) & np.isfinite(found.sigma_px)
        out[camera] = {
            name: (
                round(float(found.pixels[k, 0]), 3),
                round(float(found.pixels[k, 1]), 3),
                round(float(score[k]), 4),
            )
            for name, k in index.items()
            if there[k]
        }
    return out


def write_frame_landmarks(path: Path, landmarks: FrameLandmarks) -> None:
    """Write what `read_frame_landmarks` reads, whole or not at all."""
    document = {
        **landmarks.where.document(),
        "accuracy_px": landmarks.accuracy_px,
        "frames": {str(frame): views for frame, views in sorted(landmarks.frames.items())},
    }
    with replacing(path) as partial:
        partial.write_text(json.dumps(document) + "\n", encoding="utf-8")


def read_frame_landmarks(
    path: Path, mesh: Mesh, cameras: CameraArray, where: LandmarkMap | None = None
) -> FrameLandmarks:
    """Read landmarks of frames, of any detector.

    Args:
        path: the file.
        mesh: the one that is tracked.
        cameras: the take's.
        where: the landmarks on the mesh; those in the file come first.

    Raises:
        TakeError: listing what does not fit, by its place in the file.
    """
    document = read_json(path, TakeError, absent="no such landmarks file")
    if not isinstance(document, dict):
        raise TakeError(f"{path}: expected an object, found a {type(document).__name__}")
    problems = [
        f'unknown key "{key}"; {known_hint(key, sorted(_KEYS))}'
        for key in document
        if key not in _KEYS
    ]
    own = parse_landmark_map(document, mesh, problems)
    merged = own if own.names or where is None else where
    accuracy = document.get("accuracy_px", _ACCURACY_PX)
    if not _is_number(accuracy) or not 0.0 < accuracy < 1e4:
        problems.append(f"accuracy_px: expected a number above 0, found {accuracy!r}")
        accuracy = _ACCURACY_PX
    frames = _frames(document.get("frames"), merged, cameras, problems)
    if len(problems) > _MOST_TOLD:
        rest = len(problems) - _MOST_TOLD
        problems = [*problems[:_MOST_TOLD], f"and {rest} more"]
    raise_all(f"{path}", problems, TakeError)
    return FrameLandmarks(where=merged, accuracy_px=float(accuracy), frames=frames)


def _frames(
    given: Any, where: LandmarkMap, cameras: CameraArray, problems: list[str]
) -> dict[int, dict[str, View]]:
    if not isinstance(given, dict):
        problems.append('frames: expected an object such as {"12": {"cam03": ...}}')
        return {}
    out: dict[int, dict[str, View]] = {}
    for text, views in given.items():
        if not text.isdecimal():
            problems.append(f"frames.{text}: expected a frame number, 0 or above")
        elif not isinstance(views, dict):
            problems.append(f"frames.{text}: expected an object of cameras")
        else:
            out[int(text)] = {
                name: _view(f"frames.{text}.{name}", name, seen, where, cameras, problems)
                for name, seen in views.items()
            }
    return out


def _view(
    place: str, name: str, seen: Any, where: LandmarkMap, cameras: CameraArray, problems: list[str]
) -> View:
    if name not in cameras.names:
        problems.append(f"{place}: no such camera; {known_hint(name, cameras.names)}")
        return {}
    if isinstance(seen, list):
        if len(seen) != LANDMARKS:
            problems.append(
                f"{place}: a list has {LANDMARKS} entries, null where none, found {len(seen)}"
            )
            return {}
        sure = [i for i in surface_landmarks().tolist() if LANDMARK_NAMES[i] in where.names]
        entries = [(f"{place}[{i}]", LANDMARK_NAMES[i], seen[i]) for i in sure]
    elif isinstance(seen, dict):
        entries = [(f"{place}.{key}", key, value) for key, value in seen.items()]
    else:
        problems.append(f"{place}: expected a list of {LANDMARKS} or an object of names")
        return {}
    out: dict[str, tuple[float, float, float]] = {}
    for spot, key, value in entries:
        if value is None:
            continue
        if key not in where.names:
            problems.append(f"{spot}: no such landmark; {known_hint(key, where.names)}")
        elif (numbers := _numbers(value)) is None:
            problems.append(f"{spot}: expected [x, y] or [x, y, score 0..1], found {value!r}")
        else:
            out[key] = numbers
    return out


def _numbers(value: Any) -> tuple[float, float, float] | None:
    if not isinstance(value, list) or len(value) not in (2, 3) or not all(map(_is_number, value)):
        return None
    x, y, score = (*value, 1.0) if len(value) == 2 else value
    sound = np.isfinite([x, y]).all() and 0.0 <= score <= 1.0
    return (float(x), float(y), float(score)) if sound else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
