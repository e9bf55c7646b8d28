"""Solve the cameras of an array from a board take.

Writes CAMERAS.json, report.json beside it, and a page to look at.
Example: likeness calibrate takes/board --board board.toml --out cameras.json
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from capture.camera_file import read_cameras
from capture.errors import SettingsError
from capture.progress import Progress
from capture.take import Take
from recon.board.body import read_body
from recon.calibration.solver import CalibrateSettings
from recon.calibration.stage import calibrate, report_path
from tools.report import write_calibration_page
from tools.verbs.options import Options

REQUIRED = ("take", "board", "out")


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness calibrate`."""

    take: tyro.conf.Positional[Path]
    """The board take."""
    board: Path
    """The board's TOML file."""
    out: Path
    """cameras.json to write."""
    previous: Path | None = None
    """cameras.json of a previous session of the same array, whose world is kept."""
    settings: Annotated[CalibrateSettings, tyro.conf.arg(name="")] = field(
        default_factory=CalibrateSettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Calibrate, draw the page, report the residuals."""
    page = arguments.out.with_suffix(".html")
    if page == arguments.out:
        raise SettingsError(f"{page}: expected the name of a .json file; the page is called so")
    take = Take.open(arguments.take)
    board = read_body(arguments.board)
    previous = None if arguments.previous is None else read_cameras(arguments.previous)
    cameras = calibrate(
        take, board, arguments.settings, arguments.out, previous=previous, progress=progress
    )
    report = json.loads(report_path(arguments.out).read_text(encoding="utf-8"))
    write_calibration_page(cameras, report, page)
    plain = {k: v for k, v in report.items() if isinstance(v, str | int | float | bool)}
    return {
        "cameras": str(arguments.out), "page": str(page), "count": len(cameras), **plain,
        "gate": report["gate"], "warnings": report["warnings"],
    }  # fmt: skip
