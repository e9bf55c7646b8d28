"""The rig stage: template and tracked performances in, the actor's own rig out."""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Bools, Floats
from capture.errors import InputError, raise_all
from capture.product import is_current, stage_record, write_record
from capture.progress import Progress, silent
from rig.face_rig import FaceRig, read_rig, write_rig
from rig.fit import Fit, Observations, weighted_rms
from rig.gauge import shape_sizes
from rig.health import rig_health
from rig.hold_out import choose_strengths
from rig.known_weights import solve_known
from rig.links import find_links
from rig.neutral_frame import approximate_neutral, choose_neutral_frame
from rig.overrides import Override, check_overrides
from rig.report import describe_solve, write_report
from rig.rig_settings import RigSettings
from rig.solve import Problem, Solution, personalise, pose_frames
from rig.template import Template, write_template
from rig.weight_table import WeightTable
from rig.weights import WeightLinks, WeightPriors
from track.performance import Performance

__all__ = ["RigSettings", "check_match", "observe", "solve_rig"]


def solve_rig(
    template: Template,
    performances: Sequence[Performance],
    settings: RigSettings,
    out: Path,
    *,
    weights: WeightTable | None = None,
    overrides: Sequence[Override] = (),
    held_out: Sequence[Performance] = (),
    progress: Progress = silent,
) -> FaceRig:
    """Personalise a template to the performances of one actor.

    Writes OUT/rig.npz, OUT/transferred.npz (the template on the actor, before any refinement: a
    template file) and OUT/report.json.

    Args:
        template: the artist's rig, mm.
        performances: tracked takes of one actor in the template's vertex order, world mm.
        settings: strengths and when to stop.
        out: folder to write in.
        weights: where they are known beforehand, one row a frame of all performances in order.
        overrides: shapes as the artist wants them; left out, the rig without them comes back.
        held_out: performances that are not solved on; the report says how well they are reached.
        progress: told after each turn.

    Returns:
        the rig in the template's space; shapes that move nothing are kept as zeros, with weight 0.

    Raises:
        InputError: when vertex counts, frame counts or shape names do not fit, no vertex of any
            frame has confidence, or a method wants known weights and has none.

    References:
        Ma et al. 2016, Semantically-aware blendshape rigs from facial performance measurements.
    """
    started = time.monotonic()
    check_match(template, performances)
    if held_out:
        check_match(template, held_out, [f"held-out {n + 1}" for n in range(len(held_out))])
    check_overrides(overrides, template.names, template.moves(), len(template.neutral))
    known = _known_weights(template, performances, weights)
    _check_method(settings.method, known is not None, bool(overrides))
    product = Path(out) / "rig.npz"
    inputs = _hashes(template, performances, known) | _override_hashes(overrides)
    inputs |= {f"held_out_{n}": _performance_hash(p) for n, p in enumerate(held_out)}
    record = stage_record("rig", settings, inputs)
    products = [product, Path(out) / "transferred.npz", Path(out) / "report.json"]
    if is_current(product, record) and all(path.exists() for path in products):
        progress(1, 1, "rig")
        return read_rig(product)
    moving = template.moves()
    solvable = template.with_shapes(moving)
    seen = observe(performances, None if known is None else known[:, moving])
    frame = _neutral_frame(solvable, seen, settings.neutral_frame)
    neutral = approximate_neutral(solvable, seen.points[frame], seen.confidence[frame])
    problem = Problem(
        template=solvable, seen=seen, schedule=settings.schedule(), overrides=tuple(overrides),
        links=_links(template, moving, settings), rigid=_rigid(template, settings),
    )  # fmt: skip
    solution, chosen = _solve(problem, neutral, settings, progress)
    rig = _whole_rig(template, moving, solution.fit)
    report = describe_solve(template, moving, seen, (solution.first, solution.fit), solution.turns)
    report |= _told(problem, solution, settings)
    report |= {"neutral_frame": frame, "hold_out": chosen}
    report["topology_matches"] = _same_topology(template, performances)
    carried = _whole_deltas(template, moving, solution.targets)
    report["health"] = rig_health(
        rig, template, seen=seen, held_out=observe(held_out) if held_out else None,
        priors=settings.schedule().weights, transferred=carried, variation=settings.variation,
    )  # fmt: skip
    report["seconds"] = round(time.monotonic() - started, 3)
    write_report(products[2], report)
    write_template(products[1], replace(template, neutral=rig.neutral, deltas=carried))
    write_rig(product, rig)
    write_record(product, record)
    return read_rig(product)  # as a second run finds it


