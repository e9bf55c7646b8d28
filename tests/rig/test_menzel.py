"""Menzel's fit against Eqs 1-3 written out, vertex by vertex."""

import numpy as np
import pytest

from capture.errors import SettingsError, ShapeError
from rig.evidence import Evidence
from rig.menzel import MenzelSettings, solve_menzel
from tests.rig.grid_face import grid_template


def _scene(holes: bool = True, poses: int = 9):
    rng = np.random.default_rng(11)
    template = grid_template(8)
    targets = template.deltas + 1e-7 * rng.normal(size=template.deltas.shape)  # transfer's dust
    targets[:, 40] = 0.0
    weights = rng.uniform(0, 1, (poses, 6))
    offsets = np.tensordot(weights, 1.3 * targets, axes=1) + rng.normal(0, 0.3, (poses, 64, 3))
    confidence = rng.uniform(0, 1, (poses, 64)) if holes else np.ones((poses, 64))
    if holes:
        confidence[:, :3] = 0.0
    return targets, Evidence(offsets, confidence, weights)


def _literal(targets, evidence, strength, reference):
    """All rows of one coordinate in one dense matrix; D clamped to 1e5 as printed."""
    count = targets.shape[1]
    norms = np.linalg.norm(reference, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = norms.max(axis=1, keepdims=True) / norms
    firm = np.minimum(np.nan_to_num(ratio, nan=1e5, posinf=1e5), 1e5)
    out = np.zeros_like(targets)
    for v in range(count):
        posing = evidence.weights * evidence.confidence[:, v : v + 1]
        rows = np.concatenate([posing, np.sqrt(strength) * np.diag(firm[:, v])])
        for c in range(3):
            right = np.concatenate(
                [
                    evidence.offsets[:, v, c] * evidence.confidence[:, v],
                    np.sqrt(strength) * firm[:, v] * targets[:, v, c],
                ]
            )
            out[:, v, c] = np.linalg.lstsq(rows, right, rcond=None)[0]
    return out


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize("own", [False, True])
def test_equals_the_rows_written_out(holes: bool, own: bool) -> None:
    targets, evidence = _scene(holes)
    reference = targets if own else grid_template(8).deltas + 1e-3
    settings = MenzelSettings(strength=0.03)
    found = solve_menzel(targets, evidence, settings, None if own else reference)
    expected = _literal(targets, evidence, 0.03, reference)
    assert np.abs(found - expected).max() <= 1e-7


def test_vertices_that_hardly_move_on_the_template_stay_at_their_targets() -> None:
    targets, evidence = _scene()
    found = solve_menzel(targets, evidence, MenzelSettings(clamp=1e3))
    norms = np.linalg.norm(targets, axis=2)
    held = norms * 1e3 <= norms.max(axis=1, keepdims=True)
    assert held.mean() > 0.3
    assert (found[held] == targets[held]).all()


def test_truth_is_recovered_where_enough_poses_show_it() -> None:
    targets, _ = _scene()
    targets += 0.5  # moves everywhere
    truth = targets * np.linspace(0.8, 1.2, 6)[:, None, None]
    weights = np.random.default_rng(0).uniform(0, 1, (30, 6))
    offsets = np.tensordot(weights, truth, axes=1)
    evidence = Evidence(offsets, np.ones(offsets.shape[:2]), weights)
    weak = solve_menzel(targets, evidence, MenzelSettings(strength=1e-9))
    assert np.abs(weak - truth).max() <= 1e-3
    firm = solve_menzel(targets, evidence, MenzelSettings(strength=1e8))
    assert np.abs(firm - targets).max() <= 1e-3


def test_a_sculpted_shape_is_one_more_row() -> None:
    targets, evidence = _scene(holes=False)
    sculpted = targets[2] + np.array([0.0, 0.7, 0.0])
    row = Evidence(sculpted[None], np.full((1, 64), 300.0), np.eye(6)[2:3], np.zeros(1))
    found = solve_menzel(targets, evidence.with_rows(row), MenzelSettings(clamp=30.0))
    free = np.linalg.norm(targets[2], axis=1) * 5 > np.linalg.norm(targets[2], axis=1).max()
    assert np.abs(found[2] - sculpted)[free].max() <= 0.02


def test_without_evidence_the_targets_stay() -> None:
    targets, evidence = _scene()
    blind = Evidence(evidence.offsets, np.zeros((9, 64)), evidence.weights)
    assert (solve_menzel(targets, blind, MenzelSettings()) == targets).all()


def test_vertices_do_not_depend_on_how_many_there_are() -> None:
    rng = np.random.default_rng(1)
    targets = rng.normal(size=(3, 4500, 3))
    targets[:, -1] = 9.0  # the furthest vertex of every shape is in the tail
    weights, confidence = rng.random((2, 3)), rng.random((2, 4500))
    offsets = rng.normal(size=(2, 4500, 3))
    whole = solve_menzel(targets, Evidence(offsets, confidence, weights), MenzelSettings())
    tail = Evidence(offsets[:, 4000:], confidence[:, 4000:], weights)
    part = solve_menzel(targets[:, 4000:], tail, MenzelSettings())
    assert np.abs(part - targets[:, 4000:]).max() > 0.01
    assert np.abs(part - whole[:, 4000:]).max() <= 1e-12


def test_same_input_same_bytes() -> None:
    targets, evidence = _scene()
    first = solve_menzel(targets, evidence, MenzelSettings())
    assert first.tobytes() == solve_menzel(targets, evidence, MenzelSettings()).tobytes()


def test_refuses_what_does_not_fit() -> None:
    targets, evidence = _scene()
    with pytest.raises(ShapeError, match="V = 10"):
        solve_menzel(targets[:, :10], evidence, MenzelSettings())
    with pytest.raises(SettingsError, match=r"menzel\.strength = -1"):
        MenzelSettings(strength=-1.0)
