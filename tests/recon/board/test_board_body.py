"""Board files of every kind: one board or several, scale bar, and how the sheet was printed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from capture.errors import SettingsError
from capture.pose import Pose
from recon.board.april_grid import AprilGrid
from recon.board.body import BoardBody, BoardFace, ScaleBar, read_body
from recon.board.charuco import Board, read_board

ONE = """
[board]
kind = "charuco"
squares_x = 12
squares_y = 9
square_mm = 20.0
marker_mm = 15.0
dictionary = "DICT_5X5_1000"
legacy = false
"""
PRINT = """
[print]
bar_mm = 100.0
measured_bar_mm = 100.0
drawn_square_mm = 20.0
drawn_marker_mm = 15.0
"""
SEVERAL = """
[[boards]]
name = "front"
squares_x = 6
squares_y = 5
square_mm = 20.0
marker_mm = 15.0
dictionary = "DICT_5X5_100"

[[boards]]
name = "side"
squares_x = 5
squares_y = 5
square_mm = 20.0
marker_mm = 15.0
dictionary = "DICT_5X5_1000"
first_id = 15
[boards.body_from_board]
rotation_deg = [0.0, 90.0, 0.0]
translation_mm = [120.0, 0.0, 5.0]

[[boards]]
name = "back"
kind = "aprilgrid"
tags_x = 3
tags_y = 2
tag_mm = 20
gap_mm = 6.0
[boards.print]
bar_mm = 100.0
measured_bar_mm = 99.95
drawn_tag_mm = 20.0
drawn_gap_mm = 6.0

[scale_bar]
dictionary = "DICT_4X4_50"
markers = [0, 3]
marker_mm = 30.0
length_mm = 400.021
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "board.toml"
    path.write_text(text, encoding="utf-8")
    return path


def charuco(first_id: int = 0, dictionary: str = "DICT_4X4_250") -> Board:
    return Board(
        squares_x=4, squares_y=3, square_mm=20.0, marker_mm=15.0, dictionary=dictionary,
        first_id=first_id,
    )  # fmt: skip


def test_one_board_is_a_body_of_one_face(tmp_path: Path) -> None:
    path = write(tmp_path, ONE + PRINT)
    body, board = read_body(path), read_board(path)
    assert [face.name for face in body.faces] == ["board"]
    assert body.faces[0].board == board
    assert body.scale_bar is None
    shape = body.shape()
    np.testing.assert_array_equal(shape.corners, board.corners_mm())
    assert shape.face_count == 1
    assert shape.placed.tolist() == [True]


def test_several_boards_are_read_and_counted_through(tmp_path: Path) -> None:
    body = read_body(write(tmp_path, SEVERAL))
    front, side, back = body.faces
    assert isinstance(back.board, AprilGrid)
    assert back.board == AprilGrid(tags_x=3, tags_y=2, tag_mm=20.0, gap_mm=6.0)
    assert (front.body_from_board, back.body_from_board) == (None, None)
    assert body.scale_bar == ScaleBar(
        dictionary="DICT_4X4_50", markers=(0, 3), marker_mm=30.0, length_mm=400.021
    )
    ranges = [body.corner_range(face) for face in range(3)]
    assert ranges == [range(20), range(20, 36), range(36, 60)]
    assert body.corner_count == 60
    shape = body.shape()
    assert shape.placed.tolist() == [False, True, False]
    np.testing.assert_array_equal(shape.face, np.repeat([0, 1, 2], [20, 16, 24]))
    np.testing.assert_array_equal(shape.corners[:20], front.board.corners_mm())
    x, y = side.board.corners_mm()[:, 0], side.board.corners_mm()[:, 1]
    expected = np.stack([np.full(16, 120.0), y, 5.0 - x], axis=1)  # +X turned about +Y into -Z
    np.testing.assert_allclose(shape.corners[20:36], expected, atol=1e-12)
    np.testing.assert_array_equal(shape.flat[20:36], side.board.corners_mm()[:, :2])


def test_the_first_board_makes_body_space_where_none_has_a_place() -> None:
    body = BoardBody((BoardFace("a", charuco()), BoardFace("b", charuco(6))))
    assert body.shape().placed.tolist() == [True, False]


def test_markers_of_a_board_follow_its_first_id() -> None:
    from_zero, later = charuco(), charuco(100)
    assert later.marker_ids == range(100, 106)
    drawings = [board.pattern().generateImage((400, 300)) for board in (from_zero, later)]
    assert not np.array_equal(*drawings)
    whole = from_zero.pattern().getDictionary().bytesList
    assert not np.array_equal(whole, later.pattern().getDictionary().bytesList)
    np.testing.assert_array_equal(from_zero.corners_mm(), later.corners_mm())


@pytest.mark.parametrize(
    ("second", "bar", "told"),
    [
        (charuco(5), None, "board 'a' and board 'b' share markers (5 of DICT_4X4_250)"),
        (charuco(0, "DICT_4X4_50"), None, "by first_id, from 6 on"),
        (charuco(6), ("DICT_4X4_1000", (20, 7)), "board 'b' and the scale bar share markers (7"),
        (charuco(0, "DICT_5X5_50"), ("DICT_4X4_50", (20, 21)), ""),
        (charuco(6), ("DICT_6X6_50", (7, 8)), ""),
    ],
)
def test_shared_markers_are_told(
    second: Board, bar: tuple[str, tuple[int, int]] | None, told: str
) -> None:
    made = bar and ScaleBar(dictionary=bar[0], markers=bar[1], marker_mm=20.0, length_mm=300.0)
    faces = (BoardFace("a", charuco()), BoardFace("b", second, Pose.identity()))
    if not told:
        assert BoardBody(faces, made or None).corner_count == 12
        return
    with pytest.raises(SettingsError) as caught:
        BoardBody(faces, made or None)
    assert told in str(caught.value)


