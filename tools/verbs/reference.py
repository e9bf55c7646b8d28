"""Keep what every device sees on the day of a calibration, to be compared with later.

Record a second of somebody sitting still in the chair, then keep it beside the calibration:
sessions that use the calibration find it there, and the preflight says which device has moved or
lost focus. docs/preflight.md tells what is compared.
Example: likeness reference sessions/monday/takes/still_001 --cameras stage/cameras.json
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from capture.calibration_link import reference_of_take
from capture.camera_file import read_cameras
from capture.progress import Progress
from capture.take import Take
from tools.verbs.options import Options

REQUIRED = ("take", "cameras")


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness reference`."""

    take: tyro.conf.Positional[Path]
    """The take."""
    cameras: Path
    """The calibration; reference.npz is written beside it."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Write the reference, and report how sharp and bright each device was.

    Raises:
        InputError: when the take or the calibration does not fit.
    """
    take = Take.open(arguments.take)
    read_cameras(arguments.cameras)
    out = arguments.cameras.with_name("reference.npz")
    made = reference_of_take(take, out)
    progress(1, 1, "reference")
    return {
        "reference": str(out),
        "devices": {
            name: {"sharpness": one.sharpness, "brightness": one.brightness}
            for name, one in made.items()
        },
    }
