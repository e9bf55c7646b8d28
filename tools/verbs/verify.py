"""Read takes back from the disk: every frame's CRC, every file's hash, the ledger's sums.

A take, or a session: then every take of it, one line each.
Example: likeness verify sessions/monday/takes/smile_001
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from capture.checksums import CHECKSUMS
from capture.durable import FolderLock
from capture.errors import TakeError, WorkError
from capture.opening import OPENING
from capture.progress import Progress
from capture.session import Session
from capture.take import MANIFEST, Take
from capture.verify import VerifyReport, VerifySettings, verify_take
from tools.verbs.options import Options

_OF_A_TAKE = (MANIFEST, CHECKSUMS, OPENING, "frames")  # a take that lost one of them is damaged


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness verify`."""

    take: tyro.conf.Positional[Path]
    """The take, or a session."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Verify and report.

    Raises:
        WorkError: listing everything that is not as it was written.
    """
    if (arguments.take / "session.json").is_file():
        return _verify_session(arguments.take, progress)
    found = _verify(arguments.take, progress)
    if not found.sound:
        raise WorkError(f"{arguments.take}: {_listed(found.problems)}")
    return {"take": str(arguments.take), **_figures(found)}


def _verify_session(folder: Path, progress: Progress) -> dict[str, Any]:
    Session.open(folder)
    takes: list[dict[str, Any]] = []
    problems: list[str] = []
    for place in sorted(path for path in (folder / "takes").glob("*") if path.is_dir()):
        if place.name.startswith("."):
            continue
        if place.suffix == ".partial":
            said = _unfinished(place, problems)
        elif any((place / name).exists() for name in _OF_A_TAKE):
            try:
                found = _verify(place, progress)
            except TakeError as error:
                found = VerifyReport(0, {}, (str(error),))
            problems += [f"{place.name}: {problem}" for problem in found.problems]
            takes.append({"take": place.name, **_figures(found)})
            said = "sound" if found.sound else _counted(found.problems)
            said = f"{said}, {found.frames} frames"
        else:
            continue
        print(f"{place.name}: {said}", file=sys.stderr)
    if problems:
        raise WorkError(f"{folder}: {_listed(problems)}")
    frames = sum(take["frames"] for take in takes)
    return {"session": str(folder), "sound": True, "frames": frames, "takes": len(takes)}


def _unfinished(folder: Path, problems: list[str]) -> str:
    with FolderLock(folder) as lock:
        if not lock.held:
            return "being recorded now"
    problems.append(f"{folder.name}: was never finished; run `likeness recover {folder}`")
    return "not finished"


def _verify(folder: Path, progress: Progress) -> VerifyReport:
    return verify_take(Take.open(folder), VerifySettings(from_disk=True), progress=progress)


def _figures(found: VerifyReport) -> dict[str, Any]:
    verdicts = {str(verdict): count for verdict, count in found.verdicts.items()}
    return {"sound": found.sound, "frames": found.frames, **verdicts}


def _listed(problems: tuple[str, ...] | list[str]) -> str:
    lines = "\n".join(f"  - {problem}" for problem in problems)
    return f"{_counted(problems)}\n{lines}"


def _counted(problems: tuple[str, ...] | list[str]) -> str:
    return f"{len(problems)} problem{'s' if len(problems) > 1 else ''}"
