"""Tracking against truth: `python -m tools.bench.bench_track TAKE [--score SCORE_TRACK.py]`.

Tracks a visiting take from its neutral.obj: with several settings and by the opponent (`--cases`),
as it is and under faults put into it (`--faults`). One JSON line for each of each: errors
over skin that two cameras see (by `--score`, called with TRUTH PERFORMANCE, such as score_track.py;
without it, over confident skin by this module), CPU and wall seconds a frame, and memory. Then one
line for all: how well flagged frames of the default settings tell those whose p95 is over a
millimetre. The truth is read here only, after the stage is done. What normal displacements earn is
told by `--scan --cases default "without scan" --faults off`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from capture.archive import read_archive
from capture.arrays import Bools, Floats
from capture.camera_file import read_cameras
from capture.take import Take
from recon.mesh import Mesh, read_obj, vertex_normals
from recon.scan import reconstruct
from recon.visiting import import_take
from tools.bench.cost import measured
from tools.bench.track_faults import (
    TakeFault,
    flagged_frames,
    flagging,
    take_faults,
    write_faulty,
)
from tools.bench.track_opponent import follow_take
from track.performance import Performance, write_performance
from track.stage import TrackSettings, track
from track.visibility import count_views

_SURE = 0.2  # confidence from which skin counts as seen, without a score
_BAD_MM = 1.0  # p95 from which a frame is bad
_NARROW = 6706  # vertices of the face in takes of the ICT head, which name no face_region
OPPONENT = "opponent"
Follow = Callable[[Take, Mesh], Performance]


@dataclass
class _Flags:
    """Which frames were bad, and which were flagged, over several runs."""

    bad: list[bool] = field(default_factory=list)
    flagged: list[bool] = field(default_factory=list)


def settings_cases() -> dict[str, TrackSettings]:
    """Settings to compare by name: each switch of the stage turned, and some numbers changed."""
    base = TrackSettings()
    changes: dict[str, dict[str, Any]] = {
        "three rounds at full resolution": {"passes": 3},
        "one round at full resolution": {"passes": 1},
        "stiff first round": {"bending_coarse_mm": 8.0},
        "denser samples": {"spacing_mm": 2.5},
        "no extrapolation": {"extrapolation": 0.0},
        "windows of 15 px": {"half_window_px": 7},
    }
    for each in fields(base):
        value = getattr(base, each.name)
        if isinstance(value, bool):
            words = each.name.removeprefix("use_").replace("_", " ")
            changes[f"{'without' if value else 'with'} {words}"] = {each.name: not value}
    known = {each.name for each in fields(base)}
    cases = {"default": base}
    for words, change in changes.items():
        if set(change) <= known:
            cases[words] = replace(base, **change)
    return cases


def compare(performance: Performance, truth: Floats, neutral: Mesh) -> dict[str, float]:
    """Errors of a performance in mm over confident skin, without alignment.

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


def frame_p95(source: Path, performance: Performance, neutral: Mesh) -> Floats:
    """95th percentile (F,) of the true error, mm, over face that two cameras see then and first."""
    truth = read_archive(source / "truth.npz", ["vertices"], ["face_region"])
    placed = truth["vertices"].astype(np.float64)
    face = truth.get("face_region", np.arange(min(_NARROW, placed.shape[1])))
    eyes = np.array([camera.centre for camera in read_cameras(source / "cameras.json")])
    seen: list[Bools] = [count_views(frame, neutral.triangles, eyes)[face] >= 2 for frame in placed]
    away = np.linalg.norm(performance.vertices.astype(np.float64) - placed, axis=2)[:, face]
    rows = [np.percentile(e[s & seen[0]], 95) for e, s in zip(away, seen, strict=True)]
    return np.array(rows)


