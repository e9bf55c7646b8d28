"""Read a take back and check every frame's CRC and the ledger's sums.

Example: likeness verify takes/smile
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from capture.progress import Progress
from capture.take import Take
from tools.verbs.options import Options


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness verify`."""

    take: tyro.conf.Positional[Path]
    """The take."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Verify and report."""
    raise NotImplementedError(Take.open(arguments.take), progress)
