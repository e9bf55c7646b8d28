"""Unknown weights, from meshes to a rig: our own testbeds (goal 3) and the acceptance's cases."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from capture.archive import read_archive
from capture.arrays import Floats
from rig.face_rig import FaceRig, read_rig
from rig.neutral_frame import align_frame
from rig.stage import RigSettings, solve_rig
from rig.template import read_template
from tools.bench.rig_beds import Filming, HiddenRig, film, hidden_rig
from tools.bench.rig_scores import semantics, solved_scores

_RESTING = 4  # shapes of a bed that the actor never makes
_TRUTH = ("neutral", "deltas", "weights", "poses", "names", "template_neutral", "template_deltas")


def em_lines(
    bed: str, seeds: Sequence[int], shapes: int, poses: int, shared: Path
) -> Iterator[dict[str, Any]]:
    """Goal 3: the stage with its default settings on a testbed, one line a seed.

    63 expressions with head motion, 0.1 mm of white and 0.3 mm of smooth tracking error, an
    imperfect neutral, and a few shapes that nobody makes.
    """
    for seed in seeds:
        hidden = hidden_rig(bed, seed, shapes, shared)
        filmed = film(hidden, seed, poses, resting=_RESTING)
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as out:
            rig = solve_rig(
                hidden.template, [filmed.performance], RigSettings(neutral_frame=0), Path(out)
            )
            report = json.loads((Path(out) / "report.json").read_text(encoding="utf-8"))
        seconds = time.perf_counter() - started
        fit = report["residual_transferred_mm"], report["residual_refined_mm"]
        scores = solved_scores(hidden, filmed.weights, rig)
        given = filmed.performance.vertices[0] - hidden.neutral
        neutral = float(np.sqrt((given**2).sum(axis=1).mean()))
        yield {
            "goal": "3 em", "bed": bed, "seed": seed, "seconds": round(seconds, 1),
            "fit_start_mm": round(fit[0], 3), "fit_end_mm": round(fit[1], 3),
            "noise_mm": round(filmed.noise_mm, 3),
            "fit": round(fit[1] / fit[0], 3), **scores,
            "neutral/input": round(scores["neutral_mm"] / neutral, 3),
            "rotation_deg": round(_rotation_error(filmed, hidden, rig), 4),
            **semantics(hidden, filmed.weights, rig),
            "asked": "fit 0.35, shape/DT 0.85, neutral/input 0.35, active 2x",
        }  # fmt: skip


def case_lines(
    seeds: Sequence[int], arguments: Sequence[str], shared: Path, folder: Path, method: str = ""
) -> Iterator[dict[str, Any]]:
    """The acceptance's own cases: made, solved by the program, scored; one line a seed.

    Args:
        seeds: of `make_rig_case.py`.
        arguments: what else it is told, such as --smooth 0.5.
        shared: the folder with tools and data.
        folder: where cases and rigs are put; a case that is there is used again.
        method: how shapes are solved with the true weights told; empty: weights are not told.
    """
    tools = shared.resolve() / "tools"
    words = "".join(arguments).replace("--", "_").replace(" ", "")
    for seed in seeds:
        case = folder / f"case_{seed}{words}"
        if not (case / "truth.npz").exists():
            _run([str(tools / "make_rig_case.py"), str(case), "--seed", str(seed), *arguments])
        out = case / f"rig_{method}".rstrip("_")
        told = ["--weights", str(case / "weights.npz"), "--method", method] if method else []
        inputs = ["--template", case / "template.npz", "--performance", case / "performance.npz"]
        started = time.perf_counter()
        _run(["-m", "tools.cli", "rig", *map(str, inputs), *told, "--out", str(out), "--no-page"])
        seconds = time.perf_counter() - started
        score = json.loads(_run([str(tools / "score_rig.py"), str(case), str(out / "rig.npz")]))
        hidden, weights = read_case(case)
        yield {
            "goal": "5 case", "seed": seed, "known": method or "-", "seconds": round(seconds, 1),
            "gauge": round(score["shape_gauge"] / score["shape_gauge_template"], 3),
            "abs": round(score["shape_err"] / score["shape_err_template"], 3),
            "neutral_mm": score["neutral_err"], "weights_scaled": score["weights_gauge"],
            "weights": score["weights_rmse"],
            "active/true": round(score["active"] / score["active_true"], 2),
            "worse": score["corr_worse"], "fit_mm": score["fit_rmse"],
            **semantics(hidden, weights, _in_order(read_rig(out / "rig.npz"), hidden)),
        }  # fmt: skip


def read_case(case: Path) -> tuple[HiddenRig, Floats]:
    """Template and truth of a case of `make_rig_case.py`, and the true weights (F, B)."""
    template = read_template(case / "template.npz")
    truth = read_archive(case / "truth.npz", _TRUTH)
    hidden = HiddenRig(
        template, truth["neutral"].astype(np.float64), truth["deltas"].astype(np.float64)
    )
    return hidden, truth["weights"].astype(np.float64)


def _in_order(rig: FaceRig, hidden: HiddenRig) -> FaceRig:
    order = [rig.names.index(name) for name in hidden.template.names]
    return FaceRig(
        neutral=rig.neutral, deltas=rig.deltas[order], names=hidden.template.names,
        polygons=rig.polygons, weights=rig.weights[:, order], head_from_rig=rig.head_from_rig,
    )  # fmt: skip


def _rotation_error(filmed: Filming, hidden: HiddenRig, rig: FaceRig) -> float:
    """Mean angle between found and true head rotations, the rig's own place taken out, degrees."""
    turn, _ = align_frame(hidden.neutral, rig.neutral, np.ones(len(rig.neutral)))
    found = rig.head_from_rig[:, :3, :3] @ turn.T
    chord = np.linalg.norm(found - filmed.rotations, axis=(1, 2)) / np.sqrt(8.0)
    return float(np.degrees(2.0 * np.arcsin(np.clip(chord, 0.0, 1.0))).mean())


def _run(words: Sequence[str]) -> str:
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(words)}\n{done.stderr}")
    return done.stdout
