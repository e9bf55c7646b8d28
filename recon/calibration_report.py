"""What a calibration says of itself: numbers to draw, and warnings in an operator's words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from capture.arrays import Floats
from recon.array_solver import ArraySolution
from recon.board import Board

RMS_NAME = "mean reprojection error, vector norm (COLMAP)"
_GRID = 8  # coverage cells along the longer side of an image
_MOST_VECTORS = 200
_FEW_VIEWS = 8
_THIN_COVERAGE = 0.4
_LOOSE_FOCAL = 2e-3  # relative standard deviation of a focal length worth a warning
_BAD_RATIO = 1.15
_BENT_MM = 0.5
_STRETCHED = 1e-3  # the two sides of the printed squares differ by this much
_ODD_ONE = 2.0  # a device or pose this many times worse than the median stands out
_MANY_REJECTED = 0.05


def calibration_report(
    solution: ArraySolution, board: Board, tally: Mapping[str, Mapping[str, int]] | None = None
) -> dict[str, Any]:
    """The report of a calibration, ready for JSON.

    Args:
        solution: the calibrated array.
        board: the board, nominal.
        tally: by device, how many frames were used or refused for each reason.

    Returns:
        Residuals in px over the corners used: overall, by device, by pose; counts; the coverage
        grid of each device; flatness of the board; focal length deviations; the held-out check;
        residual vectors; warnings. A number that could not be determined is null.
    """
    kept, size = solution.kept, np.linalg.norm(solution.residuals, axis=1)
    devices = [_device(solution, index, tally) for index in range(len(solution.state.cameras))]
    poses = [_pose(solution, index) for index in range(len(solution.observations.frames))]
    report: dict[str, Any] = {
        "residual_definition": RMS_NAME,
        "mean_reprojection_px": _number(size[kept].mean()),
        "rms_per_coordinate_px": _number(np.sqrt((solution.residuals[kept] ** 2).mean())),
        "robust_sigma_px": _number(solution.sigma_px),
        "corners_used": int(kept.sum()),
        "corners_rejected": int((~kept).sum()),
        "rejection": "further off than the robust limit of its device",
        "converged": solution.converged,
        "poses_used": len(np.unique(solution.observations.pose[kept])),
        "devices": devices,
        "poses": poses,
        "board": _board(solution, board),
        "held_out": _held_out(solution),
        "world": {
            "origin": solution.world.origin,
            "z": "towards the mean of the camera centres",
            "y": solution.world.up,
        },
    }
    report["warnings"] = _warnings(report)
    report["residual_vectors"] = {
        device["name"]: _vectors(solution, index) for index, device in enumerate(devices)
    }
    return report


def summary_of(report: Mapping[str, Any]) -> dict[str, Any]:
    """The report without its residual vectors, to stand inside cameras.json."""
    return {key: value for key, value in report.items() if key != "residual_vectors"}


def _device(
    solution: ArraySolution, index: int, tally: Mapping[str, Mapping[str, int]] | None
) -> dict[str, Any]:
    observations, kept = solution.observations, solution.kept
    mine = observations.device == index
    used = mine & kept
    camera = solution.state.cameras[index]
    residuals = solution.residuals[used]
    sigma = solution.focal_sigma[index]
    grid = _coverage(observations.pixels[used], camera.width, camera.height)
    return {
        "name": camera.name,
        "views": len(np.unique(observations.pose[used])),
        "corners_used": int(used.sum()),
        "corners_rejected": int((mine & ~kept).sum()),
        "frames": dict((tally or {}).get(camera.name, {})),
        "mean_reprojection_px": _number(np.linalg.norm(residuals, axis=1).mean()),
        "rms_per_coordinate_px": _number(np.sqrt((residuals**2).mean())),
        "largest_px": _number(np.linalg.norm(residuals, axis=1).max()),
        "fx_px": _number(camera.fx),
        "fy_px": _number(camera.fy),
        "fx_sigma_px": _number(sigma[0]),
        "fy_sigma_px": _number(sigma[1]),
        "covered": _number((grid > 0).mean()),
        "coverage": grid.tolist(),
    }


def _pose(solution: ArraySolution, index: int) -> dict[str, Any]:
    rows = (solution.observations.pose == index) & solution.kept
    size = np.linalg.norm(solution.residuals[rows], axis=1)
    return {
        "frame": int(solution.observations.frames[index]),
        "devices": len(np.unique(solution.observations.device[rows])),
        "corners_used": int(rows.sum()),
        "corners_rejected": int(((solution.observations.pose == index) & ~solution.kept).sum()),
        "mean_reprojection_px": _number(size.mean()) if len(size) else None,
    }


def _coverage(pixels: Floats, width: int, height: int) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Corners in each cell (rows, columns) of a grid over the image."""
    cell = max(width, height) / _GRID
    shape = (max(1, round(height / cell)), max(1, round(width / cell)))
    counts = np.zeros(shape, dtype=np.int64)
    place = np.floor((pixels[:, ::-1] + 0.5) / [height, width] * shape).astype(np.int64)
    np.add.at(counts, tuple(np.clip(place, 0, np.array(shape) - 1).T), 1)
    return counts


