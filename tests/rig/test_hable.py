"""Hable's solve against all its rows written out in one matrix a coordinate."""

import numpy as np
import pytest

from capture.errors import SettingsError, ShapeError, SolveError
from rig.contact import ContactRows, Contacts, contact_gaps, contacts_in_poses, template_pairs
from rig.evidence import Evidence
from rig.hable import HableSettings, solve_hable
from rig.influence import influence_masks, neighbours
from tests.rig.grid_face import grid_template
from tests.rig.slit_face import NAMES, slit_template

EXACT = HableSettings(tolerance_mm=1e-9)


def _scene(holes: bool = True, poses: int = 8):
    rng = np.random.default_rng(21)
    template = slit_template()
    weights = rng.uniform(0.1, 1, (poses, len(NAMES))) * (rng.random((poses, len(NAMES))) < 0.6)
    weights[:3, 0] = 1.0
    weights[3, 1] = 5e-6  # below the floor: the pose does not show it
    offsets = np.tensordot(weights, 1.3 * template.deltas, axes=1)
    offsets += rng.normal(0, 0.3, offsets.shape)
    confidence = rng.uniform(0, 1, offsets.shape[:2]) if holes else np.ones(offsets.shape[:2])
    if holes:
        confidence[:, :4] = 0.0
    return template, influence_masks(template, rings=1), Evidence(offsets, confidence, weights)


def _literal(template, influence, evidence, settings, contacts=None):
    """Loops over rows as in the article; shapes held outside the mask are known, not unknown."""
    sources, link = template.deltas, neighbours(template.polygons, 64).toarray()
    shapes, count = influence.shape
    acts = influence >= settings.influence_floor
    used = np.where(evidence.weights >= settings.weight_floor, evidence.weights, 0.0)
    out = np.empty_like(sources)
    for c in range(3):
        rows, right = [], []

        def add(entries, value, scale, rows=rows, right=right):
            row = np.zeros(shapes * count)
            for k, v, factor in entries:
                row[k * count + v] += factor
            rows.append(scale * row)
            right.append(scale * value)

        for f, w in enumerate(used):
            for v in range(count):
                seen = [(k, v, w[k]) for k in range(shapes) if acts[k, v] or settings.hold_outside]
                add(seen, evidence.offsets[f, v, c], evidence.confidence[f, v])
        for k in range(shapes):
            for v in range(count):
                share = np.sqrt(influence[k, v])
                scale = settings.source_outside * (1 - share) + settings.source_inside * share
                add([(k, v, 1.0)], sources[k, v, c], scale)
                around = np.flatnonzero(link[v])
                if len(around):
                    entries = [(k, v, 1.0)] + [(k, u, -1.0 / len(around)) for u in around]
                    add(
                        entries,
                        sum(x * sources[k, u, c] for _, u, x in entries),
                        settings.laplacian,
                    )
        if contacts is not None:
            for w, a, b, s, target in zip(
                contacts.weights, contacts.upper, contacts.lower, contacts.scale,
                contacts.target_mm, strict=True,
            ):  # fmt: skip
                entries = [(k, b, w[k]) for k in range(shapes)]
                entries += [(k, a, -w[k]) for k in range(shapes)]
                add(entries, target[c], s[c])
        matrix, values = np.array(rows), np.array(right)
        known = sources[:, :, c].ravel()
        free = acts.ravel() if settings.hold_outside else np.ones(len(known), dtype=bool)
        matrix, values = matrix[:, free], values - matrix[:, ~free] @ known[~free]
        known[free] = np.linalg.solve(matrix.T @ matrix, matrix.T @ values)
        out[:, :, c] = known.reshape(shapes, count)
    return out


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("touch", [False, True])
def test_equals_the_rows_written_out(holes: bool, hold: bool, touch: bool) -> None:
    template, influence, evidence = _scene(holes)
    settings = HableSettings(tolerance_mm=1e-9, hold_outside=hold)
    contacts = contacts_in_poses(template_pairs(template), 8, closed=[0, 1, 2], kept=[5])
    given = contacts if touch else None
    found = solve_hable(
        template.neutral, template.polygons, template.deltas, influence, evidence, settings, given
    )
    used = np.where(evidence.weights >= 1e-5, evidence.weights, 0.0)
    rows = contacts.rows(template.neutral, used) if touch else None
    expected = _literal(template, influence, evidence, settings, rows)
    assert np.abs(found - expected).max() <= 1e-6
    assert np.abs(found - template.deltas).max() > 0.5


def test_rows_of_any_pose_axis_and_strength_and_vertices_shared_by_pairs() -> None:
    template, influence, evidence = _scene()
    rng = np.random.default_rng(3)
    pairs = template_pairs(template)
    upper = np.concatenate([pairs[:, 0], pairs[:2, 0], [10, 10]])
    lower = np.concatenate([pairs[:, 1], pairs[1:3, 1], [11, 10]])  # the last says nothing
    rows = ContactRows(
        weights=rng.random((len(upper), len(NAMES))), upper=upper, lower=lower,
        scale=rng.random((len(upper), 3)) * np.array([3.0, 30.0, 0.0]),
        target_mm=rng.normal(size=(len(upper), 3)),
    )  # fmt: skip
    rows = rows.with_rows(rows)
    found = solve_hable(
        template.neutral, template.polygons, template.deltas, influence, evidence, EXACT, rows
    )
    assert np.abs(found - _literal(template, influence, evidence, EXACT, rows)).max() <= 1e-6