def run(
    source: Path, follow: Follow, score: Path | None, scan: bool = False
) -> tuple[dict[str, Any], _Flags]:
    """Track a visiting take in a fresh folder and measure it: a row, and what was flagged.

    Args:
        source: the take.
        follow: how.
        score: script that scores it; None: `compare`.
        scan: make a scan of the first frame before.
    """
    with TemporaryDirectory() as folder:
        take = import_take(source, Path(folder) / "take")
        if scan:
            reconstruct(take, [take.frames[0]])
        neutral = read_obj(take.neutral())
        performance, cost = measured(lambda: follow(Take.open(take.folder), neutral))
        frames = len(performance.frames)
        row: dict[str, Any] = {
            "cpu_s_per_frame": round(cost["cpu_s"] / frames, 3),
            "wall_s_per_frame": round(cost["wall_s"] / frames, 3),
            "peak_mib": cost["peak_mib"],
        }
        if score is None:
            truth = read_archive(source / "truth.npz", ["vertices"])["vertices"].astype(np.float64)
            figures = compare(performance, truth, neutral)
            row |= {key: round(value, 4) for key, value in figures.items()}
        else:
            path = Path(folder) / "performance.npz"
            write_performance(path, performance)
            row |= scored(score, source / "truth.npz", path)
        worst = frame_p95(source, performance, neutral)
        report = take.products / "track" / "report.json"
        found = flagged_frames(report) if report.is_file() else None
    row["p95_by_frame"] = np.round(worst, 3).tolist()
    if found is None:
        return row, _Flags()
    row["flagged"] = found
    flagged = [int(frame) in found for frame in performance.frames]
    return row, _Flags([bool(value > _BAD_MM) for value in worst], flagged)


def scored(score: Path, *files: Path) -> dict[str, Any]:
    """The JSON that a scoring script prints for some files."""
    words = [sys.executable, str(score), *map(str, files)]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return row


def main(arguments: Sequence[str] | None = None) -> None:
    """Print one JSON line for each case and each fault, and one for the flags of all."""
    cases = settings_cases()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("take", type=Path, help="a visiting take with neutral.obj and truth.npz")
    parser.add_argument("--score", type=Path, help="script called with TRUTH PERFORMANCE")
    parser.add_argument("--cases", nargs="*", default=["default"], choices=[*cases, OPPONENT])
    parser.add_argument("--faults", default=None, help='only those with these words; "" for all')
    parser.add_argument("--scan", action="store_true", help="with a scan of the first frame")
    options = parser.parse_args(arguments)
    flags = _Flags()
    for fault in _chosen_faults(options.take, options.faults):
        with TemporaryDirectory() as folder:
            source = options.take
            if fault.words:
                source = Path(folder) / "visit"
                write_faulty(options.take, source, fault)
            for name in options.cases:
                words: dict[str, Any] = {"fault": fault.words or "none", "case": name}
                follow: Follow = follow_take
                if name != OPPONENT:
                    words["settings"] = _changed(cases[name])
                    follow = _tracker(cases[name])
                row, found = run(source, follow, options.score, options.scan)
                print(json.dumps({**words, **row}), flush=True)
                if name == "default":
                    flags.bad.extend(found.bad)
                    flags.flagged.extend(found.flagged)
    if flags.bad:
        print(json.dumps({"flags": flagging(flags.bad, flags.flagged)}), flush=True)


def _chosen_faults(source: Path, wanted: str | None) -> list[TakeFault]:
    """None at first, and the faults with these words; none of them when they are None."""
    none = [TakeFault(words="")]
    if wanted is None:
        return none
    names = read_cameras(source / "cameras.json").names
    count = len(read_archive(source / "truth.npz", ["vertices"])["vertices"])
    return none + [fault for fault in take_faults(names, count) if wanted in fault.words]


def _tracker(settings: TrackSettings) -> Follow:
    return lambda take, neutral: track(take, neutral, settings)


def _changed(settings: TrackSettings) -> dict[str, Any]:
    """The settings that are not the defaults."""
    default = asdict(TrackSettings())
    return {key: value for key, value in asdict(settings).items() if value != default[key]}


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")


if __name__ == "__main__":
    main()
