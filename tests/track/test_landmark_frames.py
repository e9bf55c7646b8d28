"""Landmarks of frames and landmark maps: read, refused by place, carried to other meshes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture.camera import CameraArray
from capture.errors import TakeError
from tests.track.face_scene import TEMPLATE, head
from tools.bench.neutral_scene import arc_cameras
from track.face_landmarks import LANDMARK_NAMES, LANDMARKS, Detection
from track.landmark_frames import (
    FrameLandmarks,
    detected_views,
    read_frame_landmarks,
    write_frame_landmarks,
)
from track.landmark_map import (
    map_beside,
    read_landmark_map,
    transferred,
    vertex_map,
    write_landmark_map,
)

MESH = head(TEMPLATE)


@pytest.fixture(scope="module")
def cameras() -> CameraArray:
    return arc_cameras(np.array([0.0, 0.0, 20.0]), count=4)


def write(folder: Path, document: Any) -> Path:
    path = folder / "landmarks.json"
    path.write_text(json.dumps(document))
    return path


def test_named_points_and_lists_become_sightings(tmp_path: Path, cameras: CameraArray) -> None:
    listed = [[float(i), 2.0 * i] for i in range(LANDMARKS)]
    listed[49] = None  # type: ignore[call-overload]
    document = {
        "vertices": {"lip_outer_0": 1200, "lip_outer_1": 1201, "jaw_8": 1300, "mole": 1400},
        "accuracy_px": 2.0,
        "frames": {
            "3": {"cam01": {"lip_outer_0": [10.0, 11.0, 0.25], "mole": [5, 6]}, "cam02": listed}
        },
    }
    found = read_frame_landmarks(write(tmp_path, document), MESH, cameras)
    assert found.sightings(0) == []
    (sightings,) = found.sightings(3)
    assert sightings.cameras == ("cam01", "cam02")
    names = [found.where.names[p] for p in sightings.point]
    assert names == ["lip_outer_0", "mole", "lip_outer_0"]  # the jaw is no piece of skin in a list
    assert sightings.pixel.tolist() == [[10.0, 11.0], [5.0, 6.0], [48.0, 96.0]]
    assert sightings.information[:, 0].tolist() == [0.0625, 0.25, 0.25]
    assert sightings.information[:, 1].tolist() == [0.0, 0.0, 0.0]
    points = found.where.surface.points(MESH.vertices)
    assert np.array_equal(points[0], MESH.vertices[1200])


def test_what_is_written_is_read_again(tmp_path: Path, cameras: CameraArray) -> None:
    where = vertex_map({"lip_outer_0": 1200, "lids_left_0": 900}, MESH.triangles)
    pixels = np.full((LANDMARKS, 2), np.nan)
    pixels[LANDMARK_NAMES.index("lip_outer_0")] = [100.25, 200.5]
    detection = Detection(pixels=pixels, sigma_px=np.full(LANDMARKS, 4.0))
    views = detected_views({"cam00": detection, "cam02": detection}, where, accuracy_px=2.0)
    made = FrameLandmarks(where=where, accuracy_px=2.0, frames={7: views})
    path = tmp_path / "frame_0007.json"
    write_frame_landmarks(path, made)
    found = read_frame_landmarks(path, MESH, cameras)
    assert found.frames[7]["cam02"] == {"lip_outer_0": (100.25, 200.5, 0.25)}
    (one,), (two,) = found.sightings(7), made.sightings(7)
    assert np.array_equal(one.information, two.information)
    assert np.allclose(
        one.surface.points(MESH.vertices), two.surface.points(MESH.vertices), atol=1e-9
    )


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([], "expected an object, found a list"),
        ({"frame": {}}, r'unknown key "frame"; did you mean .frames.'),
        ({"frames": []}, "frames: expected an object such as"),
        ({"frames": {"x": {}}}, r"frames\.x: expected a frame number"),
        ({"frames": {"1": {"cam9": {}}}}, r"frames\.1\.cam9: no such camera; did you mean"),
        ({"frames": {"1": {"cam01": [[1, 2]]}}}, r"frames\.1\.cam01: a list has 68 entries.*1"),
        ({"frames": {"1": {"cam01": {"mole": [1]}}}}, r"cam01\.mole: expected \[x, y\] or"),
        ({"frames": {"1": {"cam01": {"mole": [1, 2, 3]}}}}, r"score 0\.\.1\], found \[1, 2, 3\]"),
        ({"frames": {"1": {"cam01": {"mol": [1, 2]}}}}, r"no such landmark; did you mean 'mole'"),
        ({"frames": {}, "accuracy_px": -1}, r"accuracy_px: expected a number above 0, found -1"),
        ({"frames": {}, "vertices": {"a": 99999}}, r"vertices\.a: vertex must be .* found 99999"),
        ({"frames": {}, "vertices": [1]}, r"vertices: a list has 68 entries, found 1"),
        (
            {"frames": {}, "points": {"a": {"corners": [0, 1, 2], "weights": [1, 0, 0]}}},
            r"points\.a: corners \[0, 1, 2\] are no triangle",
        ),
        (
            {"frames": {}, "points": {"a": {"corners": [0, 1, 73], "weights": [1, 1, 0]}}},
            r"points\.a: weights must be three numbers of sum 1",
        ),
    ],
)
def test_misfits_are_refused_by_place(
    tmp_path: Path, cameras: CameraArray, document: Any, message: str
) -> None:
    if isinstance(document, dict) and "vertices" not in document:
        document = {"vertices": {"mole": 1400}, **document}
    with pytest.raises(TakeError, match=message):
        read_frame_landmarks(write(tmp_path, document), MESH, cameras)


def test_a_file_of_nonsense_is_told_shortly(tmp_path: Path, cameras: CameraArray) -> None:
    frames = {str(n): {"nobody": {}} for n in range(1000)}
    with pytest.raises(TakeError, match="and 980 more") as caught:
        read_frame_landmarks(write(tmp_path, {"frames": frames}), MESH, cameras)
    assert len(str(caught.value)) < 5000


def test_map_stands_beside_the_mesh_and_carries_over(tmp_path: Path) -> None:
    named = {"nose_bridge_3": 30 * 72 + 36, "lip_outer_0": 18 * 72 + 30, "chin": 9 * 72 + 36}
    path = map_beside(tmp_path / "head.obj")
    assert path.name == "head.landmarks.json"
    path.write_text(json.dumps({"vertices": named}))
    known = read_landmark_map(path, MESH)
    other = head(TEMPLATE, columns=101, rows=83)  # another topology of the same face
    moved = transferred(known, MESH, other)
    assert moved.names == known.names
    gap = np.linalg.norm(
        moved.surface.points(other.vertices) - known.surface.points(MESH.vertices), axis=1
    )
    assert gap.max() < 0.5  # mm: the two polyhedra differ by no more
    write_landmark_map(path, moved)  # points inside triangles
    read = read_landmark_map(path, other)
    assert np.allclose(read.surface.barycentric, moved.surface.barycentric, atol=1e-6)
    assert np.array_equal(read.surface.corners, moved.surface.corners)
    again = transferred(moved, other, MESH)
    back = again.surface.points(MESH.vertices) - known.surface.points(MESH.vertices)
    assert np.linalg.norm(back, axis=1).max() < 1.0
    empty = tmp_path / "empty.json"
    empty.write_text("{}")
    with pytest.raises(TakeError, match="no landmarks: expected vertices or points"):
        read_landmark_map(empty, MESH)
