"""The protocol of the calibration: many seeds of one hard synthetic take, and what was asked."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from functools import partial

import numpy as np

from capture.errors import LikenessError
from recon.calibration.solver import ArraySolution, CalibrateSettings, solve_array
from tools.bench.bench_rows import Row, RowFile
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state, observe
from tools.bench.calibrate_opponents import Opponent, failure
from tools.bench.calibrate_scores import SIGMAS, camera_scores, sigma_ratios, sigma_scores

PROTOCOL = BoardScene(poses=60, bow_mm=0.3, outliers=0.01, hidden=0.1)
SMALL = BoardScene(
    size_px=640, focal_px=1440.0, radius_mm=620.0, devices=8, poses=24, bow_mm=0.3, outliers=0.01
)
_LOST_UM = 1000.0  # a triangulation worse than this is no solution, whatever the solver says


def run_seed(scene: BoardScene, settings: CalibrateSettings) -> Row:
    """Solve one synthetic take and measure it against the truth.

    Returns:
        `seconds` (wall) and `cpu_s` of the solve, and `failed` with the program's words; or, with
        `failed` empty, the scores, see the columns of `seed_lines`.
    """
    truth = make_state(scene)
    observations = observe(scene, truth)
    wall, processor = time.perf_counter(), time.process_time()
    try:
        solution = solve_array(observations, A4_BOARD.corners_mm(), settings)
        words = ""
    except LikenessError as error:
        words = failure(error)
    row: Row = {
        "seconds": time.perf_counter() - wall,
        "cpu_s": time.process_time() - processor,
        "sightings": len(observations),
        "failed": words,
    }
    if not words:
        row |= solution_scores(scene, solution)
        if row["triangulation_um"] > _LOST_UM:
            row["failed"] = f"a wrong array: {row['triangulation_um']:.0f} um"
    return row


def solution_scores(scene: BoardScene, solution: ArraySolution) -> Row:
    """What one solution of a scene is worth: errors, checks, and predicted against true ones."""
    truth, found = make_state(scene).cameras, solution.state.cameras
    row: Row = dict(camera_scores(truth, found))
    row["converged"] = bool(solution.converged)
    row["held_out_ratio"] = solution.held_out.ratio
    row["split_half_p95_px"] = solution.split_half.p95_px
    row["sigma_px"] = solution.sigma_px
    row["sigmas"] = (
        None if solution.covariance is None else sigma_scores(truth, found, solution.covariance)
    )
    return row


def run_seeds(
    scene: BoardScene, seeds: Sequence[int], settings: CalibrateSettings, rows: RowFile
) -> list[Row]:
    """One row a seed, printed as it is made."""
    print(
        f"{'seed':>4s} {'tri um':>8s} {'f rms':>7s} {'f max':>7s} {'conv':>5s} {'held':>6s} "
        f"{'split p95':>9s} {'wall s':>7s}  predicted / true: {', '.join(SIGMAS)}"
    )
    out = []
    for seed in seeds:
        case = dataclasses.replace(scene, seed=seed)
        row = rows.row(f"protocol {case} {settings}", partial(run_seed, case, settings))
        print(_seed_line(seed, row), flush=True)
        out.append(row)
    return out


def _seed_line(seed: int, row: Row) -> str:
    if "triangulation_um" not in row:
        return f"{seed:4d} failed: {row['failed']}"
    ratios = (
        "-"
        if row["sigmas"] is None
        else " ".join(f"{value:5.2f}" for value in sigma_ratios([row["sigmas"]]).values())
    )
    return (
        f"{seed:4d} {row['triangulation_um']:8.2f} {row['focal_rms_px']:7.3f} "
        f"{row['focal_max_px']:7.3f} {'yes' if row['converged'] else 'NO':>5s} "
        f"{row['held_out_ratio']:6.3f} {row['split_half_p95_px']:9.4f} {row['seconds']:7.1f}  "
        f"{ratios}{'  ' + row['failed'] if row['failed'] else ''}"
    )


def protocol_table(rows: Sequence[Row]) -> list[tuple[str, str, str]]:
    """Figure, asked, measured (worst and median of the seeds), for every goal of the protocol."""
    good = [row for row in rows if not row["failed"]]
    fine = sum(bool(row["converged"]) for row in good)
    table = [("seeds that converge", f"{len(rows)} of {len(rows)}", f"{fine} of {len(rows)}")]
    if not good:
        return table

    def spread(key: str, form: str) -> str:
        values = np.array([row[key] for row in good], dtype=np.float64)
        return f"worst {np.max(values):{form}}, median {np.median(values):{form}}"

    table += [
        ("triangulation rmse, um", "<= 5", spread("triangulation_um", ".2f")),
        ("focal error rms of devices, px", "<= 1", spread("focal_rms_px", ".3f")),
        ("focal error of the worst device, px", "", spread("focal_max_px", ".3f")),
        ("principal point error rms, px", "", spread("principal_rms_px", ".3f")),
        ("camera centre error rms, um", "", spread("centre_rms_um", ".2f")),
        ("held-out over training residual", "<= 1.15", spread("held_out_ratio", ".3f")),
        ("split-half p95, px", "<= 0.1", spread("split_half_p95_px", ".4f")),
        ("solve, wall s", "<= 60", spread("seconds", ".1f")),
        ("solve, processor s", "", spread("cpu_s", ".1f")),
    ]
    told = [row["sigmas"] for row in good if row["sigmas"] is not None]
    if told:
        for name, ratio in sigma_ratios(told).items():
            table.append((f"predicted over true: {name}", "0.70 to 1.30", f"{ratio:.3f}"))
    return table


def run_opponents(
    scene: BoardScene, seeds: Sequence[int], methods: Sequence[Opponent], rows: RowFile
) -> dict[str, list[Row]]:
    """Every method on the same sightings of every seed."""
    out: dict[str, list[Row]] = {method.name: [] for method in methods}
    for seed in seeds:
        case = dataclasses.replace(scene, seed=seed)
        for method in methods:
            if len(out[method.name]) >= method.most_seeds:
                continue
            key = f"opponent {method.name} {case}"
            out[method.name].append(rows.row(key, partial(_oppose, case, method)))
    return out


def _oppose(scene: BoardScene, method: Opponent) -> Row:
    truth = make_state(scene)
    observations = observe(scene, truth)
    start = time.perf_counter()
    try:
        found, words = method.solve(observations, A4_BOARD.corners_mm()), ""
    except LikenessError as error:
        words = failure(error)
    row: Row = {"seconds": time.perf_counter() - start, "failed": words}
    if not words:
        row |= camera_scores(truth.cameras, found)
        if not row["triangulation_um"] < _LOST_UM:
            row["failed"] = f"a wrong array: {row['triangulation_um'] / 1000.0:.1f} mm"
    return row


def opponent_line(name: str, rows: Sequence[Row]) -> str:
    """One line of the table of methods: worst and median errors, seconds, failures in words."""
    good = [row for row in rows if not row["failed"]]
    words = sorted({row["failed"] for row in rows if row["failed"]})
    told = f"{len(rows) - len(good)} of {len(rows)} failed: {words[0]}" if words else ""
    seconds = f"{np.median([row['seconds'] for row in rows]):8.1f}"
    if not good:
        return f"{name:45s} {'-':>9s} {'-':>9s} {'-':>8s} {seconds}  {told}"
    error = [row["triangulation_um"] for row in good]
    focal = [row["focal_rms_px"] for row in good]
    return (
        f"{name:45s} {max(error):9.2f} {np.median(error):9.2f} {max(focal):8.2f} {seconds}  {told}"
    )
