import numpy as np
import pytest

from capture.errors import ShapeError, SolveError
from track.rigid import Similarity, fit_similarity, nearest_rotations


def random_motion(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Similarity(
        rotation=q * np.sign(np.linalg.det(q)),
        translation=rng.normal(0, 50, 3),
        scale=float(rng.uniform(0.5, 2.0)),
    )


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("with_scale", [True, False])
def test_motion_is_recovered(seed: int, with_scale: bool) -> None:
    truth = random_motion(seed)
    if not with_scale:
        truth = Similarity(rotation=truth.rotation, translation=truth.translation)
    rng = np.random.default_rng(seed + 100)
    points = rng.normal(0, 40, (30, 3))
    if seed % 2:
        points[:, 2] = 0.0  # a plane is enough
    weights = rng.uniform(0, 1, 30)
    spoilt = truth.apply(points)
    weights[:3] = 0.0
    spoilt[:3] += 500.0
    found = fit_similarity(points, spoilt, weights, with_scale=with_scale)
    assert np.abs(found.matrix() - truth.matrix()).max() < 1e-9
    assert found.scale == pytest.approx(truth.scale, abs=1e-12)


def test_a_mirror_is_not_a_rotation() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    found = fit_similarity(points, points * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_composition() -> None:
    one, two = random_motion(1), random_motion(2)
    points = np.random.default_rng(0).normal(size=(5, 3))
    assert np.allclose(two.after(one).apply(points), two.apply(one.apply(points)))
    assert np.allclose(two.after(one).matrix(), two.matrix() @ one.matrix())


def test_weights_say_who_matters() -> None:
    points = np.random.default_rng(3).normal(0, 10, (40, 3))
    target = points.copy()
    target[20:] += [5.0, 0.0, 0.0]
    weights = np.where(np.arange(40) < 20, 1.0, 1e-9)
    assert (
        np.abs(fit_similarity(points, target, weights).apply(points)[:20] - points[:20]).max()
        < 1e-6
    )


def test_nearest_rotations_are_rotations() -> None:
    matrices = np.random.default_rng(0).normal(size=(50, 3, 3))
    turns = nearest_rotations(matrices)
    assert np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12
    assert np.abs(np.linalg.det(turns) - 1.0).max() < 1e-12
    assert np.abs(nearest_rotations(2.0 * turns) - turns).max() < 1e-12


def test_refusals() -> None:
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    with pytest.raises(SolveError, match="5 points lie on one line"):
        fit_similarity(line, line)
    with pytest.raises(SolveError, match="positive weights"):
        fit_similarity(line, line, np.zeros(5))
    with pytest.raises(ShapeError, match="with N = 5 as in source"):
        fit_similarity(line, line[:4])
