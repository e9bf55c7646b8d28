"""Every corner that a calibration dropped, as a table to look through."""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Bools
from capture.product import replacing
from recon.calibration.device_numbers import number
from recon.calibration.solver import ArraySolution

BEHIND = "behind the camera"
WHOLE_VIEW = "whole view off"
ALONE = "corner off"
COLUMNS = (
    "device", "frame", "corner", "x", "y", "dx", "dy", "size_px", "limit_px", "reason",
)  # fmt: skip
_WHOLE = 0.5  # of a view's corners dropped: the view is off, not its corners
_LEAST_WHOLE = 4


def write_corner_log(path: Path, solution: ArraySolution) -> None:
    """Write every rejected sighting as CSV: where it was seen, how far off, beyond which limit.

    Columns are `COLUMNS`: x, y the place seen, dx, dy the predicted place minus it, px; empty where
    the corner fell behind its camera. Rows are in the order of device, pose, corner.

    Args:
        path: file to write, whole or not at all.
        solution: the calibrated array.
    """
    seen = solution.observations
    reasons = rejection_reasons(solution)
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(COLUMNS)
        for row in np.flatnonzero(~solution.kept).tolist():
            dx, dy = solution.residuals[row].tolist()
            numbers = [*seen.pixels[row].tolist(), dx, dy, float(np.hypot(dx, dy))]
            numbers.append(float(solution.limit_px[row]))
            table.writerow(
                [
                    seen.device_names[int(seen.device[row])],
                    seen.frames[int(seen.pose[row])],
                    int(seen.corner[row]),
                    *(f"{value:.3f}" if np.isfinite(value) else "" for value in numbers),
                    reasons[row],
                ]
            )


def rejection_reasons(solution: ArraySolution) -> list[str]:
    """Why each sighting (M) was dropped, in words; "" for those that were used."""
    lost = ~np.isfinite(solution.residuals).all(axis=1)
    off = _in_whole_views(solution)
    reasons = np.where(lost, BEHIND, np.where(off, WHOLE_VIEW, ALONE))
    return [str(word) for word in np.where(solution.kept, "", reasons)]


def rejection_summary(solution: ArraySolution) -> dict[str, Any]:
    """How many sightings were dropped, by reason, by device and by frame, for JSON.

    Of a device also by how much (median, px; null when nothing or behind the camera) and how many
    of its views were off as a whole; of the frames only those in which anything was dropped.
    """
    seen, dropped = solution.observations, ~solution.kept
    off = _in_whole_views(solution)
    size = np.linalg.norm(solution.residuals, axis=1)
    devices = {}
    for index, name in enumerate(seen.device_names):
        mine = seen.device == index
        gone = int((mine & dropped).sum())
        devices[name] = {
            "rejected": gone,
            "of": int(mine.sum()),
            "median_px": number(np.median(size[mine & dropped])) if gone else None,
            "whole_views": len(np.unique(seen.pose[mine & off])),
            "views": len(np.unique(seen.pose[mine])),
        }
    frames = []
    for index in np.unique(seen.pose[dropped]).tolist():
        rows = seen.pose == index
        frames.append(
            {
                "frame": int(seen.frames[index]),
                "rejected": int((rows & dropped).sum()),
                "of": int(rows.sum()),
                "whole_views": len(np.unique(seen.device[rows & off])),
            }
        )
    counts = Counter(reason for reason in rejection_reasons(solution) if reason)
    return {"reasons": dict(sorted(counts.items())), "devices": devices, "frames": frames}


def _in_whole_views(solution: ArraySolution) -> Bools:
    """Which dropped sightings (M,) belong to a view most of whose corners were dropped."""
    off = np.zeros(len(solution.kept), dtype=np.bool_)
    for _, _, rows in solution.observations.views():
        lost = ~solution.kept[rows]
        if lost.sum() >= _LEAST_WHOLE and lost.mean() >= _WHOLE:
            off[rows] = lost
    return off
