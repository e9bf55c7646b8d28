"""Make a take of a visiting folder of images, frames lossless.

SRC holds cameras.json (optional) and one folder of numbered PNG files a camera; or images and a
COLMAP model. Example: likeness import ../visit/smile --out takes/smile
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from capture.progress import Progress
from recon.visiting import import_take
from tools.verbs.options import Options


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness import`."""

    source: tyro.conf.Positional[Path]
    """The visiting folder."""
    out: Path
    """The take to write."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Import and report devices and frames."""
    take = import_take(arguments.source, arguments.out, progress=progress)
    return {
        "take": str(take.folder),
        "devices": len(take.device_names),
        "frames": len(take.frames),
        "cameras": take.has_cameras,
    }
