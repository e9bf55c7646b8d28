"""Check from a few board poses whether an array still stands as it was calibrated.

Writes drift.json and a page, beside NEW.json or else in the take. With --resolve or
--resolve-moved the devices that have moved are solved anew against the others, which keep every
digit, and all cameras are written to NEW.json. docs/sessions.md says more.
Example: likeness drift takes/check --board board.toml --cameras cameras.json
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from capture.camera import CameraArray
from capture.camera_file import cameras_from_document, write_cameras
from capture.documents import read_json
from capture.errors import CameraError, InputError, SolveError, TakeError
from capture.product import replacing
from capture.progress import Progress
from capture.take import Take
from recon.board.body import read_body
from recon.board.corner_cache import CornerCache
from recon.board.corners import CornerLimits
from recon.board.diagnosis import explain_blind, merged_words
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.board.sightings import observe_board
from recon.calibration.drift import DriftSettings, check_drift, resolve_devices
from recon.calibration.drift_report import DriftReport
from tools.report.drift import write_drift_page
from tools.verbs.options import Options

REQUIRED = ("take", "board", "cameras")


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness drift`."""

    take: tyro.conf.Positional[Path]
    """A take of the board at 3 to 10 places."""
    board: Path
    """The board's TOML file."""
    cameras: Path
    """cameras.json to compare with."""
    resolve: tuple[str, ...] = ()
    """Devices to solve anew; needs --out."""
    resolve_moved: bool = False
    """Solve anew whatever has moved; needs --out."""
    lens: bool = False
    """Solve the lenses of these devices too, from 8 poses or more."""
    out: Path | None = None
    """Where to write the cameras after solving devices anew; never the file of --cameras."""
    settings: Annotated[DriftSettings, tyro.conf.arg(name="")] = field(
        default_factory=DriftSettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Check, solve anew what is asked for, write, and report in words."""
    _check_paths(arguments)
    document = read_json(arguments.cameras, CameraError, absent="no such file")
    cameras = cameras_from_document(document, str(arguments.cameras))
    body = read_body(arguments.board)
    take = Take.open(arguments.take)
    settings = arguments.settings
    limits = CornerLimits(max_blur_px=settings.max_blur_px, max_poses=settings.max_poses)
    cache = CornerCache(take, body)
    found = observe_board(take, body, limits, cache=cache, progress=progress)
    seen, shape = found.observations, body.shape()
    odd = merged_words(explain_blind(take, body, found), len(take.device_names))
    progress(0, 1, "drift")
    try:
        report = check_drift(cameras, seen, shape, settings)
    except TakeError as error:
        if odd:
            raise TakeError(f"{error}\nwhat the images show:\n  - " + "\n  - ".join(odd)) from error
        raise
    told = report.document() | {"take": take.name, "cameras": arguments.cameras.name}
    told["words"] = [*told["words"], *odd]
    refusal = ""
    if arguments.out is not None:
        refusal = _refusal(report, arguments)
        if not refusal:
            new = _resolved(arguments, cameras, report, (seen, shape))
            again = check_drift(new, seen, shape, settings)
            told["after"] = {
                "resolved": [a.name for a, b in zip(new, cameras, strict=True) if a is not b],
                "headline": again.headline(),
                "moved": list(again.moved),
            }
            old = document["report"] if isinstance(document.get("report"), dict) else {}
            note = {"resolved": told["after"]["resolved"], "resolved_from": arguments.cameras.name}
            write_cameras(arguments.out, new, old | note)
    files = _write(arguments, take, told)
    progress(1, 1, "drift")
    if refusal:
        raise SolveError(f"{refusal}; the report is {files['report']}")
    return (told if arguments.json else _short(told)) | files


def _check_paths(arguments: Arguments) -> None:
    wanted = bool(arguments.resolve) or arguments.resolve_moved
    if wanted and arguments.out is None:
        raise InputError("drift: --resolve and --resolve-moved need --out NEW.json")
    if arguments.out is not None and not wanted:
        raise InputError(
            "drift: --out is where cameras solved anew are written: give --resolve NAME or "
            "--resolve-moved too"
        )
    if arguments.lens and not wanted:
        raise InputError("drift: --lens belongs to --resolve or --resolve-moved")
    if arguments.out is not None and arguments.out.resolve() == arguments.cameras.resolve():
        raise InputError(
            f"drift: --out {arguments.out} is the file of --cameras, which is never overwritten; "
            "give another name"
        )
    if arguments.out is not None:
        report = arguments.out.with_name(f"{arguments.out.stem}.drift.json")
        if report.resolve() == arguments.cameras.resolve():
            raise InputError(
                f"drift: the report {report} would overwrite the file of --cameras; give another "
                "name to --out"
            )


def _refusal(report: DriftReport, arguments: Arguments) -> str:
    """Why devices are not solved anew, or ""."""
    if report.board_factor != 1.0:
        return (
            f"{arguments.board}: the devices agree only with a board {report.board_factor:.4f} "
            "times as large as this file says; nothing was solved anew"
        )
    if report.verdict == "anew" and not arguments.resolve:
        return f"{report.headline()}; nothing was solved anew"
    return ""


def _resolved(
    arguments: Arguments,
    cameras: CameraArray,
    report: DriftReport,
    sightings: tuple[BoardObservations, BoardShape],
) -> CameraArray:
    names = list(arguments.resolve)
    if arguments.resolve_moved:
        names += [name for name in report.moved if name not in names]
    if not names:
        return cameras
    return resolve_devices(cameras, names, *sightings, arguments.settings, lens=arguments.lens)


def _write(arguments: Arguments, take: Take, told: dict[str, Any]) -> dict[str, str]:
    folder, stem = take.products / "drift", "drift"
    if arguments.out is not None:
        folder, stem = arguments.out.parent, f"{arguments.out.stem}.drift"
    report, page = folder / f"{stem}.json", folder / f"{stem}.html"
    with replacing(report) as partial:
        partial.write_text(json.dumps(told, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    write_drift_page(told, page)
    return {"report": str(report), "page": str(page)}


def _short(told: dict[str, Any]) -> dict[str, Any]:
    """The verdict and what else was said, one line each."""
    out = {"verdict": told["headline"]}
    for number, line in enumerate(told["words"][1:], start=1):
        out[f"remark {number}"] = line
    if "after" in told:
        out["resolved"] = ", ".join(told["after"]["resolved"]) or "nothing"
        out["afterwards"] = told["after"]["headline"]
    return out
