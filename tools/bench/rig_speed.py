"""Speed of the rig solver against the printed systems and public solvers, in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from capture.arrays import Floats
from capture.pose import Pose
from rig.box_qp import solve_box_qp
from rig.template import Template
from rig.update import (
    UpdatePriors,
    assemble,
    mean_vertex_area,
    prefers_direct,
    update_shapes,
)
from rig.weights import WeightPriors, solve_weights, sum_frames
from tools.bench.cost import measured
from tools.bench.rig_instances import (
    UpdateInstance,
    arkit_template,
    ict_apple_template,
    ict_path,
    patch_template,
    some_shapes,
    update_instance,
    weight_curves,
)
from tools.bench.rig_opponents import (
    cvxopt_qp,
    daqp_qp,
    kkt_residual,
    literal_update,
    literal_weights,
    missing,
    update_residual,
)
from tools.make_template import ict_template

_Value = TypeVar("_Value")
_LAMBDA_R, _LAMBDA_D = 0.1, 0.05  # Ma et al., in mm
_TOLERANCE = 1e-8  # relative residual at which the updates are compared
_TURNS = 10  # alternations of a frame in the literal loop
UPDATES = ("patch", "arkit", "tight", "narrow", "full")


def timed(work: Callable[[], _Value], repeats: int = 3) -> tuple[_Value, float, float]:
    """What the work gave, and its least seconds of wall clock and of CPU over the repeats."""
    walls, processors = [], []
    for _ in range(repeats):
        wall, processor = time.perf_counter(), time.process_time()
        value = work()
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    return value, min(walls), min(processors)


def ma_priors(template: Template) -> UpdatePriors:
    """Ma et al.'s strengths on plain sums in mm, in the solver's own normalisation."""
    area = mean_vertex_area(template.neutral, template.mesh.triangles)
    return UpdatePriors(
        gradient_mm2=_LAMBDA_R * area, offset=_LAMBDA_D, relative_mm2=0.0,
        neutral_offset=_LAMBDA_D, tolerance=_TOLERANCE,
    )  # fmt: skip


def make_update(name: str, shared: Path) -> UpdateInstance:
    """An instance by name: "patch" needs no data, the others are those of rig.md 1.2.

    Tolerances are shares of the largest motion of all shapes, but for "tight": of each its own.
    """
    if name == "patch":
        template = patch_template(24, 40)
        return update_instance(name, template, template.support(1e-3))
    if name == "full":
        template = ict_template(ict_path(shared), 26_719)
    else:
        template = arkit_template(shared) if name == "arkit" else ict_apple_template(shared)
    if name == "tight":
        template = some_shapes(template, 35, seed=0)
        return update_instance(name, template, template.support(0.303))
    share = {"arkit": 1e-5, "narrow": 1e-3, "full": 1e-4}[name]
    norms = np.linalg.norm(template.deltas, axis=2)
    return update_instance(name, template, norms > share * norms.max())


def update_line(instance: UpdateInstance, literal: bool) -> dict[str, Any]:
    """Goal 1: one blendshape update, ours and (where it is feasible) the literal `spsolve`."""
    template, evidence = instance.template, instance.evidence
    priors = ma_priors(template)
    inputs = (
        template.neutral, template.mesh.triangles, instance.targets, instance.support, evidence
    )  # fmt: skip
    small = len(template.neutral) < 10_000
    if small:
        update_shapes(*inputs, priors)  # compiles
    (neutral, deltas), cost = measured(lambda: update_shapes(*inputs, priors))
    wall, cpu = cost["wall_s"], cost["cpu_s"]
    if small:
        _, wall, cpu = timed(lambda: update_shapes(*inputs, priors))
    found = np.concatenate([(neutral - template.neutral)[None], deltas])
    system = assemble(*inputs, priors)
    line = {
        "goal": "1 update", "case": instance.name, "scalars": instance.scalars,
        "active_per_vertex": round(float(instance.support.sum(axis=0).mean()), 1),
        "path": "direct" if prefers_direct(system, priors.tolerance) else "iterative",
        "wall_s": round(wall, 3), "cpu_s": round(cpu, 3), "peak_mib": cost["peak_mib"],
        "residual": update_residual(
            template, found, instance.support, evidence, priors, instance.targets
        ),
    }  # fmt: skip
    if literal:
        targets, support = instance.targets, instance.support
        expected, (seconds, processor) = literal_update(
            template, targets, support, evidence, priors
        )
        line |= {
            "opponent": "spsolve", "opponent_s": round(seconds, 2),
            "ratio": round(seconds / wall, 1), "ratio_cpu": round(processor / cpu, 1),
            "difference": float(np.abs(found - expected).max() / np.abs(expected).max()),
        }  # fmt: skip
    return line


def update_lines(shared: Path, cases: tuple[str, ...], literal: bool) -> Iterator[dict[str, Any]]:
    """Goal 1 on the instances asked for."""
    for name in cases:
        yield update_line(make_update(name, shared), literal and name not in ("narrow", "full"))


def speed_template(shared: Path | None) -> Template:
    """Whose take and Gram goal 2 is measured on: ICT's narrow face, or a sheet without data."""
    return patch_template(82, 51) if shared is None else ict_apple_template(shared)


