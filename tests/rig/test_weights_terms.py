"""Sparsity kinds, temporal kinds, rigid vertices and links: each against its literal form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize

from capture.errors import InputError, ShapeError
from rig.box_qp import kkt_residual
from rig.weights import (
    WeightLinks,
    WeightPriors,
    mean_square_residuals,
    place_heads,
    solve_weights,
    sum_frames,
)
from tests.rig.grid_face import grid_template, perform, random_motions, smooth_field

BARE = WeightPriors(
    sparsity_mm2=0.0, evidence=0.0, smoothness=0.0, debias=False, iterations=500, tolerance=1e-12
)


def _scene(frames: int, noise_mm: float, seed: int = 0, holes: bool = False):
    rng = np.random.default_rng(seed)
    template = grid_template()
    deltas = template.deltas[:5]
    weights = rng.uniform(0, 1, (frames, 5)) * (rng.uniform(size=(frames, 5)) < 0.6)
    points = perform(template.neutral, deltas, weights, random_motions(frames, rng))
    points += rng.normal(0, noise_mm, points.shape)
    confidence = rng.uniform(0.2, 1.0, points.shape[:2]) if holes else np.ones(points.shape[:2])
    if holes:
        confidence[:, rng.choice(400, 60, replace=False)] = 0.0
    return template.neutral, deltas, points, confidence, rng


def _frame_terms(neutral, deltas, points, confidence, weights, head=None):
    """Gram (B, B), linear (B,) of one frame's mean squared residual with the best motion held.

    The head's rotation and translation come from Procrustes with `head` (V,) as squared
    confidence; the QP then sees every vertex in the head's space.
    """
    square = confidence**2 / (confidence**2).sum()
    head = square if head is None else head / head.sum()
    posed = neutral + np.tensordot(weights, deltas, axes=1)
    a, b = head @ posed, head @ points
    left, _, right = np.linalg.svd(((posed - a) * head[:, None]).T @ (points - b))
    flip = np.diag([1, 1, np.linalg.det(left @ right)])
    rotation = (left @ flip @ right).T
    local = (points - b) @ rotation + a - neutral
    gram = np.einsum("v,kva,lva->kl", square, deltas, deltas)
    return gram, np.einsum("v,kva,va->k", square, deltas, local), rotation


def _bounded(gram, linear):
    root = np.linalg.cholesky(gram)
    matrix, right = root.T, np.linalg.solve(root, linear)
    return lsq_linear(matrix, right, (0, 1), method="bvls", tol=1e-15).x


def _scales(deltas, confidence):
    square = confidence**2 / (confidence**2).sum()
    centred = deltas - np.einsum("v,kva->ka", square, deltas)[:, None]
    return np.einsum("v,kva,kva->k", square, centred, centred)


def _alternated(scene, frame, add, rounds=4000):
    """Literal alternation of one frame; `add(gram, linear, weights)` puts the priors on."""
    neutral, deltas, points, confidence, _ = scene
    weights = np.zeros(len(deltas))
    for _ in range(rounds):
        gram, linear, _ = _frame_terms(neutral, deltas, points[frame], confidence[frame], weights)
        new = _bounded(*add(gram, linear))
        done = np.abs(new - weights).max() < 1e-12
        weights = new
        if done:
            break
    return weights


@pytest.mark.parametrize("holes", [False, True])
def test_l1_equals_the_literal_alternation(holes: bool) -> None:
    scene = _scene(4, 0.5, holes=holes)
    sums = sum_frames(*scene[:4])
    solved, _ = solve_weights(sums, np.zeros(4, bool), replace(BARE, sparsity="l1", l1_mm2=0.2))
    for frame in range(4):
        expected = _alternated(scene, frame, lambda g, c: (g, c - 0.1))
        assert np.abs(solved[frame] - expected).max() <= 1e-7
    assert (solved == 0.0).any()


def test_reweighted_is_l1_with_prices_from_the_last_solution() -> None:
    scene = _scene(3, 0.5, seed=3)
    sums = sum_frames(*scene[:4])
    priors = replace(
        BARE, sparsity="reweighted", reweighted_mm2=0.05, reweight_floor=0.1, reweight_rounds=3
    )
    solved, _ = solve_weights(sums, np.zeros(3, bool), priors)
    for frame in range(3):
        price = np.full(5, 0.025)
        for _ in range(3):
            expected = _alternated(scene, frame, lambda g, c, p=price: (g, c - p))
            price = 0.025 / (expected + 0.1)
        assert np.abs(solved[frame] - expected).max() <= 1e-7


def test_every_kind_of_sparsity_works_with_debiasing_and_evidence() -> None:
    neutral, deltas, points, confidence, rng = _scene(20, 0.0)
    points = points + np.array([smooth_field(points[0], 0.5, rng) for _ in points])
    sums = sum_frames(neutral, deltas, points, confidence)
    alone = np.zeros(20, bool)
    plain, _ = solve_weights(sums, alone, BARE)
    for kind in ("squared", "l1", "reweighted"):
        shrunk, _ = solve_weights(sums, alone, WeightPriors(sparsity=kind, debias=False))
        sparse, _ = solve_weights(sums, alone, WeightPriors(sparsity=kind, evidence=0.1))
        assert (sparse > 0.01).sum() < (plain > 0.01).sum()
        assert sparse.sum() >= shrunk.sum()
        assert sparse.min() >= 0.0
        assert sparse.max() <= 1.0


def test_every_shape_that_stays_explains_its_share_of_the_residual() -> None:
    neutral, deltas, points, confidence, rng = _scene(8, 0.0, seed=4)
    points = points + np.array([smooth_field(points[0], 0.5, rng) for _ in points])
    sums = sum_frames(neutral, deltas, points, confidence)
    solved, _ = solve_weights(sums, np.zeros(8, bool), replace(BARE, evidence=0.15))
    squares = mean_square_residuals(sums, solved)
    for f in range(8):
        kept = np.flatnonzero(solved[f] > 0.0)
        for k in kept:
            fewer = deltas[kept[kept != k]]
            without = sum_frames(neutral, fewer, points[f : f + 1], confidence[f : f + 1])
            again, _ = solve_weights(without, np.zeros(1, bool), BARE)
            rise = mean_square_residuals(without, again)[0] - squares[f]
            assert rise >= 0.95 * 0.15 * squares[f]


def test_reweighting_finds_as_few_shapes_as_l1_and_shrinks_them_less() -> None:
    neutral, deltas, points, confidence, rng = _scene(20, 0.0)
    points = points + np.array([smooth_field(points[0], 0.5, rng) for _ in points])
    sums, alone = sum_frames(neutral, deltas, points, confidence), np.zeros(20, bool)
    l1, _ = solve_weights(sums, alone, replace(BARE, sparsity="l1", l1_mm2=0.1))
    again, _ = solve_weights(sums, alone, replace(BARE, sparsity="reweighted", reweighted_mm2=0.03))
    free, _ = solve_weights(sums, alone, BARE)
    large = (free > 0.5) & (free < 1.0)
    assert (again > 0.0).sum() <= (l1 > 0.0).sum() < (free > 0.0).sum()
    assert np.abs(again - free)[large].mean() < np.abs(l1 - free)[large].mean()


def _take_energy(scene, linked, smoothness, flat):
    neutral, deltas, points, confidence, _ = scene
    weights = flat.reshape(len(points), -1)
    sums = sum_frames(neutral, deltas, points, confidence)
    scale = np.stack([_scales(deltas, row) for row in confidence])
    change = np.diff(weights, axis=0, prepend=0.0)
    steps = smoothness * (scale * change**2)[linked]
    return float(mean_square_residuals(sums, weights).sum() + steps.sum())


@pytest.mark.parametrize("smoothness", [0.05, 1.0])
@pytest.mark.parametrize("holes", [False, True])
def test_joint_is_the_minimum_of_a_dense_qp_over_the_whole_take(
    smoothness: float, holes: bool
) -> None:
    scene = _scene(6, 1.0, seed=5, holes=holes)
    neutral, deltas, points, confidence, _ = scene
    linked = np.array([False, True, True, False, True, True])
    priors = replace(BARE, temporal="joint", smoothness=smoothness)
    solved, heads = solve_weights(sum_frames(*scene[:4]), linked, priors)
    scale = np.stack([_scales(deltas, row) for row in confidence])
    hessian, linear = np.zeros((6, 5, 6, 5)), np.zeros((6, 5))
    for f in range(6):
        gram, linear[f], rotation = _frame_terms(
            neutral, deltas, points[f], confidence[f], solved[f]
        )
        hessian[f, :, f] += gram
        assert np.abs(rotation - heads[f, :3, :3]).max() <= 1e-7
        if linked[f]:
            pull = np.diag(smoothness * scale[f])
            for one, other, sign in ((f, f, 1), (f - 1, f - 1, 1), (f, f - 1, -1), (f - 1, f, -1)):
                hessian[one, :, other] += sign * pull
    bounds = np.zeros(30), np.ones(30)
    residual = kkt_residual(hessian.reshape(30, 30), linear.ravel(), bounds, solved.ravel())
    assert residual <= 1e-8
    expected = _bounded(hessian.reshape(30, 30), linear.ravel())
    assert np.abs(solved.ravel() - expected).max() <= 1e-7


def test_joint_is_the_minimum_of_the_energy_with_the_motion_fitted() -> None:
    scene, linked = _scene(3, 1.0, seed=5), np.array([False, True, True])
    priors = replace(BARE, temporal="joint", smoothness=0.5)
    solved, _ = solve_weights(sum_frames(*scene[:4]), linked, priors)
    found = minimize(
        lambda x: _take_energy(scene, linked, 0.5, x),
        solved.ravel() + np.random.default_rng(0).normal(0, 0.05, 15),
        bounds=[(0, 1)] * 15,
        method="L-BFGS-B",
        options={"maxiter": 20},
    )
    energy = _take_energy(scene, linked, 0.5, solved.ravel())
    assert energy <= found.fun + 1e-9
    assert found.fun <= energy + 1e-3


def test_causal_solves_each_frame_given_the_one_before() -> None:
    scene = _scene(5, 1.0, seed=6, holes=True)
    _, deltas, _, confidence, _ = scene
    linked = np.array([False, True, True, False, True])
    solved, _ = solve_weights(sum_frames(*scene[:4]), linked, replace(BARE, smoothness=0.5))
    for f in range(5):
        pull = 0.5 * _scales(deltas, confidence[f]) * linked[f]
        before = solved[f - 1]
        expected = _alternated(scene, f, lambda g, c, p=pull, b=before: (g + np.diag(p), c + p * b))
        assert np.abs(solved[f] - expected).max() <= 1e-7


@pytest.mark.parametrize("temporal", ["causal", "joint"])
def test_takes_do_not_know_of_each_other_and_long_ones_are_solved_in_blocks(temporal: str) -> None:
    neutral, deltas, points, confidence, _ = _scene(90, 1.0, seed=7)
    linked = np.arange(90) % 45 > 0
    priors = replace(BARE, temporal=temporal, smoothness=0.5, evidence=0.05)
    both, _ = solve_weights(sum_frames(neutral, deltas, points, confidence), linked, priors)
    for span in (slice(0, 45), slice(45, 90)):
        sums = sum_frames(neutral, deltas, points[span], confidence[span])
        one, _ = solve_weights(sums, linked[:45], priors)
        assert np.abs(one - both[span]).max() <= 1e-8


def test_joint_is_as_calm_backward_as_forward() -> None:
    neutral, deltas, points, confidence, _ = _scene(8, 1.0, seed=8)
    linked = np.arange(8) > 0
    priors = replace(BARE, temporal="joint", smoothness=0.5)
    forward, _ = solve_weights(sum_frames(neutral, deltas, points, confidence), linked, priors)
    backward, _ = solve_weights(
        sum_frames(neutral, deltas, points[::-1], confidence), linked, priors
    )
    assert np.abs(forward - backward[::-1]).max() <= 1e-8


def test_rigid_vertices_alone_place_the_head() -> None:
    scene = _scene(3, 0.4, seed=9, holes=True)
    neutral, deltas, points, confidence, _ = scene
    rigid = np.zeros(400)
    rigid[340:] = np.linspace(0.5, 1.0, 60)
    sums = sum_frames(neutral, deltas, points, confidence, rigid)
    solved, heads = solve_weights(sums, np.zeros(3, bool), BARE)
    for f in range(3):
        head = (confidence[f] * rigid) ** 2
        weights = np.zeros(5)
        for _ in range(500):
            gram, linear, rotation = _frame_terms(
                neutral, deltas, points[f], confidence[f], weights, head
            )
            before, weights = weights, _bounded(gram, linear)
            if np.abs(weights - before).max() < 1e-12:
                break
        assert np.abs(solved[f] - weights).max() <= 1e-8
        assert np.abs(heads[f, :3, :3] - rotation).max() <= 1e-8
        away = perform(neutral, deltas, solved[f : f + 1], heads[f : f + 1])[0] - points[f]
        square = confidence[f] ** 2
        expected = (square @ (away**2).sum(axis=1)) / square.sum()
        assert mean_square_residuals(sums, solved)[f] == pytest.approx(expected, abs=1e-9)
        assert np.abs(head @ away).max() <= 1e-9 * head.sum()


def test_what_moves_outside_the_rigid_vertices_does_not_move_the_head() -> None:
    neutral, deltas, points, confidence, rng = _scene(4, 0.0)
    rigid = np.zeros(400)
    rigid[360:] = 1.0
    still = np.abs(deltas[:, 360:]).max(axis=(1, 2)) == 0.0
    points = perform(neutral, deltas, np.where(still, 0.5, 0.0) * np.ones((4, 1)),
                     random_motions(4, rng))  # fmt: skip
    sums = sum_frames(neutral, deltas, points, confidence, rigid)
    disturbed = points.copy()
    disturbed[:, :200] += rng.normal(0, 5.0, (4, 200, 3))
    before = solve_weights(sums, np.zeros(4, bool), BARE)[1]
    known = np.where(still, 0.5, 0.0) * np.ones((4, 1))
    after = place_heads(sum_frames(neutral, deltas, disturbed, confidence, rigid), known)
    assert np.abs(before - after).max() <= 1e-6


def test_too_few_rigid_vertices_seen_means_motion_from_all() -> None:
    neutral, deltas, points, confidence, _ = _scene(2, 0.3)
    rigid = np.zeros(400)
    rigid[:10] = 1.0
    confidence[1, 2:10] = 0.0
    sums = sum_frames(neutral, deltas, points, confidence, rigid)
    every = sum_frames(neutral, deltas, points, confidence)
    one, other = solve_weights(sums, np.zeros(2, bool), BARE), solve_weights(
        every, np.zeros(2, bool), BARE
    )  # fmt: skip
    assert np.abs(one[1][1] - other[1][1]).max() <= 1e-9
    assert np.abs(one[1][0] - other[1][0]).max() > 1e-4


def test_symmetric_pairs_equal_the_literal_term() -> None:
    scene = _scene(3, 1.0, seed=11, holes=True)
    _, deltas, _, confidence, _ = scene
    links = WeightLinks(symmetric=np.array([[1, 2]]))
    sums = sum_frames(*scene[:4])
    solved, _ = solve_weights(sums, np.zeros(3, bool), replace(BARE, symmetry=0.7), links=links)
    for f in range(3):
        part = 0.7 * _scales(deltas, confidence[f])[[1, 2]].mean()
        tie = np.zeros((5, 5))
        tie[1:3, 1:3] = part * np.array([[1, -1], [-1, 1]])
        expected = _alternated(scene, f, lambda g, c, t=tie: (g + t, c))
        assert np.abs(solved[f] - expected).max() <= 1e-7
    tight, _ = solve_weights(sums, np.zeros(3, bool), replace(BARE, symmetry=1e4), links=links)
    assert np.abs(tight[:, 1] - tight[:, 2]).max() <= 1e-3


@pytest.mark.parametrize("evidence", [0.0, 0.05])
def test_of_an_exclusive_pair_one_at_most_is_active(evidence: float) -> None:
    scene = _scene(12, 1.0, seed=12)
    sums, alone = sum_frames(*scene[:4]), np.zeros(12, bool)
    links = WeightLinks(exclusive=np.array([[0, 4], [4, 3]]))
    free, _ = solve_weights(sums, alone, BARE)
    solved, _ = solve_weights(sums, alone, replace(BARE, evidence=evidence), links=links)
    assert (np.minimum(free[:, 0], free[:, 4]) > 0).any()
    for a, b in links.exclusive:
        assert np.minimum(solved[:, a], solved[:, b]).max() == 0.0
    if evidence == 0.0:
        for f in np.flatnonzero(np.minimum(free[:, 0], free[:, 4]) > 0):
            loser = (0, 4)[int(free[f, 0] >= free[f, 4])]
            assert solved[f, loser] == 0.0


def test_a_rigid_move_changes_head_motion_alone_and_scale_changes_nothing() -> None:
    neutral, deltas, points, confidence, rng = _scene(6, 0.3, seed=13, holes=True)
    rigid = np.zeros(400)
    rigid[340:] = 1.0
    links = WeightLinks(symmetric=np.array([[1, 2]]))
    linked = np.arange(6) > 0
    move = random_motions(1, rng)[0]
    moved = points @ move[:3, :3].T + move[:3, 3]
    for priors in (WeightPriors(tolerance=1e-12), replace(BARE, temporal="joint", smoothness=0.1)):
        first, heads = solve_weights(
            sum_frames(neutral, deltas, points, confidence, rigid), linked, priors, None, links
        )
        second, moved_heads = solve_weights(
            sum_frames(neutral, deltas, moved, confidence, rigid), linked, priors, None, links
        )
        assert np.abs(first - second).max() <= 1e-8
        assert np.abs(move @ heads - moved_heads).max() <= 1e-6
        large = replace(priors, sparsity_mm2=100.0 * priors.sparsity_mm2)
        scaled, _ = solve_weights(
            sum_frames(10 * neutral, 10 * deltas, 10 * points, confidence, rigid),
            linked, large, None, links,
        )  # fmt: skip
        assert np.abs(first - scaled).max() <= 1e-8


def test_points_without_confidence_are_not_read() -> None:
    neutral, deltas, points, confidence, _ = _scene(3, 0.3, holes=True)
    first = solve_weights(sum_frames(neutral, deltas, points, confidence), np.ones(3, bool), BARE)
    points[confidence == 0.0] = np.nan
    second = solve_weights(sum_frames(neutral, deltas, points, confidence), np.ones(3, bool), BARE)
    assert (first[0] == second[0]).all()
    assert (first[1] == second[1]).all()


def test_same_input_same_bytes_whatever_the_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    neutral, deltas, points, confidence, _ = _scene(300, 0.5, holes=True)
    priors = WeightPriors(smoothness=0.2)
    results = []
    for cores in (2, 1, 3):
        monkeypatch.setattr("rig.ranges._cores", lambda cores=cores: cores)
        sums = sum_frames(neutral, deltas, points, confidence)
        for temporal in ("causal", "joint"):
            given = replace(priors, temporal=temporal)
            weights, heads = solve_weights(sums, np.arange(300) > 0, given)
            results.append(weights.tobytes() + heads.tobytes())
    assert results[0] == results[2] == results[4]
    assert results[1] == results[3] == results[5]


def test_mistakes_are_named() -> None:
    with pytest.raises(InputError, match=r"sparsity = 'l0'; one of squared, l1, reweighted"):
        WeightPriors(sparsity="l0")
    with pytest.raises(ShapeError, match="exclusive"):
        WeightLinks(exclusive=np.array([1, 2]))
    scene = _scene(2, 0.3)
    sums = sum_frames(*scene[:4])
    links = WeightLinks(symmetric=np.array([[1, 7]]))
    with pytest.raises(InputError, match=r"symmetric pairs name shapes 1\.\.7; .* 0\.\.4"):
        solve_weights(sums, np.zeros(2, bool), BARE, links=links)
