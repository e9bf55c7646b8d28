"""The blendshape update: both fast paths against the literal system of Ma et al. Eq 7."""

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve

from capture.errors import SolveError
from rig.evidence import Evidence
from rig.gradient import gradient_operator
from rig.update import (
    UpdatePriors,
    assemble,
    mean_vertex_area,
    offset_stiffness,
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
    """Eq 7 with the neutral column, written out over all 3 V (B + 1) scalars and masked by rows."""
    count, shapes = len(template.neutral), len(targets) + 1
    operator = gradient_operator(template.neutral, template.mesh.triangles)
    big = sparse.kron(sparse.eye_array(shapes), sparse.kron(operator, sparse.eye_array(3)))
    factors = np.concatenate([np.ones((len(evidence.weights), 1)), evidence.weights], axis=1)
    posing = sparse.kron(sparse.csr_array(factors), sparse.eye_array(3 * count))
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
    active = np.repeat(np.concatenate([np.ones((1, count), dtype=bool), support]).ravel(), 3)
    kept = np.flatnonzero(active)
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


def test_direct_and_iterative_paths_agree() -> None:
    template, targets, support, evidence = _scene(20)
    system = assemble(template.neutral, template.mesh.triangles, targets, support, evidence, PRIORS)
    direct = solve_direct(system)
    iterated = solve_iterative(system, np.zeros_like(system.right), PRIORS)
    assert np.abs(direct - iterated).max() <= 1e-6
    warm = solve_iterative(system, iterated, UpdatePriors(tolerance=1e-9, iterations=1))
    assert np.abs(direct - warm).max() <= 1e-6


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
