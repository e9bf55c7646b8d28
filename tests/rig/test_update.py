"""The blendshape update: both fast paths against the literal system of Ma et al. Eq 7."""

import os
from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve

from capture.errors import ShapeError, SolveError
from rig.evidence import Evidence
from rig.gradient import gradient_operator
from rig.update import (
    UpdatePriors,
    assemble,
    mean_vertex_area,
    offset_stiffness,
    prefers_direct,
    solve_direct,
    solve_iterative,
    update_shapes,
)
from tests.rig.grid_face import grid_template

PRIORS = UpdatePriors(tolerance=1e-11)


def _scene(side: int = 8, frames: int = 7, holes: bool = True):
    rng = np.random.default_rng(3)
    template = grid_template(side)
    support = template.support(1e-3)[:5]
    targets = np.where(support[:, :, None], template.deltas[:5], 0.0)
    weights = rng.uniform(0, 1, (frames, 5))
    offsets = np.tensordot(weights, 1.3 * targets, axes=1) + rng.normal(
        0, 0.4, (frames, side**2, 3)
    )
    confidence = rng.uniform(0, 1, (frames, side**2)) if holes else np.ones((frames, side**2))
    if holes:
        confidence[:, :5] = 0.0
    return template, targets, support, Evidence(offsets, confidence, weights)


def _literal(template, targets, support, evidence, priors):
    """Eq 7 with the neutral column, written out over all 3 V (B + 1) scalars, masked one by one."""
    count, shapes = len(template.neutral), len(targets) + 1
    operator = gradient_operator(template.neutral, template.mesh.triangles)
    big = sparse.kron(sparse.eye_array(shapes), sparse.kron(operator, sparse.eye_array(3)))
    posing = sparse.kron(sparse.csr_array(evidence.factors), sparse.eye_array(3 * count))
    sure = sparse.diags_array(np.repeat(evidence.confidence.ravel(), 3) ** 2)
    wanted = np.concatenate([np.zeros((1, count, 3)), targets]).ravel()
    strength = priors.gradient_mm2 / mean_vertex_area(template.neutral, template.mesh.triangles)
    offset = sparse.diags_array(np.repeat(offset_stiffness(targets, priors).T.ravel(), 3))
    matrix = posing.T @ sure @ posing + strength * (big.T @ big) + offset
    right = (
        posing.T @ sure @ evidence.offsets.ravel()
        + strength * (big.T @ (big @ wanted))
        + offset @ wanted
    )
    each = support if support.ndim == 3 else np.repeat(support[:, :, None], 3, axis=2)
    kept = np.flatnonzero(np.concatenate([np.ones((1, count, 3), dtype=bool), each]))
    out = np.zeros(len(wanted))
    out[kept] = spsolve(sparse.csc_array(matrix)[kept][:, kept], right[kept])
    return out.reshape(shapes, count, 3)


@pytest.mark.parametrize("holes", [False, True])
def test_equals_the_literal_system(holes: bool) -> None:
    template, targets, support, evidence = _scene(holes=holes)
    expected = _literal(template, targets, support, evidence, PRIORS)
    triangles = template.mesh.triangles
    neutral, shapes = update_shapes(template.neutral, triangles, targets, support, evidence, PRIORS)
    assert np.abs(neutral - template.neutral - expected[0]).max() <= 1e-6
    assert np.abs(shapes - expected[1:]).max() <= 1e-6


CONFIDENCES = {
    "sure": lambda rng, shape: np.ones(shape),
    "by vertex": lambda rng, shape: np.tile(rng.uniform(0, 1, shape[1]), (shape[0], 1)),
    "by frame": lambda rng, shape: rng.uniform(0, 1, shape) * (rng.uniform(0, 1, shape) > 0.2),
}
PULLS = {
    "the paper's": UpdatePriors(gradient_mm2=10.0, relative_mm2=0.0, tolerance=1e-11),
    "stiff": UpdatePriors(gradient_mm2=3000.0, relative_mm2=0.0, tolerance=1e-11),
    "relative": UpdatePriors(tolerance=1e-11),
}


