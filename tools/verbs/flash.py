"""Check by a flash of light that every device exposes at the same trigger.

Time stamps can all be wrong together; light cannot. Record a second and flash once in the middle.
Example: likeness flash sessions/monday/takes/flash_001
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from capture.judgement import Colour
from capture.preflight import flash_findings, flash_levels, worst
from capture.preflight.flash import flash_of
from capture.progress import Progress
from capture.take import Take
from tools.verbs.options import Options

REQUIRED = ("take",)


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness flash`."""

    take: tyro.conf.Positional[Path]
    """The take."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Find the flash in every device, and report who saw it at another trigger.

    Raises:
        TakeError: when the take does not fit.
    """
    levels = flash_levels(Take.open(arguments.take))
    progress(1, 1, "flash")
    found = flash_findings(levels)
    return {
        "colour": str(worst(found)),
        "same trigger everywhere": worst(found) == Colour.GREEN,
        "findings": [f"{one.sentence} {one.remedy}".strip() for one in found],
        "frames": {name: _frame(flash_of(series).index) for name, series in levels.items()},
    }


def _frame(index: int) -> int | None:
    return index if index >= 0 else None
