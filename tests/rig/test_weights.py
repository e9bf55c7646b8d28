"""Weights and head motion: the fast sums give what the literal loop over vertices gives."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from rig.weights import (
    WeightPriors,
    mean_square_residuals,
    place_heads,
    solve_weights,
    sum_frames,
)
from tests.rig.grid_face import grid_template, perform, random_motions, smooth_field

PLAIN = WeightPriors(sparsity_mm2=0.0, evidence=0.0, smoothness=0.0, iterations=500)


def _scene(frames: int, noise_mm: float, seed: int = 0):
    rng = np.random.default_rng(seed)
    template = grid_template()
    deltas = template.deltas[:5]
    weights = rng.uniform(0, 1, (frames, 5)) * (rng.uniform(size=(frames, 5)) < 0.6)
    motions = random_motions(frames, rng)
    points = perform(template.neutral, deltas, weights, motions)
    points += rng.normal(0, noise_mm, points.shape)
    return template, deltas, weights, motions, points, rng


def _literal_frame(neutral, deltas, points, confidence, sparsity, rounds=3000):
    """Ma et al. Eq 4 for one frame, vertex by vertex: Procrustes, then bounded least squares."""
    square = confidence**2 / (confidence**2).sum()
    root = np.sqrt(np.repeat(square, 3))
    weights = np.zeros(len(deltas))
    for _ in range(rounds):
        posed = neutral + np.tensordot(weights, deltas, axes=1)
        a, b = square @ posed, square @ points
        left, _, right = np.linalg.svd(((posed - a) * square[:, None]).T @ (points - b))
        flip = np.diag([1, 1, np.linalg.det(left @ right)])
        rotation = (left @ flip @ right).T
        local = (points - b) @ rotation
        columns = (deltas - np.einsum("v,kva->ka", square, deltas)[:, None]).reshape(
            len(deltas), -1
        )
        target = (local - (neutral - square @ neutral)).ravel()
        matrix = np.vstack([(columns * root).T, np.sqrt(sparsity) * np.ones((1, len(deltas)))])
        right_side = np.append(target * root, 0.0)
        new = lsq_linear(matrix, right_side, (0, 1), method="bvls", tol=1e-14).x
        done = np.abs(new - weights).max() < 1e-11
        weights = new
        if done:
            break
    return weights, rotation


@pytest.mark.parametrize("sparsity", [0.0, 0.05])
@pytest.mark.parametrize("holes", [False, True])
def test_equals_the_literal_alternation(sparsity: float, holes: bool) -> None:
    template, deltas, _, _, points, rng = _scene(4, 0.5)
    confidence = rng.uniform(0.2, 1.0, points.shape[:2]) if holes else np.ones(points.shape[:2])
    if holes:
        confidence[:, rng.choice(400, 60, replace=False)] = 0.0
    sums = sum_frames(template.neutral, deltas, points, confidence)
    priors = WeightPriors(
        sparsity_mm2=sparsity, evidence=0.0, smoothness=0.0, debias=False, tolerance=1e-12
    )
    solved, motions = solve_weights(sums, np.zeros(4, dtype=bool), priors)
    for frame in range(4):
        weights, rotation = _literal_frame(
            template.neutral, deltas, points[frame], confidence[frame], sparsity
        )
        assert np.abs(solved[frame] - weights).max() <= 1e-7
        assert np.abs(motions[frame, :3, :3] - rotation).max() <= 1e-7


def test_recovers_weights_and_motion_exactly_without_noise() -> None:
    template, deltas, weights, motions, points, _ = _scene(30, 0.0)
    sums = sum_frames(template.neutral, deltas, points, np.ones(points.shape[:2]))
    solved, heads = solve_weights(sums, np.zeros(30, dtype=bool), PLAIN)
    assert np.abs(solved - weights).max() <= 1e-7
    assert np.abs(heads - motions).max() <= 1e-5  # mm


def test_rigid_move_of_the_world_leaves_weights_alone() -> None:
    template, deltas, _, _, points, rng = _scene(6, 0.3)
    ones = np.ones(points.shape[:2])
    move = random_motions(1, rng)[0]
    moved = points @ move[:3, :3].T + move[:3, 3]
    first, heads = solve_weights(
        sum_frames(template.neutral, deltas, points, ones), np.zeros(6, dtype=bool), PLAIN
    )
    second, moved_heads = solve_weights(
        sum_frames(template.neutral, deltas, moved, ones), np.zeros(6, dtype=bool), PLAIN
    )
    assert np.abs(first - second).max() <= 1e-7
    assert np.abs(move @ heads - moved_heads).max() <= 1e-5


def test_sparsity_leaves_fewer_shapes_and_debiasing_keeps_their_size() -> None:
    template, deltas, weights, _, points, rng = _scene(20, 0.0)
    points = points + np.array([smooth_field(points[0], 0.5, rng) for _ in points])
    sums = sum_frames(template.neutral, deltas, points, np.ones(points.shape[:2]))
    alone = np.zeros(20, dtype=bool)
    plain, _ = solve_weights(sums, alone, PLAIN)
    shrunk, _ = solve_weights(
        sums, alone, WeightPriors(sparsity_mm2=0.05, evidence=0.0, debias=False)
    )
    sparse, _ = solve_weights(sums, alone, WeightPriors(sparsity_mm2=0.05, evidence=0.0))
    assert (sparse > 0.01).sum() < (plain > 0.01).sum()
    assert (sparse > 0.01).sum() <= (shrunk > 0.0).sum()
    assert sparse.sum() > shrunk.sum()
    assert np.abs(sparse - weights).mean() < np.abs(shrunk - weights).mean()


def test_smoothness_calms_contiguous_frames_and_stops_at_a_boundary() -> None:
    template, deltas, _, _, points, rng = _scene(1, 0.0)
    points = np.repeat(points, 12, axis=0) + rng.normal(0, 3.0, (12, 400, 3))
    points[6:] = template.neutral
    linked = np.ones(12, dtype=bool)
    linked[[0, 6]] = False
    sums = sum_frames(template.neutral, deltas, points, np.ones((12, 400)))
    rough, _ = solve_weights(sums, linked, PLAIN)
    calm, _ = solve_weights(
        sums, linked, WeightPriors(sparsity_mm2=0.0, smoothness=2.0, iterations=500)
    )
    assert (
        np.abs(np.diff(calm[:6], axis=0)).mean() < 0.6 * np.abs(np.diff(rough[:6], axis=0)).mean()
    )
    assert np.abs(calm[6:]).max() <= 1e-7


def test_residuals_from_the_sums_are_those_of_the_vertices() -> None:
    template, deltas, weights, _, points, rng = _scene(4, 0.5)
    confidence = rng.uniform(0, 1, points.shape[:2])
    sums = sum_frames(template.neutral, deltas, points, confidence)
    heads = place_heads(sums, weights)
    away = perform(template.neutral, deltas, weights, heads) - points
    square = confidence**2
    expected = (square * (away**2).sum(axis=2)).sum(axis=1) / square.sum(axis=1)
    assert mean_square_residuals(sums, weights) == pytest.approx(expected, abs=1e-9)


def test_shapes_that_earn_nothing_are_taken_out() -> None:
    template, deltas, weights, _, points, rng = _scene(20, 0.0)
    points = points + np.array([smooth_field(points[0], 0.5, rng) for _ in points])
    sums = sum_frames(template.neutral, deltas, points, np.ones(points.shape[:2]))
    alone = np.zeros(20, dtype=bool)
    every, _ = solve_weights(sums, alone, PLAIN)
    earning, _ = solve_weights(
        sums, alone, WeightPriors(sparsity_mm2=0.0, evidence=0.1, smoothness=0.0)
    )
    unused = weights == 0.0
    assert (earning[unused] > 0).sum() < 0.7 * (every[unused] > 0).sum()
    assert (earning[weights > 0.3] > 0).all()


def test_a_frame_without_confidence_is_at_rest() -> None:
    template, deltas, _, _, points, _ = _scene(3, 0.0)
    confidence = np.ones(points.shape[:2])
    confidence[1] = 0.0
    sums = sum_frames(template.neutral, deltas, points, confidence)
    weights, motions = solve_weights(sums, np.array([False, True, True]), PLAIN)
    assert (weights[1] == 0.0).all()
    assert (motions[1] == np.eye(4)).all()


def test_known_weights_place_the_head() -> None:
    template, deltas, weights, motions, points, _ = _scene(5, 0.0)
    sums = sum_frames(template.neutral, deltas, points, np.ones(points.shape[:2]))
    assert np.abs(place_heads(sums, weights) - motions).max() <= 1e-8
