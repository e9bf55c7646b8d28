"""The AprilGrid: Kalibr's layout, and corners that OpenCV's detector agrees with."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from capture.errors import SettingsError
from recon.board.april_grid import AprilGrid
from recon.board.marker_dictionary import marker_cells

# The codes of tags 0 and 1 of t36h11 in Kalibr's kalibr_create_target_pdf.
KALIBR_CODES = {0: 0xD5D628584, 1: 0xD97F18B49}


def grid(layout: str = "kalibr", border_bits: int = 2, **others: int) -> AprilGrid:
    return AprilGrid(
        tags_x=4, tags_y=3, tag_mm=20.0, gap_mm=6.0, layout=layout, border_bits=border_bits,
        **others,
    )  # fmt: skip


def drawn(board: AprilGrid, px_per_mm: int, margin: int) -> np.ndarray:
    """The board in an image, cell by cell, whose size in px the caller makes whole."""
    wide, high = (round(side * px_per_mm) for side in board.size_mm)
    image = np.full((high, wide), 255, np.uint8)

    def fill(x: float, y: float, side: float) -> None:
        left, top, size = (round(value * px_per_mm) for value in (x, y, side))
        image[top : top + size, left : left + size] = 0

    step = board.tag_mm + board.gap_mm
    for row in range(board.tags_y + 1):
        for column in range(board.tags_x + 1):
            fill(column * step, row * step, board.gap_mm)
    for index, marker in enumerate(board.marker_ids):
        cells = marker_cells(board.dictionary, marker, board.border_bits)
        cells = np.rot90(cells, 2) if board.half_turned else cells
        x, y = board.place(index)
        side = board.tag_mm / len(cells)
        for row, column in np.argwhere(cells).tolist():
            fill(x + column * side, y + row * side, side)
    return np.pad(image, margin, constant_values=255)


def test_a_tag_stands_as_kalibr_prints_it() -> None:
    for marker, code in KALIBR_CODES.items():
        # Kalibr: black where bit 6 i + j is 0; turned by half a turn; row 0 drawn at the top.
        black = np.array([[not code & (1 << (6 * i + j)) for j in range(6)] for i in range(6)])
        printed = np.pad(np.rot90(black, 2), 2, constant_values=True)
        board = grid()
        assert board.half_turned
        ours = np.rot90(marker_cells(board.dictionary, marker, 2), 2)
        np.testing.assert_array_equal(ours, printed)


def test_ids_rise_from_the_bottom_left_in_kalibrs_layout_and_from_the_top_left_in_opencvs() -> None:
    kalibr, opencv = grid("kalibr"), grid("opencv")
    assert kalibr.place(0) == (6.0, 6.0 + 2 * 26.0)
    assert kalibr.place(5) == (6.0 + 26.0, 6.0 + 26.0)
    assert opencv.place(0) == (6.0, 6.0)
    assert opencv.place(5) == (6.0 + 26.0, 6.0 + 26.0)
    ours = opencv.markers()[1]
    theirs = cv2.aruco.GridBoard((4, 3), 20.0, 6.0, opencv.marker_dictionary())
    np.testing.assert_allclose(ours[..., :2] - 6.0, np.array(theirs.getObjPoints())[..., :2])


@pytest.mark.parametrize(("layout", "border_bits"), [("kalibr", 2), ("opencv", 1), ("kalibr", 1)])
def test_opencvs_detector_counts_corners_as_we_do(layout: str, border_bits: int) -> None:
    board = grid(layout, border_bits, first_id=7)
    scale, margin = (10, 40) if border_bits == 2 else (8, 40)
    image = cv2.GaussianBlur(drawn(board, scale, margin), (0, 0), 1.0)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    detector = cv2.aruco.ArucoDetector(board.marker_dictionary(), parameters)
    found, ids, _ = detector.detectMarkers(image)
    places = np.ravel(ids)
    assert sorted(places.tolist()) == list(range(12))
    expected = board.corners_mm().reshape(-1, 4, 3)[places][..., :2] * scale + margin - 0.5
    rough = np.asarray(found).reshape(-1, 4, 2)
    assert np.abs(rough - expected).max() < 6.0  # px: a corner for another would be 48 away or more
    fine = cv2.cornerSubPix(
        image, expected.astype(np.float32).reshape(-1, 1, 2) + 1.0, (9, 9), (-1, -1),
        (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4),
    )  # fmt: skip
    np.testing.assert_allclose(fine.reshape(-1, 4, 2), expected, atol=0.05)


def test_corners_lie_inside_the_pattern_a_pitch_apart() -> None:
    board = grid()
    corners = board.corners_mm()
    assert corners.shape == (board.corner_count, 3) == (48, 3)
    apart = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    assert apart.min() == pytest.approx(board.pitch_mm)
    assert np.all(corners[:, :2].min(axis=0) == board.gap_mm)
    np.testing.assert_allclose(corners[:, :2].max(axis=0), np.array(board.size_mm) - board.gap_mm)


@pytest.mark.parametrize(
    ("others", "told"),
    [
        ({"tags_x": 0}, "tags_x: at least 1, found 0"),
        ({"gap_mm": 25.0}, "not Kalibr's ratio tagSpacing"),
        ({"gap_mm": 0.3}, "not Kalibr's ratio tagSpacing: 6 perhaps"),
        ({"border_bits": 9}, "border_bits: at most 8, found 9"),
        ({"tag_mm": float("nan")}, "tag_mm: must be above 0 mm, found nan"),
        ({"layout": "left"}, 'expected "kalibr" or "opencv", found \'left\''),
        ({"dictionary": "DICT_APRILTAG_36h12"}, "did you mean 'DICT_APRILTAG_36"),
        ({"first_id": 580}, "4 x 3 tags need 12 markers from id 580 on, DICT_APRILTAG_36h11 has"),
        ({"first_id": -1}, "first_id: at least 0, found -1"),
        ({"kind": "charuco"}, 'kind: expected "aprilgrid"'),
    ],
)
def test_what_does_not_fit_is_told(others: dict[str, object], told: str) -> None:
    values: dict[str, object] = {"tags_x": 4, "tags_y": 3, "tag_mm": 20.0, "gap_mm": 6.0}
    with pytest.raises(SettingsError) as caught:
        AprilGrid(**{**values, **others})  # type: ignore[arg-type]
    assert told in str(caught.value)
