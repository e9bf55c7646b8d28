"""What is said of devices that found no board: each fault its message."""

from __future__ import annotations

import dataclasses
from functools import cache

import cv2
import numpy as np
import pytest

from capture.arrays import Image
from capture.errors import TakeError
from recon.board.april_grid import AprilGrid
from recon.board.body import BoardBody, FlatBoard
from recon.board.charuco import Board
from recon.board.corners import CornerLimits
from recon.board.diagnosis import explain_blind, merged_words
from recon.board.marker_census import MarkerKind, marker_census
from recon.board.marker_layout import Layout
from recon.board.sightings import observe_board
from tests.board_prints import MemoryTake, flipped, grid_print, render, small_camera, turned
from tools.bench.board_scene import A4_BOARD

GRID = AprilGrid(tags_x=5, tags_y=4, tag_mm=28.0, gap_mm=8.0)
EVEN = dataclasses.replace(A4_BOARD, squares_y=8)
OLD = dataclasses.replace(EVEN, legacy=True)
SOLVED = "switch off the mirror in its driver"


@cache
def picture(board: FlatBoard, upside_down: bool = False) -> Image:
    pose = turned(12, 10, 185 if upside_down else 5, board.corners_mm().mean(axis=0))
    sheet = grid_print(board) if isinstance(board, AprilGrid) else board
    return render(small_camera(), pose, sheet)


def explained(image: Image, board: FlatBoard, limits: CornerLimits | None = None) -> str:
    """What is said of the only device of a take of one frame; "" when it is not blind."""
    take = MemoryTake({"cam07": [image]})
    body = BoardBody.of(board)
    found = observe_board(take, body, limits or CornerLimits())
    return explain_blind(take, body, found).get("cam07", "")


def changed(board: FlatBoard, **fields: object) -> FlatBoard:
    return dataclasses.replace(board, **fields)  # type: ignore[arg-type]


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize(
    ("shown", "fields", "words"),
    [
        (A4_BOARD, {}, ""),
        (
            A4_BOARD,
            {"dictionary": "DICT_4X4_250"},
            "sees markers of DICT_5X5_100; the board file says DICT_4X4_250",
        ),
        (
            A4_BOARD,
            {"squares_x": 11},
            "the markers lie as on a board with 12 squares a row; "
            "the board file says squares_x = 11",
        ),
        (EVEN, {"legacy": True}, "legacy = false fits; the board file says legacy = true"),
        (OLD, {"legacy": False}, "legacy = true fits; the board file says legacy = false"),
        (
            A4_BOARD,
            {"first_id": 10},
            "the markers count from 0; the board file says first_id = 10",
        ),
    ],
)
def test_wrong_board_files_are_told_in_words(
    shown: Board, fields: dict[str, object], words: str, upside_down: bool
) -> None:
    assert explained(picture(shown, upside_down), changed(shown, **fields)) == words


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({}, ""),
        (
            {"tags_x": 6},
            "the markers lie as on a board with 5 tags a row; the board file says tags_x = 6",
        ),
        (
            {"border_bits": 1},
            "sees markers of DICT_APRILTAG_36h11 with border_bits = 2; "
            "the board file says border_bits = 1",
        ),
        (
            {"layout": "opencv"},
            'the tags lie as in the other layout; the board file says "opencv"',
        ),
        (
            {"gap_mm": 2.0},
            "finds corners, but not where the board file has them: compare its kind and all its "
            "sizes (squares and markers, tags and gaps) with the board",
        ),
    ],
)
def test_wrong_april_grids_are_told_though_corners_are_found(
    fields: dict[str, object], words: str
) -> None:
    if not words or "border_bits" in fields:  # no corners, so that no array can be solved
        assert explained(picture(GRID), changed(GRID, **fields)) == words
        return
    with pytest.raises(TakeError) as caught:  # else an array would be solved with that file
        explained(picture(GRID), changed(GRID, **fields))
    assert str(caught.value) == f"the board is not as its file says: cam07: {words}"


def test_a_grid_taken_for_a_charuco_board_is_told() -> None:
    words = explained(picture(GRID), A4_BOARD)
    assert words == "sees markers of DICT_APRILTAG_36h11; the board file says DICT_5X5_1000"


