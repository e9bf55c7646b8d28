"""Printed boards: what OpenCV draws, at true scale, on a page that holds it, in the same bytes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pypdfium2
import pytest

from capture.arrays import Floats
from capture.errors import InputError, SettingsError
from recon.board.april_grid import AprilGrid
from recon.board.body import FlatBoard, ScaleBar, read_body
from recon.board.charuco import Board, read_board
from tools.board_print.board_text import board_caption
from tools.board_print.pattern import Pattern, bar_pattern, board_pattern, outlines
from tools.board_print.sheet import PAGES_MM, Sheet, lay_out
from tools.board_print.sheet_files import svg_text, write_pdf
from tools.cli import main

INCH_MM = 25.4


def charuco(squares_x: int = 6, squares_y: int = 5, **others: object) -> Board:
    values: dict[str, object] = {
        "square_mm": 14.0, "marker_mm": 7.0, "dictionary": "DICT_5X5_100", **others
    }  # fmt: skip
    return Board(squares_x=squares_x, squares_y=squares_y, **values)  # type: ignore[arg-type]


def grid(layout: str = "kalibr", border_bits: int = 2) -> AprilGrid:
    return AprilGrid(
        tags_x=3, tags_y=2, tag_mm=20.0, gap_mm=6.0, layout=layout, border_bits=border_bits,
        first_id=4,
    )  # fmt: skip


def painted(svg: str, px_per_mm: float, size_mm: tuple[float, float]) -> np.ndarray:
    """The pattern of an SVG in pixels, 0 black and 255 white, by the even-odd rule."""
    data = re.search(r'<path id="pattern"[^>]* d="([^"]*)"', svg)
    assert data is not None
    assert 'fill-rule="evenodd"' in svg
    wide, high = (round(side * px_per_mm) for side in size_mm)
    inside = np.zeros((high, wide), dtype=np.bool_)
    for loop in data[1].split("Z")[:-1]:
        assert loop[0] == "M"
        points = np.array([point.split() for point in loop[1:].split(" L")], dtype=np.float64)
        points *= px_per_mm
        for (x, y0), (x1, y1) in zip(points, np.roll(points, -1, axis=0), strict=True):
            assert x == x1 or y0 == y1
            if x == x1:
                top, bottom = round(min(y0, y1)), round(max(y0, y1))
                inside[top:bottom, round(x) :] ^= True
    return np.where(inside, 0, 255).astype(np.uint8)


def pattern_svg(pattern: Pattern) -> str:
    return svg_text(Sheet("x", pattern.size_mm, (0.0, 0.0), 10.0, pattern.loops, (), ()))


@pytest.mark.parametrize(
    "board",
    [
        charuco(), charuco(5, 4), charuco(5, 4, legacy=True), charuco(4, 6, legacy=True),
        charuco(first_id=40), charuco(dictionary="DICT_4X4_50", marker_mm=6.0),
        charuco(dictionary="DICT_7X7_50", marker_mm=9.0),
        charuco(dictionary="DICT_APRILTAG_36h11", marker_mm=8.0),
    ],
)  # fmt: skip
def test_a_charuco_board_is_drawn_as_opencv_draws_it(board: Board) -> None:
    wide, high = (round(4 * side) for side in board.size_mm)
    theirs = board.pattern().generateImage((wide, high), marginSize=0, borderBits=1)
    ours = painted(pattern_svg(board_pattern(board)), 4.0, board.size_mm)
    np.testing.assert_array_equal(ours, np.asarray(theirs))


@pytest.mark.parametrize(("layout", "border_bits"), [("kalibr", 2), ("opencv", 2), ("opencv", 1)])
def test_the_tags_of_a_grid_are_those_of_opencv(layout: str, border_bits: int) -> None:
    board = grid(layout, border_bits)
    scale = 2.0 if border_bits == 2 else 2.4
    ours = painted(pattern_svg(board_pattern(board)), scale, board.size_mm)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    black = 0
    for index, marker in enumerate(board.marker_ids):
        x, y = (round(value * scale) for value in board.place(index))
        side = round(board.tag_mm * scale)
        theirs = np.asarray(dictionary.generateImageMarker(marker, side, borderBits=border_bits))
        theirs = np.rot90(theirs, 2) if layout == "kalibr" else theirs
        np.testing.assert_array_equal(ours[y : y + side, x : x + side], theirs)
        black += int((theirs == 0).sum())
    crossings = 4 * 3 * round(board.gap_mm * scale) ** 2
    assert (
        abs(int((ours == 0).sum()) - black - crossings) <= 12 * 2 * 16
    )  # rounded px of 12 squares


def test_outlines_enclose_the_cells_and_share_no_edge() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        cells = rng.random((7, 6)) < 0.5
        loops = outlines(cells)
        back = np.zeros_like(cells)
        edges: list[tuple[int, int, int, int]] = []
        for loop in loops:
            for (x, y0), (x1, y1) in zip(loop.tolist(), np.roll(loop, -1, 0).tolist(), strict=True):
                assert (x == x1) != (y0 == y1)
                low, high = sorted((y0, y1)) if x == x1 else sorted((x, x1))
                edges += [(x, y0, int(x == x1), step) for step in range(low, high)]
                if x == x1:
                    back[low:high, x:] ^= True
        np.testing.assert_array_equal(back, cells)
        lines = [(x, 0, v, s) if v else (0, y, v, s) for x, y, v, s in edges]
        assert len(set(lines)) == len(lines)


def rendered(path: Path, dpi: float, page: int = 0) -> np.ndarray:
    """A page in grey; pdfium stretches it to whole pixels, which `px_per_mm` undoes."""
    document = pypdfium2.PdfDocument(path)
    try:
        image = document[page].render(scale=dpi / 72.0, grayscale=True).to_numpy()
        return np.ascontiguousarray(image.reshape(image.shape[:2]))
    finally:
        document.close()


def px_per_mm(image: np.ndarray, sheet: Sheet) -> Floats:
    return np.array(image.shape[::-1]) / np.array(sheet.page_mm)


def printed(board: FlatBoard, page: str, folder: Path) -> tuple[Sheet, Path]:
    sheet = lay_out(board_pattern(board), board_caption("front", board), page)
    path = folder / "board.pdf"
    write_pdf(path, [sheet])
    return sheet, path


def square_sides(corners_mm: Floats, found_mm: Floats) -> Floats:
    """The scale of the found corners along x and y: found = affine(nominal)."""
    flat = np.concatenate([corners_mm[:, :2], np.ones((len(corners_mm), 1))], axis=1)
    affine = np.linalg.lstsq(flat, found_mm, rcond=None)[0]
    assert np.abs(found_mm - flat @ affine).max() < 0.03  # mm
    scales: Floats = np.linalg.norm(affine[:2], axis=1)
    return scales


def test_the_default_board_measures_true_on_the_printed_page(tmp_path: Path) -> None:
    board = charuco(12, 9, square_mm=20.0, marker_mm=15.0)
    sheet, path = printed(board, "A4", tmp_path)
    document = pypdfium2.PdfDocument(path)
    points = document[0].get_size()
    document.close()
    np.testing.assert_allclose(np.array(points) / 72 * INCH_MM, (297.0, 210.0), atol=1e-3)
    image = rendered(path, 150.0)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board.pattern()).detectBoard(image)
    assert len(np.ravel(ids)) == board.corner_count
    nominal = board.corners_mm()[np.ravel(ids)]
    found = np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5
    found /= px_per_mm(image, sheet)
    sides = square_sides(nominal, found) * board.square_mm
    np.testing.assert_allclose(sides, board.square_mm, atol=0.02)
    expected = nominal[:, :2] + np.array(sheet.origin_mm)
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_the_bar_measures_what_it_says(tmp_path: Path) -> None:
    sheet, path = printed(charuco(), "A4", tmp_path)
    image = 255.0 - rendered(path, 300.0)
    scale = px_per_mm(image, sheet)
    ticks = [stroke for stroke in sheet.strokes if stroke.x0 == stroke.x1 and stroke.width > 0.1]
    row = round((ticks[0].y0 + 0.5) * scale[1])  # above all ticks but the first and the last
    ink = image[row - 2 : row + 3].mean(axis=0)
    middles = []
    for tick in (ticks[0], ticks[-1]):
        place = int(tick.x0 * scale[0])
        near = np.arange(place - 8, place + 9)
        middles.append(float((near * ink[near]).sum() / ink[near].sum()))
    assert (middles[1] - middles[0]) / scale[0] == pytest.approx(100.0, abs=0.02)
    assert sheet.bar_mm == 100.0
    assert sheet.words[0].text.startswith("this bar must measure 100.00 mm")


def test_no_hairline_shows_within_black(tmp_path: Path) -> None:
    sheet, path = printed(charuco(), "120x110", tmp_path)
    image = rendered(path, 97.0)  # no cell falls on whole pixels
    fine = 8
    high, wide = image.shape
    scale = px_per_mm(image, sheet)
    assert scale[0] == pytest.approx(scale[1], rel=3e-3)
    truth = painted(svg_text(sheet), fine * float(scale[0]), sheet.page_mm)
    reach = np.ones((3 * fine, 3 * fine), np.uint8)
    sampled = slice(fine // 2, None, fine)
    black = cv2.dilate(truth, reach)[sampled, sampled][:high, :wide] == 0
    assert black.sum() > 10000
    assert image[: len(black), : black.shape[1]][black].max() == 0


def test_a_printed_grid_is_found_by_opencv_at_true_size(tmp_path: Path) -> None:
    board = grid()
    sheet, path = printed(board, "A4", tmp_path)
    image = cv2.GaussianBlur(rendered(path, 200.0), (0, 0), 1.0)
    scale = px_per_mm(image, sheet)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = board.border_bits
    _, ids, _ = cv2.aruco.ArucoDetector(board.marker_dictionary(), parameters).detectMarkers(image)
    assert sorted(np.ravel(ids).tolist()) == list(range(6))
    nominal = board.corners_mm()
    expected = (nominal[:, :2] + np.array(sheet.origin_mm)) * scale - 0.5
    found = cv2.cornerSubPix(
        image, (expected + 1.5).astype(np.float32).reshape(-1, 1, 2), (9, 9), (-1, -1),
        (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4),
    ).reshape(-1, 2).astype(np.float64)  # fmt: skip
    np.testing.assert_allclose(found, expected, atol=0.1)
    sides = square_sides(nominal, found / scale) * board.tag_mm
    np.testing.assert_allclose(sides, board.tag_mm, atol=0.02)


def test_everything_lies_on_the_page_and_apart() -> None:
    for board, page in ((charuco(), "A4"), (charuco(4, 9), "A4"), (grid(), "150x120")):
        sheet = lay_out(board_pattern(board), board_caption("front", board), page)
        wide, high = sheet.page_mm
        points = np.concatenate(sheet.loops)
        ends = np.array([[[s.x0, s.y0], [s.x1, s.y1]] for s in sheet.strokes]).reshape(-1, 2)
        letters = np.array([[w.x + 0.52 * w.size * len(w.text), w.y] for w in sheet.words])
        for places in (points, ends, letters):
            assert places.min() >= 0
            assert np.all(places.max(axis=0) <= [wide, high])
        assert min(w.y - w.size for w in sheet.words) >= points[:, 1].max()
    assert lay_out(board_pattern(charuco(4, 9)), "", "A3").page_mm == (420.0, 297.0)
    assert lay_out(board_pattern(charuco(9, 14)), "", "A4").page_mm == PAGES_MM["A4"][::-1]


@pytest.mark.parametrize(
    ("page", "told"),
    [
        ("A4", "--page A4: the board of 280 x 196 mm needs"),
        ("A4", "take --page A3, or a smaller board; it is never scaled"),
        ("B5", "--page B5: expected A4, A3, A2, A1, A0, or WIDTHxHEIGHT in mm as in 500x350"),
        ("15x0", "--page 15x0: expected A4"),
    ],
)
def test_a_page_that_does_not_fit_is_told(page: str, told: str) -> None:
    with pytest.raises(InputError) as caught:
        lay_out(board_pattern(charuco(20, 14, dictionary="DICT_5X5_1000")), "", page)
    assert told in str(caught.value)


def test_the_page_that_a_refusal_names_does() -> None:
    board = charuco(9, 7, square_mm=141.03, marker_mm=100.0, dictionary="DICT_5X5_1000")
    with pytest.raises(InputError) as caught:
        lay_out(board_pattern(board), "words", "A4")
    named = re.search(r"take --page (\d+x\d+),", str(caught.value))
    assert named is not None
    assert lay_out(board_pattern(board), "words", named[1]).loops


def test_a_sheet_that_cannot_be_written_leaves_no_board_file(tmp_path: Path) -> None:
    (tmp_path / "b.pdf").mkdir()
    assert main(["board", "--out", str(tmp_path / "b.pdf")]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["b.pdf"]


def test_the_markers_of_a_scale_bar_are_found(tmp_path: Path) -> None:
    bar = ScaleBar(dictionary="DICT_4X4_50", markers=(7, 3), marker_mm=30.0, length_mm=400.0)
    path = tmp_path / "bar.pdf"
    write_pdf(path, [lay_out(bar_pattern(bar), "", "A4")])
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    found, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(rendered(path, 100.0))
    assert sorted(np.ravel(ids).tolist()) == [3, 7]
    sides = [np.linalg.norm(corners[0, 1] - corners[0, 0]) * 0.254 for corners in found]
    np.testing.assert_allclose(sides, 30.0, atol=0.5)


def test_the_verb_writes_sheet_and_board_file_and_the_same_bytes_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pdf, svg = tmp_path / "b.pdf", tmp_path / "b.svg"
    words = ["board", "--squares-x", "8", "--square-mm", "19.5", "--first-id", "3"]
    assert main([*words, "--out", str(pdf), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["bar_mm"], report["board"]) == ([100.0], str(tmp_path / "b.toml"))
    once = pdf.read_bytes()
    with pytest.raises(SettingsError, match=r"measure the bar of 100\.0 mm on the printed sheet"):
        read_board(tmp_path / "b.toml")
    assert main([*words, "--out", str(pdf)]) == 0
    assert pdf.read_bytes() == once
    assert main(["board", "--board", str(tmp_path / "b.toml"), "--out", str(svg)]) == 0
    board = charuco(8, 9, square_mm=19.5, marker_mm=15.0, dictionary="DICT_5X5_1000", first_id=3)
    assert svg.read_text() == svg_text(
        lay_out(board_pattern(board), board_caption("board", board), "A4")
    )
    text = (tmp_path / "b.toml").read_text()
    measured = re.sub(r"# measured_bar_mm = 100 .*", "measured_bar_mm = 100.02", text)
    (tmp_path / "b.toml").write_text(measured)
    assert read_board(tmp_path / "b.toml") == board
    assert main([*words, "--out", str(pdf)]) == 2
    assert "exists and says otherwise" in capsys.readouterr().err
    assert (tmp_path / "b.toml").read_text() == measured


def test_the_verb_draws_a_page_for_each_board_of_a_body(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = (
        "squares_x = 5\nsquares_y = 4\nsquare_mm = 15\nmarker_mm = 11\n"
        'dictionary = "DICT_4X4_100"\n'
    )
    bar = (
        '[scale_bar]\ndictionary = "DICT_5X5_50"\nmarkers = [0, 1]\n'
        "marker_mm = 30\nlength_mm = 400\n"
    )
    path = tmp_path / "body.toml"
    path.write_text(
        f'[[boards]]\nname = "größe"\n{one}[[boards]]\nname = "side"\nfirst_id = 10\n{one}{bar}',
        encoding="utf-8",
    )
    out = tmp_path / "body.pdf"
    assert main(["board", "--board", str(path), "--out", str(out)]) == 0
    document = pypdfium2.PdfDocument(out)
    assert len(document) == 3
    document.close()
    for page, face in enumerate(read_body(path).faces):
        image = rendered(out, 100.0, page)
        detector = cv2.aruco.CharucoDetector(face.board.pattern())  # type: ignore[union-attr]
        assert len(np.ravel(detector.detectBoard(image)[1])) == 12
    capsys.readouterr()
    assert main(["board", "--board", str(path), "--out", str(tmp_path / "body.svg")]) == 2
    assert "choose one with --face (größe, side, scale_bar)" in capsys.readouterr().err
    svg = str(tmp_path / "side.svg")
    assert main(["board", "--board", str(path), "--out", svg, "--face", "side"]) == 0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--out", "b.png"], "expected a name ending in .pdf or .svg"),
        (["--kind", "aprilgrid", "--squares-x", "4"], "--kind aprilgrid has no --squares-x"),
        (["--board", "b.toml", "--first-id", "4"], "tells all of the board; leave out --first-id"),
        (["--face", "front"], "--face front: the board file has board"),
        (["--square-mm", "30"], "take --page A3"),
        (["--marker-mm", "30"], "must be below square_mm = 20.0, found 30.0"),
    ],
)
def test_bad_use_is_told_and_nothing_is_written(
    tmp_path: Path, words: list[str], told: str,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["board", *([] if "--out" in words else ["--out", "b.pdf"]), *words]) == 2
    assert told in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
