"""Box QPs: exact, inside the box, equal to SciPy's active set."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from capture.errors import ShapeError, SolveError
from rig.box_qp import kkt_residual, solve_box_qp


def _problem(rng: np.random.Generator, n: int, decades: float) -> tuple[np.ndarray, np.ndarray]:
    matrix = rng.normal(size=(n + rng.integers(0, 20), n)) * np.logspace(0, -decades, n)
    target = matrix @ rng.uniform(-0.5, 1.5, n) + 0.1 * rng.normal(size=len(matrix))
    return matrix, target


@pytest.mark.parametrize("decades", [0.0, 1.5, 2.5])
def test_agrees_with_scipy_and_satisfies_kkt(decades: float) -> None:
    rng = np.random.default_rng(5)
    for _ in range(15):
        n = int(rng.integers(2, 57))
        matrix, target = _problem(rng, n, decades)
        gram, linear = matrix.T @ matrix, matrix.T @ target
        zero, one = np.zeros(n), np.ones(n)
        start = rng.uniform(-0.5, 1.5, (1, n))
        x = solve_box_qp(gram[None], linear[None], zero[None], one[None], start)[0]
        expected = lsq_linear(matrix, target, (0, 1), method="bvls", tol=1e-15, max_iter=5000).x
        assert kkt_residual(gram, linear, (zero, one), x) <= 1e-8
        assert np.abs(x - expected).max() <= 1e-9
        assert x.min() >= 0.0
        assert x.max() <= 1.0


@pytest.mark.parametrize("seed", range(8))
def test_ill_conditioned_problems_of_the_size_of_a_face(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, count = 51, 40
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    gram = (turn * np.logspace(0, -5, n)) @ turn.T
    gram = (gram + gram.T) / 2
    linear = rng.uniform(-0.5, 1.5, (count, n)) @ gram + rng.normal(0, 1e-3, (count, n))
    low, high = np.zeros((count, n)), rng.choice([0.0, 0.5, 1.0], (count, n), p=[0.1, 0.1, 0.8])
    solved = solve_box_qp(gram[None], linear, low, high, rng.uniform(-0.5, 1.5, (count, n)))
    assert (solved >= low).all()
    assert (solved <= high).all()
    for row in range(count):
        assert kkt_residual(gram, linear[row], (low[row], high[row]), solved[row]) <= 1e-12
    again = solve_box_qp(gram[None], linear, low, high, solved)
    assert np.abs(again - solved).max() <= 1e-9
    root = np.linalg.cholesky(gram)
    for row in range(2):
        kept = high[row] > 0
        right = np.linalg.solve(root, linear[row])
        bounds = (low[row][kept], high[row][kept])
        x = lsq_linear(root.T[:, kept], right, bounds, method="bvls", tol=1e-15, max_iter=5000).x
        assert np.abs(solved[row][kept] - x).max() <= 1e-6


def test_warm_start_changes_nothing_but_the_path() -> None:
    rng = np.random.default_rng(6)
    matrix, _ = _problem(rng, 40, 2.0)
    gram = matrix.T @ matrix
    linear = rng.normal(size=(50, 40))
    low, high = np.zeros((50, 40)), np.ones((50, 40))
    cold = solve_box_qp(gram[None], linear, low, high, np.zeros((50, 40)))
    warm = solve_box_qp(gram[None], linear, low, high, rng.uniform(-1, 2, (50, 40)))
    assert np.abs(cold - warm).max() <= 1e-9


def test_free_and_fixed_variables() -> None:
    gram = np.diag([1.0, 2.0, 4.0])[None]
    linear = np.array([[5.0, -4.0, 2.0]])
    low, high = np.array([[-np.inf, -np.inf, 0.0]]), np.array([[np.inf, np.inf, 0.0]])
    assert solve_box_qp(gram, linear, low, high, np.zeros((1, 3))) == pytest.approx(
        np.array([[5.0, -2.0, 0.0]])
    )


def test_one_hessian_a_problem() -> None:
    grams = np.stack([np.eye(2), 4 * np.eye(2)])
    linear = np.array([[0.5, 2.0], [2.0, -1.0]])
    solved = solve_box_qp(grams, linear, np.zeros((2, 2)), np.ones((2, 2)), np.zeros((2, 2)))
    assert solved == pytest.approx(np.array([[0.5, 1.0], [0.5, 0.0]]))


def test_refuses_a_singular_hessian_and_wrong_shapes() -> None:
    gram = np.ones((1, 2, 2))
    half = np.full((1, 2), 0.5)
    with pytest.raises(SolveError, match="not positive definite"):
        solve_box_qp(gram, half, np.zeros((1, 2)), np.ones((1, 2)), half)
    with pytest.raises(ShapeError, match="lower"):
        solve_box_qp(gram, half, np.zeros((1, 3)), np.ones((1, 2)), half)