@pytest.mark.parametrize("pull", PULLS)
@pytest.mark.parametrize("confidence", CONFIDENCES)
def test_each_path_equals_the_literal_system(confidence: str, pull: str) -> None:
    template, targets, support, evidence = _scene(17)  # enough vertices for threads
    sure = CONFIDENCES[confidence](np.random.default_rng(8), evidence.confidence.shape)
    evidence = Evidence(evidence.offsets, sure, evidence.weights)
    priors, triangles = PULLS[pull], template.mesh.triangles
    expected = _literal(template, targets, support, evidence, priors)
    expected[1:] -= targets
    system = assemble(template.neutral, triangles, targets, support, evidence, priors)
    expected = expected.transpose(1, 0, 2)[system.position >= 0]
    assert np.abs(solve_direct(system) - expected).max() <= 1e-8
    cold = solve_iterative(system, np.zeros_like(system.right), priors)
    assert np.abs(cold - expected).max() <= 1e-7
    warm = solve_iterative(system, cold, replace(priors, tolerance=1e-9, iterations=1))
    assert np.abs(warm - expected).max() <= 1e-7


def test_rows_that_show_a_shape_alone_say_nothing_of_the_neutral() -> None:
    template, targets, support, evidence = _scene()
    sculpted = np.where(support[:2, :, None], 1.5 * targets[:2], 0.0)
    rows = Evidence(sculpted, np.full(support[:2].shape, 30.0), np.eye(5)[:2], np.zeros(2))
    both, triangles = evidence.with_rows(rows), template.mesh.triangles
    neutral, shapes = update_shapes(template.neutral, triangles, targets, support, both, PRIORS)
    expected = _literal(template, targets, support, both, PRIORS)
    assert np.abs(neutral - template.neutral - expected[0]).max() <= 1e-6
    assert np.abs(shapes - expected[1:]).max() <= 1e-6
    assert np.abs(shapes[:2] - sculpted).max() <= 0.15  # two times their strength is theirs


def test_a_mask_for_each_coordinate_equals_the_literal_system() -> None:
    template, targets, _, evidence = _scene(9)
    support = np.abs(targets) > 1e-3
    assert not (support == support[:, :, :1]).all()
    targets[0, :, 1] += 0.2  # what transfer leaves where the mask says nothing moves
    expected = _literal(template, np.where(support, targets, 0.0), support, evidence, PRIORS)
    iterate = replace(PRIORS, tolerance=1e-12)
    for priors in (PRIORS, iterate):
        neutral, shapes = update_shapes(
            template.neutral, template.mesh.triangles, targets, support, evidence, priors
        )
        assert np.abs(neutral - template.neutral - expected[0]).max() <= 1e-6
        assert np.abs(shapes - expected[1:]).max() <= 1e-6
        assert (shapes[~support] == 0.0).all()


def test_extra_stiffness_enters_the_system_and_its_energy() -> None:
    template, targets, support, evidence = _scene()
    extra = np.where(support, 0.0, 3.0)
    everywhere = np.ones_like(support)
    priors = replace(PRIORS, extra_offset=extra)
    neutral, shapes = update_shapes(
        template.neutral, template.mesh.triangles, targets, everywhere, evidence, priors
    )
    expected = _literal(template, targets, everywhere, evidence, priors)
    assert np.abs(neutral - template.neutral - expected[0]).max() <= 1e-6
    assert np.abs(shapes - expected[1:]).max() <= 1e-6
    rise = offset_stiffness(targets, priors) - offset_stiffness(targets, PRIORS)
    assert np.abs(rise[:, 1:] - extra.T).max() <= 1e-12


def test_the_same_bytes_however_the_work_is_shared_out() -> None:
    template, targets, support, evidence = _scene(20)
    arguments = (template.neutral, template.mesh.triangles, targets, support, evidence)
    system = assemble(*arguments, PRIORS)
    start = np.zeros_like(system.right)
    first = solve_iterative(system, start, PRIORS)
    assert first.tobytes() == solve_iterative(assemble(*arguments, PRIORS), start, PRIORS).tobytes()
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        alone = solve_iterative(system, start, PRIORS)
    finally:
        os.sched_setaffinity(0, allowed)
    assert first.tobytes() == alone.tobytes()