def weights_line(template: Template, frames: int, few: int = 4) -> dict[str, Any]:
    """Goal 2: weights and head motion of a take, ours and the literal loop with CVXOPT."""
    rng = np.random.default_rng(3)
    truth = weight_curves(len(template.names), frames, 4, rng)
    points, turned = _moving_take(template, truth, rng)
    confidence = np.ones(points.shape[:2])
    following = np.arange(frames) > 0
    count = len(template.neutral)
    paper = WeightPriors(
        sparsity_mm2=0.1 / count, evidence=0.0, debias=False, smoothness=0.0, tolerance=1e-4
    )

    def solve(priors: WeightPriors) -> tuple[Floats, Floats]:
        sums = sum_frames(template.neutral, template.deltas, points, confidence)
        return solve_weights(sums, following, priors)

    sums = sum_frames(template.neutral, template.deltas, points[:300], confidence[:300])
    solve_weights(sums, following[:300], paper)  # compiles
    (found, motions), wall, cpu = timed(lambda: solve(paper), 2)
    (chosen, _), usual_wall, _ = timed(lambda: solve(WeightPriors()), 1)
    line: dict[str, Any] = {
        "goal": "2 weights", "vertices": count, "shapes": len(template.names), "frames": frames,
        "fps": round(frames / wall), "cpu_ms": round(1e3 * cpu / frames, 3),
        "fps_default": round(frames / usual_wall),
        "rotation_deg": round(float(_angles_deg(motions[:, :3, :3], turned).mean()), 4),
        "weights_rmse": round(float(np.sqrt(((found - truth) ** 2).mean())), 4),
        "weights_rmse_default": round(float(np.sqrt(((chosen - truth) ** 2).mean())), 4),
        "outside": int(((found < 0) | (found > 1) | (chosen < 0) | (chosen > 1)).sum()),
    }  # fmt: skip
    if word := missing("cvxopt"):
        return line | {"opponent": word}
    step = max(1, frames // few)
    (expected, rotations), seconds, processor = timed(
        lambda: literal_weights(template, points[::step], 0.1, _TURNS), 1
    )
    fps = len(expected) / seconds
    return line | {
        "opponent": "numpy + cvxopt", "opponent_fps": round(fps, 1),
        "ratio": round(frames / wall / fps, 1),
        "ratio_cpu": round(processor / len(expected) / (cpu / frames), 1),
        "opponent_rotation_deg": round(float(_angles_deg(rotations, turned[::step]).mean()), 4),
        "difference": float(np.abs(found[::step] - expected).max()),
    }  # fmt: skip


def qp_line(template: Template, active: int, frames: int = 2000) -> dict[str, Any]:
    """Goal 2: one box QP a frame on the Gram of the shapes, warm from the frame before."""
    rng = np.random.default_rng(active)
    truth = weight_curves(len(template.names), frames, active, rng)
    columns = template.deltas.reshape(len(template.names), -1)
    gram = columns @ columns.T
    noise = rng.normal(0.0, 0.5, truth.shape) @ np.linalg.cholesky(gram).T  # 0.5 mm on vertices
    linears = truth @ gram + noise
    zeros, ones = np.zeros_like(linears), np.ones_like(linears)
    cold = solve_box_qp(gram[None], linears, zeros, ones, zeros)
    warm = np.concatenate([cold[:1], cold[:-1]])
    found, _, cpu = timed(lambda: solve_box_qp(gram[None], linears, zeros, ones, warm), 5)
    line: dict[str, Any] = {
        "goal": "2 qp", "case": f"{active} active", "us": round(1e6 * cpu / frames, 1),
        "kkt": kkt_residual(gram, linears, found),
        "outside": int(((found < 0) | (found > 1)).sum()),
    }  # fmt: skip
    makers = {"daqp": daqp_qp, "cvxopt": cvxopt_qp}
    for name, make in makers.items():
        if word := missing(name):
            line[name] = word
            continue
        solve = make(gram)
        rows = linears[:: 1 if name == "daqp" else 10]
        started = time.process_time()
        answers = np.stack([solve(row) for row in rows])
        seconds = time.process_time() - started
        line[f"{name}_us"] = round(1e6 * seconds / len(rows), 1)
        line[f"{name}_ratio"] = round(seconds / len(rows) / (cpu / frames), 1)
        line[f"{name}_kkt"] = kkt_residual(gram, rows, answers)
    return line


def _moving_take(
    template: Template, weights: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Frames (F, V, 3) with head motion and 0.5 mm of noise, and the rotations (F, 3, 3)."""
    phase = np.linspace(0.0, 8.0 * np.pi, len(weights))
    turns = np.stack([0.12 * np.sin(phase), 0.2 * np.sin(0.7 * phase), 0.05 * np.cos(phase)], 1)
    shifts = 8.0 * np.stack([np.cos(phase), np.sin(phase), np.sin(2.0 * phase)], 1)
    points = np.empty((len(weights), len(template.neutral), 3))
    rotations = np.empty((len(weights), 3, 3))
    for frame, row in enumerate(weights):
        head = Pose.from_rotation_vector(turns[frame], shifts[frame])
        posed = template.neutral + np.tensordot(row, template.deltas, axes=1)
        points[frame] = head.apply(posed) + rng.normal(0.0, 0.5, posed.shape)
        rotations[frame] = head.matrix()[:3, :3]
    return points, rotations


def _angles_deg(found: Floats, truth: Floats) -> Floats:
    cosine = (np.einsum("fab,fab->f", found, truth) - 1.0) / 2.0
    skew = np.linalg.norm(found - truth, axis=(1, 2)) / np.sqrt(8.0)
    angles: Floats = np.degrees(2.0 * np.arctan2(skew, np.sqrt(np.maximum((1 + cosine) / 2, 0))))
    return angles
