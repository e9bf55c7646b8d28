"""Parts of a take solved anew: exact where they must be, smooth in between."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.arrays import Bools, Floats
from capture.errors import ShapeError
from capture.pose import Pose
from track.corrections.blend import (
    blend,
    blend_confidence,
    blend_weights,
    ease_to_held,
    interpolate,
)

MASKS = st.lists(st.booleans(), min_size=1, max_size=40).map(lambda m: np.array(m, dtype=bool))


def takes(frames: int, seed: int = 0) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    return rng.normal(0, 50, (frames, 12, 3)), rng.normal(0, 50, (frames, 12, 3))


def only(frames: int, start: int, stop: int) -> Bools:
    mask: Bools = np.zeros(frames, dtype=bool)
    mask[start:stop] = True
    return mask


@given(solved=MASKS, ease=st.integers(0, 12))
def test_frames_that_were_not_solved_are_the_old_ones_bit_by_bit(solved: Bools, ease: int) -> None:
    old, new = takes(len(solved))
    for kind in (np.float64, np.float32):
        out = blend(old.astype(kind), new.astype(kind), solved, ease)
        assert out.dtype == kind
        assert out[~solved].tobytes() == old.astype(kind)[~solved].tobytes()


@given(solved=MASKS, ease=st.integers(0, 12))
def test_every_run_has_a_frame_that_is_wholly_new(solved: Bools, ease: int) -> None:
    weights = blend_weights(solved, ease)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], solved.astype(int), [0]])))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        assert weights[start:stop].max() == 1.0
        assert weights[start:stop].min() > 0.0


@pytest.mark.parametrize("ease", [0, 1, 3, 8])
def test_the_ease_has_no_step_in_place_or_speed(ease: int) -> None:
    weights = blend_weights(only(60, 20, 45), ease)
    assert np.abs(np.diff(weights)).max() <= 1.5 / (ease + 1)
    assert np.abs(np.diff(weights, n=2)).max() <= 6.0 / (ease + 1) ** 2
    assert (weights[20 + ease : 45 - ease] == 1.0).all()
    np.testing.assert_allclose(weights[20:45], weights[20:45][::-1])


def test_a_locked_frame_inside_a_range_is_eased_into() -> None:
    solved = only(41, 5, 36)
    solved[20] = False
    weights = blend_weights(solved, 4)
    assert weights[20] == 0.0
    assert 0.0 < weights[19] == weights[21] < 0.2
    assert (weights[[12, 15, 25]] == 1.0).all()


def test_the_ends_of_the_take_are_cut_not_eased() -> None:
    weights = blend_weights(only(10, 6, 10), 3)
    assert weights[-1] == 1.0
    assert (blend_weights(np.ones(5, dtype=bool), 3) == 1.0).all()
    assert (blend_weights(only(5, 2, 3), 9) == [0, 0, 1, 0, 0]).all()


def test_two_equal_solutions_blend_to_themselves() -> None:
    old, _ = takes(20)
    out = blend(old, old, only(20, 4, 15), 4)
    np.testing.assert_allclose(out, old, atol=1e-12)  # mm


def test_confidence_is_that_of_the_better_end_and_falls_between_what_differs() -> None:
    old, new = np.zeros((20, 2, 3)), np.zeros((20, 2, 3))
    new[:, 1, 0] = 5.0  # mm apart at the second vertex
    sure, half = np.ones((20, 2)), np.full((20, 2), 0.5)
    found = blend_confidence((old, half), (new, sure), only(20, 5, 15), 3)
    assert (found[:5] == 0.5).all()
    assert (found[8:12] == 1.0).all()
    assert 0.5 < found[6, 0] < 1.0
    assert found[6, 1] < 0.1
    assert (blend_confidence((old, half), (old, half), only(20, 5, 15), 3) == 0.5).all()


def test_an_ease_below_zero_is_refused() -> None:
    with pytest.raises(ShapeError, match="ease_frames: expected 0 or more, found -1"):
        blend_weights(only(5, 1, 2), -1)


def turning_head(count: int = 30) -> Floats:
    """A head that turns by 1.5 degrees a frame about its neck, while its mouth opens and closes."""
    rng = np.random.default_rng(1)
    rest = rng.normal(0, 40, (200, 3)) + [0.0, 150.0, 40.0]
    frames = []
    for f in range(count):
        face = rest.copy()
        face[:40, 1] -= 8.0 * np.sin(f / 9.0) ** 2
        turn = Pose.from_rotation_vector(np.radians([0.3, 1.5, 0.2]) * f, np.zeros(3))
        frames.append(turn.apply(face))
    return np.stack(frames)


def test_gaps_in_smooth_motion_are_filled_close_to_it() -> None:
    truth, known = turning_head(), np.ones(30, dtype=bool)
    known[[6, 7, 8, 9, 17, 22, 23]] = False
    broken = truth.copy()
    broken[~known] = 1e6
    filled = interpolate(broken, known, np.arange(30))
    assert filled[known].tobytes() == truth[known].tobytes()
    error = np.linalg.norm(filled - truth, axis=2)
    assert error.max() < 0.25  # mm; vertices move 5 mm a frame
    straight = 0.5 * (truth[5] + truth[10])  # of frames 7 and 8, as a line would have it
    halfway = np.linalg.norm(straight - 0.5 * (truth[7] + truth[8]), axis=1)
    assert halfway.max() > 4 * error.max()


def test_the_last_frames_stay_what_the_last_known_one_is() -> None:
    truth = turning_head(10)
    known = np.ones(10, dtype=bool)
    known[7:] = False
    filled = interpolate(truth, known, np.arange(10))
    assert all((filled[f] == truth[6]).all() for f in (7, 8, 9))


def test_what_rests_on_one_side_is_not_overshot() -> None:
    still, far = turning_head(2)
    still = np.stack([still, still, still, still, still])
    still[0] += far[0] - still[0] + [30.0, 0.0, 0.0]  # it comes to rest at once
    known = np.array([True, True, False, False, True])
    filled = interpolate(still, known, np.arange(5))
    assert np.abs(filled[2:4] - still[1]).max() < 1e-6  # mm


def test_interpolation_moves_with_the_world() -> None:
    truth, known = turning_head(12), np.ones(12, dtype=bool)
    known[4:7] = False
    move = Pose.from_rotation_vector(np.array([0.3, -0.5, 0.2]), np.array([10.0, 20.0, -300.0]))
    one = move.apply(interpolate(truth, known, np.arange(12)))
    other = interpolate(move.apply(truth), known, np.arange(12))
    np.testing.assert_allclose(one, other, atol=1e-6)  # mm


def test_uneven_frame_numbers_are_times() -> None:
    truth = turning_head(30)
    rows = np.array([0, 3, 4, 7, 9, 10, 14])
    known = np.array([True, True, False, True, False, True, True])
    filled = interpolate(truth[rows], known, rows)
    assert np.linalg.norm(filled - truth[rows], axis=2).max() < 0.4  # mm


def test_something_must_be_known() -> None:
    with pytest.raises(ShapeError, match="expected at least one frame"):
        interpolate(turning_head(3), np.zeros(3, dtype=bool), np.arange(3))


@pytest.mark.parametrize("reach", [0, 1, 5, 50])
def test_held_frames_are_exact_and_their_neighbours_come_along(reach: int) -> None:
    take = turning_head(24).astype(np.float32)
    held = {6: take[6] + np.float32(1.5), 15: take[15], 18: take[18] - np.float32(0.5)}
    out = ease_to_held(take, held, reach)
    assert out.dtype == np.float32
    assert all(out[place].tobytes() == target.tobytes() for place, target in held.items())
    far = [f for f in range(24) if min(abs(f - place) for place in held) > reach]
    assert out[far].tobytes() == take[far].tobytes()
    moved = np.linalg.norm(out - take, axis=2)
    assert np.ptp(moved, axis=1).max() < 1e-3  # mm: the whole head alike
    moved = moved.mean(axis=1)
    assert (moved[[16, 17]] <= np.sqrt(3) * 0.5).all()
    near = moved[6 : 6 + min(reach, 8) + 2]
    assert (np.diff(near) < 0.0).all()
    assert np.abs(np.diff(near, n=2)).max(initial=0.0) < 6.0 * 2.6 / (min(reach, 8) + 1) ** 2


def test_what_is_spread_turns_with_the_head() -> None:
    take = turning_head(12)
    turn = Pose.from_rotation_vector(np.radians([0.3, 1.5, 0.2]) * 4, np.zeros(3))
    still = np.stack([take[0], turn.apply(take[0])])
    out = ease_to_held(still, {0: still[0] + [0.0, 0.0, 3.0]}, 1)
    expected = 0.5 * turn.rotation @ [0.0, 0.0, 3.0]
    np.testing.assert_allclose(out[1] - still[1], np.tile(expected, (200, 1)), atol=1e-9)  # mm


def test_a_frame_held_to_itself_shields_what_lies_behind_it() -> None:
    take = turning_head(20)
    out = ease_to_held(take, {5: take[5] + 2.0, 8: take[8]}, 10)
    assert (out[8:] == take[8:]).all()
    assert (out[6:8] != take[6:8]).any(axis=(1, 2)).all()


def test_held_frames_give_the_same_whatever_their_order() -> None:
    take = turning_head(20)
    held = {3: take[3] + 1.0, 9: take[9] - 1.0, 12: take[12]}
    turned = dict(reversed(held.items()))
    assert ease_to_held(take, held, 4).tobytes() == ease_to_held(take, turned, 4).tobytes()
