"""Finished frames of a performance, kept on disk so that interrupted work goes on after them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.archive import read_archive, write_archive
from capture.arrays import Floats32
from capture.errors import ShapeError
from capture.product import is_current, record_path, write_record
from track.evidence import EVIDENCE_KEYS, FrameEvidence

FIGURES = ("samples", "correlation", "residual_px", "views", "seconds")


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedFrame:
    """One finished frame, as stored.

    Attributes:
        frame: which.
        vertices: (V, 3) float32 world mm.
        confidence: (V,) float32 0..1.
        figures: by name, see `FIGURES`.
        evidence: what its last round measured.
        reference: the frame it was matched to beside the neutral; -1: the neutral alone.
    """

    frame: int
    vertices: Floats32
    confidence: Floats32
    figures: Mapping[str, float]
    evidence: FrameEvidence
    reference: int = -1


class FrameStore:
    """A folder of frames, each valid for its record.

    Args:
        folder: made when a frame is first stored.
        records: what each frame is made of.
        vertex_count: V.
    """

    def __init__(
        self, folder: Path, records: Mapping[int, Mapping[str, Any]], vertex_count: int
    ) -> None:
        self._folder, self._records, self._count = folder, records, vertex_count

    def load(self, frame: int) -> TrackedFrame | None:
        """The stored frame, or None when there is none that was made this way."""
        path = self._path(frame)
        if not is_current(path, self._records[frame]):
            return None
        try:
            keys = ("vertices", "confidence", "figures", "reference", *EVIDENCE_KEYS)
            held = read_archive(path, required=keys, gaps=EVIDENCE_KEYS)
        except ShapeError:
            return None  # damaged: made again
        if held["vertices"].shape != (self._count, 3):
            return None
        return TrackedFrame(
            frame=frame,
            vertices=held["vertices"],
            confidence=held["confidence"],
            figures=dict(zip(FIGURES, held["figures"].tolist(), strict=True)),
            evidence=FrameEvidence(**{key: held[key] for key in EVIDENCE_KEYS}),
            reference=int(held["reference"]),
        )

    def save(self, frame: int, tracked: TrackedFrame) -> None:
        """Store a frame, whole or not at all."""
        path = self._path(frame)
        arrays = {
            "vertices": tracked.vertices,
            "confidence": tracked.confidence,
            "figures": np.array([tracked.figures[name] for name in FIGURES]),
            "reference": np.array(tracked.reference, dtype=np.int64),
        }
        write_archive(path, {**arrays, **tracked.evidence.arrays()})
        write_record(path, self._records[frame])

    def drop(self, frame: int) -> None:
        """Remove a stored frame, if it is there."""
        path = self._path(frame)
        record_path(path).unlink(missing_ok=True)
        path.unlink(missing_ok=True)

    def _path(self, frame: int) -> Path:
        return self._folder / f"frame_{frame:04d}.npz"
