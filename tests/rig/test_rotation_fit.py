"""The compiled rotation against LAPACK's SVD, reflections and flat clouds included."""

import numpy as np

from rig.rotation_fit import fit_rotation


def _fit(cross: np.ndarray) -> np.ndarray:
    rotation = np.empty((3, 3))
    fit_rotation(np.ascontiguousarray(cross), rotation, np.empty((4, 3, 3)))
    return rotation


def _expected(cross: np.ndarray) -> np.ndarray:
    left, _, right = np.linalg.svd(cross)
    return (left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right).T


def test_equals_the_svd_for_every_spread_of_singular_values() -> None:
    rng = np.random.default_rng(1)
    for _ in range(120):
        left, right = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
        sizes = np.array([1.0, rng.uniform(0.1, 0.9), 10.0 ** rng.uniform(-12, -1)])
        cross = left @ np.diag(sizes * 10.0 ** rng.uniform(-6, 6)) @ right
        found = _fit(cross)
        assert np.abs(found - _expected(cross)).max() <= 1e-11
        assert np.abs(found @ found.T - np.eye(3)).max() <= 1e-14
        assert np.linalg.det(found) > 0


def test_flat_and_mirrored_clouds() -> None:
    rng = np.random.default_rng(2)
    turn = _expected(rng.normal(size=(3, 3)))
    flat = rng.normal(size=(40, 3)) * [1.0, 0.7, 0.0]
    assert np.abs(_fit(flat.T @ (flat @ turn.T)) - turn).max() <= 1e-12
    cloud = rng.normal(size=(40, 3)) * [2.0, 1.0, 0.5]
    mirrored = cloud * [1, 1, -1]
    found = _fit(cloud.T @ mirrored)
    assert np.linalg.det(found) > 0
    assert np.abs(found - _expected(cloud.T @ mirrored)).max() <= 1e-11


def test_a_line_gets_a_rotation_and_nothing_the_identity() -> None:
    line = np.outer(np.arange(5.0) - 2.0, [1.0, 2.0, -1.0])
    turn = _expected(np.random.default_rng(3).normal(size=(3, 3)))
    found = _fit(line.T @ (line @ turn.T))
    assert np.abs(line @ found.T - line @ turn.T).max() <= 1e-12
    assert np.abs(found @ found.T - np.eye(3)).max() <= 1e-12
    assert (_fit(np.zeros((3, 3))) == np.eye(3)).all()
