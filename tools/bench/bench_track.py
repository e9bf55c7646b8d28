"""Tracking against truth: `python -m tools.bench.bench_track TAKE --truth TRUTH.npz`.

Tracks a take from its neutral.obj with several settings and prints one JSON line for each: errors
over confident skin (vertex RMSE, its tangential and normal parts, median, p95, share beyond 1 mm),
the round-trip drift of the last frame, and CPU and wall seconds a frame. The truth is read here
only, after the stage is done.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from capture.arrays import Floats
from capture.take import Take
from recon.mesh import Mesh, read_obj, vertex_normals
from recon.visiting import import_take
from track.performance import Performance
from track.stage import TrackSettings, track

_SURE = 0.2  # confidence from which skin counts as seen
CASES: dict[str, TrackSettings] = {
    "default": TrackSettings(),
    "three rounds at full resolution": TrackSettings(passes=3),
    "stiff first round": TrackSettings(bending_coarse_mm=8.0),
    "denser samples": TrackSettings(spacing_mm=2.5),
    "no extrapolation": TrackSettings(extrapolation=0.0),
    "windows of 15 px": TrackSettings(half_window_px=7),
}


def compare(performance: Performance, truth: Floats, neutral: Mesh) -> dict[str, float]:
    """Errors of a performance in mm, without alignment.

    Args:
        performance: F frames.
        truth: (F, V, 3) world mm.
        neutral: the topology.
    """
    away = performance.vertices.astype(np.float64) - truth
    normal = np.stack([vertex_normals(frame, neutral.triangles) for frame in truth])
    along = np.einsum("fvx,fvx->fv", away, np.nan_to_num(normal))
    whole = np.linalg.norm(away, axis=2)
    across = np.sqrt(np.maximum(whole**2 - along**2, 0.0))
    sure = performance.confidence > _SURE
    last = whole[-1][sure[-1]]
    return {
        "vertex_rmse_mm": _rms(whole[sure]),
        "tangential_mm": _rms(across[sure]),
        "normal_mm": _rms(along[sure]),
        "median_mm": float(np.median(whole[sure])),
        "p95_mm": float(np.percentile(whole[sure], 95)),
        "beyond_1mm": float((whole[sure] > 1.0).mean()),
        "round_trip_drift_mm": _rms(last),
        "sure_share": float(sure.mean()),
    }


def run_case(source: Path, truth: Path, settings: TrackSettings) -> dict[str, float]:
    """Track a visiting take in a fresh folder and measure it."""
    with TemporaryDirectory() as folder, np.load(truth, allow_pickle=False) as archive:
        take = import_take(source, Path(folder) / "take")
        neutral = read_obj(take.neutral())
        cpu, wall = time.process_time(), time.perf_counter()
        performance = track(Take.open(take.folder), neutral, settings)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        frames = len(performance.frames)
        figures = compare(performance, archive["vertices"][:frames].astype(np.float64), neutral)
    return {**figures, "cpu_s_per_frame": cpu / frames, "wall_s_per_frame": wall / frames}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print one JSON line for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("take", type=Path, help="a visiting take with neutral.obj")
    parser.add_argument("--truth", type=Path, required=True, help="truth.npz with vertices (F,V,3)")
    parser.add_argument("--cases", nargs="*", default=["default"], choices=list(CASES))
    options = parser.parse_args(arguments)
    for name in options.cases:
        figures = run_case(options.take, options.truth, CASES[name])
        line = {
            "case": name,
            "settings": dataclasses.asdict(CASES[name]),
            **{key: round(value, 4) for key, value in figures.items()},
        }
        print(json.dumps(line), flush=True)


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")


if __name__ == "__main__":
    main()
