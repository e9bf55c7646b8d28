"""A predictor of one actor finds his landmarks in frames it was not trained on; dlib's place."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera_file import write_cameras
from capture.errors import ExtraError, SettingsError, SolveError, TakeError
from capture.pose import Pose
from capture.take import Take
from recon.visiting import import_take
from tests.track.landmark_face import face, face_cameras, face_map, noisy_skin, photograph
from track.face_landmarks import Detection, Missed
from track.landmark_actor import read_model
from track.landmark_dlib import ShapePredictor, TreeSettings, train_predictor
from track.landmark_expressions import landmark_shapes
from track.landmark_stage import (
    LandmarkSettings,
    detect_landmarks,
    import_landmarks,
    stored_hash,
    stored_sightings,
    train_landmarks,
)

MESH = face()
WHERE = face_map(MESH)
SKIN = noisy_skin(MESH, WHERE)
CAMERAS = face_cameras(3)
SMALL = LandmarkSettings(pictures=30, turn_deg=2.0, shift_mm=4.0, cascades=10, trees=20)


@pytest.fixture(scope="module")
def shapes() -> dict[str, np.ndarray]:
    every = landmark_shapes(MESH, WHERE)
    return {name: every[name] for name in ("jaw_open", "smile_left", "brow_inner")}


def moments(shapes: dict[str, np.ndarray]) -> list[np.ndarray]:
    """The neutral, a smile with the head turned and moved, and nobody."""
    turn = Pose.from_rotation_vector(np.array([0.02, 0.05, -0.02]), np.array([5.0, -3.0, 4.0]))
    moved = MESH.vertices + 0.7 * shapes["smile_left"] + 0.5 * shapes["brow_inner"]
    return [MESH.vertices, turn.apply(moved), MESH.vertices + [0.0, 0.0, -3000.0]]


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory, shapes: dict[str, np.ndarray]) -> Take:
    folder = tmp_path_factory.mktemp("actor")
    write_cameras(folder / "source" / "cameras.json", CAMERAS)
    for camera in CAMERAS:
        (folder / "source" / camera.name).mkdir()
        for frame, vertices in enumerate(moments(shapes)):
            image = photograph(camera, MESH, vertices, SKIN)
            path = folder / "source" / camera.name / f"{frame:04d}.png"
            cv2.imwrite(str(path), (image * 255.0).astype(np.uint8))
    return import_take(folder / "source", folder / "take")


def test_landmarks_are_found_where_they_are(take: Take, shapes: dict[str, np.ndarray]) -> None:
    pytest.importorskip("dlib")
    detector = train_landmarks(take, MESH, WHERE, SMALL, shapes=shapes)
    report = detect_landmarks(take, detector, WHERE, SMALL, [0, 1])
    truth = WHERE.surface.points(moments(shapes)[1])
    images = {name: take.image(name, 1) for name in take.device_names}
    found = detector.detect_frame(images)
    gap = np.linalg.norm(found.points.positions - truth, axis=1)[17:]
    still = np.linalg.norm(WHERE.surface.points(MESH.vertices) - truth, axis=1)[17:]
    assert np.median(still) > 6.0
    assert np.nanmedian(gap) < 1.5
    assert np.isfinite(gap).mean() > 0.9
    assert report["frames"]["1"]["found"]
    (sightings,) = stored_sightings(take, MESH, 1)
    lifted = sightings.lifted(MESH.vertices, {camera.name: camera for camera in CAMERAS})
    there = WHERE.surface.points(MESH.vertices)[17:] + lifted.motion  # all but the jaw
    sure = lifted.views >= 2
    assert sure.sum() > 40
    assert np.median(np.linalg.norm(there - truth[17:], axis=1)[sure]) < 2.5
    assert stored_sightings(take, MESH, 2) == []
    assert stored_hash(take, 2) == "none"
    one = detector.detect(images["cam07"], "cam07")
    assert isinstance(one, Detection)
    assert isinstance(detector.detect(images["cam07"], "elsewhere"), Missed)

    folder = take.products / "landmarks" / "predictor"
    sizes = [path.stat().st_size for path in folder.glob("*.dat")]
    assert len(sizes) == len(CAMERAS)
    assert max(sizes) < 2_500_000
    stamp = (folder / "model.json").stat().st_mtime_ns
    train_landmarks(take, MESH, WHERE, SMALL, shapes=shapes)
    assert (folder / "model.json").stat().st_mtime_ns == stamp  # current: not trained again
    with pytest.raises(SolveError, match=r"views agree on \d+ of 23 steady landmarks"):
        detector.detect_frame({name: take.image(name, 2) for name in take.device_names[:1]})
    (folder / "cam07.dat").write_bytes(b"no trees")
    with pytest.raises(TakeError, match=r"cam07\.dat: missing, or not the predictor"):
        read_model(folder, CAMERAS)
    with pytest.raises(TakeError, match="expected a dlib shape predictor"):
        ShapePredictor(folder / "cam07.dat")


def test_landmarks_of_another_detector_are_taken_over(take: Take, tmp_path: Path) -> None:
    path = tmp_path / "detected.json"
    views = {name: {"lip_outer_0": [100.5, 200.25]} for name in take.device_names}
    path.write_text(json.dumps({"frames": {"2": views}, "accuracy_px": 1.5}))
    assert import_landmarks(take, MESH, path, WHERE) == {"2": 3}
    (sightings,) = stored_sightings(take, MESH, 2)
    assert sightings.accuracy_px == 1.5
    assert sightings.pixel.tolist() == [[100.5, 200.25]] * 3
    assert stored_hash(take, 2) != "none"
    (take.products / "landmarks" / "frame_0002.json").unlink()
    path.write_text(json.dumps({"frames": {"9": views}}))
    with pytest.raises(TakeError, match=r"frames\.9: the take has frames 0\.\.2"):
        import_landmarks(take, MESH, path, WHERE)


def test_training_is_deterministic_and_learns(tmp_path: Path) -> None:
    pytest.importorskip("dlib")
    rng = np.random.default_rng(0)
    images, points = [], []
    for _ in range(40):
        spot = rng.uniform(30.0, 70.0, 2)
        image = np.zeros((100, 100), np.uint8)
        cv2.circle(image, tuple(np.rint(spot).astype(int).tolist()), 12, 255, -1)
        images.append(image)
        points.append(spot + 22.0 * np.array([[-1, -1], [1, -1], [0, 0], [-1, 1], [1, 1]]))
    boxes = np.tile([10.0, 10.0, 90.0, 90.0], (40, 1))
    settings = TreeSettings(cascades=8, trees=30)
    for name in ("a.dat", "b.dat"):
        train_predictor(tmp_path / name, images, boxes, np.array(points), settings, "seed")
    assert (tmp_path / "a.dat").read_bytes() == (tmp_path / "b.dat").read_bytes()
    predictor = ShapePredictor(tmp_path / "a.dat")
    told = np.array([predictor.predict(image, boxes[0]) for image in images])
    assert np.median(np.linalg.norm(told - np.array(points), axis=2)) < 3.0


def test_without_dlib_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "dlib", None)
    with pytest.raises(ExtraError, match=r"dlib-bin.*pip install 'likeness\[landmarks\]'"):
        ShapePredictor(tmp_path / "any.dat")


def test_dlib_is_imported_only_when_it_is_used() -> None:
    code = "import sys, track.landmark_stage; sys.exit('dlib' in sys.modules)"
    root = Path(__file__).resolve().parents[2]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


def test_a_model_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TakeError, match="no trained landmark model"):
        read_model(tmp_path, CAMERAS)
    (tmp_path / "model.json").write_text(json.dumps({"views": {}}))
    with pytest.raises(TakeError, match="expected a trained landmark model"):
        read_model(tmp_path, CAMERAS)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"landmarks\.pictures = 2: must be at least 8"):
        LandmarkSettings(pictures=2)
    with pytest.raises(SettingsError, match=r"landmarks\.trees\.depth = 0"):
        TreeSettings(depth=0)
