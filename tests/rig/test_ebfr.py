"""EBFR against the Kronecker systems of the public codes, and its dependence on the unit."""

import numpy as np
import pytest

from capture.errors import SettingsError
from rig.ebfr import EbfrSettings, solve_ebfr
from rig.evidence import Evidence
from rig.gradient import components
from tests.rig.grid_face import grid_template


def _scene(holes: bool = True, poses: int = 7):
    rng = np.random.default_rng(12)
    template = grid_template(7)
    weights = rng.uniform(0, 1, (poses, 6))
    offsets = np.tensordot(weights, 1.3 * template.deltas, axes=1)
    offsets += rng.normal(0, 0.2, offsets.shape)
    confidence = rng.uniform(0, 1, (poses, 49)) if holes else np.ones((poses, 49))
    if holes:
        confidence[:, :2] = 0.0
    return template, Evidence(offsets, confidence, weights)


def _frame(points):
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    return np.column_stack(
        [points[1] - points[0], points[2] - points[0], normal / np.sqrt(np.linalg.norm(normal))]
    )


def _literal(template, targets, evidence, settings):
    """Triangle by triangle, nine scalars a frame, then the edges of all, component by component."""
    neutral, triangles = template.neutral, template.mesh.triangles
    shapes, unit = len(targets), settings.unit_mm
    edges = np.zeros((len(triangles), shapes, 3, 3))
    for t, corner in enumerate(triangles):
        rest = _frame(neutral[corner])
        known = np.array([_frame((neutral + d)[corner]) - rest for d in targets])
        rows, right = [], []
        for pose, weights in enumerate(evidence.weights):
            sure = evidence.confidence[pose, corner].min()
            shown = _frame((neutral + evidence.offsets[pose])[corner]) - rest
            rows.append(sure * np.kron(weights[None], np.eye(9)))
            right.append(sure * shown.ravel())
        for k in range(shapes):
            norm = np.linalg.norm(known[k]) / unit
            held = ((1 + norm) / (settings.kappa + norm)) ** settings.theta
            block = np.zeros((9, 9 * shapes))
            block[:, 9 * k : 9 * k + 9] = np.sqrt(settings.beta) * held * np.eye(9)
            rows.append(block)
            right.append(np.sqrt(settings.beta) * held * known[k].ravel())
        solved = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
        edges[t] = solved.reshape(shapes, 3, 3)
    return edges[..., :2]


def _vertices(edges, triangles, targets):
    """Dense least squares for every edge, with the gauge that `solve_ebfr` documents."""
    count = targets.shape[1]
    rows, right = [], []
    for t, (a, b, c) in enumerate(triangles.tolist()):
        first, second = edges[t, :, :, 0], edges[t, :, :, 1]
        for begin, end, edge in ((a, b, first), (b, c, second - first), (c, a, -second)):
            row = np.zeros(count)
            row[begin], row[end] = -1.0, 1.0
            rows.append(row)
            right.append(edge.ravel())
    found = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    found = found.reshape(count, len(targets), 3).transpose(1, 0, 2)
    labels = components(triangles, count)
    for k, target in enumerate(targets):
        norms = np.linalg.norm(target, axis=1)
        for label in range(labels.max() + 1):
            own = labels == label
            still = own & (norms <= max(1e-3 * norms.max(), 1e-9))
            chosen = still if still.any() else own
            found[k, own] += (target - found[k])[chosen].mean(axis=0)
    return found


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize("unit_mm", [1.0, 1000.0])
def test_equals_the_literal_systems(holes: bool, unit_mm: float) -> None:
    template, evidence = _scene(holes)
    settings = EbfrSettings(unit_mm=unit_mm)
    triangles, targets = template.mesh.triangles, template.deltas
    found = solve_ebfr(template.neutral, triangles, targets, evidence, settings)
    edges = _literal(template, targets, evidence, settings)
    assert np.abs(found - _vertices(edges, triangles, targets)).max() <= 1e-8