def test_mirrored_images_are_told() -> None:
    image = flipped(picture(A4_BOARD))
    assert explained(image, A4_BOARD) == (
        "its images are mirrored (the board is found after flipping left to right): " + SOLVED
    )
    both = explained(image, changed(A4_BOARD, dictionary="DICT_6X6_250"))
    assert both == (
        f"its images are mirrored ({SOLVED}), and sees markers of DICT_5X5_100; "
        "the board file says DICT_6X6_250"
    )


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.full((400, 400), 3, np.uint8), "its image is black (lens cap, exposure"),
        (np.full((400, 400), 20, np.uint16), "its image is black"),
        (np.full((400, 400), 255, np.uint8), "its image is white (exposure or gain"),
        (np.full((400, 400), 120, np.uint8), "its image is empty"),
        (None, "no board in 1 images looked at, plain or mirrored"),
    ],
)
def test_images_without_a_board_are_told(image: Image | None, words: str) -> None:
    if image is None:
        noise = np.random.default_rng(1).integers(0, 255, (40, 40)).astype(np.uint8)
        image = np.asarray(cv2.resize(noise, (400, 400), interpolation=cv2.INTER_NEAREST))
    assert words in explained(image, A4_BOARD)


def test_soft_devices_and_short_views_are_told() -> None:
    soft = cv2.GaussianBlur(picture(A4_BOARD), (0, 0), 1.2)
    words = explained(np.asarray(soft), A4_BOARD, CornerLimits(max_blur_px=1.2))
    assert "blurred in 1 of 1 frames" in words
    assert "focus, aperture" in words
    few = explained(picture(A4_BOARD), A4_BOARD, CornerLimits(min_corners=89))
    assert "the board is as its file says in 1 of 1 images looked at" in few
    assert "(1 few corners)" in few


def test_one_blind_device_is_told_among_good_ones() -> None:
    good = picture(A4_BOARD)
    grey = np.full_like(good, 90)
    shown: dict[str, list[Image | None]] = {f"cam{n}": [grey, good] for n in range(4)}
    shown["cam2"] = [grey, flipped(good)]
    shown["cam3"] = [None, None]
    take = MemoryTake(shown | {"cam3": [good, good]})
    body = BoardBody.of(A4_BOARD)
    found = observe_board(take, body, CornerLimits())
    words = explain_blind(take, body, found)
    assert list(words) == ["cam2"]  # looked at where the others saw the board
    assert SOLVED in words["cam2"]


def test_a_wrong_file_is_told_once_for_all_devices_and_few_images_are_read() -> None:
    names = [f"cam{n:02d}" for n in range(6)]
    take = MemoryTake({name: [picture(A4_BOARD)] for name in names})
    body = BoardBody.of(changed(A4_BOARD, dictionary="DICT_4X4_50", squares_x=9))
    found = observe_board(take, body, CornerLimits())
    take.reads = 0
    lines = merged_words(explain_blind(take, body, found), len(names))
    assert lines == ["all 6 devices: sees markers of DICT_5X5_100; the board file says DICT_4X4_50"]
    assert take.reads == 3  # of three devices
    assert merged_words({"a": "x", "b": "y", "c": "x"}, 3) == ["a, c: x", "b: y"]


def test_the_smallest_dictionary_that_holds_the_ids_is_named() -> None:
    kind = MarkerKind("DICT_4X4")
    assert [kind.dictionary(n) for n in (0, 49, 50, 100, 249, 250, 5000)] == [
        "DICT_4X4_50", "DICT_4X4_50", "DICT_4X4_100", "DICT_4X4_250", "DICT_4X4_250",
        "DICT_4X4_1000", "DICT_4X4_50",
    ]  # fmt: skip
    seen = marker_census(picture(A4_BOARD))[MarkerKind.of(A4_BOARD)]
    assert len(seen.ids) >= 50  # of 54
    assert len(set(seen.ids.tolist())) == len(seen.ids)


@pytest.mark.parametrize("squares", [(3, 4), (7, 5), (8, 6), (12, 9)])
@pytest.mark.parametrize("legacy", [False, True])
def test_layouts_of_charuco_boards_are_those_of_opencv(
    squares: tuple[int, int], legacy: bool
) -> None:
    board = Board(
        squares_x=squares[0], squares_y=squares[1], square_mm=20.0, marker_mm=15.0,
        dictionary="DICT_5X5_1000", legacy=legacy,
    )  # fmt: skip
    pattern = board.pattern()
    theirs = np.array(pattern.getObjPoints())[:, :, :2]
    ours = 15.0 * Layout.of(board).places(np.ravel(pattern.getIds()).astype(np.int64))
    np.testing.assert_allclose(ours - ours[0, 0], theirs - theirs[0, 0], atol=1e-3)


@pytest.mark.parametrize("layout", ["kalibr", "opencv"])
def test_layouts_of_april_grids_are_those_of_their_class(layout: str) -> None:
    grid = dataclasses.replace(GRID, layout=layout, first_id=3)
    ids, corners = grid.markers()
    ours = 28.0 * Layout.of(grid).places(ids)
    np.testing.assert_allclose(ours - ours[0, 0], corners[:, :, :2] - corners[0, 0, :2], atol=1e-9)
