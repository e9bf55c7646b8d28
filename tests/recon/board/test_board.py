"""The board file: strict reading, and geometry that agrees with OpenCV's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture.errors import SettingsError
from recon.board.charuco import Board, read_board

GOOD = """
[board]
kind = "charuco"
squares_x = 12
squares_y = 9
square_mm = 20.0
marker_mm = 15.0
dictionary = "DICT_5X5_1000"
legacy = false
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "board.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_contracts_board_is_read(tmp_path: Path) -> None:
    board = read_board(write(tmp_path, GOOD))
    assert board == Board(
        squares_x=12, squares_y=9, square_mm=20.0, marker_mm=15.0, dictionary="DICT_5X5_1000"
    )
    assert board.corner_count == 88


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize(("columns", "rows"), [(12, 9), (5, 8), (4, 4)])
def test_corners_are_opencvs(columns: int, rows: int, legacy: bool) -> None:
    board = Board(
        squares_x=columns, squares_y=rows, square_mm=12.5, marker_mm=9.0,
        dictionary="DICT_4X4_100", legacy=legacy,
    )  # fmt: skip
    expected = np.asarray(board.pattern().getChessboardCorners())
    np.testing.assert_allclose(board.corners_mm(), expected, atol=1e-4)
    assert board.pattern().getLegacyPattern() is legacy


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            "square_mm = 20.0",
            "square_m = 20.0",
            "unknown key 'square_m'; did you mean 'square_mm'?",
        ),
        ("square_mm = 20.0", "square_m = 20.0", "missing key 'square_mm'"),
        ("DICT_5X5_1000", "DICT_5X5_100O", "did you mean 'DICT_5X5_100'?"),
        ("DICT_5X5_1000", "DICT_4X4_50", "need 54 markers, DICT_4X4_50 has 50"),
        ("marker_mm = 15.0", "marker_mm = 25.0", "must be below square_mm = 20.0, found 25.0"),
        ("squares_x = 12", "squares_x = 2", "squares_x: at least 3, found 2"),
        ("squares_x = 12", "squares_x = 12.5", "squares_x: expected int, found 12.5"),
        ("square_mm = 20.0", "square_mm = nan", "square_mm: must be above 0 mm, found nan"),
        ("legacy = false", "legacy = 1", "legacy: expected bool, found 1"),
        ('"charuco"', '"chess"', "kind: only \"charuco\" is known, found 'chess'"),
        ("[board]", "[bord]", "unknown table 'bord'; did you mean 'board'?"),
        ("[board]", "[board", "not readable as TOML"),
    ],
)
def test_what_does_not_fit_is_told(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = write(tmp_path, GOOD.replace(old, new))
    with pytest.raises(SettingsError) as caught:
        read_board(path)
    assert told in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no such file; a board file holds"):
        read_board(tmp_path / "none.toml")
