"""A template is laid where a detector saw the face, though some views saw it elsewhere."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.arrays import Floats, Image
from capture.camera import CameraArray
from capture.camera_file import read_cameras
from capture.pose import Pose
from tests.track.landmark_face import face, face_cameras, face_map
from track.face_landmarks import LANDMARKS, Detection, Missed
from track.landmark_actor import landmark_rest
from track.landmark_dlib import GenericDetector
from track.landmark_place import place_detected
from track.landmark_points import meet_landmarks
from track.rigid import Similarity

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
MESH = face()
WHERE = face_map(MESH)
CAMERAS = face_cameras(8)


class Seeing:
    """A detector that is some pixels off, grossly so in some views, and blind in others."""

    def __init__(self, cameras: CameraArray, points: Floats, wrong: set[str], blind: set[str]):
        self.cameras, self.points, self.wrong, self.blind = cameras, points, wrong, blind

    def detect(self, image: Image, view: str) -> Detection | Missed:
        if view in self.blind:
            return Missed(reason=f"{view}: no frontal face found")
        rng = np.random.default_rng(len(view) + int(view[3:]))
        pixels = self.cameras.by_name(view).project(self.points)
        pixels = pixels + rng.normal(0.0, 3.0, pixels.shape) + (90.0 if view in self.wrong else 0.0)
        return Detection(pixels=pixels, sigma_px=np.full(LANDMARKS, 3.0))


def test_template_is_laid_on_the_detected_face() -> None:
    names = CAMERAS.names
    points = landmark_rest(WHERE, MESH.vertices)
    detector = Seeing(CAMERAS, points, wrong={names[1], names[6]}, blind={names[0]})
    images = {name: np.zeros((4, 4), np.uint8) for name in names}
    turn = Pose.from_rotation_vector(np.array([0.4, -1.1, 0.7]), np.zeros(3)).rotation
    away = Similarity(rotation=turn, translation=np.array([300.0, -50.0, 80.0]), scale=1.1)
    place = place_detected(detector, images, CAMERAS, away.apply(MESH.vertices), WHERE)
    assert place.world_from_template is not None
    back = place.world_from_template.apply(away.apply(MESH.vertices))
    front = MESH.vertices[:, 2] > 20.0
    assert np.linalg.norm(back - MESH.vertices, axis=1)[front].max() < 4.0
    assert place.report["views"] == 7
    assert place.report["landmarks"] == 51
    assert place.report["missed"] == [f"{names[0]}: no frontal face found"]
    assert place.report["gap_mm"] < 3.0


def test_too_few_landmarks_give_no_place() -> None:
    detector = Seeing(CAMERAS, landmark_rest(WHERE, MESH.vertices), set(), set(CAMERAS.names[1:]))
    images = {name: np.zeros((4, 4), np.uint8) for name in CAMERAS.names}
    place = place_detected(detector, images, CAMERAS, MESH.vertices, WHERE)
    assert place.world_from_template is None
    assert place.report["landmarks"] == 0


@pytest.mark.landmarks
@pytest.mark.shared_data
@pytest.mark.filterwarnings("ignore:pkg_resources")
def test_the_generic_model_finds_a_rendered_face() -> None:
    source = SHARED / "takes" / "dev-smile"
    cameras = read_cameras(source / "cameras.json")
    with np.load(source / "truth.npz") as data:
        ids, truth = data["landmarks68"], data["vertices"][0].astype(np.float64)
    detector = GenericDetector()
    found = {}
    for camera in cameras:
        image = cv2.imread(str(source / camera.name / "0000.png"), cv2.IMREAD_UNCHANGED)
        one = detector.detect(image, camera.name)
        if isinstance(one, Detection):
            found[camera.name] = one
    assert len(found) >= 6
    points = meet_landmarks(cameras, found)
    gap = np.linalg.norm(points.positions - truth[ids], axis=1)[17:]
    assert np.nanmedian(gap) < 10.0  # mm: coarse, as docs/landmarks.md says
    assert isinstance(detector.detect(np.zeros((200, 200), np.uint8), "dark"), Missed)
