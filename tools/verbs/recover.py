"""Make takes of what a crash left of a recording, and say exactly what was saved.

A session, or one folder NAME.partial of it. Nothing whole is thrown away: a frame is saved when its
CRC is right, and a damaged file is kept beside its copy. Takes that are being recorded are left
alone. It can be stopped and run again.
Example: likeness recover sessions/monday
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from capture.errors import WorkError
from capture.progress import Progress
from capture.recover import Outcome, TakeRecovery, recover_session, recover_take
from capture.session import Session
from tools.verbs.options import Options


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness recover`."""

    what: tyro.conf.Positional[Path]
    """A session, or a folder NAME.partial in its `takes`."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Recover, one line a take on stderr, and report.

    Raises:
        WorkError: when a take could not be recovered; it stays as it is.
    """
    if (arguments.what / "session.json").is_file():
        session = Session.open(arguments.what)
        done = recover_session(session, progress=progress, told=_tell)
    else:
        done = (recover_take(arguments.what, progress=progress),)
        _tell(done[0])
    failed = [recovery for recovery in done if recovery.outcome == Outcome.FAILED]
    if failed:
        lines = "\n".join(f"  - {recovery.sentence}" for recovery in failed)
        raise WorkError(f"{arguments.what}: {len(failed)} could not be recovered\n{lines}")
    report: dict[str, Any] = {
        str(outcome): sum(recovery.outcome == outcome for recovery in done)
        for outcome in Outcome
        if outcome != Outcome.FAILED
    }
    if not done:
        report = {"nothing to do": f"{arguments.what}: no take in it is unfinished"}
    if arguments.json:
        report = {"takes": [recovery.document() for recovery in done]}
    return report


def _tell(recovery: TakeRecovery) -> None:
    print(recovery.sentence, file=sys.stderr)