def _board(solution: ArraySolution, board: Board) -> dict[str, Any]:
    """How flat and how square the board turned out."""
    seen = np.unique(solution.observations.corner[solution.kept])
    found, nominal = solution.state.corners[seen], board.corners_mm()[seen]
    centred = found - found.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    height = centred @ axes[2]
    flat, _, _, _ = np.linalg.lstsq(nominal - nominal.mean(axis=0), centred, rcond=None)
    lengths = np.linalg.norm(flat[:2], axis=1)
    return {
        "shape_solved": bool(np.ptp(height) > 0),
        "corners_seen": len(seen),
        "corners": board.corner_count,
        "bow_mm": _number(np.ptp(height)),
        "flatness_rms_mm": _number(height.std()),
        "width_over_height": _number(lengths[0] / lengths[1]),
    }


def _held_out(solution: ArraySolution) -> dict[str, Any]:
    check = solution.held_out
    frames = [int(solution.observations.frames[pose]) for pose in check.poses]
    return {
        "frames": frames,
        "training_rms_per_coordinate_px": _number(check.training_px),
        "held_out_rms_per_coordinate_px": _number(check.held_out_px),
        "ratio": _number(check.ratio),
        "remark": check.remark,
    }


def _vectors(solution: ArraySolution, index: int) -> list[list[float]]:
    """Residuals [x, y, dx, dy] of one device, px: the place seen, predicted minus it."""
    rows = np.flatnonzero((solution.observations.device == index) & solution.kept)
    if len(rows) > _MOST_VECTORS:
        rows = rows[np.linspace(0, len(rows) - 1, _MOST_VECTORS).round().astype(int)]
    table = np.concatenate([solution.observations.pixels[rows], solution.residuals[rows]], axis=1)
    vectors: list[list[float]] = np.round(table, 3).tolist()
    return vectors


def _warnings(report: Mapping[str, Any]) -> list[str]:
    out = []
    if not report["converged"]:
        out.append("The solve stopped before it settled: treat these cameras with care.")
    total = report["corners_used"] + report["corners_rejected"]
    if report["corners_rejected"] > _MANY_REJECTED * total:
        out.append(
            f"{report['corners_rejected']} of {total} corners disagree with the rest and were "
            "dropped: was the board moving fast, or reflecting light?"
        )
    ratio = report["held_out"]["ratio"]
    if ratio is not None and ratio > _BAD_RATIO:
        out.append(
            f"Frames left out of the solve fit {ratio:.2f} times worse than those in it "
            f"(up to {_BAD_RATIO} is good): take more board poses."
        )
    return (
        out + _board_warnings(report["board"]) + _device_warnings(report) + _pose_warnings(report)
    )


def _board_warnings(board: Mapping[str, Any]) -> list[str]:
    out = []
    if board["bow_mm"] > _BENT_MM:
        out.append(
            f"The board is bent by {board['bow_mm']:.2f} mm: it was allowed for; "
            "mount it on a stiff plate."
        )
    if abs(board["width_over_height"] - 1.0) > _STRETCHED:
        out.append(
            f"The printed squares are {board['width_over_height']:.4f} times as wide as high: "
            "measure the board both ways; its scale was taken between the two."
        )
    return out


def _device_warnings(report: Mapping[str, Any]) -> list[str]:
    out = []
    usual = float(np.median([device["mean_reprojection_px"] for device in report["devices"]]))
    for device in report["devices"]:
        name = device["name"]
        if device["views"] < _FEW_VIEWS:
            out.append(
                f"{name}: used the board in {device['views']} frames only; show it the board at "
                f"{_FEW_VIEWS} places or more."
            )
        if device["covered"] < _THIN_COVERAGE:
            out.append(
                f"{name}: corners cover {100 * device['covered']:.0f} % of its image; "
                "hold the board into its corners too."
            )
        loose = (device["fx_sigma_px"] or np.inf) / device["fx_px"]
        if not loose <= _LOOSE_FOCAL:
            told = f"to {100 * loose:.2f} %" if np.isfinite(loose) else "not at all"
            out.append(f"{name}: its focal length is known {told}; tilt the board more before it.")
        if device["mean_reprojection_px"] > _ODD_ONE * usual:
            out.append(
                f"{name}: residual {device['mean_reprojection_px']:.2f} px where {usual:.2f} px is "
                "usual here: is its lens sharp and tight, and was it triggered with the others?"
            )
    return out


def _pose_warnings(report: Mapping[str, Any]) -> list[str]:
    sizes = [pose["mean_reprojection_px"] for pose in report["poses"]]
    known = [size for size in sizes if size is not None]
    usual = float(np.median(known)) if known else 0.0
    out = []
    for pose in report["poses"]:
        size = pose["mean_reprojection_px"]
        if size is None:
            out.append(f"frame {pose['frame']}: no corner agrees with the other frames.")
        elif size > _ODD_ONE * usual:
            out.append(
                f"frame {pose['frame']}: residual {size:.2f} px where {usual:.2f} px is usual: "
                "the board moved during the exposure, or the devices were not together."
            )
    return out


def _number(value: Any) -> float | None:
    """A float with seven digits, or None for what is not finite: JSON knows no NaN."""
    number = float(value)
    return float(f"{number:.7g}") if np.isfinite(number) else None
