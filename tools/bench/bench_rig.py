"""Benchmark of the rig solver: `python -m tools.bench.bench_rig [CASE_FOLDER ...]`.

Prints one JSON line for the blendshape update against the literal sparse system of Ma et al. Eq 7
(SciPy `spsolve` on three coordinates), one for weights and head motion against the literal loop
over vertices, and one for each folder with template.npz and performance.npz: the whole stage.
Seconds are of CPU time of the process, so that they hold on a loaded machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.optimize import lsq_linear
from scipy.sparse.linalg import spsolve

from capture.arrays import Floats
from rig.evidence import Evidence
from rig.gradient import gradient_operator
from rig.neutral_frame import align_frame
from rig.stage import RigSettings, solve_rig
from rig.template import Template, read_template
from rig.update import (
    UpdatePriors,
    mean_vertex_area,
    offset_stiffness,
    update_shapes,
)
from rig.weights import WeightPriors, solve_weights, sum_frames
from track.performance import read_performance


def patch_template(side: int, shapes: int, seed: int = 1) -> Template:
    """A bulged sheet of side x side vertices with overlapping local shapes, mm."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.linspace(-110, 110, side), np.linspace(-100, 100, side), indexing="ij")
    neutral = np.column_stack([x.ravel(), y.ravel(), 80 - 0.004 * (x**2 + y**2).ravel()])
    centres = neutral[rng.choice(len(neutral), shapes), :2]
    apart = np.linalg.norm(neutral[None, :, :2] - centres[:, None], axis=2) / 75.0
    deltas = (np.clip(1 - apart**2, 0, None) ** 2)[:, :, None] * rng.normal(0, 4, (shapes, 1, 3))
    row, column = np.divmod(np.arange((side - 1) ** 2), side - 1)
    corner = row * side + column
    quads = np.stack([corner, corner + 1, corner + side + 1, corner + side], axis=1)
    names = tuple(f"shape{k:02d}" for k in range(shapes))
    return Template(neutral=neutral, deltas=deltas, names=names, polygons=quads.astype(np.int32))


def bench_update(side: int = 24, shapes: int = 40, frames: int = 60) -> dict[str, Any]:
    """One blendshape update, ours and the literal sparse system."""
    template = patch_template(side, shapes)
    rng = np.random.default_rng(2)
    support = template.support(1e-3)
    targets = np.where(support[:, :, None], template.deltas, 0.0)
    weights = rng.uniform(0, 1, (frames, shapes)) * (rng.uniform(size=(frames, shapes)) < 0.2)
    offsets = np.tensordot(weights, 1.2 * targets, axes=1)
    offsets += rng.normal(0, 0.2, offsets.shape)
    evidence = Evidence(offsets, np.ones(offsets.shape[:2]), weights)
    priors = UpdatePriors(tolerance=1e-8)
    triangles = template.mesh.triangles
    update_shapes(template.neutral, triangles, targets, support, evidence, priors)  # compiles
    ours, (neutral, deltas) = _timed(
        lambda: update_shapes(template.neutral, triangles, targets, support, evidence, priors)
    )
    literal, (expected, unknowns) = _timed(
        lambda: _literal_update(template, targets, support, evidence, priors)
    )
    found = np.concatenate([(neutral - template.neutral)[None], deltas])
    return {
        "bench": "update", "scalars": unknowns, "ours_s": ours, "literal_s": literal,
        "ratio": round(literal / ours, 1), "difference_mm": float(np.abs(found - expected).max()),
    }  # fmt: skip


