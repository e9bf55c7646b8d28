"""Captures: closed forms equal refits with a frame left out or added; greedy lists make sense."""

import numpy as np
import pytest

from capture.errors import InputError
from rig.captures import (
    Captures,
    leverages,
    redundant_captures,
    remaining_uncertainty,
    suggest_captures,
    variance_growth,
)


def _captures(seed: int, frames: int = 30, shapes: int = 8) -> Captures:
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0, 1, (frames, shapes)) * (rng.uniform(size=(frames, shapes)) < 0.4)
    return Captures(weights, rng.uniform(0.05, 0.5, shapes), rng.uniform(0.2, 3.0, shapes))


def _literal_total(weights, captures) -> float:
    matrix = weights.T @ weights + np.diag(captures.ridge)
    return float((captures.areas * np.diag(np.linalg.inv(matrix))).sum())


@pytest.mark.parametrize("seed", range(3))
def test_growth_is_that_of_a_refit_without_the_frame(seed: int) -> None:
    captures = _captures(seed)
    whole = _literal_total(captures.weights, captures)
    for frame, growth in enumerate(variance_growth(captures)):
        without = _literal_total(np.delete(captures.weights, frame, axis=0), captures)
        assert abs(without / whole - 1.0 - growth) <= 1e-10


def test_leverages_are_the_diagonal_of_the_hat_matrix_and_sum_to_the_effective_shapes() -> None:
    captures = _captures(1)
    matrix = captures.weights.T @ captures.weights + np.diag(captures.ridge)
    hat = captures.weights @ np.linalg.solve(matrix, captures.weights.T)
    shares = leverages(captures)
    assert np.abs(shares - np.diag(hat)).max() <= 1e-12
    learnt = 1.0 - remaining_uncertainty(captures)
    assert abs(shares.sum() - learnt.sum()) <= 1e-10


def test_variance_is_that_of_shapes_solved_from_noise() -> None:
    """Shapes drawn from the prior, solved from noisy frames: the spread is the one predicted."""
    captures = _captures(2, frames=12, shapes=4)
    rng = np.random.default_rng(0)
    trials = 20_000
    truth = rng.normal(size=(4, trials)) / np.sqrt(captures.ridge)[:, None]
    seen = captures.weights @ truth + rng.normal(size=(12, trials))
    matrix = captures.weights.T @ captures.weights + np.diag(captures.ridge)
    error = np.linalg.solve(matrix, captures.weights.T @ seen) - truth
    predicted = np.diag(captures.covariance())
    assert np.abs((error**2).mean(axis=1) / predicted - 1.0).max() <= 0.05
    assert np.allclose(remaining_uncertainty(captures), predicted * captures.ridge)


def test_a_frame_shot_five_times_is_redundant_four_times_and_a_single_one_never() -> None:
    weights = np.concatenate([np.eye(3), np.tile([[1.0, 0.0, 0.0]], (4, 1)), np.zeros((2, 3))])
    captures = Captures(weights, np.full(3, 0.1), np.array([1.0, 25.0, 25.0]))
    drops = redundant_captures(captures, allowed_growth=0.02)
    frames = [drop.frame for drop in drops]
    assert set(frames[:2]) == {7, 8}  # the neutral says nothing of shapes: first to go
    assert drops[1].growth == pytest.approx(0.0, abs=1e-12)
    assert set(frames[2:]) < {0, 3, 4, 5, 6}
    assert len(frames) == 6


def test_the_growth_told_is_that_of_a_refit_without_all_that_were_dropped() -> None:
    captures = _captures(4)
    drops = redundant_captures(captures, allowed_growth=0.3)
    assert 3 <= len(drops) < 30
    whole = _literal_total(captures.weights, captures)
    for n, drop in enumerate(drops, start=1):
        rest = np.delete(captures.weights, [d.frame for d in drops[:n]], axis=0)
        assert abs(_literal_total(rest, captures) / whole - 1.0 - drop.growth) <= 1e-9
    assert drops[-1].growth <= 0.3


def test_what_was_never_shown_is_undetermined_and_suggested_first() -> None:
    rng = np.random.default_rng(5)
    weights = rng.uniform(0, 1, (40, 5))
    weights[:, 3] = 0.0
    captures = Captures(weights, np.full(5, 0.2), np.ones(5))
    left = remaining_uncertainty(captures)
    assert left[3] == pytest.approx(1.0)
    assert np.delete(left, 3).max() < 0.2
    assert suggest_captures(captures, 1, pairs=False)[0].shapes == (3,)


def test_the_gain_of_a_suggestion_is_that_of_a_refit_with_it() -> None:
    captures = _captures(6, frames=6)
    suggested = suggest_captures(captures, 4)
    weights = captures.weights
    for suggestion in suggested:
        before = _literal_total(weights, captures)
        row = np.zeros((1, 8))
        row[0, list(suggestion.shapes)] = 1.0
        weights = np.concatenate([weights, row])
        after = _literal_total(weights, captures)
        assert abs(1.0 - after / before - suggestion.gain) <= 1e-10
        best = max(
            before - _literal_total(np.concatenate([weights[:-1], one]), captures)
            for i in range(8)
            for j in range(8)
            for one in [np.eye(8)[i : i + 1] + (i != j) * np.eye(8)[j : j + 1]]
        )
        assert before - after >= best - 1e-12


def test_shapes_that_overlap_or_do_not_move_are_not_suggested_together() -> None:
    captures = Captures(np.zeros((1, 3)), np.full(3, 0.1), np.array([1.0, 1.0, 0.0]))
    overlap = np.array([[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1.0]])
    found = suggest_captures(captures, 5, overlap)
    assert {s.shapes for s in found} <= {(0,), (1,)}
    assert (0, 1) in {s.shapes for s in suggest_captures(captures, 1)}


def test_a_ridge_of_nothing_is_refused_with_the_reason() -> None:
    with pytest.raises(InputError, match="needs a ridge above 0, found 0"):
        Captures(np.eye(2), np.array([1.0, 0.0]), np.ones(2))
