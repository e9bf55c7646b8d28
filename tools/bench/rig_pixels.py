"""From pixels: a rig solved on tracked takes reproduces an expression that it never saw.

Takes of one actor are rendered by `render_take.py`, imported and tracked by the program, and the
rig is solved on all but the held-out ones. Then weights and head motion of each held-out take are
solved twice with the same priors, shapes and neutral fixed: for the solved rig, and for the
template transferred to the solver's own neutral. Takes that are there already are used again, so
an interrupted run goes on where it was.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from capture.archive import read_archive
from capture.arrays import Floats
from rig.face_rig import FaceRig
from rig.solve import pose_frames, weighted_rms
from rig.stage import RigSettings, observe, solve_rig
from rig.template import Template
from rig.transfer import transfer_shapes
from tools.bench.rig_beds import personal_shapes
from tools.bench.rig_instances import ict_path
from tools.make_template import ict_template
from track.performance import Performance, read_performance

ACTOR_SEED = 57
_SIZE_PX, _FRAMES = 640, 8
_TRACKED_VERTICES = 11_248
_TRUTH_KEYS = ("vertices",)
_TRUTH_REST = (
    "surface", "surface_tri", "faces", "landmarks68", "weights", "names", "R", "t", "pivot",
    "identity",
)  # fmt: skip
TRAINING = {
    "smile_open": "jawOpen:0.8,mouthSmile_L:0.8,mouthSmile_R:0.7,cheekSquint_L:0.5,"
    "cheekSquint_R:0.5",
    "brows_up": "browInnerUp_L:0.9,browInnerUp_R:0.9,browOuterUp_L:0.8,browOuterUp_R:0.7,"
    "eyeWide_L:0.7,eyeWide_R:0.7",
    "frown": "browDown_L:0.8,browDown_R:0.9,mouthFrown_L:0.8,mouthFrown_R:0.8,mouthShrugLower:0.6",
    "sneer": "noseSneer_L:0.9,noseSneer_R:0.8,mouthUpperUp_L:0.7,mouthUpperUp_R:0.8,"
    "eyeSquint_L:0.7,eyeSquint_R:0.7",
    "stretch": "mouthStretch_L:0.8,mouthStretch_R:0.8,mouthLowerDown_L:0.8,mouthLowerDown_R:0.7,"
    "jawOpen:0.3",
    "side": "mouthLeft:0.7,mouthSmile_L:0.5,cheekPuff_R:0.7",
    "funnel": "mouthFunnel:0.8,jawOpen:0.5,jawLeft:0.5",
    "pucker": "mouthPucker:0.9,jawForward:0.5,cheekPuff_L:0.4",
}
ALONE = {  # what a range of motion asks for by itself, and the takes above show in company only
    "smile": "mouthSmile_L:0.7,mouthSmile_R:0.8",
    "inner_brows": "browInnerUp_L:0.8,browInnerUp_R:0.8,jawOpen:0.2",
    "wrinkle": "noseSneer_L:0.7,noseSneer_R:0.8,mouthShrugLower:0.5",
}
HELD_OUT = {
    "held_grin": "mouthSmile_L:0.8,mouthSmile_R:0.9,jawOpen:0.3,browInnerUp_L:0.5,"
    "browInnerUp_R:0.5,noseSneer_L:0.4,noseSneer_R:0.4",
    "held_grimace": "mouthFrown_L:0.6,mouthFrown_R:0.6,mouthStretch_L:0.6,mouthStretch_R:0.6,"
    "jawOpen:0.5,browDown_L:0.6,browDown_R:0.6,mouthLowerDown_L:0.4,mouthLowerDown_R:0.4",
}
_ORDER = (
    "smile_open", "brows_up", "frown", "sneer", "held_grin", "stretch", "side", "funnel",
    "pucker", "held_grimace", *ALONE,
)  # fmt: skip


def make_takes(folder: Path, shared: Path, names: Sequence[str] = _ORDER) -> None:
    """Render, import and track the takes that are not there, one after the other."""
    for name in names:
        place = folder / name
        source, take = place / "source", place / "take"
        if _product(folder, name).exists():
            continue
        place.mkdir(parents=True, exist_ok=True)
        if not (source / "neutral.obj").exists():  # the last that the renderer writes
            expression = (TRAINING | ALONE | HELD_OUT)[name]
            words = ["--seed", str(ACTOR_SEED), "--size", str(_SIZE_PX), "--expr", expression]
            script = str(shared.resolve() / "tools" / "render_take.py")
            _run([script, str(source), "--frames", str(_FRAMES), *words])
        _run(["-m", "tools.cli", "import", str(source), "--out", str(take)])
        neutral = str(source / "neutral.obj")
        _run(["-m", "tools.cli", "track", str(take), "--neutral", neutral])
        print(f"{name}: tracked", file=sys.stderr, flush=True)


def pixel_lines(folder: Path, shared: Path, seeds: Sequence[int]) -> Iterator[dict[str, Any]]:
    """One line a template and held-out take, over the takes that are tracked.

    Each is solved on the takes that show shapes in company, and again with those that show some
    alone.

    Args:
        folder: of `make_takes`.
        shared: the folder with data/ict.
        seeds: each gives an artist's generic template that makes every shape in another way than
            the actor; first comes the model itself, whose shapes are the actor's.
    """
    performances = {
        name: read_performance(_product(folder, name))
        for name in _ORDER
        if _product(folder, name).exists()
    }
    model = ict_template(ict_path(shared), _TRACKED_VERTICES)
    for chosen, seed in product((TRAINING, TRAINING | ALONE), (None, *seeds)):
        training = [performances[name] for name in chosen if name in performances]
        template = model if seed is None else artist_template(model, seed)
        kind = "model" if seed is None else str(seed)
        started = time.perf_counter()
        rig = solve_rig(template, training, RigSettings(), folder / f"rig_{kind}_{len(training)}")
        seconds = time.perf_counter() - started
        for name in HELD_OUT:
            if name not in performances:
                continue
            truth = read_archive(
                folder / name / "source" / "truth.npz", _TRUTH_KEYS, optional=_TRUTH_REST
            )["vertices"].astype(np.float64)
            yield {
                "goal": "pixels", "template": "the model's own" if seed is None else f"seed {seed}",
                "held_out": name, "training": len(training), "solve_s": round(seconds, 1),
                **held_out_errors(template, rig, performances[name], truth), "asked": "0.6",
            }  # fmt: skip


def artist_template(model: Template, seed: int) -> Template:
    """The model's neutral with shapes as somebody else would have sculpted them."""
    rng = np.random.default_rng([seed, 3])
    return replace(model, deltas=personal_shapes(model.neutral, model.deltas, (0.65, 1.35), rng))


