"""Read a take back and check every frame's CRC and the ledger's sums.

Example: likeness verify takes/smile
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from capture.errors import WorkError
from capture.progress import Progress
from capture.take import Take
from capture.verify import verify_take
from tools.verbs.options import Options


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness verify`."""

    take: tyro.conf.Positional[Path]
    """The take."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Verify and report.

    Raises:
        WorkError: listing everything that is not as it was written.
    """
    found = verify_take(Take.open(arguments.take), progress=progress)
    if not found.sound:
        lines = "\n".join(f"  - {problem}" for problem in found.problems)
        raise WorkError(f"{arguments.take}: {len(found.problems)} problems\n{lines}")
    verdicts = {str(verdict): count for verdict, count in found.verdicts.items()}
    return {"take": str(arguments.take), "sound": True, "frames": found.frames, **verdicts}
