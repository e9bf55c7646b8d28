"""Track the neutral mesh through a take.

Writes TAKE/products/track/performance.npz; finished frames are kept, so it can be interrupted.
Example: likeness track takes/smile --neutral takes/smile/neutral.obj
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from capture.progress import Progress
from capture.take import Take
from recon.mesh import read_obj
from tools.verbs.options import Options, parse_frames
from track.stage import TrackSettings, track

REQUIRED = ("take", "neutral")


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness track`."""

    take: tyro.conf.Positional[Path]
    """The take; it needs cameras."""
    neutral: Path
    """The neutral in tracking topology, registered to the first frame, OBJ, world mm."""
    landmarks: Path | None = None
    """Hand marks of the first frame, JSON: the neutral is laid rigidly onto them."""
    frames: str | None = None
    """A:B (B excluded): solve these frames again with their corrections, blended at the ends."""
    workers: int = 1
    """Processes that follow parts of a long take side by side."""
    settings: Annotated[TrackSettings, tyro.conf.arg(name="")] = field(
        default_factory=TrackSettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Track and report frames, vertices and mean confidence."""
    take = Take.open(arguments.take)
    again: tuple[int, int] | None = None
    if arguments.frames is not None:
        chosen = parse_frames(arguments.frames, take.frames)
        again = (chosen[0], chosen[-1])
    performance = track(
        take,
        read_obj(arguments.neutral),
        arguments.settings,
        landmarks=arguments.landmarks,
        again=again,
        workers=arguments.workers,
        progress=progress,
    )
    return {
        "performance": str(take.products / "track" / "performance.npz"),
        "frames": len(performance.frames),
        "vertices": performance.vertices.shape[1],
        "mean_confidence": round(float(performance.confidence.mean()), 4),
    }