def test_each_component_keeps_its_place() -> None:
    template, evidence = _scene(holes=False)
    twice = np.concatenate([template.mesh.triangles, template.mesh.triangles + 49])
    neutral = np.concatenate([template.neutral, template.neutral + np.array([500.0, 0.0, 0.0])])
    moved = template.deltas + np.array([3.0, 0.0, 0.0])  # the second part has no still vertex
    targets = np.concatenate([template.deltas, moved], axis=1)
    both = Evidence(
        np.concatenate([evidence.offsets, evidence.offsets], axis=1),
        np.ones((7, 98)),
        evidence.weights,
    )
    found = solve_ebfr(neutral, twice, targets, both, EbfrSettings())
    alone = solve_ebfr(
        template.neutral, template.mesh.triangles, template.deltas, evidence, EbfrSettings()
    )
    assert np.abs(found[:, :49] - alone).max() <= 1e-9
    assert np.abs(found[:, 49:].mean(axis=1) - moved.mean(axis=1)).max() <= 1e-9


def test_truth_is_recovered_and_metres_leave_the_targets_alone() -> None:
    rng = np.random.default_rng(2)
    template, _ = _scene()
    targets = template.deltas
    truth = 1.3 * targets
    weights = rng.uniform(0, 1, (30, 6))
    offsets = np.tensordot(weights, truth, axes=1)
    evidence = Evidence(offsets, np.ones(offsets.shape[:2]), weights)
    errors = {}
    for unit_mm, beta in ((1.0, 1e-10), (1.0, 0.1), (10.0, 0.1), (1000.0, 0.1)):
        settings = EbfrSettings(beta=beta, unit_mm=unit_mm)
        found = solve_ebfr(template.neutral, template.mesh.triangles, targets, evidence, settings)
        errors[unit_mm, beta] = np.abs(found - truth).max()
    assert errors[1.0, 1e-10] <= 1e-3
    assert errors[1.0, 0.1] < errors[10.0, 0.1] < errors[1000.0, 0.1]
    assert errors[1000.0, 0.1] > 0.9 * np.abs(targets - truth).max()


def test_without_evidence_the_targets_stay() -> None:
    template, evidence = _scene()
    blind = Evidence(evidence.offsets, np.zeros((7, 49)), evidence.weights)
    found = solve_ebfr(
        template.neutral, template.mesh.triangles, template.deltas, blind, EbfrSettings()
    )
    assert np.abs(found - template.deltas).max() <= 1e-12


def test_a_sculpted_shape_is_one_more_row() -> None:
    template, evidence = _scene(holes=False)
    sculpted = 1.4 * template.deltas[0]
    row = Evidence(sculpted[None], np.full((1, 49), 1e4), np.eye(6)[:1], np.zeros(1))
    found = solve_ebfr(
        template.neutral, template.mesh.triangles, template.deltas, evidence.with_rows(row),
        EbfrSettings(),
    )  # fmt: skip
    assert np.abs(found[0] - sculpted).max() <= 1e-3


def test_beta_anneals_from_first_to_last() -> None:
    settings = EbfrSettings()
    betas = [settings.at_turn(turn, 5).beta for turn in range(5)]
    assert betas == pytest.approx([0.5, 0.4, 0.3, 0.2, 0.1])
    assert settings.at_turn(0, 1).beta == 0.1
    with pytest.raises(SettingsError, match=r"ebfr\.unit_mm = 0\.0"):
        EbfrSettings(unit_mm=0.0)


def test_the_edge_system_is_the_graph_laplacian() -> None:
    """Positions whose edges are given exactly come back exactly."""
    template, _ = _scene()
    triangles = template.mesh.triangles
    truth = np.random.default_rng(0).normal(size=(1, 49, 3))
    evidence = Evidence(truth, np.full((1, 49), 1e6), np.ones((1, 1)))
    found = solve_ebfr(template.neutral, triangles, truth, evidence, EbfrSettings())
    assert np.abs(found - truth).max() <= 1e-9
