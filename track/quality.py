"""Quality of a tracked take by frame and vertex, and its file `quality.npz`.

::

    TAKE/products/track/quality.npz

What the tracker measured of itself (`track.evidence`), what the mesh shows of itself (jitter,
returns to the neutral), what a scan says, and what all this together makes likely
(`track.error_model`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.archive import read_archive, write_archive
from capture.arrays import Bools, Floats32, Ints, check_shape
from capture.errors import ShapeError
from recon.mesh import Mesh
from recon.scan import load_scan
from recon.surface import Scan, SurfaceQuery
from track.error_model import ErrorModel, likely_errors
from track.evidence import FrameEvidence
from track.performance import Performance

CARRIED, SEEN, FOUND = 0, 1, 2  # marks of a vertex in a frame
_LEAST_VIEWS = 1.5  # views that must see skin, or agree on it: two, but for the mean around it
_SCAN_REACH_MM = 5.0  # a scan farther away does not show this skin
_RETURN_MM, _AWAY_MM = 0.5, 1.5  # of the 90th percentile from the neutral: back at it, and away
_ARRAYS = (
    "reprojection_px", "correlation", "views_used", "scan_distance_mm", "jitter_mm",
    "likely_error_mm",
)  # fmt: skip
_GAPS = (*_ARRAYS[:2], *_ARRAYS[3:5], "round_trip_mm")


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackQuality:
    """Quality of F frames of V vertices; NaN where there is no such number.

    Attributes:
        frames: (F,) int64 frame numbers of the take.
        reprojection_px: (F, V) float32 mean distance of the agreeing matches from the mesh.
        correlation: (F, V) float32 mean NCC of believed matches in the last round.
        views_used: (F, V) float32 how many views agreed.
        scan_distance_mm: (F, V) float32 from the vertex to the frame's scan; NaN without a scan,
            and where it ends within 5 mm.
        jitter_mm: (F, V) float32 length of the second difference over frames, head motion taken
            out; NaN in the first and last frame.
        likely_error_mm: (F, V) float32 of the error model: the true error is as likely above as
            below.
        marks: (F, V) uint8: 0 carried by its neighbours, two views do not see it; 1 seen by two
            views, but they did not agree; 2 found where two or more views agreed.
        reference: (F,) int64 the frame each was matched to; -1 is the neutral.
        round_trip_mm: (F,) float32 RMS distance of seen skin from the neutral, head motion taken
            out, at frames that returned to it; NaN at others. It holds what is left of the
            expression too, so it bounds drift from above.
    """

    frames: Ints
    reprojection_px: Floats32
    correlation: Floats32
    views_used: Floats32
    scan_distance_mm: Floats32
    jitter_mm: Floats32
    likely_error_mm: Floats32
    marks: NDArray[np.uint8]
    reference: Ints
    round_trip_mm: Floats32

    def __post_init__(self) -> None:
        check_shape(
            frames=(self.frames, "F"),
            **{key: (getattr(self, key), "F V") for key in (*_ARRAYS, "marks")},
            reference=(self.reference, "F"),
            round_trip_mm=(self.round_trip_mm, "F"),
        )

    @property
    def seen(self) -> Bools:
        """Which skin (F, V) two views see, whether they agreed on it or not."""
        seen: Bools = self.marks != CARRIED
        return seen


def measure_quality(
    neutral: Mesh,
    performance: Performance,
    evidence: Sequence[FrameEvidence],
    mm_per_px: float,
    *,
    scans: Mapping[int, Path] | None = None,
    model: ErrorModel | None = None,
) -> TrackQuality:
    """Put together the quality of a tracked take.

    Args:
        neutral: the reference, as it was tracked.
        performance: F frames.
        evidence: of each; `FrameEvidence.nothing` of the reference frame itself.
        mm_per_px: how much skin a pixel of the full images spans.
        scans: files by frame number.
        model: what turns evidence into mm; the fitted one by default.

    Raises:
        ShapeError: when evidence and performance do not belong together.
    """
    count, vertices = performance.vertices.shape[:2]
    if len(evidence) != count:
        raise ShapeError(f"evidence: expected one of each of {count} frames, found {len(evidence)}")
    still = stilled(performance)
    marks = np.stack([_marks(told) for told in evidence])
    marks[0] = np.where(performance.confidence[0] > 0.0, FOUND, CARRIED)  # the reference itself
    likely = likely_errors(neutral, still, evidence, mm_per_px, model=model)
    scan = np.full((count, vertices), np.nan, np.float32)
    for row, frame in enumerate(performance.frames.tolist()):
        if scans and frame in scans:
            scan[row] = _scan_distance(load_scan(scans[frame]), performance.vertices[row])
    return TrackQuality(
        frames=performance.frames,
        reprojection_px=np.stack([told.reprojection_px for told in evidence]),
        correlation=np.stack([told.correlation for told in evidence]),
        views_used=np.stack([told.views for told in evidence]),
        scan_distance_mm=scan,
        jitter_mm=jitter(still),
        likely_error_mm=likely,
        marks=marks,
        reference=performance.reference,
        round_trip_mm=round_trip(still, marks != CARRIED),
    )


def read_quality(path: Path) -> TrackQuality:
    """Read quality.npz; nothing in it is unpickled.

    Raises:
        ShapeError: naming the file, and the key or shape that does not fit.
    """
    keys = tuple(field.name for field in fields(TrackQuality))
    arrays = read_archive(path, required=keys, gaps=_GAPS)
    kinds: dict[str, type] = {"frames": np.int64, "reference": np.int64, "marks": np.uint8}
    typed: dict[str, Any] = {
        key: value.astype(kinds.get(key, np.float32)) for key, value in arrays.items()
    }
    try:
        return TrackQuality(**typed)
    except ShapeError as error:
        raise ShapeError(f"{path}: {error}") from error


def write_quality(path: Path, quality: TrackQuality) -> None:
    """Write quality.npz, whole or not at all, the same bytes for the same arrays."""
    write_archive(path, {field.name: getattr(quality, field.name) for field in fields(quality)})


def stilled(performance: Performance) -> Floats32:
    """Vertices (F, V, 3) with the head motion taken out, in the neutral's place, mm."""
    out = np.empty_like(performance.vertices)
    for row, motion in enumerate(performance.head_from_neutral):
        turn, shift = motion[:3, :3], motion[:3, 3]
        out[row] = (performance.vertices[row] - shift) @ turn  # the inverse of a rigid motion
    return out


