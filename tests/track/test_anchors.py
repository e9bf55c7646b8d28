"""Anchors: where a take is cut, and what lies between."""

import pytest

from track.anchors import REST_MM, Segment, choose_anchors, segments

REST, MOVING = 0.5 * REST_MM, 3.0 * REST_MM


def test_the_stillest_frame_of_every_later_rest_is_an_anchor() -> None:
    unrest = {0: 0.0, 1: REST, 2: MOVING, 3: MOVING, 4: REST, 5: 0.1, 6: REST, 7: MOVING, 8: 0.2}
    assert choose_anchors(unrest) == (0, 5, 8)


def test_the_first_rest_has_only_its_first_frame() -> None:
    assert choose_anchors(dict.fromkeys(range(5), REST)) == (0,)


def test_a_frame_that_nobody_saw_is_no_anchor_unless_it_is_wanted() -> None:
    unrest = {0: 0.0, 1: float("inf"), 2: MOVING, 3: float("inf")}
    assert choose_anchors(unrest) == (0,)
    assert choose_anchors(unrest, wanted=(2, 99)) == (0, 2)


def test_of_equally_still_frames_the_later_is_taken() -> None:
    assert choose_anchors({0: 0.0, 1: MOVING, 2: REST, 3: REST}) == (0, 3)


def test_segments_hold_every_frame_but_the_anchors_once() -> None:
    parts = segments([3, 4, 5, 6, 8, 9], [3, 5, 6])
    assert parts == (
        Segment(left=3, frames=(4,), right=5),
        Segment(left=6, frames=(8, 9), right=None),
    )


@pytest.mark.parametrize("anchors", [[0], [0, 4], [0, 1, 2, 3, 4]])
def test_anchors_and_segments_make_the_whole_take(anchors: list[int]) -> None:
    frames = list(range(5))
    parts = segments(frames, anchors)
    assert sorted([*anchors, *(f for part in parts for f in part.frames)]) == frames
