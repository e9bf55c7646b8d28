"""Write a rig, a performance or weights in an exchange format, chosen by the suffix of --out.

Example: likeness export rig/rig.npz --out rig.usdc
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from capture.progress import Progress
from rig.export import export
from tools.verbs.options import Options


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness export`."""

    thing: tyro.conf.Positional[Path]
    """rig.npz, performance.npz or weights.npz."""
    out: Path
    """A file whose suffix is usdc, usda, glb, ma, csv, obj or npz."""
    fps: float = 75.0
    """Frames a second of the performance."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Export and report the files and their size."""
    files = export(arguments.thing, arguments.out, fps=arguments.fps)
    progress(1, 1, "export")
    return {"files": [str(path) for path in files], "bytes": sum(p.stat().st_size for p in files)}
