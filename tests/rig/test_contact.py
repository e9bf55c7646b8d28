"""Contact rows: which poses are found closed, and that rows say what contacts mean."""

import numpy as np
import pytest

from capture.errors import ShapeError
from rig.contact import (
    Contacts,
    closed_pairs,
    contact_gaps,
    contacts_in_poses,
    template_pairs,
)
from rig.evidence import Evidence
from tests.rig.slit_face import NAMES, slit_template


def _poses(weights):
    template = slit_template()
    offsets = np.tensordot(weights, template.deltas, axes=1)
    return template, Evidence(offsets, np.ones(offsets.shape[:2]), weights)


def test_closed_poses_are_found_where_both_vertices_are_seen() -> None:
    weights = np.zeros((4, len(NAMES)))
    weights[1, NAMES.index("blink")] = 1.0
    weights[2, NAMES.index("blink")] = 0.5
    weights[3, NAMES.index("blink")] = 1.0
    template, evidence = _poses(weights)
    pairs = template_pairs(template)
    evidence.confidence[3, pairs[0, 0]] = 0.0
    found = closed_pairs(template.neutral, pairs, evidence, 0.5)
    assert found[1].all()
    assert not found[0].any()
    assert not found[2].any()
    assert found[3].tolist() == [False] + [True] * (len(pairs) - 1)


def test_rows_vanish_exactly_where_pairs_meet() -> None:
    weights = np.zeros((2, len(NAMES)))
    weights[0, NAMES.index("blink")] = 1.0
    template, _ = _poses(weights)
    pairs = template_pairs(template)
    contacts = contacts_in_poses(pairs, 2, closed=[0], kept=[1])
    rows = contacts.rows(template.neutral, weights)
    apart = np.einsum(
        "rb,brc->rc",
        rows.weights,
        template.deltas[:, rows.lower] - template.deltas[:, rows.upper],
    )
    meets = np.arange(len(rows.lower)) < len(pairs)
    assert (rows.target_mm[~meets] == 0.0).all()
    assert np.abs(apart - rows.target_mm)[:, 1].max() <= 1e-12
    assert (rows.scale == np.array([0.0, contacts.strength, 0.0])).all()
    lower = template.neutral[rows.lower] + np.einsum(
        "rb,brc->rc", rows.weights, template.deltas[:, rows.lower]
    )
    upper = template.neutral[rows.upper] + np.einsum(
        "rb,brc->rc", rows.weights, template.deltas[:, rows.upper]
    )
    assert np.abs(lower - upper)[meets].max() <= 1e-12


def test_gaps_are_what_is_left_of_what_was_asked() -> None:
    weights = np.zeros((3, len(NAMES)))
    weights[:, NAMES.index("blink")] = (1.0, 0.75, 0.0)
    template, _ = _poses(weights)
    pairs = template_pairs(template)
    contacts = contacts_in_poses(pairs, 3, closed=[0, 1])
    gaps = contact_gaps(template.neutral, template.deltas, weights, contacts)
    opening = np.abs(np.diff(template.neutral[pairs], axis=1)[:, 0, 1])
    assert np.abs(gaps[0]).max() <= 1e-12
    assert np.abs(gaps[1] - 0.25 * opening).max() <= 1e-12
    assert np.isnan(gaps[2]).all()


def test_refuses_what_does_not_fit() -> None:
    template = slit_template()
    pairs = template_pairs(template)
    with pytest.raises(ShapeError, match=r"poses must lie in 0..4, found \[-1, 5\]"):
        contacts_in_poses(pairs, 5, closed=[5], kept=[-1])
    with pytest.raises(ShapeError, match="pose 2, pair 0: either closed or kept"):
        contacts_in_poses(pairs, 5, closed=[2], kept=[2])
    wrong = contacts_in_poses(pairs + 1000, 1, closed=[0])
    with pytest.raises(ShapeError, match="vertex ids must lie in"):
        wrong.rows(template.neutral, np.ones((1, len(NAMES))))
    flags = np.zeros((1, len(pairs)), dtype=bool)
    with pytest.raises(ShapeError, match="strength = nan"):
        Contacts(pairs=pairs, closed=flags, kept=flags, strength=float("nan"))
