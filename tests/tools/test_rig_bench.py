from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture.arrays import Floats
from rig.box_qp import solve_box_qp
from rig.contact import contact_gaps, contacts_in_poses
from rig.face_rig import FaceRig
from rig.hable import HableSettings, solve_hable
from rig.influence import influence_masks
from rig.template import Template
from rig.update import update_shapes
from tools.bench.rig import table
from tools.bench.rig_beds import HiddenRig, film, hidden_rig, known_poses, personal_shapes, seeds_of
from tools.bench.rig_instances import (
    expression_weights,
    patch_template,
    touching_pairs,
    update_instance,
    weight_curves,
)
from tools.bench.rig_known import methods, score
from tools.bench.rig_opponents import (
    cvxopt_qp,
    daqp_qp,
    kkt_residual,
    literal_hable,
    literal_update,
    literal_weights,
    missing,
    update_residual,
)
from tools.bench.rig_scores import best_scales, correlations, semantics, solved_scores
from tools.bench.rig_speed import ma_priors


def hidden_patch(seed: int = 5) -> HiddenRig:
    template = patch_template(14, 6)
    rng = np.random.default_rng(seed)
    deltas = personal_shapes(template.neutral, template.deltas, (0.8, 1.2), rng)
    return HiddenRig(template, template.neutral * np.array([1.02, 0.99, 1.0]), deltas)


def perfect_rig(hidden: HiddenRig, weights: Floats) -> FaceRig:
    return FaceRig(
        neutral=hidden.neutral, deltas=hidden.deltas, names=hidden.template.names,
        polygons=hidden.template.polygons, weights=weights,
        head_from_rig=np.tile(np.eye(4), (len(weights), 1, 1)),
    )  # fmt: skip


def test_the_same_seed_gives_the_same_instance_and_another_seed_another() -> None:
    template = patch_template(10, 5)
    support = template.support(1e-3)
    first, again = (update_instance("x", template, support, 12, seed=3) for _ in range(2))
    other = update_instance("x", template, support, 12, seed=4)
    assert (first.evidence.offsets == again.evidence.offsets).all()
    assert (first.evidence.weights == again.evidence.weights).all()
    assert (first.evidence.offsets != other.evidence.offsets).any()
    assert first.scalars == 3 * (support.sum() + 100)


def test_a_bed_and_its_performances_depend_on_the_seed_alone() -> None:
    rigs = [hidden_patch() for _ in range(2)]
    films = [film(rig, 9, 8, resting=2) for rig in rigs]
    assert (films[0].performance.vertices == films[1].performance.vertices).all()
    assert (films[0].weights[:, -2:] == 0).all()
    assert (known_poses(rigs[0], 2)[0].offsets == known_poses(rigs[1], 2)[0].offsets).all()


def test_our_own_actor_has_the_generic_heads_vertices_and_other_shapes() -> None:
    rig = hidden_rig("actor", 11, 12)
    assert rig.deltas.shape == rig.template.deltas.shape == (12, len(rig.neutral), 3)
    alike = correlations(rig.deltas, rig.template.deltas)
    assert (alike > 0.8).all()
    assert (alike < 0.9999).all()


def test_every_shape_is_made_once_and_curves_have_as_many_active_as_asked() -> None:
    weights = expression_weights(30, 40, np.random.default_rng(0))
    assert (weights.max(axis=0) >= 0.6).all()
    assert weights.max() <= 1.0
    curves = weight_curves(51, 1500, 20, np.random.default_rng(1))
    assert 15.0 < (curves > 0).sum(axis=1).mean() < 22.0
    assert np.abs(np.diff(curves, axis=0)).max() < 0.2


def test_the_printed_update_system_gives_what_ours_gives() -> None:
    template = patch_template(9, 5)
    instance = update_instance("x", template, template.support(1e-3), 12)
    priors = replace(ma_priors(template), tolerance=1e-11)
    common = instance.targets, instance.support, instance.evidence
    neutral, deltas = update_shapes(
        template.neutral, template.mesh.triangles, *common, priors
    )  # fmt: skip
    expected, _ = literal_update(template, *common, priors)
    found = np.concatenate([(neutral - template.neutral)[None], deltas])
    np.testing.assert_allclose(found, expected, atol=1e-8)
    targets, support, evidence = common
    assert update_residual(template, expected, support, evidence, priors, targets) < 1e-10
    wrong = expected + 0.01 * np.concatenate([np.ones((1, 81)), support])[:, :, None]
    assert update_residual(template, wrong, support, evidence, priors, targets) > 1e-4


def test_hables_rows_written_out_give_what_ours_gives_and_contacts_close_gaps() -> None:
    template = patch_template(9, 5)
    evidence = update_instance("x", template, template.support(0.0), 14).evidence
    common = template.polygons, template.deltas, influence_masks(template), evidence
    settings = HableSettings()
    expected, _, _ = literal_hable(*common, settings, 1e-12)
    found = solve_hable(template.neutral, *common, settings)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    contacts = contacts_in_poses(np.array([[40, 42]]), 14, kept=[2])
    held = solve_hable(template.neutral, *common, settings, contacts)
    assert np.nanmax(contact_gaps(template.neutral, held, evidence.weights, contacts)) < 0.01


