from __future__ import annotations

import pytest

from capture.errors import InputError
from tools.verbs.options import parse_frames

FRAMES = tuple(range(3, 15))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, list(FRAMES)),
        ("3:6", [3, 4, 5]),
        (":5", [3, 4]),
        ("12:", [12, 13, 14]),
        ("3:15:4", [3, 7, 11]),
        ("7", [7]),
        ("4,9", [4, 9]),
    ],
)
def test_frames_are_chosen(text: str | None, expected: list[int]) -> None:
    assert parse_frames(text, FRAMES) == expected


@pytest.mark.parametrize("text", ["a:b", "3:4:5:6", "", "5:5", "0:4", "14:16", "99", "1.5"])
def test_frames_that_cannot_be_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"--frames .*3\.\.14"):
        parse_frames(text, FRAMES)


def test_a_range_of_endless_digits_is_refused_at_once() -> None:
    with pytest.raises(InputError, match=r"no frame 3; the take has 0\.\.2"):
        parse_frames("0:100000000000000000000000", (0, 1, 2))