def bench_weights(side: int = 80, shapes: int = 50, frames: int = 200) -> dict[str, Any]:
    """Weights and head motion of a take, ours and the literal alternation over vertices."""
    template = patch_template(side, shapes)
    rng = np.random.default_rng(3)
    truth = rng.uniform(0, 1, (frames, shapes)) * (rng.uniform(size=(frames, shapes)) < 0.15)
    points = template.neutral + np.tensordot(truth, template.deltas, axes=1)
    points += rng.normal(0, 0.3, points.shape)
    ones = np.ones(points.shape[:2])
    plain = WeightPriors(sparsity_mm2=0.0, evidence=0.0, smoothness=0.0)
    alone = np.zeros(frames, dtype=bool)

    def solve() -> Floats:
        sums = sum_frames(template.neutral, template.deltas, points, ones)
        return solve_weights(sums, alone, plain)[0]

    solve()  # compiles
    ours, found = _timed(solve)
    few = 2
    literal, expected = _timed(lambda: _literal_weights(template, points[:few]))
    return {
        "bench": "weights", "vertices": side**2, "shapes": shapes, "frames": frames,
        "fps": round(frames / ours), "literal_fps": round(few / literal, 2),
        "ratio": round((frames / ours) / (few / literal), 1),
        "difference_to_literal_after_10_turns": float(np.abs(found[:few] - expected).max()),
    }  # fmt: skip


def bench_case(folder: Path) -> dict[str, Any]:
    """The whole stage on a folder with template.npz and performance.npz."""
    template = read_template(folder / "template.npz")
    performance = read_performance(folder / "performance.npz")
    with tempfile.TemporaryDirectory() as out:
        seconds, _ = _timed(lambda: solve_rig(template, [performance], RigSettings(), Path(out)))
        report = json.loads((Path(out) / "report.json").read_text(encoding="utf-8"))
    kept = ("residual_transferred_mm", "residual_refined_mm", "ratio", "active_shapes_mean")
    return {"bench": "stage", "case": folder.name, "cpu_s": seconds} | {k: report[k] for k in kept}


def _literal_update(
    template: Template,
    targets: Floats,
    support: np.ndarray,
    evidence: Evidence,
    priors: UpdatePriors,
) -> tuple[Floats, int]:
    count, columns = len(template.neutral), len(targets) + 1
    triangles = template.mesh.triangles
    operator = gradient_operator(template.neutral, triangles)
    bending = sparse.kron(
        sparse.eye_array(columns), sparse.kron(operator.T @ operator, sparse.eye_array(3))
    ) * (priors.gradient_mm2 / mean_vertex_area(template.neutral, triangles))
    factors = np.concatenate([np.ones((len(evidence.weights), 1)), evidence.weights], axis=1)
    offset = sparse.diags_array(np.repeat(offset_stiffness(targets, priors).T.ravel(), 3))
    data = sparse.kron(sparse.csr_array(factors.T @ factors), sparse.eye_array(3 * count))
    wanted = np.concatenate([np.zeros((1, count, 3)), targets]).ravel()
    seen = np.tensordot(factors.T, evidence.offsets, axes=1).ravel()
    right = seen + bending @ wanted + offset @ wanted
    active = np.concatenate([np.ones((1, count), dtype=bool), support]).ravel()
    kept = np.flatnonzero(np.repeat(active, 3))
    out = np.zeros(len(wanted))
    matrix = sparse.csc_array(sparse.csr_array(data + bending + offset)[kept][:, kept])
    out[kept] = spsolve(matrix, right[kept])
    return out.reshape(columns, count, 3), len(kept)


def _literal_weights(template: Template, points: Floats) -> Floats:
    found = np.zeros((len(points), len(template.names)))
    columns = template.deltas.reshape(len(template.names), -1).T
    ones = np.ones(len(template.neutral))
    for frame, target in enumerate(points):
        for _ in range(10):
            posed = template.neutral + np.tensordot(found[frame], template.deltas, axes=1)
            rotation, shift = align_frame(posed, target, ones)
            local = (target @ rotation.T + shift - template.neutral).ravel()
            found[frame] = lsq_linear(columns, local, (0, 1), method="bvls").x
    return found


def _timed(work: Any) -> tuple[float, Any]:
    started = time.process_time()
    result = work()
    return round(time.process_time() - started, 3), result


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the benchmark's lines."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench.bench_rig", description=__doc__)
    parser.add_argument("cases", nargs="*", type=Path, help="folders of make_rig_case.py")
    given = parser.parse_args(arguments)
    print(json.dumps(bench_update()), flush=True)
    print(json.dumps(bench_weights()), flush=True)
    for case in given.cases:
        print(json.dumps(bench_case(case)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