def test_quadratic_programs_of_public_solvers_agree_with_ours() -> None:
    if word := missing("daqp", "cvxopt"):
        pytest.skip(word)
    columns = patch_template(12, 7).deltas.reshape(7, -1)
    gram = columns @ columns.T
    linears = np.random.default_rng(0).uniform(-0.3, 1.3, (6, 7)) @ gram
    zeros, ones = np.zeros_like(linears), np.ones_like(linears)
    ours = solve_box_qp(gram[None], linears, zeros, ones, zeros)
    for make, tolerance in ((daqp_qp, 1e-9), (cvxopt_qp, 5e-3)):
        answers = np.stack([make(gram)(linear) for linear in linears])
        np.testing.assert_allclose(answers, ours, atol=tolerance)
    assert kkt_residual(gram, linears, ours) < 1e-12
    assert kkt_residual(gram, linears, np.clip(ours + 0.1, 0, 1)) > 0.01


def test_the_printed_loop_finds_weights_and_rotation() -> None:
    if word := missing("cvxopt"):
        pytest.skip(word)
    hidden = hidden_patch()
    weights = np.array([[0.0, 0.6, 0.0, 0.3, 0.0, 0.0]])
    faces = hidden.template.neutral + np.tensordot(weights, hidden.template.deltas, axes=1)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    found, rotations = literal_weights(hidden.template, faces @ turn.T + 5.0, 0.0, 60)
    np.testing.assert_allclose(found, weights, atol=0.02)
    np.testing.assert_allclose(rotations[0], turn, atol=0.01)


def test_a_package_that_is_not_there_is_named() -> None:
    assert "no_such_solver not installed" in missing("no_such_solver")
    assert missing("numpy") == ""


def test_scores_are_nothing_for_the_truth_and_see_a_scale() -> None:
    hidden = hidden_patch()
    evidence, held_out = known_poses(hidden, 1)
    assert score(hidden, hidden.neutral, hidden.deltas, held_out)["rmse_mm"] < 1e-9
    rig = perfect_rig(hidden, evidence.weights)
    assert solved_scores(hidden, evidence.weights, rig)["shape/DT"] < 1e-6
    doubled = replace(rig, deltas=2.0 * rig.deltas, weights=rig.weights / 2.0)
    scores = solved_scores(hidden, evidence.weights, doubled)
    assert scores["gauge/DT"] < 1e-6 < scores["shape/DT"]
    assert scores["weights_scaled"] < 1e-9 < scores["weights"]
    np.testing.assert_allclose(best_scales(doubled.deltas, hidden.deltas), 0.5)


def test_semantics_names_the_shape_that_lost_its_meaning() -> None:
    hidden = hidden_patch()
    weights = np.eye(6)
    spoiled = hidden.deltas.copy()
    spoiled[2] = spoiled[2][:, ::-1]
    told = semantics(hidden, weights, replace(perfect_rig(hidden, weights), deltas=spoiled))
    assert told["worst_shape"] == hidden.template.names[2]
    assert told["worst_fall"] > 0.02
    fine = semantics(hidden, weights, perfect_rig(hidden, weights))
    assert fine["worst_fall"] < 0.0


def test_every_method_beats_the_transferred_template_on_held_out_poses() -> None:
    hidden = hidden_patch()
    evidence, held_out = known_poses(hidden, 1, white_mm=0.02, smooth_mm=0.0)
    targets = hidden.template.deltas
    found = {
        name: score(hidden, *method(hidden, targets, evidence), held_out)["rmse_mm"]
        for name, method in methods(quick=True).items()
    }
    for name in ("EBFR mm 0.1", "Menzel 0.1", "Hable", "Ma", "ours"):
        assert found[name] < found["DT"], name


def test_pairs_across_a_slit_are_found_and_lie_upper_first() -> None:
    """Two sheets that face each other at 0.5 mm, joined far away."""
    x, z = np.meshgrid(np.arange(4.0), np.arange(12.0), indexing="ij")
    upper = np.stack([x.ravel(), np.full(x.size, 0.5), z.ravel()], axis=1)
    lower = upper * np.array([1.0, 0.0, 1.0])
    corner = np.array([12 * i + j for i in range(3) for j in range(11)])
    quads = np.stack([corner, corner + 1, corner + 13, corner + 12], axis=1)
    polygons = np.concatenate([quads[:, ::-1], quads + 48]).astype(np.int32)
    neutral = np.concatenate([upper, lower])
    template = Template(
        neutral=neutral, deltas=np.zeros((1, 96, 3)), names=("a",), polygons=polygons
    )
    pairs = touching_pairs(template, neutral, 0.6)
    assert len(pairs) == 48
    assert (pairs[:, 0] + 48 == pairs[:, 1]).all()


def test_seeds_and_tables_are_read_and_written() -> None:
    assert list(seeds_of("101,103-105")) == [101, 103, 104, 105]
    text = table([{"goal": "a", "x": 1.23456, "y": "z"}, {"goal": "a", "x": 2.0, "w": 3}])
    assert text.splitlines()[1:] == ["a", "x      y  w", "1.235  z", "2         3"]
