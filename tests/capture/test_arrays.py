"""`check_shape` and `check_finite`: what passes, and the text of what does not."""

from __future__ import annotations

import numpy as np
import pytest

from capture.arrays import check_finite, check_shape
from capture.errors import ShapeError


def test_letters_are_bound_and_returned() -> None:
    bound = check_shape(points=(np.zeros((7, 3)), "N 3"), weights=(np.zeros((7, 2)), "N B"))
    assert bound == {"N": 7, "B": 2}


@pytest.mark.parametrize(
    ("shape", "spec"),
    [((4, 3), "... 3"), ((3,), "... 3"), ((5, 4, 3), "... 3"), ((2, 9), "2 *"), ((), "")],
)
def test_what_fits_passes(shape: tuple[int, ...], spec: str) -> None:
    check_shape(array=(np.zeros(shape), spec))


@pytest.mark.parametrize(
    ("shape", "spec"),
    [((4, 2), "... 3"), ((), "... 3"), ((3,), "N 3"), ((2, 9, 1), "2 *"), ((3, 4), "N N")],
)
def test_what_does_not_fit_is_named_with_both_shapes(shape: tuple[int, ...], spec: str) -> None:
    with pytest.raises(ShapeError) as caught:
        check_shape(array=(np.zeros(shape), spec))
    assert "array: expected shape" in str(caught.value)
    assert str(shape) in str(caught.value)


def test_letters_must_agree_and_the_message_says_with_whom() -> None:
    with pytest.raises(ShapeError, match=r"weights.*with N = 7 as in points, found \(6,\)"):
        check_shape(points=(np.zeros((7, 3)), "N 3"), weights=(np.zeros(6), "N"))


def test_check_finite_counts_and_points_at_the_first() -> None:
    array = np.zeros((3, 2))
    array[1, 1] = np.nan
    array[2, 0] = np.inf
    with pytest.raises(
        ShapeError, match=r"depth: .* found 2 that are not, the first at index \(1, 1\)"
    ):
        check_finite(depth=array)
