import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture.camera import CameraArray
from capture.errors import TakeError
from tools.bench.neutral_scene import arc_cameras
from track.landmark_file import read_landmarks


@pytest.fixture(scope="module")
def cameras() -> CameraArray:
    return arc_cameras(np.zeros(3), count=4)


def write(folder: Path, document: Any) -> Path:
    path = folder / "marks.json"
    path.write_text(json.dumps(document))
    return path


def test_points_and_triangulated_views(tmp_path: Path, cameras: CameraArray) -> None:
    truth = np.array([[10.0, -20.0, 60.0], [-31.0, 5.0, 44.0]])
    views = [
        {
            "vertex": 7 + n,
            "camera": camera.name,
            "pixel": camera.project(truth[n : n + 1])[0].tolist(),
        }
        for n in range(2)
        for camera in cameras
    ]
    points = [{"vertex": 3, "position_mm": [1.0, 2.0, 3.0]}]
    path = write(tmp_path, {"space": "world", "points": points, "views": views})
    marks = read_landmarks(path, 20, cameras)
    assert marks.vertices.tolist() == [3, 7, 8]
    assert marks.positions[0].tolist() == [1.0, 2.0, 3.0]
    assert np.abs(marks.positions[1:] - truth).max() < 1e-6
    assert marks.miss_mm.max() < 1e-6


def test_a_shifted_mark_shows_in_its_miss(tmp_path: Path, cameras: CameraArray) -> None:
    views = []
    for index, camera in enumerate(cameras):
        pixel = camera.project(np.zeros((1, 3)))[0] + (10.0 if index == 0 else 0.0)
        views.append({"vertex": 1, "camera": camera.name, "pixel": pixel.tolist()})
    marks = read_landmarks(write(tmp_path, {"views": views}), 20, cameras)
    assert 0.5 < marks.miss_mm[0] < 8.0


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"points": [{"vertex": 20, "position_mm": [0, 0, 0]}]}, r"points\[0\]: vertex .* 0\.\.19"),
        ({"points": [{"vertex": 2.5, "position_mm": [0, 0, 0]}]}, r"vertex must be .* found 2\.5"),
        ({"points": [{"vertex": 2, "position_mm": [0, 0]}]}, r"position_mm must be 3 finite"),
        ({"points": [{"vertex": 2, "position_mm": "here"}]}, r"position_mm must be 3 .* 'here'"),
        (
            {"views": [{"vertex": 2, "camera": "cam99", "pixel": [1, 2]}]},
            r"no camera 'cam99'.*cam00",
        ),
        ({"views": [{"vertex": 2, "camera": "cam00", "pixel": [1, 2]}]}, r"marked in one view"),
        ({"space": "camera", "points": []}, r'only "world" is known'),
        ({"pionts": []}, r'unknown key "pionts"'),
        ({}, r"no marks"),
        ({"points": 5}, r"points: expected a list"),
        ([1, 2], r"expected an object .* found a list"),
    ],
)
def test_refusals(tmp_path: Path, cameras: CameraArray, document: Any, message: str) -> None:
    with pytest.raises(TakeError, match=message):
        read_landmarks(write(tmp_path, document), 20, cameras)


def test_parallel_rays_are_refused(tmp_path: Path, cameras: CameraArray) -> None:
    twice = [{"vertex": 2, "camera": "cam00", "pixel": [320.0, 300.0]}] * 2
    with pytest.raises(TakeError, match="rays are parallel"):
        read_landmarks(write(tmp_path, {"views": twice}), 20, cameras)


def test_unreadable_files_are_refused(tmp_path: Path, cameras: CameraArray) -> None:
    with pytest.raises(TakeError, match="no such landmarks file"):
        read_landmarks(tmp_path / "none.json", 20, cameras)
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(TakeError, match="not readable as JSON"):
        read_landmarks(tmp_path / "bad.json", 20, cameras)
