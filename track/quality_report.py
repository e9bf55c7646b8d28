"""What the tracking stage writes of quality: `quality.npz`, `quality.csv`, rows of its report."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats32
from capture.camera import Camera, CameraArray
from capture.product import replacing
from recon.mesh import Mesh
from track.error_model import frame_error
from track.evidence import FrameEvidence
from track.performance import Performance
from track.quality import FOUND, TrackQuality, measure_quality, write_quality
from track.quality_regions import face_regions
from track.quality_words import frame_words, take_words, view_habits

FLAG_MM = 0.7  # likely error above which a frame is flagged: so that few above 1 mm are missed
_DIGITS = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class QualityReport:
    """Quality of a take in numbers by frame and in words.

    Attributes:
        rows: of each frame: `likely_error_mm` (95th percentile over the face's seen skin),
            `flagged`, `why`,
            and medians over the skin of `quality.npz`'s arrays; None where there is no number.
        views: what is wrong with views throughout the take.
    """

    rows: tuple[Mapping[str, Any], ...]
    views: tuple[str, ...]

    def joined(self, report: Mapping[str, Any]) -> dict[str, Any]:
        """The stage's report with this one's rows in its `frames`, and its words beside them."""
        rows = [{**row, **own} for row, own in zip(report["frames"], self.rows, strict=True)]
        flagged = [row["frame"] for row in self.rows if row["flagged"]]
        words = {"flagged_frames": flagged, "view_remarks": list(self.views)}
        return {**report, "frames": rows, **words}


def write_quality_report(
    folder: Path,
    neutral: Mesh,
    performance: Performance,
    evidence: Sequence[FrameEvidence],
    cameras: CameraArray,
    scans: Mapping[int, Path],
) -> QualityReport:
    """Judge a tracked take, and write `quality.npz` and `quality.csv` into a folder.

    Args:
        folder: TAKE/products/track.
        neutral: the reference, as it was tracked.
        performance: F frames.
        evidence: of each, its views in the order of the cameras; that of the reference frame is
            `FrameEvidence.nothing`.
        cameras: the take's.
        scans: files by frame number; none where there are none.
    """
    scale = mm_per_pixel(list(cameras), neutral)
    quality = measure_quality(neutral, performance, evidence, scale, scans=scans)
    report = quality_report(neutral, performance, evidence, quality, list(cameras))
    write_quality(folder / "quality.npz", quality)
    _write_table(folder / "quality.csv", report.rows)
    return report


def quality_report(
    neutral: Mesh,
    performance: Performance,
    evidence: Sequence[FrameEvidence],
    quality: TrackQuality,
    cameras: Sequence[Camera],
) -> QualityReport:
    """Sum quality up by frame, flag the doubtful frames, and say why."""
    seen = quality.seen
    regions = face_regions(neutral.vertices, seen[0])
    habits = view_habits(cameras, performance.vertices, evidence)
    face = regions.face if (regions.face & seen[0]).any() else np.ones_like(seen[0])
    rows = []
    for row, told in enumerate(evidence):
        skin = seen[row] & seen[0] & face
        likely = quality.likely_error_mm[row]
        measured = bool((quality.marks[row] == FOUND).any())
        worst = frame_error(likely[skin if skin.any() else seen[0] & face]) if row else 0.0
        flagged = not measured or not worst <= FLAG_MM
        why = frame_words(told, likely.astype(np.float64), skin, regions, habits) if row else []
        if flagged and not why:
            why = ["many small doubts: no region or view stands out"]
        rows.append(
            {
                "frame": int(performance.frames[row]),
                "likely_error_mm": _rounded(worst),
                "likely_median_mm": _median(likely, skin),
                "flagged": flagged,
                "why": why,
                **_figures(quality, row, skin),
            }
        )
    return QualityReport(rows=tuple(rows), views=tuple(take_words(habits)))


def mm_per_pixel(cameras: Sequence[Camera], neutral: Mesh) -> float:
    """How much skin a pixel spans, mm: the median over cameras at the middle of the neutral."""
    centre = neutral.vertices.mean(axis=0)[None]
    return float(np.median([abs(float(c.depths(centre)[0])) / c.fx for c in cameras]))


def _figures(quality: TrackQuality, row: int, skin: Bools) -> dict[str, float | None]:
    found = skin & (quality.marks[row] == FOUND)
    return {
        "reprojection_px": _median(quality.reprojection_px[row], found),
        "ncc": _median(quality.correlation[row], found),
        "views_used": _median(quality.views_used[row], skin) if row else None,
        "scan_distance_mm": _median(quality.scan_distance_mm[row], skin),
        "jitter_mm": _median(quality.jitter_mm[row], skin),
        "round_trip_mm": _rounded(float(quality.round_trip_mm[row])),
        "seen_share": _rounded(float(skin.mean())),
        "found_share": _rounded(float(found.sum()) / max(float(skin.sum()), 1.0)),
    }


def _median(values: Floats32, chosen: Bools) -> float | None:
    known = values[chosen & np.isfinite(values)]
    return _rounded(float(np.median(known))) if len(known) else None


def _rounded(value: float) -> float | None:
    return round(value, _DIGITS) if np.isfinite(value) else None


def _write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    with replacing(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(list(rows[0]))
        for row in rows:
            cells = {**row, "flagged": int(row["flagged"]), "why": "; ".join(row["why"])}
            writer.writerow(["" if cell is None else cell for cell in cells.values()])
