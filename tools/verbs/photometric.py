"""Measure how each device turns light into numbers: black level, gain, falloff to the corners.

From a take of an evenly lit field, from the white of a board take, or from both; frames with the
lens capped give the black level. Writes photometric.json and a page to look at. Values must be
linear in light.
Example: likeness photometric --board-take takes/board --board board.toml --cameras cameras.json
--out photometric.json
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from capture.camera_file import read_cameras
from capture.progress import Progress
from capture.take import Take
from recon.board.body import read_body
from recon.photometry.sources import LightSources, PhotometricSettings
from recon.photometry.stage import calibrate_photometry
from tools.report.photometric import write_photometric_page
from tools.verbs.options import Options

REQUIRED = ("out",)


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness photometric`."""

    flat: Path | None = None
    """A take in which every device sees something evenly lit."""
    board_take: Path | None = None
    """A board take; needs --board and --cameras."""
    board: Path | None = None
    """The board's TOML file."""
    cameras: Path | None = None
    """cameras.json of the same array."""
    dark: Path | None = None
    """A take with all lenses capped: the black level."""
    out: Path
    """photometric.json to write."""
    settings: Annotated[PhotometricSettings, tyro.conf.arg(name="")] = field(
        default_factory=PhotometricSettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Measure, draw the page, report the gains and the warnings."""
    sources = LightSources(
        flat=_take(arguments.flat),
        board_take=_take(arguments.board_take),
        board=None if arguments.board is None else read_body(arguments.board),
        cameras=None if arguments.cameras is None else read_cameras(arguments.cameras),
        dark=_take(arguments.dark),
    )
    model = calibrate_photometry(sources, arguments.settings, arguments.out, progress=progress)
    report = json.loads(arguments.out.read_text(encoding="utf-8"))["report"]
    page = arguments.out.with_suffix(".html")
    write_photometric_page(model, report, page)
    return {
        "photometric": str(arguments.out),
        "page": str(page),
        "count": len(model),
        "gains_known": report["gains_known"],
        "gains": {device.name: round(device.gain, 4) for device in model},
        "warnings": report["warnings"],
    }


def _take(folder: Path | None) -> Take | None:
    return None if folder is None else Take.open(folder)
