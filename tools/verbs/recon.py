"""Reconstruct the surface of frames by stereo.

Writes TAKE/products/recon/frame_0000.ply, a mesh in world millimetres, for each chosen frame.
Example: likeness recon takes/smile --frames 0:12
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from capture.progress import Progress
from capture.take import Take
from recon.scan import ReconSettings, reconstruct
from tools.verbs.options import Options, parse_frames

REQUIRED = ("take",)


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness recon`."""

    take: tyro.conf.Positional[Path]
    """The take; it needs cameras."""
    frames: str | None = None
    """A:B (B excluded), A:B:STEP, A, or A,B,C; all frames when left out."""
    settings: Annotated[ReconSettings, tyro.conf.arg(name="")] = field(
        default_factory=ReconSettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Reconstruct and report the files written."""
    take = Take.open(arguments.take)
    frames = parse_frames(arguments.frames, take.frames)
    scans = reconstruct(take, frames, arguments.settings, progress=progress)
    return {"take": str(take.folder), "frames": frames, "scans": [str(scan) for scan in scans]}
