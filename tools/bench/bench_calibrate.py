"""The synthetic table of the calibration: `python -m tools.bench.bench_calibrate --help`.

For each case and seed: triangulation error of the face volume after rigid alignment without scale,
focal length error, held-out ratio, and CPU seconds of the solve.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence

import numpy as np

from recon.array_solver import CalibrateSettings, solve_array
from tools.bench.board_scene import (
    A4_BOARD,
    BoardScene,
    make_state,
    observe,
    triangulation_error,
)

_LARGE = BoardScene()
_SMALL = BoardScene(size_px=640, focal_px=1440.0, radius_mm=620.0, poses=18)
_FLAT = CalibrateSettings(free_board=False)
_FREE = CalibrateSettings()
CASES: dict[str, tuple[BoardScene, CalibrateSettings]] = {
    "2048 px, 40 poses": (_LARGE, _FREE),
    "2048 px, 15 poses": (dataclasses.replace(_LARGE, poses=15), _FREE),
    "bow 0.3 mm, board held flat": (dataclasses.replace(_LARGE, bow_mm=0.3), _FLAT),
    "bow 0.3 mm, released": (dataclasses.replace(_LARGE, bow_mm=0.3), _FREE),
    "bow 0.3 mm, 1 % outliers": (dataclasses.replace(_LARGE, bow_mm=0.3, outliers=0.01), _FREE),
    "640 px, 18 poses": (_SMALL, _FREE),
    "640 px, bow 0.3, 1 % outliers": (
        dataclasses.replace(_SMALL, bow_mm=0.3, outliers=0.01),
        _FREE,
    ),
    "640 px, 4 devices": (dataclasses.replace(_SMALL, devices=4), _FREE),
    "640 px, 32 devices": (dataclasses.replace(_SMALL, devices=32), _FREE),
}


def run_case(scene: BoardScene, settings: CalibrateSettings) -> dict[str, float]:
    """Solve one synthetic board take and measure it against the truth.

    Args:
        scene: how the take looks.
        settings: of the solve.

    Returns:
        Errors in micrometres and px, the held-out ratio, CPU seconds, sightings.
    """
    truth = make_state(scene)
    observations = observe(scene, truth)
    start = time.process_time()
    solution = solve_array(observations, A4_BOARD.corners_mm(), settings)
    seconds = time.process_time() - start
    error = triangulation_error(truth.cameras, solution.state.cameras)
    focal = [a.fx - b.fx for a, b in zip(solution.state.cameras, truth.cameras, strict=True)]
    return {
        "triangulation_um": 1000.0 * float(np.sqrt((error**2).sum(axis=1).mean())),
        "focal_rms_px": float(np.sqrt(np.mean(np.square(focal)))),
        "held_out_ratio": solution.held_out.ratio,
        "cpu_s": seconds,
        "sightings": float(len(observations)),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print one line a case: the worst over the seeds of each error, the median of the seconds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=3, help="how many seeds a case (default 3)")
    parser.add_argument("--case", default="", help="only cases whose name holds this text")
    options = parser.parse_args(arguments)
    print(f"{'case':32s} {'tri um':>8s} {'f px':>7s} {'held':>6s} {'cpu s':>7s} {'corners':>8s}")
    for name, (scene, settings) in CASES.items():
        if options.case not in name:
            continue
        rows = [
            run_case(dataclasses.replace(scene, seed=seed), settings)
            for seed in range(options.seeds)
        ]
        worst = {key: max(row[key] for row in rows) for key in rows[0]}
        seconds = float(np.median([row["cpu_s"] for row in rows]))
        print(
            f"{name:32s} {worst['triangulation_um']:8.2f} {worst['focal_rms_px']:7.2f} "
            f"{worst['held_out_ratio']:6.3f} {seconds:7.1f} {worst['sightings']:8.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