@pytest.mark.parametrize("reader", [read_body, read_board])
def test_a_shrunken_sheet_with_nominal_sizes_is_refused_in_words(
    tmp_path: Path, reader: object
) -> None:
    text = ONE + PRINT.replace("measured_bar_mm = 100.0", "measured_bar_mm = 95.3")
    path = write(tmp_path, text)
    with pytest.raises(SettingsError) as caught:
        reader(path)  # type: ignore[operator]
    assert (
        "square_mm says 20.0, but the printed bar of 100 mm measures 95.3 mm: the squares are "
        "19.06 mm; write that"
    ) in str(caught.value)
    assert "the markers are 14.295 mm; write that" in str(caught.value)
    told = text.replace("\nsquare_mm = 20.0", "\nsquare_mm = 19.06")
    told = told.replace("\nmarker_mm = 15.0", "\nmarker_mm = 14.295")
    assert reader(write(tmp_path, told))  # type: ignore[operator]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("measured_bar_mm = 100.0\n", "", "measure the bar of 100.0 mm on the printed sheet"),
        ("measured_bar_mm = 100.0", "measured_bar_mm = 0", "expected a length above 0 mm, found 0"),
        ("drawn_square_mm = 20.0", "", "print: missing key 'drawn_square_mm'"),
        ("bar_mm = 100.0", "baar_mm = 100.0", "did you mean 'bar_mm'?"),
        ("square_mm = 20.0", "square_m = 20.0", "unknown key 'square_m'; did you mean 'square_mm'"),
        ("square_mm = 20.0", "square_m = 20.0", "missing key 'square_mm'"),
        ('"charuco"', '"chess"', 'kind: only "charuco" and "aprilgrid" are known, found \'chess\''),
        ("DICT_5X5_1000", "DICT_4X4_50", "need 54 markers, DICT_4X4_50 has 50"),
        ("[board]", "[bord]", "unknown table 'bord'; did you mean 'board'?"),
        ("legacy = false", "name = 'x'", "name: only a board of several, under [[boards]], has it"),
        ("legacy = false", "print = 3", "print: the table [print] stands by itself"),
        ("[board]", "[[boards]]", "[board] and [print] are for one board"),
    ],
)
def test_what_does_not_fit_one_board_is_told(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = write(tmp_path, (ONE + PRINT).replace(old, new, 1))
    with pytest.raises(SettingsError) as caught:
        read_body(path)
    assert told in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('name = "front"', "", "[[boards]] 0: missing key 'name'"),
        ('name = "front"', 'name = "side"', "2 boards are called 'side'"),
        ('name = "front"', 'name = "../x"', "found '../x'"),
        ("first_id = 15", "first_id = 14", "share markers (14 of DICT_5X5_1000)"),
        ("rotation_deg = [0.0, 90.0, 0.0]", "rotation_deg = [0.0, 90.0]", "expected three numbers"),
        ("rotation_deg", "rotation_rad", "did you mean 'rotation_deg'?"),
        ("translation_mm = [120.0, 0.0, 5.0]", "translation_mm = [nan, 0, 0]", "three numbers"),
        ("rotation_deg = [0.0, 90.0, 0.0]", "rotation_deg = [1e300, 0, 0]", "numbers up to 1e+06"),
        ("markers = [0, 3]", "markers = [0, 0]", "expected two ids that differ, found 0 and 0"),
        ("markers = [0, 3]", "markers = [0, 50]", "need marker 50, DICT_4X4_50 has 0 to 49"),
        ("markers = [0, 3]", "", "[scale_bar]: missing key 'markers'"),
        ("length_mm = 400.021", "length_mm = 20", "must be above marker_mm = 30.0, found 20.0"),
        ("measured_bar_mm = 99.95", "measured_bar_mm = 97.0", "the gaps are 5.82 mm; write that"),
        ("tag_mm = 20", 'tag_mm = "20"', "[[boards]] back: tag_mm: expected float, found '20'"),
    ],
)
def test_what_does_not_fit_several_is_told(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = write(tmp_path, SEVERAL.replace(old, new, 1))
    with pytest.raises(SettingsError) as caught:
        read_body(path)
    assert told in str(caught.value)
    assert str(path) in str(caught.value)


def test_what_is_yet_to_be_printed_is_read_without_a_measured_bar(tmp_path: Path) -> None:
    path = write(tmp_path, ONE + PRINT.replace("measured_bar_mm = 100.0\n", ""))
    assert read_body(path, check_print=False).corner_count == 88


VALUES = st.recursive(
    st.booleans()
    | st.integers(-5, 2000)
    | st.just(10**400)
    | st.just(10**30)
    | st.floats()
    | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=6,
)


@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_any_file_is_read_or_refused_by_name(tmp_path: Path, data: st.DataObject) -> None:
    lines = data.draw(st.sampled_from([ONE + PRINT, SEVERAL])).splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        index = data.draw(st.integers(0, len(lines) - 1))
        key = lines[index].partition(" = ")[0]
        value = data.draw(VALUES)
        lines[index] = data.draw(st.sampled_from(["", f"{key} = {_toml(value)}", "[[boards]]"]))
    path = write(tmp_path, "\n".join(lines))
    try:
        body = read_body(path)
    except SettingsError as error:
        told = str(error)
    else:
        told = str(path)
        assert body.shape().corners.shape == (body.corner_count, 3)
    assert str(path) in told


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml(k)} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, int | float) else f'"{value}"'