def _solve(
    problem: Problem, neutral: Floats, settings: RigSettings, progress: Progress
) -> tuple[Solution, dict[str, Any] | None]:
    """Solve by the method asked for; with hold-out, solve again with the strengths it chose."""
    if settings.method != "ma":
        return solve_known(problem, neutral, settings.method, progress), None
    solution = personalise(problem, neutral, progress)
    if not settings.hold_out:
        return solution, None
    sizes = shape_sizes(solution.fit.deltas, solution.targets)
    scaled = solution.targets * sizes[:, None, None]
    schedule, trials = choose_strengths(problem, solution.fit, scaled, progress)
    chosen = {
        "variation": schedule.variation,
        "gradient_mm2": schedule.update.gradient_mm2,
        "trials": [dataclasses.asdict(trial) for trial in trials],
    }
    return personalise(replace(problem, schedule=schedule), neutral, progress), chosen


def _check_method(method: str, known: bool, overridden: bool) -> None:
    if overridden and method == "transfer":
        raise InputError('rig.method = "transfer" solves nothing that could obey an override')
    if not known and method != "ma":
        raise InputError(
            f'rig.method = "{method}" wants known weights (--weights W.npz); without them only '
            '"ma" solves'
        )


def _told(problem: Problem, solution: Solution, settings: RigSettings) -> dict[str, Any]:
    """What the solve itself says, for the report."""
    return {
        "method": settings.method,
        "settled": solution.settled,
        "unseen_frames": int((~problem.seen.confidence.any(axis=1)).sum()),
        "overrides": [item.name for item in problem.overrides],
        "best_fit": _best_fit(problem.seen, solution.first, solution.fit),
    }


def check_match(
    template: Template,
    performances: Sequence[Performance],
    names: Sequence[str] = (),
) -> None:
    """Refuse performances that are not in the template's vertex order.

    Args:
        template: the artist's rig.
        performances: tracked takes.
        names: what to call each performance (its file); "performance 1" and so on when empty.

    Raises:
        InputError: giving both vertex counts, for every performance that does not fit.
    """
    if not performances:
        raise InputError("rig: needs at least one performance, found none")
    called = list(names) or [f"performance {i + 1}" for i in range(len(performances))]
    wanted = len(template.neutral)
    problems = [
        f"template has {wanted} vertices, {name} {performance.vertices.shape[1]}: both must be in "
        f"one topology; make the template from the mesh that was tracked"
        for name, performance in zip(called, performances, strict=True)
        if performance.vertices.shape[1] != wanted
    ]
    raise_all("rig", problems)
    if not any((_confidence(p) > 0).any() for p in performances):
        raise InputError("rig: no vertex of any frame has confidence above 0: nothing to fit")
    if not template.moves().any():
        raise InputError("rig: no shape of the template moves any vertex: nothing to personalise")


def observe(performances: Sequence[Performance], known: Floats | None = None) -> Observations:
    """All frames of all performances, one after the other; contiguity ends at each boundary."""
    points = np.concatenate([p.vertices for p in performances]).astype(np.float64)
    confidence = np.concatenate([_confidence(p) for p in performances])
    points[confidence <= 0.0] = 0.0
    contiguous = np.concatenate(
        [np.concatenate([[False], np.diff(p.frames) == 1])[: len(p.frames)] for p in performances]
    )
    return Observations(points, confidence, contiguous, known)


def _confidence(performance: Performance) -> Floats:
    """Confidence in 0..1, 0 where it or the vertex is not a number."""
    given = np.nan_to_num(np.asarray(performance.confidence, dtype=np.float64), nan=0.0)
    finite = np.isfinite(performance.vertices).all(axis=2)
    sure: Floats = np.where(finite, np.clip(given, 0.0, 1.0), 0.0)
    return sure


