"""Board places before a known array: the truth recovered, outliers and a moved device borne."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from capture.camera import CameraArray
from capture.errors import ShapeError
from recon.board.shape import BoardShape
from recon.calibration.board_places import place_boards
from tools.bench.bench_drift import moved_state
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state, observe

SCENE = BoardScene(
    devices=5, size_px=640, focal_px=1440.0, radius_mm=620.0, poses=4, outliers=0.03, seed=2
)
TRUTH = make_state(SCENE)
SHAPE = BoardShape.flat_board(A4_BOARD.corners_mm())
MIDDLE = A4_BOARD.corners_mm().mean(axis=0)[None]


def test_places_are_those_of_the_truth_whatever_one_device_says() -> None:
    push = np.concatenate([np.radians([0.4, -0.5, 0.3]), [3.0, 2.0, 1.0]])
    seen = observe(SCENE, moved_state(TRUTH, {2: push}))
    places = place_boards(seen, SHAPE, TRUTH.cameras)
    assert [place.frame for place in places] == list(seen.frames)
    outvoted = [place for place in places if len(place.miss_px) > 3]
    assert len(outvoted) >= 2
    for place in outvoted:
        true = TRUTH.array_from_board[place.pose]
        off = true.inverse() @ place.world_from_board
        assert np.linalg.norm(place.world_from_board.apply(MIDDLE) - true.apply(MIDDLE)) < 0.1  # mm
        assert np.degrees(np.linalg.norm(off.rotation_vector())) < 0.06
        for device, miss in place.miss_px.items():
            assert miss > 3.0 if device == 2 else miss < 0.3


def test_frames_that_nobody_saw_have_no_place() -> None:
    seen = observe(SCENE, TRUTH)
    places = place_boards(seen.select(seen.pose != 1), SHAPE, TRUTH.cameras)
    assert [place.pose for place in places] == [0, 2, 3]


def test_cameras_in_another_order_are_refused() -> None:
    turned = CameraArray(TRUTH.cameras.cameras[::-1])
    with pytest.raises(ShapeError, match=r"sightings of cam00, .* cameras cam04, "):
        place_boards(observe(SCENE, TRUTH), SHAPE, turned)


def test_a_camera_that_faces_away_says_nothing() -> None:
    back = dataclasses.replace(
        TRUTH.cameras[0],
        camera_from_world=TRUTH.cameras[0].camera_from_world.inverse(),
    )
    wrong = CameraArray((back, *TRUTH.cameras.cameras[1:]))
    for place in place_boards(observe(SCENE, TRUTH), SHAPE, wrong):
        off = TRUTH.array_from_board[place.pose].inverse() @ place.world_from_board
        if len(place.miss_px) > 3:
            assert np.degrees(np.linalg.norm(off.rotation_vector())) < 0.3
