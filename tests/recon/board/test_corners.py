"""Corner detection on rendered boards with known corners."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from capture.arrays import Floats, Image
from capture.camera import Camera
from capture.pose import Pose
from recon.board.corners import (
    BLURRED,
    FEW_CORNERS,
    NO_BOARD,
    ONE_LINE,
    CornerLimits,
    detect_corners,
)
from tools.bench.board_scene import A4_BOARD, render_board

CAMERA = Camera(
    name="cam", width=640, height=640, fx=1440.0, fy=1440.0, cx=322.3, cy=317.9,
    distortion=np.array([-0.12, 0.16, 1e-4, -3e-4, 0.0]), camera_from_world=Pose.identity(),
)  # fmt: skip
MIDDLE = Pose(np.eye(3), -A4_BOARD.corners_mm().mean(axis=0))


def placed(yaw: float, pitch: float, spin: float) -> Pose:
    turn = Pose.identity()
    for vector in ([0, yaw, 0], [pitch, 0, 0], [0, 0, spin]):
        turn = turn @ Pose.from_rotation_vector(np.radians(np.array(vector, float)), np.zeros(3))
    return Pose(np.eye(3), np.array([5.0, -4.0, 620.0])) @ turn @ MIDDLE


def truth(pose: Pose) -> Floats:
    return CAMERA.project(pose.apply(A4_BOARD.corners_mm()))


@pytest.fixture(scope="module")
def frontal() -> Image:
    return render_board(CAMERA, placed(10, 15, 5), A4_BOARD)


@pytest.mark.parametrize(("yaw", "pitch", "spin"), [(0, 0, 0), (40, 10, 12), (-25, -35, -8)])
def test_corners_are_found_to_a_twentieth_of_a_pixel(yaw: float, pitch: float, spin: float) -> None:
    pose = placed(yaw, pitch, spin)
    view = detect_corners(render_board(CAMERA, pose, A4_BOARD, seed=1), A4_BOARD)
    miss = view.pixels - truth(pose)[view.ids]
    assert view.refusal == ""
    assert len(view.ids) >= 70
    assert np.sqrt((miss**2).mean()) < 0.05  # px, per coordinate
    assert np.abs(miss.mean(axis=0)).max() < 0.01  # px: no half-pixel, no bias


def test_sixteen_bits_and_colour_see_the_same(frontal: Image) -> None:
    plain = detect_corners(frontal, A4_BOARD)
    deep = detect_corners(frontal.astype(np.uint16) * 16, A4_BOARD)  # 12 bits in 16
    colour = detect_corners(np.repeat(frontal[:, :, None], 3, axis=2), A4_BOARD)
    for other in (deep, colour):
        np.testing.assert_array_equal(other.ids, plain.ids)
        np.testing.assert_allclose(other.pixels, plain.pixels, atol=0.01)


def test_the_edge_spread_grows_with_the_blur(frontal: Image) -> None:
    sharp = detect_corners(frontal, A4_BOARD).blur_px
    soft = detect_corners(cv2.GaussianBlur(frontal, (0, 0), 2.0), A4_BOARD).blur_px
    smear = detect_corners(cv2.blur(frontal, (5, 1)), A4_BOARD).blur_px  # motion along a row
    assert 0.5 < sharp < 1.6
    assert 1.8 < soft < 3.2
    assert smear > 1.3 * sharp


def test_bad_views_are_refused_by_reason(frontal: Image) -> None:
    assert detect_corners(np.full((480, 640), 90, np.uint8), A4_BOARD).refusal == NO_BOARD
    assert detect_corners(np.zeros((480, 640), np.uint16), A4_BOARD).refusal == NO_BOARD
    soft = cv2.GaussianBlur(frontal, (0, 0), 2.0)
    assert detect_corners(soft, A4_BOARD, CornerLimits(max_blur_px=1.5)).refusal == BLURRED
    few = detect_corners(frontal, A4_BOARD, CornerLimits(min_corners=89))
    assert few.refusal == FEW_CORNERS
    strip = frontal.copy()
    row = truth(placed(10, 15, 5))[44:55]  # one row of corners: hide the rest of the board
    low, high = int(row[:, 1].min()) - 36, int(row[:, 1].max()) + 36
    strip[:low], strip[high:] = 90, 90
    found = detect_corners(strip, A4_BOARD, CornerLimits(min_corners=4))
    assert found.refusal in (ONE_LINE, "")
    assert (found.refusal == ONE_LINE) == (len(set((found.ids // 11).tolist())) == 1)


def test_the_same_image_gives_the_same_bytes(frontal: Image) -> None:
    one, two = (detect_corners(frontal, A4_BOARD) for _ in range(2))
    assert one.pixels.tobytes() == two.pixels.tobytes()
