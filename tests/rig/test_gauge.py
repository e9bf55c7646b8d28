"""What the data leave open: sizes against weights, and where shapes rest."""

import numpy as np
import pytest

from rig.gauge import (
    choose_scales,
    count_peaks,
    repetition,
    resting_weights,
    shape_sizes,
    without_gaps,
)
from rig.solve import Schedule
from rig.weights import WeightPriors

STILLS = np.zeros(40, dtype=bool)


def _amounts(seed: int, shapes: int = 200, activations: int = 6):
    """True sizes about the template's, and what a fit finds in the template's scale."""
    rng = np.random.default_rng(seed)
    sizes = np.exp(rng.normal(0.0, 0.2, shapes))
    weights = np.zeros((40, shapes))
    for k in range(shapes):
        weights[rng.choice(40, activations, replace=False), k] = rng.uniform(0, 1, activations)
    return sizes, weights * sizes


def test_a_run_of_contiguous_frames_is_one_activation() -> None:
    weights = np.array([0.0, 0.3, 0.6, 0.2, 0.0, 0.4, 0.4])[:, None]
    take = np.array([False, True, True, True, True, True, True])
    assert count_peaks(weights, take).tolist() == [2]
    assert count_peaks(weights, np.zeros(7, dtype=bool)).tolist() == [5]


def test_sizes_come_nearer_the_truth_than_the_template_is() -> None:
    sizes, amounts = _amounts(1)
    scales = choose_scales(amounts, STILLS, np.ones(len(sizes)), 0.2)
    before = np.sqrt((np.log(sizes) ** 2).mean())
    after = np.sqrt((np.log(sizes / scales) ** 2).mean())
    assert after < 0.8 * before
    assert abs(np.log(sizes / scales).mean()) < 0.05


def test_weights_fit_the_box_afterwards() -> None:
    _, amounts = _amounts(2)
    scales = choose_scales(1.5 * amounts, STILLS, np.ones(amounts.shape[1]), 0.2)
    assert (1.5 * amounts / scales).max() <= 1.0


def test_what_was_hardly_exercised_takes_the_templates_size() -> None:
    weights = np.zeros((40, 3))
    weights[3:9, 2] = 0.15
    scales = choose_scales(weights, STILLS, np.array([0.5, 1.0, 2.0]), 0.2)
    assert scales.tolist() == [2.0, 1.0, 0.5]


def test_one_small_activation_hardly_moves_the_size() -> None:
    weights = np.zeros((40, 1))
    weights[5] = 0.3
    assert choose_scales(weights, STILLS, np.ones(1), 0.2)[0] == pytest.approx(1.0, abs=0.06)


def test_a_size_away_from_the_templates_is_drawn_back() -> None:
    weights = np.zeros((40, 1))
    weights[5] = 0.3
    scale = choose_scales(weights, STILLS, np.array([1.5]), 0.2)[0]
    assert 0.6 < scale < 0.75


def test_a_shape_that_is_on_in_most_frames_rests_there() -> None:
    rng = np.random.default_rng(3)
    weights = np.zeros((60, 3))
    weights[:, 0] = 0.2 + rng.normal(0, 0.005, 60)
    weights[::7, 0] = rng.uniform(0.3, 1.0, len(weights[::7]))
    weights[::3, 1] = rng.uniform(0.2, 1.0, 20)
    weights[:, 2] = rng.uniform(0.0, 1.0, 60)  # someone who talks: no resting value
    rest = resting_weights(weights)
    assert rest[0] == pytest.approx(0.2, abs=0.01)
    assert rest[1:].tolist() == [0.0, 0.0]


def test_an_expression_that_is_held_is_no_rest() -> None:
    held = np.concatenate([np.zeros(10), np.linspace(0, 0.8, 10), np.full(30, 0.8)])
    weakly = np.concatenate([np.zeros(20), np.full(20, 0.3), np.linspace(0.3, 0.0, 10)])
    assert resting_weights(np.stack([held, weakly], axis=1)).tolist() == [0.0, 0.0]


def test_sizes_are_measured_along_the_original() -> None:
    rng = np.random.default_rng(4)
    shapes = rng.normal(size=(3, 50, 3))
    assert shape_sizes(shapes * np.array([0.7, 1.0, 1.6])[:, None, None], shapes) == pytest.approx(
        [0.7, 1.0, 1.6]
    )
    assert shape_sizes(-shapes, shapes).tolist() == [0.1, 0.1, 0.1]


def test_repetition_counts_activations_of_shapes_that_have_any() -> None:
    weights = np.zeros((12, 3))
    weights[[1, 4, 7], 0] = 0.5
    weights[2, 1] = 0.9
    weights[5, 1] = 0.08  # too little to tell
    assert repetition(weights, np.zeros(12, dtype=bool)) == 2.0
    assert repetition(np.zeros((12, 3)), np.zeros(12, dtype=bool)) == 0.0


def test_activity_is_priced_high_at_first_only_where_shapes_are_seen_in_combinations() -> None:
    schedule = Schedule(strict_evidence=0.6, weights=WeightPriors(evidence=0.1))
    prices = [schedule.posing(turn, 6.0).evidence for turn in range(12)]
    assert prices[0] == 0.6
    assert prices == sorted(prices, reverse=True)
    assert prices[-1] == 0.1
    assert schedule.posing(0, 1.2).evidence == 0.1
    assert 0.1 < schedule.posing(0, 2.5).evidence < 0.6
    assert not schedule.relaxed(0, 6.0)
    assert schedule.relaxed(11, 6.0)
    off = Schedule(strict_evidence=0.6, weights=WeightPriors(evidence=0.0))
    assert off.posing(0, 6.0).evidence == 0.0


def test_a_gap_inside_a_take_does_not_end_an_activation() -> None:
    seen = np.array([True, True, False, False, True, True, True])
    take = np.array([False, True, True, True, True, False, True])
    kept, linked = without_gaps(seen, take)
    assert kept.tolist() == [0, 1, 4, 5, 6]
    assert linked.tolist() == [False, True, True, False, True]


def test_few_frames_agree_on_nothing() -> None:
    assert resting_weights(np.array([[0.3]])).tolist() == [0.0]
    assert resting_weights(np.array([[0.3], [0.3], [0.3]])).tolist() == [0.0]
    assert resting_weights(np.zeros((0, 2))).tolist() == [0.0, 0.0]
