"""What is odd about a calibration, one sentence each: the `warnings` of its report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

_FEW_VIEWS = 8
_THIN_COVERAGE = 0.4
_LOOSE_FOCAL = 2e-3  # relative standard deviation of a focal length worth a warning
_BAD_RATIO = 1.15
_BENT_MM = 0.5
_STRETCHED = 1e-3  # the two sides of the printed squares differ by this much
_ODD_ONE = 2.0  # a device or pose this many times worse than the median stands out
_MANY_REJECTED = 0.05


def calibration_warnings(report: Mapping[str, Any]) -> list[str]:
    """What is odd about a calibration, in words that name the device or the frame.

    Args:
        report: with its numbers of the whole, of devices, poses, board and held-out poses.
    """
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
    if (board["bow_mm"] or 0.0) > _BENT_MM:
        out.append(
            f"The board is bent by {board['bow_mm']:.2f} mm: it was allowed for; "
            "mount it on a stiff plate."
        )
    if abs((board["width_over_height"] or 1.0) - 1.0) > _STRETCHED:
        out.append(
            f"The printed squares are {board['width_over_height']:.4f} times as wide as high: "
            "measure the board both ways; its scale was taken between the two."
        )
    return out


def _device_warnings(report: Mapping[str, Any]) -> list[str]:
    out = []
    sizes = [device["mean_reprojection_px"] for device in report["devices"]]
    usual = float(np.median([size for size in sizes if size is not None] or [np.inf]))
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
            told = f"known to {100 * loose:.2f} %" if np.isfinite(loose) else "not known"
            out.append(f"{name}: its focal length is {told}; tilt the board more before it.")
        if (device["mean_reprojection_px"] or 0.0) > _ODD_ONE * usual:
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