def jitter(still: Floats32) -> Floats32:
    """Length (F, V) of the second difference of (F, V, 3) over frames; NaN at both ends."""
    out = np.full(still.shape[:2], np.nan, np.float32)
    for row in range(1, len(still) - 1):
        second = still[row - 1] - 2.0 * still[row] + still[row + 1]
        out[row] = np.linalg.norm(second, axis=1)
    return out


def round_trip(still: Floats32, seen: Bools) -> Floats32:
    """RMS distance (F,) from the first frame where the face came back to it; NaN elsewhere.

    Args:
        still: (F, V, 3) mm, head motion taken out.
        seen: (F, V) the skin that counts.
    """
    check_shape(still=(still, "F V 3"), seen=(seen, "F V"))
    out = np.full(len(still), np.nan, np.float32)
    left = False
    for row in range(1, len(still)):
        both = seen[0] & seen[row]
        if not both.any():
            continue
        away = np.linalg.norm(still[row][both] - still[0][both], axis=1)
        far = float(np.quantile(away, 0.9))
        left = left or far > _AWAY_MM
        if left and far < _RETURN_MM:
            out[row] = np.sqrt((away.astype(np.float64) ** 2).mean())
    return out


def _marks(told: FrameEvidence) -> NDArray[np.uint8]:
    seen = told.views_open >= _LEAST_VIEWS
    found = told.views >= _LEAST_VIEWS
    marks: NDArray[np.uint8] = np.where(found, FOUND, np.where(seen, SEEN, CARRIED)).astype(
        np.uint8
    )
    return marks


def _scan_distance(scan: Scan, vertices: Floats32) -> Floats32:
    _, _, away = SurfaceQuery(scan.vertices, scan.triangles).closest_points(vertices)
    return np.where(away <= _SCAN_REACH_MM, away, np.nan).astype(np.float32)
