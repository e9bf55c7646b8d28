"""Write the HTML report of a take: one self-contained page.

Example: likeness report takes/smile --rig rig --out report.html
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from capture.errors import InputError
from capture.progress import Progress
from tools.report import report_for_take
from tools.verbs.options import Options


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness report`."""

    take: tyro.conf.Positional[Path]
    """The take, or a session: then the latest take of each slate."""
    rig: Path | None = None
    """The folder that `likeness rig` wrote."""
    out: Path
    """The page to write."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Write the page and report its size.

    Raises:
        InputError: when --rig names a folder without a rig.
    """
    if arguments.rig is not None and not (arguments.rig / "rig.npz").is_file():
        raise InputError(
            f"{arguments.rig}: expected a folder that `likeness rig` wrote, found no rig.npz in it"
        )
    report_for_take(arguments.take, arguments.out, rig=arguments.rig, progress=progress)
    return {"page": str(arguments.out), "bytes": arguments.out.stat().st_size}
