"""The actor's images: determinism, skin that sticks, a board that is where it should be, dlib."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera import Camera
from capture.errors import SettingsError
from capture.pose import Pose
from tools.actor.array import make_array
from tools.actor.board_renderer import BoardRenderer
from tools.actor.canvas import Canvas
from tools.actor.model import ActorModel, build_actor
from tools.actor.renderer import ActorRenderer, Exposure
from tools.actor.scene import DEMO_BOARD
from tools.actor.script import board_pose
from tools.actor.sensor import Sensor, expose, make_sensors

STILL = Sensor(defocus_px=0.0, vignetting=0.0)


def frontal(size: int) -> Camera:
    array = make_array(0, count=1, size=size)
    place = np.array([0.0, 0.0, 660.0])
    flip = np.diag([1.0, -1.0, -1.0])
    return array[0].posed(Pose(flip, -flip @ place))


@pytest.fixture(scope="module")
def canvas() -> Canvas:
    return Canvas()


@pytest.fixture(scope="module")
def actor() -> ActorModel:
    return build_actor(4)


@pytest.fixture(scope="module")
def renderer(actor: ActorModel, canvas: Canvas) -> ActorRenderer:
    return ActorRenderer(actor, canvas)


def test_an_image_is_decided_by_its_key(actor: ActorModel, renderer: ActorRenderer) -> None:
    camera = frontal(200)
    posed = actor.pose(actor.weights(jawOpen=0.4), Pose.identity())
    images = [
        renderer.render(camera, posed, Sensor(), Exposure(seed, t_ns))
        for seed, t_ns in ((1, 5), (1, 5), (1, 6), (2, 5))
    ]
    assert images[0].dtype == np.uint8
    assert images[0].tobytes() == images[1].tobytes()
    assert images[0].tobytes() != images[2].tobytes()
    assert images[0].tobytes() != images[3].tobytes()
    again = ActorRenderer(actor).render(camera, posed, Sensor(), Exposure(1, 5))
    assert again.tobytes() == images[0].tobytes()


def test_sensor_noise_gain_and_bits() -> None:
    grey = np.full((300, 300), 0.4, np.float32)
    sensor = replace(STILL, shot_dn=0.02, read_dn=1.5)
    image = expose(grey, sensor, (0, "a", 0)).astype(float)
    assert image.mean() == pytest.approx(100.0, abs=0.2)
    assert image.var() == pytest.approx(1.5**2 + 0.02 * 100 + 1 / 12, rel=0.04)
    bright = expose(grey, replace(sensor, gain=1.5), (0, "a", 0))
    assert bright.mean() == pytest.approx(150.0, abs=0.2)
    deep = expose(grey, replace(sensor, bits=12), (0, "a", 0))
    assert deep.dtype == np.uint16
    assert deep.mean() == pytest.approx(100.0 * 4095 / 255, rel=0.005)
    with pytest.raises(SettingsError, match=r"read_dn = .*: must be at least 0"):
        Sensor(read_dn=-1.0)
    assert make_sensors(3, ["a", "b"]) == make_sensors(3, ["a", "b"])
    assert make_sensors(3, ["a", "b"])["b"] == make_sensors(3, ["b"])["b"]


def test_the_skin_sticks_to_the_surface(actor: ActorModel, renderer: ActorRenderer) -> None:
    """The same rest points show the same albedo at rest and in an expression, seen obliquely."""
    camera = frontal(640)
    neutral = actor.pose(actor.weights(), Pose.identity())
    head = Pose.from_rotation_vector(np.array([0.03, 0.05, 0.0]), np.array([2.0, 1.0, 0.0]))
    moved = actor.pose(actor.weights(mouthSmile=0.6, browInnerUp=0.6), head)
    triangles = actor.neutral.triangles
    centre = neutral.skin[triangles].mean(axis=1)
    painted = np.maximum(actor.paint.lip, actor.paint.brow)[triangles].max(axis=1)
    picked = triangles[(centre[:, 2] > 70) & (np.abs(centre[:, 0]) < 40) & (painted == 0)]

    plain = actor.paint.albedo[picked].mean(axis=1)

    def seen(posed_skin: np.ndarray, image: np.ndarray) -> np.ndarray:
        pixels = camera.project(posed_skin[picked].mean(axis=1)).astype(np.float32)
        sampled = cv2.remap(image, pixels[:, None, 0], pixels[:, None, 1], cv2.INTER_LINEAR)[:, 0]
        return sampled / plain  # the fine detail alone

    still = seen(neutral.skin, renderer.albedo(camera, neutral))
    acted = seen(moved.skin, renderer.albedo(camera, moved))
    unmoved = seen(neutral.skin, renderer.albedo(camera, moved))
    assert np.corrcoef(still, acted)[0, 1] > 0.85
    assert np.corrcoef(still, unmoved)[0, 1] < 0.65


def test_highlights_move_with_the_view(actor: ActorModel, renderer: ActorRenderer) -> None:
    """Light over albedo of the same skin differs between two views; matt skin would keep it."""
    posed = actor.pose(actor.weights(), Pose.identity())
    array = make_array(2, count=16, size=320)
    spots = posed.skin[actor.face_region]
    forward = spots[
        (np.abs(spots[:, 0]) < 35) & (spots[:, 1] > 35)
    ]  # the forehead: nothing hides it
    ratios = []
    for camera in (array[5], array[11]):
        pixels = camera.project(forward).astype(np.float32)
        columns, rows = pixels[:, None, 0], pixels[:, None, 1]
        light = cv2.remap(renderer.radiance(camera, posed), columns, rows, cv2.INTER_LINEAR)
        albedo = cv2.remap(renderer.albedo(camera, posed), columns, rows, cv2.INTER_LINEAR)
        ratios.append((light / albedo)[:, 0])
    change = np.abs(ratios[0] / ratios[1] - 1.0)
    assert len(change) > 100
    assert np.quantile(change, 0.9) > 0.02  # 0.003 without gloss


def test_depth_is_that_of_the_surface(actor: ActorModel, renderer: ActorRenderer) -> None:
    camera = make_array(3, count=16, size=240)[5]
    posed = actor.pose(actor.weights(), Pose.identity())
    depth = renderer.depth(camera, posed)
    tip = posed.skin[actor.landmarks68[[30, 33, 8]]][:1]
    column, row = np.rint(camera.project(tip)[0]).astype(int)
    assert depth[row, column] == pytest.approx(camera.depths(tip)[0], abs=0.8)
    assert np.isnan(depth[0, 0])


def test_board_corners_lie_where_the_camera_says(canvas: Canvas) -> None:
    """Detected corners against `Camera.project`: at most 0.05 px rms a coordinate, no bias."""
    array = make_array(1, count=16, size=640)
    renderer = BoardRenderer(DEMO_BOARD, canvas)
    detector = cv2.aruco.CharucoDetector(DEMO_BOARD.pattern())
    size = (
        DEMO_BOARD.squares_x * DEMO_BOARD.square_mm,
        DEMO_BOARD.squares_y * DEMO_BOARD.square_mm,
    )
    misses = []
    for index in range(6):
        held = board_pose(index, 5, size)
        outward = -held.rotation[:, 2]
        best = max(
            array,
            key=lambda camera: float(outward @ (camera.centre / np.linalg.norm(camera.centre))),
        )
        sharp = replace(STILL, read_dn=0.0, shot_dn=0.0)
        image = expose(renderer.radiance(best, held), sharp, (0, "a", 0))
        corners, ids, _, _ = detector.detectBoard(image)
        assert ids is not None
        start = corners.astype(np.float32).reshape(-1, 1, 2).copy()
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
        found = cv2.cornerSubPix(image, start, (3, 3), (-1, -1), stop).reshape(-1, 2)
        true = best.project(held.apply(DEMO_BOARD.corners_mm()))[ids.ravel()]
        edge = np.minimum(true, 639 - true).min(axis=1) > 6
        misses.append((found - true)[edge])
    miss = np.concatenate(misses)
    assert len(miss) > 250
    assert np.sqrt((miss**2).mean(axis=0)).max() < 0.05
    assert np.abs(miss.mean(axis=0)).max() < 0.01


def test_dlib_finds_the_face_from_the_front(canvas: Canvas) -> None:
    dlib = pytest.importorskip("dlib")
    detector = dlib.get_frontal_face_detector()
    camera = frontal(320)
    for seed in (None, 1, 2):
        actor = build_actor(seed)
        posed = actor.pose(actor.weights(), Pose.identity())
        image = ActorRenderer(actor, canvas).render(camera, posed, Sensor(), Exposure())
        found = detector(image, 0)
        assert len(found) == 1, seed
        nose = camera.project(posed.skin[actor.landmarks68[30:31]])[0]
        assert found[0].contains(dlib.point(*[int(v) for v in nose])), seed


@pytest.mark.landmarks
def test_dlib_landmarks_lie_near_the_true_ones(canvas: Canvas) -> None:
    dlib = pytest.importorskip("dlib")
    spec = importlib.util.find_spec("face_recognition_models")
    if spec is None or spec.origin is None:
        pytest.skip("face_recognition_models is not installed")
    model = Path(spec.origin).parent / "models" / "shape_predictor_68_face_landmarks.dat"
    detector, predictor = dlib.get_frontal_face_detector(), dlib.shape_predictor(str(model))
    camera = frontal(640)
    misses = []
    for seed in (None, 0, 1, 2, 3, 4):
        actor = build_actor(seed)
        posed = actor.pose(actor.weights(), Pose.identity())
        image = ActorRenderer(actor, canvas).render(camera, posed, Sensor(), Exposure())
        shape = predictor(image, detector(image, 0)[0])
        found = np.array([(point.x, point.y) for point in shape.parts()])
        true = camera.project(posed.skin[actor.landmarks68])
        misses.append(np.linalg.norm(found - true, axis=1))
    between_eyes = 146.0  # px at this size
    assert np.median(misses) < 0.05 * between_eyes