def test_flagged_pairs_meet_and_others_are_left_alone() -> None:
    template, influence, evidence = _scene(holes=False)
    pairs = template_pairs(template)
    ask = contacts_in_poses(pairs, 8, closed=[0, 1, 2])
    given = (template.neutral, template.polygons, template.deltas, influence, evidence, EXACT)
    gap = [
        np.nanmax(contact_gaps(template.neutral, shapes, evidence.weights, ask))
        for shapes in (solve_hable(*given), solve_hable(*given, ask))
    ]
    assert gap[0] > 0.5
    assert gap[1] <= 0.1
    every = Contacts(pairs=pairs, closed=ask.closed, kept=ask.kept, axes=(True, True, True))
    shapes = solve_hable(*given, every)
    assert np.nanmax(contact_gaps(template.neutral, shapes, evidence.weights, every)) <= 0.1


def test_holding_is_the_limit_of_a_firm_source() -> None:
    template, influence, evidence = _scene()
    inside = np.where(influence >= 1e-4, 1.0, 0.0)  # so that the strength within stays 1
    offsets = evidence.offsets - np.tensordot(
        evidence.weights, np.where((inside == 0.0)[:, :, None], template.deltas, 0.0), axes=1
    )
    clean = Evidence(offsets, evidence.confidence, evidence.weights)
    firm, held = (
        solve_hable(
            template.neutral, template.polygons, template.deltas, inside, shown,
            HableSettings(tolerance_mm=1e-9, source_outside=outside, hold_outside=hold),
        )
        for shown, outside, hold in ((clean, 1e5, False), (evidence, 10.0, True))
    )  # fmt: skip
    assert np.abs(firm - held).max() <= 1e-4
    assert (held[inside == 0.0] == template.deltas[inside == 0.0]).all()


def test_truth_is_recovered_when_sources_are_weak() -> None:
    rng = np.random.default_rng(2)
    template = grid_template(12)
    truth = template.deltas * np.linspace(0.8, 1.3, 6)[:, None, None]
    weights = rng.uniform(0, 1, (40, 6))
    offsets = np.tensordot(weights, truth, axes=1)
    evidence = Evidence(offsets, np.ones(offsets.shape[:2]), weights)
    weak = HableSettings(source_inside=1e-3, source_outside=1e-3, laplacian=1e-3, tolerance_mm=1e-9)
    found = solve_hable(
        template.neutral, template.polygons, template.deltas, np.ones((6, 144)), evidence, weak
    )
    assert np.abs(found - truth).max() <= 1e-3


def test_without_evidence_the_sources_stay() -> None:
    template, influence, evidence = _scene()
    blind = Evidence(evidence.offsets, np.zeros((8, 64)), evidence.weights)
    found = solve_hable(
        template.neutral, template.polygons, template.deltas, influence, blind, EXACT
    )
    assert (found == template.deltas).all()


def test_a_sculpted_shape_is_one_more_row() -> None:
    template, influence, evidence = _scene(holes=False)
    sculpted = template.deltas[1] + np.array([0.0, 0.0, 2.0])
    row = Evidence(sculpted[None], np.full((1, 64), 100.0), np.eye(4)[1:2], np.zeros(1))
    found = solve_hable(
        template.neutral, template.polygons, template.deltas, influence,
        evidence.with_rows(row), EXACT,
    )  # fmt: skip
    inside = influence[1] >= 1e-4
    assert np.abs(found[1] - sculpted)[inside].max() <= 0.05


def test_same_input_same_bytes_with_threads() -> None:
    template = grid_template(20)
    rng = np.random.default_rng(6)
    weights = rng.random((9, 6))
    evidence = Evidence(rng.normal(size=(9, 400, 3)), rng.random((9, 400)), weights)
    given = (template.neutral, template.polygons, template.deltas, influence_masks(template))
    first = solve_hable(*given, evidence, HableSettings())
    assert first.tobytes() == solve_hable(*given, evidence, HableSettings()).tobytes()


def test_refuses_what_does_not_fit_and_says_when_it_does_not_converge() -> None:
    template, influence, evidence = _scene()
    given = (template.neutral, template.polygons, template.deltas)
    with pytest.raises(ShapeError, match="V = 64 as in neutral"):
        solve_hable(*given, influence[:, :9], evidence, EXACT)
    with pytest.raises(SettingsError, match=r"hable\.laplacian = -1\.0"):
        HableSettings(laplacian=-1.0)
    with pytest.raises(SolveError, match="remain after 2 iterations"):
        solve_hable(*given, influence, evidence, HableSettings(tolerance_mm=1e-9, iterations=2))