def test_factorises_small_or_stiff_systems_and_iterates_on_large_ones() -> None:
    def choice(side: int, priors: UpdatePriors) -> bool:
        template, targets, support, evidence = _scene(side)
        triangles = template.mesh.triangles
        return prefers_direct(
            assemble(template.neutral, triangles, targets, support, evidence, priors),
            priors.tolerance,
        )

    loose = UpdatePriors(gradient_mm2=1.0, tolerance=1e-5)
    assert choice(8, loose)
    assert not choice(60, loose)
    assert choice(60, replace(loose, gradient_mm2=1e5, relative_mm2=0.0))


def test_refuses_a_mask_of_another_size() -> None:
    template, targets, support, evidence = _scene()
    with pytest.raises(ShapeError, match=r"support: expected shape \(5, 64\) or \(5, 64, 3\)"):
        update_shapes(
            template.neutral, template.mesh.triangles, targets, support[:4], evidence, PRIORS
        )


def test_refuses_a_mesh_without_area() -> None:
    template, targets, support, evidence = _scene()
    with pytest.raises(SolveError, match="zero area"):
        update_shapes(
            np.zeros_like(template.neutral), template.mesh.triangles, targets, support, evidence,
            PRIORS,
        )  # fmt: skip


def test_the_mask_holds_shapes_still_and_frees_the_neutral() -> None:
    template, targets, support, evidence = _scene()
    moved = Evidence(evidence.offsets + 2.0, evidence.confidence, evidence.weights)
    neutral, shapes = update_shapes(
        template.neutral, template.mesh.triangles, targets, support, moved, PRIORS
    )
    assert (shapes[~support] == 0.0).all()
    assert np.linalg.norm(neutral - template.neutral, axis=1)[5:].min() > 0.5


def test_true_shapes_are_recovered_from_enough_frames() -> None:
    rng = np.random.default_rng(4)
    template = grid_template(12)
    support = template.support(1e-3)[:5]
    truth = 1.2 * np.where(support[:, :, None], template.deltas[:5], 0.0)
    bias = np.array([0.3, -0.2, 0.1])
    weights = rng.uniform(0, 1, (40, 5))
    offsets = bias + np.tensordot(weights, truth, axes=1)
    evidence = Evidence(offsets, np.ones(offsets.shape[:2]), weights)
    weak = UpdatePriors(gradient_mm2=1e-5, offset=1e-5, relative_mm2=0.0, neutral_offset=1e-5)
    neutral, shapes = update_shapes(
        template.neutral, template.mesh.triangles, template.deltas[:5], support, evidence, weak
    )
    assert np.abs(neutral - template.neutral - bias).max() <= 1e-3
    assert np.abs(shapes - truth).max() <= 1e-3


def test_without_evidence_the_targets_stay() -> None:
    template, targets, support, evidence = _scene()
    blind = Evidence(evidence.offsets, np.zeros_like(evidence.confidence), evidence.weights)
    neutral, shapes = update_shapes(
        template.neutral, template.mesh.triangles, targets, support, blind, PRIORS
    )
    assert np.abs(neutral - template.neutral).max() <= 1e-12
    assert np.abs(shapes - targets).max() <= 1e-12


def test_a_face_meshed_more_finely_is_smoothed_over_the_same_distance() -> None:
    changes = []
    for side in (15, 29):
        template = grid_template(side)
        truth = 1.5 * template.deltas[:1]
        evidence = Evidence(truth, np.ones(truth.shape[:2]), np.ones((1, 1)))
        priors = UpdatePriors(gradient_mm2=400.0, neutral_offset=1e6)
        _, shapes = update_shapes(
            template.neutral, template.mesh.triangles, template.deltas[:1],
            template.support(1e-3)[:1], evidence, priors,
        )  # fmt: skip
        changes.append(np.linalg.norm(shapes - template.deltas[:1], axis=2).max())
    assert changes[0] == pytest.approx(changes[1], rel=0.05)


def test_says_when_it_does_not_converge() -> None:
    template, targets, support, evidence = _scene(20)
    system = assemble(template.neutral, template.mesh.triangles, targets, support, evidence, PRIORS)
    with pytest.raises(SolveError, match="after 2 iterations"):
        solve_iterative(system, np.zeros_like(system.right), UpdatePriors(iterations=2))
