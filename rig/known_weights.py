"""Shapes from frames whose weights are known, by the method of one's choice."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats
from capture.progress import Progress, silent
from rig.contact import ContactRows, Contacts, closed_pairs, template_pairs
from rig.ebfr import EbfrSettings, solve_ebfr
from rig.evidence import Evidence
from rig.fit import undo_motion
from rig.hable import HableSettings, solve_hable
from rig.influence import influence_masks
from rig.menzel import MenzelSettings, solve_menzel
from rig.overrides import overridden, override_evidence, sculpted
from rig.solve import Problem, Solution, pose_problem, transferred

_ROUNDS = 3  # of head motion and shapes: the motion hardly depends on the shapes
_MENZEL_STRENGTH = 0.03  # of E_reg; the paper's implicit 1 hardly leaves the transfer


def solve_known(
    problem: Problem, neutral: Floats, method: str, progress: Progress = silent
) -> Solution:
    """Place the heads, solve the shapes, and again until both agree; the neutral is kept.

    Args:
        problem: with `seen.weights` known.
        neutral: (V, 3) the actor's neutral in template space, mm.
        method: "hable", "menzel", "ebfr" or "transfer".
        progress: told after each round.

    References:
        Hable, Solving blendshapes for ARKit; Menzel et al. 2022; Li et al. 2010.
    """
    schedule, template = problem.schedule, problem.template
    targets = transferred(template, neutral, schedule)
    fit = first = pose_problem(problem, (neutral, targets), schedule.weights)
    progress(0, _ROUNDS, "rig")
    for turn in range(_ROUNDS if method != "transfer" else 0):
        evidence = Evidence(undo_motion(fit, problem.seen), problem.seen.confidence, fit.weights)
        contacts = _contacts(problem, neutral, evidence)
        if problem.overrides:  # the rows of contacts are weights, and stay valid
            evidence = evidence.with_rows(override_evidence(problem.overrides, template.names))
        deltas = _solve(problem, fit.neutral, targets, evidence, (method, contacts))
        fit = pose_problem(problem, (neutral, deltas), schedule.weights)
        progress(turn + 1, _ROUNDS, "rig")
    progress(_ROUNDS, _ROUNDS, "rig")
    return Solution(first=first, fit=fit, turns=[], targets=targets, settled=True)


def _solve(
    problem: Problem,
    neutral: Floats,
    targets: Floats,
    evidence: Evidence,
    chosen: tuple[str, ContactRows | None],
) -> Floats:
    method, contacts = chosen
    template = problem.template
    told = overridden(problem.overrides, template.names, len(neutral))
    if method == "hable":
        masks = np.maximum(influence_masks(template), told)
        return solve_hable(
            neutral, template.polygons, targets, masks, evidence, HableSettings(), contacts
        )
    if method == "menzel":
        settings = MenzelSettings(strength=_MENZEL_STRENGTH)
        sculpts = sculpted(targets, problem.overrides, template.names)
        return solve_menzel(targets, evidence, settings, sculpts)
    return solve_ebfr(neutral, template.mesh.triangles, targets, evidence, EbfrSettings(beta=0.01))


def _contacts(problem: Problem, neutral: Floats, evidence: Evidence) -> ContactRows | None:
    """Lips and lids of the template that the frames show shut are to shut in the rig, too."""
    pairs = template_pairs(problem.template)
    if not pairs.size:
        return None
    closed = closed_pairs(neutral, pairs, evidence)
    if not closed.any():
        return None
    contacts = Contacts(pairs=pairs, closed=closed, kept=np.zeros_like(closed))
    return contacts.rows(neutral, evidence.weights)
