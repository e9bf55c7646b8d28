"""Corner detection on AprilGrids, bodies of several boards, and the scale bar."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from capture.arrays import Floats
from capture.camera import Camera
from capture.pose import Pose
from recon.board.april_grid import AprilGrid
from recon.board.body import BoardBody, BoardFace, ScaleBar
from recon.board.charuco import Board
from recon.board.corners import FEW_CORNERS, NO_BOARD, CornerDetector, CornerLimits, detect_corners
from tests.board_prints import grid_print, markers_print, render, turned
from tools.bench.board_scene import A4_BOARD

CAMERA = Camera(
    name="cam", width=640, height=640, fx=1440.0, fy=1440.0, cx=322.3, cy=317.9,
    distortion=np.array([-0.12, 0.16, 1e-4, -3e-4, 0.0]), camera_from_world=Pose.identity(),
)  # fmt: skip
GRID = AprilGrid(tags_x=6, tags_y=5, tag_mm=28.0, gap_mm=8.0)
SMALL = Board(
    squares_x=7, squares_y=5, square_mm=18.0, marker_mm=13.0, dictionary="DICT_5X5_1000",
    first_id=100,
)  # fmt: skip


def truth(board: Board | AprilGrid, pose: Pose) -> Floats:
    return CAMERA.project(pose.apply(board.corners_mm()))


def middle(board: Board | AprilGrid) -> Floats:
    centre: Floats = board.corners_mm().mean(axis=0)
    return centre


@pytest.mark.parametrize("layout", ["kalibr", "opencv"])
@pytest.mark.parametrize(("yaw", "pitch", "spin"), [(0, 0, 0), (40, 10, 12), (10, 40, 190)])
def test_the_corners_of_an_april_grid_are_saddles_without_bias(
    layout: str, yaw: float, pitch: float, spin: float
) -> None:
    grid = dataclasses.replace(GRID, layout=layout, first_id=7)
    pose = turned(yaw, pitch, spin, middle(grid))
    view = detect_corners(render(CAMERA, pose, grid_print(grid), seed=1), grid)
    assert view.refusal == ""
    assert len(view.ids) >= 110  # of 120
    miss = view.pixels - truth(grid, pose)[view.ids]
    assert np.abs(miss).max() < 0.25  # px
    assert np.sqrt((miss**2).mean()) < 0.05
    assert np.abs(miss.mean(axis=0)).max() < 0.01


def test_a_part_of_an_april_grid_is_enough() -> None:
    pose = turned(10, 10, 5, middle(GRID))
    image = render(CAMERA, pose, grid_print(GRID), seed=1)
    places = truth(GRID, pose)
    image[: int(places[:, 1].mean())] = 90  # a hand before the upper half
    view = detect_corners(image, GRID)
    assert view.refusal == ""
    assert 32 <= len(view.ids) <= 64
    assert np.abs(view.pixels - places[view.ids]).max() < 0.25
    few = detect_corners(image, GRID, CornerLimits(min_corners=65))
    assert few.refusal == FEW_CORNERS


def test_faces_of_a_body_are_found_apart_and_numbered_through() -> None:
    grid = dataclasses.replace(GRID, tags_x=3, tags_y=3)
    far = dataclasses.replace(SMALL, first_id=200)
    body = BoardBody(
        (
            BoardFace("left", SMALL, Pose.identity()),
            BoardFace("grid", grid),
            BoardFace("far", far),
        )
    )
    left = Pose(np.eye(3), np.array([-75.0, 0, 0])) @ turned(20, 5, 3, middle(SMALL))
    right = Pose(np.eye(3), np.array([70.0, 0, 0])) @ turned(-20, 5, -3, middle(grid))
    image = render(CAMERA, left, SMALL, seed=1)
    other = render(CAMERA, right, grid_print(grid), seed=2)
    image[:, 320:] = other[:, 320:]
    detector = CornerDetector(body)
    view = detector.detect(image)
    assert view.refusal == ""
    first, second, third = (body.corner_range(face) for face in range(3))
    on_first = view.ids < second.start
    assert on_first.sum() >= 20
    assert (~on_first).sum() >= 28
    assert view.ids.max() < third.start  # the far face is not in the image
    assert (np.diff(view.ids) > 0).all()
    np.testing.assert_allclose(
        view.pixels[on_first], truth(SMALL, left)[view.ids[on_first]], atol=0.25
    )
    np.testing.assert_allclose(
        view.pixels[~on_first], truth(grid, right)[view.ids[~on_first] - second.start], atol=0.25
    )
    only_grid = CornerDetector(body, CornerLimits(min_corners=25)).detect(image)
    assert only_grid.refusal == ""  # the smaller face is left out, the larger one stays
    assert (only_grid.ids >= second.start).all()
    none = CornerDetector(body, CornerLimits(min_corners=99)).detect(image)
    assert none.refusal == FEW_CORNERS
    assert detector.detect(np.full((300, 300), 90, np.uint8)).refusal == NO_BOARD
    assert first.start == 0


def test_one_board_is_found_the_same_alone_and_on_a_body() -> None:
    image = render(CAMERA, turned(10, 15, 5, middle(A4_BOARD)), A4_BOARD)
    alone = detect_corners(image, A4_BOARD)
    body = BoardBody((BoardFace("a", A4_BOARD), BoardFace("b", SMALL)))
    together = detect_corners(image, body)
    assert alone.ids.tobytes() == together.ids.tobytes()
    assert alone.pixels.tobytes() == together.pixels.tobytes()
    assert alone.blur_px == together.blur_px


@pytest.mark.parametrize("tilt", [(0, 0, 0), (35, 20, 15), (-30, 25, 170)])
def test_the_ends_of_a_scale_bar_are_found_at_their_centres(
    tilt: tuple[float, float, float],
) -> None:
    bar = ScaleBar(dictionary="DICT_4X4_50", markers=(9, 4), marker_mm=25.0, length_mm=150.0)
    body = BoardBody.of(A4_BOARD, bar)
    size = (215.0, 65.0)
    sheet = markers_print(bar.dictionary, {9: (20.0, 20.0), 4: (170.0, 20.0)}, 25.0, size)
    centres = np.array([[32.5, 32.5, 0.0], [182.5, 32.5, 0.0]])
    pose = turned(*tilt, centres.mean(axis=0))
    finds = CornerDetector(body).find(render(CAMERA, pose, sheet, seed=3))
    assert finds.ends.tolist() == [0, 1]
    np.testing.assert_allclose(finds.end_pixels, CAMERA.project(pose.apply(centres)), atol=0.12)
    board = render(CAMERA, turned(*tilt, middle(A4_BOARD)), A4_BOARD)
    assert len(CornerDetector(body).find(board).ends) == 0  # none by chance


def test_an_end_of_the_bar_that_is_seen_twice_is_left_out() -> None:
    bar = ScaleBar(dictionary="DICT_4X4_50", markers=(9, 4), marker_mm=25.0, length_mm=150.0)
    sheet = markers_print(bar.dictionary, {9: (20.0, 20.0), 4: (120.0, 20.0)}, 25.0, (165.0, 65.0))
    image = render(CAMERA, turned(0, 0, 0, np.array([82.0, 32.0, 0.0])), sheet)
    image[400:600, 60:300] = image[220:420, 60:300]  # the left marker again, lower
    assert CornerDetector(BoardBody.of(A4_BOARD, bar)).find(image).ends.tolist() == [1]


def test_eight_bits_take_the_short_way_to_the_same_brightness() -> None:
    """The table of 256 levels and the plain formula agree, saturated and dark images included."""
    image = render(CAMERA, turned(10, 15, 5, middle(A4_BOARD)), A4_BOARD)
    for shown in (image, image // 4, cv2.add(image, 120), np.zeros_like(image)):
        short = detect_corners(shown, A4_BOARD)
        long = detect_corners(shown[:, :, None], A4_BOARD)  # not (H, W): the plain formula
        assert short.pixels.tobytes() == long.pixels.tobytes()
        np.testing.assert_equal(short.blur_px, long.blur_px)
