"""The benches of the calibration: `python -m tools.bench.bench_calibrate [PART ...]`.

protocol   16 devices of 2048 px, 60 poses, 0.1 px of noise, a board bowed by 0.3 mm, 1 % outliers,
           10 % hidden corners, many seeds: errors, checks, and predicted against true deviations
opponents  what others make of the same sightings, and of a take that suits them
cases      other arrays and takes, one line each
images     rendered images of the bent board through the real detector
faults     takes with one fault each: what the program says of them; and healthy ones

--small makes all of them small: minutes become seconds, and figures worse.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from recon.calibration.solver import CalibrateSettings
from tools.bench.bench_rows import Row, RowFile
from tools.bench.board_scene import BoardScene
from tools.bench.calibrate_faults import run_faults, run_healthy, run_image_faults
from tools.bench.calibrate_images import IMAGES, SMALL_IMAGES, run_images
from tools.bench.calibrate_opponents import opponents
from tools.bench.calibrate_protocol import (
    PROTOCOL,
    SMALL,
    opponent_line,
    protocol_table,
    run_opponents,
    run_seed,
    run_seeds,
)

_LARGE = BoardScene()
_MIDDLE = BoardScene(size_px=640, focal_px=1440.0, radius_mm=620.0, poses=18)
_FLAT = CalibrateSettings(free_board=False)
_FREE = CalibrateSettings()
CASES: dict[str, tuple[BoardScene, CalibrateSettings]] = {
    "2048 px, 40 poses": (_LARGE, _FREE),
    "2048 px, 15 poses": (dataclasses.replace(_LARGE, poses=15), _FREE),
    "bow 0.3 mm, board held flat": (dataclasses.replace(_LARGE, bow_mm=0.3), _FLAT),
    "bow 0.3 mm, released": (dataclasses.replace(_LARGE, bow_mm=0.3), _FREE),
    "bow 0.3 mm, 1 % outliers": (dataclasses.replace(_LARGE, bow_mm=0.3, outliers=0.01), _FREE),
    "640 px, 18 poses": (_MIDDLE, _FREE),
    "640 px, bow 0.3, 1 % outliers": (
        dataclasses.replace(_MIDDLE, bow_mm=0.3, outliers=0.01),
        _FREE,
    ),
    "640 px, 4 devices": (dataclasses.replace(_MIDDLE, devices=4), _FREE),
    "640 px, 32 devices": (dataclasses.replace(_MIDDLE, devices=32), _FREE),
    "640 px, ring of 8": (
        dataclasses.replace(_MIDDLE, devices=8, layout="ring", poses=40),
        _FREE,
    ),
    "640 px, two clusters": (
        dataclasses.replace(_MIDDLE, devices=10, layout="clusters", span_deg=45.0),
        _FREE,
    ),
    "640 px, turned devices": (
        dataclasses.replace(_MIDDLE, devices=9, layout="turned", span_deg=50.0),
        _FREE,
    ),
}
PARTS = ("protocol", "opponents", "cases", "images", "faults")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the parts that were asked for and print their tables."""
    options = _parser().parse_args(arguments)
    rows = RowFile(options.out)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    told: dict[str, Any] = {}
    for part in options.parts or ["protocol"]:
        print(f"\n== {part}", flush=True)
        if part == "protocol":
            told[part] = _protocol(SMALL if options.small else PROTOCOL, seeds, rows)
        elif part == "opponents":
            told[part] = _opponents(SMALL if options.small else PROTOCOL, seeds, rows, options.only)
        elif part == "cases":
            told[part] = _cases(seeds, options.only, options.small, rows)
        elif part == "images":
            scene = SMALL_IMAGES if options.small else IMAGES
            poses = options.poses or scene.poses
            told[part] = run_images(dataclasses.replace(scene, poses=poses), rows)
        else:
            told[part] = {
                "faults": run_faults(options.small, rows, options.only),
                "images": run_image_faults(rows),
                "healthy": run_healthy(4 if options.small else 20, rows),
            }
    if options.json is not None:
        options.json.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("parts", nargs="*", choices=PARTS, help="default: protocol")
    parser.add_argument("--seeds", type=int, default=20, help="how many seeds (default 20)")
    parser.add_argument("--first-seed", type=int, default=0, help="the first of them (default 0)")
    parser.add_argument("--small", action="store_true", help="small takes, quick")
    parser.add_argument("--only", default="", help="only cases, methods, faults with this text")
    parser.add_argument("--poses", type=int, default=0, help="of the rendered take (default 60)")
    parser.add_argument(
        "--out", type=Path, default=None, help="JSON lines to keep rows in and to go on from"
    )
    parser.add_argument("--json", type=Path, default=None, help="write all results to this file")
    return parser


def _protocol(scene: BoardScene, seeds: Sequence[int], rows: RowFile) -> dict[str, Any]:
    found = run_seeds(scene, seeds, _FREE, rows)
    table = protocol_table(found)
    print("\n| figure | asked | measured |\n| --- | --- | --- |")
    for line in table:
        print("| " + " | ".join(line) + " |")
    return {"seeds": found, "table": table}


def _opponents(
    scene: BoardScene, seeds: Sequence[int], rows: RowFile, only: str
) -> dict[str, dict[str, list[Row]]]:
    whole = dataclasses.replace(scene, hidden=0.0, outliers=0.0)
    methods = [method for method in opponents() if only in method.name]
    told: dict[str, dict[str, list[Row]]] = {}
    for title, case in (
        (f"the protocol, {len(seeds)} seeds", scene),
        (f"no hidden corners, no outliers, {len(seeds)} seeds", whole),
        (f"and a flat board, {len(seeds)} seeds", dataclasses.replace(whole, bow_mm=0.0)),
    ):
        print(
            f"\n{title}\n{'method':45s} {'worst um':>9s} {'median um':>9s} {'f px':>8s}     wall s"
        )
        told[title] = run_opponents(case, seeds, methods, rows)
        for name, lines in told[title].items():
            print(opponent_line(name, lines), flush=True)
    return told


def _cases(
    seeds: Sequence[int], only: str, small: bool, rows: RowFile
) -> dict[str, dict[str, float]]:
    """One line a case: the worst over the seeds of each error, the median of the seconds."""
    print(f"{'case':32s} {'tri um':>8s} {'f px':>7s} {'held':>6s} {'cpu s':>7s} {'corners':>8s}")
    told = {}
    for name, (scene, settings) in CASES.items():
        if only not in name or (small and scene.size_px > 640):
            continue
        found = []
        for seed in seeds:
            case = dataclasses.replace(scene, seed=seed)
            found.append(
                rows.row(
                    f"case {case} {settings}",
                    partial(run_seed, case, settings),
                )
            )
        lost = [row["failed"] for row in found if row["failed"]]
        if lost:
            print(f"{name:32s} {len(lost)} of {len(found)} failed: {lost[0]}", flush=True)
            continue
        keys = ("triangulation_um", "focal_rms_px", "held_out_ratio", "sightings")
        worst = {key: max(float(row[key]) for row in found) for key in keys}
        worst["cpu_s"] = float(np.median([row["cpu_s"] for row in found]))
        print(
            f"{name:32s} {worst['triangulation_um']:8.2f} {worst['focal_rms_px']:7.2f} "
            f"{worst['held_out_ratio']:6.3f} {worst['cpu_s']:7.1f} {worst['sightings']:8.0f}",
            flush=True,
        )
        told[name] = worst
    return told


if __name__ == "__main__":
    main()