def _known_weights(
    template: Template, performances: Sequence[Performance], weights: WeightTable | None
) -> Floats | None:
    if weights is None:
        return None
    frames = sum(len(p.frames) for p in performances)
    if len(weights.weights) != frames:
        raise InputError(
            f"weights: {len(weights.weights)} rows for {frames} frames of "
            f"{len(performances)} performances; one row a frame, in order"
        )
    found: Floats = weights.columns(template.names)
    if found.min(initial=0.0) < 0.0 or found.max(initial=0.0) > 1.0:
        raise InputError(f"weights: must lie in 0..1, found {found.min():.4g}..{found.max():.4g}")
    return found


def _neutral_frame(template: Template, seen: Observations, asked: int) -> int:
    if asked < 0 and seen.weights is not None:
        total = np.where(seen.confidence.any(axis=1), seen.weights.sum(axis=1), np.inf)
        return int(np.argmin(total))
    if asked < 0:
        return choose_neutral_frame(template, seen.points, seen.confidence)
    if asked >= len(seen.points):
        raise InputError(
            f"neutral_frame {asked}: the performances hold frames 0..{len(seen.points) - 1}"
        )
    if not (seen.confidence[asked] > 0).any():
        raise InputError(f"neutral_frame {asked}: no vertex of that frame has confidence above 0")
    return asked


def _best_fit(seen: Observations, *fits: Fit) -> dict[str, float]:
    """Residuals with no prior on the weights: what each set of shapes can reach at best."""
    free = WeightPriors(sparsity_mm2=0.0, evidence=0.0, smoothness=0.0, debias=False)
    reached = []
    for fit in fits:
        posed = pose_frames(fit.neutral, fit.deltas, seen, free, fit.weights)
        reached.append(weighted_rms(posed.residuals(seen.points), seen.confidence))
    before, after = reached
    return {
        "residual_transferred_mm": before,
        "residual_refined_mm": after,
        "ratio": after / before if before > 0 else 0.0,
    }


def _links(template: Template, moving: Bools, settings: RigSettings) -> WeightLinks:
    found = find_links(template, moving, settings.exclusive)
    return found if settings.symmetry > 0.0 else replace(found, symmetric=found.symmetric[:0])


def _rigid(template: Template, settings: RigSettings) -> bool:
    if settings.head == "rigid" and template.rigid_vertices.size < 3:
        raise InputError(
            'rig.head = "rigid" wants a template with three or more rigid_vertices, this one has '
            f'{template.rigid_vertices.size}; add them to the template, or use head = "all"'
        )
    return settings.head == "rigid"


def _whole_deltas(template: Template, moving: Bools, some: Floats) -> Floats:
    deltas = np.zeros(template.deltas.shape)
    deltas[moving] = some
    return deltas


def _whole_rig(template: Template, moving: Bools, fit: Fit) -> FaceRig:
    weights = np.zeros((len(fit.weights), len(template.names)))
    weights[:, moving] = fit.weights
    return FaceRig(
        neutral=fit.neutral,
        deltas=_whole_deltas(template, moving, fit.deltas),
        names=template.names,
        polygons=template.polygons,
        weights=weights,
        head_from_rig=fit.motions,
    )


def _same_topology(template: Template, performances: Sequence[Performance]) -> bool:
    own = {frozenset(p) - {-1} for p in template.polygons.tolist()}
    return all({frozenset(q) - {-1} for q in p.polygons.tolist()} == own for p in performances)


def _hashes(
    template: Template, performances: Sequence[Performance], known: Floats | None
) -> dict[str, str]:
    inputs = {
        "template": _digest(
            template.neutral, template.deltas, np.array(template.names, dtype=np.str_),
            template.polygons, template.rigid_vertices, template.lid_pairs, template.lip_pairs,
        )
    }  # fmt: skip
    for number, p in enumerate(performances):
        inputs[f"performance_{number}"] = _performance_hash(p)
    if known is not None:
        inputs["weights"] = _digest(known)
    return inputs


def _performance_hash(performance: Performance) -> str:
    return _digest(
        performance.vertices, performance.confidence, performance.frames, performance.polygons
    )


def _override_hashes(overrides: Sequence[Override]) -> dict[str, str]:
    return {
        f"override_{item.name}": _digest(
            np.where(item.touched[:, None], item.delta, 0.0), item.touched, np.array(item.strength)
        )
        for item in overrides
    }


def _digest(*arrays: NDArray[Any]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