def held_out_errors(
    template: Template, rig: FaceRig, performance: Performance, truth: Floats
) -> dict[str, float]:
    """Root mean square distance, mm, of the reproduced take from the tracked one and the truth."""
    seen = observe([performance])
    priors = RigSettings().schedule().weights
    errors = []
    for deltas in (rig.deltas, transfer_shapes(template, rig.neutral)):
        fit = pose_frames(rig.neutral, deltas, seen, priors)
        counted = (seen.confidence > 0).astype(np.float64)
        errors.append(
            (
                weighted_rms(fit.residuals(seen.points), seen.confidence),
                weighted_rms(fit.residuals(truth), counted),
            )
        )
    (ours, ours_true), (generic, generic_true) = errors
    return {
        "rms_mm": round(ours, 4),
        "template_rms_mm": round(generic, 4),
        "ratio": round(ours / generic, 3),
        "truth_rms_mm": round(ours_true, 4),
        "template_truth_rms_mm": round(generic_true, 4),
        "truth_ratio": round(ours_true / generic_true, 3),
    }


def _product(folder: Path, name: str) -> Path:
    return folder / name / "take" / "products" / "track" / "performance.npz"


def _run(words: Sequence[str]) -> None:
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, env=dict(os.environ)
    )
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(words)}\n{done.stderr}")
