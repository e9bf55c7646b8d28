"""Speed of the fits with known weights: Menzel's, EBFR and Hable's against the literal rows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats
from rig.contact import Contacts, contact_gaps, template_pairs
from rig.ebfr import EbfrSettings, solve_ebfr
from rig.evidence import Evidence
from rig.hable import HableSettings, solve_hable
from rig.influence import influence_masks
from rig.menzel import MenzelSettings, solve_menzel
from rig.template import Template
from rig.transfer import transfer_shapes
from tools.bench.cost import measured
from tools.bench.rig_instances import (
    arkit_template,
    expression_weights,
    ict_apple_template,
    some_shapes,
    update_instance,
)
from tools.bench.rig_opponents import literal_hable
from tools.bench.rig_speed import timed

_MENZEL_PAPER_S, _EBFR_PAPER_S = 0.499, 1.594
_POSES = 102
_SHUT = ("eyeBlink_L", "eyeBlink_R")
_SEALED = (("mouthSmile_L", "mouthSmile_R"), ("mouthPucker",), ("mouthFrown_L", "mouthFrown_R"))


def position_lines(shared: Path) -> Iterator[dict[str, Any]]:
    """Goal 5: Menzel's fit with its deformation transfer, and EBFR, on 1,220 vertices."""
    template = arkit_template(shared)
    evidence = update_instance("arkit", template, template.support(1e-3), 51).evidence
    neutral = template.neutral * np.array([1.03, 0.98, 1.02])  # somebody else's

    def transfer() -> Floats:
        return transfer_shapes(template, neutral)

    def menzel() -> Floats:
        return solve_menzel(transfer(), evidence, MenzelSettings())

    targets, transfer_s, _ = timed(transfer)

    def ebfr() -> Floats:
        return solve_ebfr(neutral, template.mesh.triangles, targets, evidence, EbfrSettings())

    for name, work, paper in (("menzel", menzel, _MENZEL_PAPER_S), ("ebfr", ebfr, _EBFR_PAPER_S)):
        _, wall, cpu = timed(work, 4)
        yield {
            "goal": "5 position", "case": name, "wall_s": round(wall, 3), "cpu_s": round(cpu, 3),
            "of_it_transfer_s": round(transfer_s, 3) if name == "menzel" else 0.0,
            "paper_s": paper, "ratio": round(paper / wall, 1),
        }  # fmt: skip


def hable_line(shared: Path, literal: bool = True) -> dict[str, Any]:
    """Goal 6: Hable's solve with contact rows, 102 poses of 50 shapes on the narrow face."""
    template, evidence, contacts = hable_instance(shared)
    influence = influence_masks(template)
    common = (template.neutral, template.polygons, template.deltas, influence, evidence)
    settings = HableSettings()
    solve_hable(*common, settings, contacts)  # compiles
    _, cost = measured(lambda: solve_hable(*common, settings, contacts))
    sealed, wall, cpu = timed(lambda: solve_hable(*common, settings, contacts), 2)
    free, free_wall, _ = timed(lambda: solve_hable(*common, settings), 1)
    gaps = contact_gaps(template.neutral, sealed, evidence.weights, contacts)
    before = contact_gaps(template.neutral, free, evidence.weights, contacts)
    line: dict[str, Any] = {
        "goal": "6 hable", "unknowns": influence.size, "poses": len(evidence.weights),
        "wall_s": round(wall, 2), "cpu_s": round(cpu, 2), "peak_mib": cost["peak_mib"],
        "without_contacts_s": round(free_wall, 2), "contact_rows": int((~np.isnan(gaps)).sum()),
        "gap_max_mm": round(float(np.nanmax(gaps)), 4),
        "gap_max_without_mm": round(float(np.nanmax(before)), 3),
    }  # fmt: skip
    if literal:
        expected, (build, solve, processor), steps = literal_hable(
            template.polygons, template.deltas, influence, evidence, settings
        )
        line |= {
            "opponent": "lsqr x, y, z without contacts", "opponent_s": round(solve, 2),
            "opponent_build_s": round(build, 2), "opponent_iterations": steps,
            "ratio": round(solve / wall, 1), "ratio_cpu": round(processor / cpu, 1),
            "difference_mm": float(np.abs(free - expected).max()),
        }  # fmt: skip
    return line


def hable_instance(shared: Path) -> tuple[Template, Evidence, Contacts]:
    """The poses, the first four of which ask lids to meet and lips to stay together."""
    whole = ict_apple_template(shared)
    template = some_shapes(whole, 50, seed=3)
    weights = expression_weights(50, _POSES, np.random.default_rng(5))
    flagged = (_SHUT, *_SEALED)
    for pose, names in enumerate(flagged):
        weights[pose] = [float(name in names) for name in template.names]
    gains = np.random.default_rng(6).uniform(0.8, 1.2, 50)
    offsets = np.tensordot(weights * gains, template.deltas, axes=1)
    offsets += np.random.default_rng(7).normal(0.0, 0.2, offsets.shape)
    pairs = template_pairs(template)
    closed = np.zeros((_POSES, len(pairs)), dtype=bool)
    kept: Bools = np.zeros_like(closed)
    closed[0, : len(template.lid_pairs)] = True
    kept[1 : len(flagged), len(template.lid_pairs) :] = True
    contacts = Contacts(pairs=pairs, closed=closed, kept=kept)
    return template, Evidence(offsets, np.ones(offsets.shape[:2]), weights), contacts
