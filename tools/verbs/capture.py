"""Record a session: arm the array, prompt the talent, know within seconds whether a take is good.

Opens the operator's console in this terminal; docs/operator.md tells all of it. A session that is
there already goes on where it stood. Without hardware: --simulate 16.
Example: likeness capture sessions/today --array array.toml
"""

from __future__ import annotations

import logging
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from capture.array_file import ArrayFile, read_array_file, simulated_array_file
from capture.array_open import open_array
from capture.calibration_link import link_calibration
from capture.devices.backend import LineOwner, load_backend
from capture.devices.preset import read_preset
from capture.devices.roster import Finding as RosterFinding
from capture.devices.roster import compare, look
from capture.errors import InputError
from capture.judgement import Colour
from capture.live import LiveArray
from capture.preflight import Finding, PreflightSettings, Subject, preflight
from capture.progress import Progress
from capture.rom.conductor import Conductor, Stand
from capture.rom.shot_list import read_shot_list, standard_shot_list
from capture.rom.view import View
from capture.session import Session
from tools.verbs.capture_unattended import Rehearsal, run_unattended
from tools.verbs.options import Options

REQUIRED = ("session",)
_SETTLED = ("keep", "flag", "skipped")  # of a prompt: it has a take that counts, or needs none


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness capture`."""

    session: tyro.conf.Positional[Path]
    """The session's folder; made when it is not there."""
    array: Path | None = None
    """The array file: devices, trigger, rate. docs/operator.md shows one."""
    simulate: int | None = None
    """So many simulated devices instead of an array file."""
    shots: Path | None = None
    """The shot list; the standard list of about sixty expressions when not given."""
    unattended: bool = False
    """Run all prompts without keys, for tests and rehearsals."""
    retakes: int = 1
    """With --unattended: how often a prompt is recorded again while its take is red."""
    overrule: bool = False
    """With --unattended: record even when the check of the array is red."""
    settings: Annotated[PreflightSettings, tyro.conf.arg(name="")] = field(
        default_factory=PreflightSettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Record, and report every take with its verdict.

    Raises:
        InputError: when it is not clear which devices to use.
        DeviceError: when a device cannot be opened or, unattended, the array not be armed.
    """
    file = _array_file(arguments)
    if not arguments.unattended:
        _check_console()
    shots = arguments.shots
    prompts = standard_shot_list() if shots is None else read_shot_list(shots)
    roster = _roster(file)  # before the devices are opened: then they are in use, by us
    remarks: list[str] = []
    array = open_array(file, told=remarks.append)
    try:
        session = Session.create(arguments.session)
        if file.calibration is not None:
            link_calibration(session.folder, file.calibration)
        live = LiveArray(array, file.record)
        stand = Stand(
            session=session, prompts=prompts, array=live, settings=file.record,
            frame_set_bytes=sum(device.info.layout.nbytes for device in array.devices),
            preflight=_checker(live, file, roster, arguments),
        )  # fmt: skip
        with Conductor(stand) as conductor:
            if arguments.unattended:
                rehearsal = Rehearsal(retakes=arguments.retakes, overrule=arguments.overrule)
                run_unattended(conductor, rehearsal, progress)
            else:
                _open_console(conductor, array.names, remarks)
        view = conductor.view()
    finally:
        array.close()
    return _report(view, remarks, arguments.json)


def _open_console(conductor: Conductor, names: tuple[str, ...], remarks: list[str]) -> None:
    from tools.terminal.console import Console  # Textual takes a while to import

    listener = _Listener(remarks)
    logger = logging.getLogger("capture")
    logger.addHandler(listener)
    try:
        Console(conductor, names, remarks=remarks).run()
    finally:
        logger.removeHandler(listener)
    print("the devices stop; takes that are still being written are finished ...", file=sys.stderr)


class _Listener(logging.Handler):
    """Hands warnings to the console: printed, they would run across its screen."""

    def __init__(self, remarks: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._remarks = remarks

    def emit(self, record: logging.LogRecord) -> None:
        """Hand one on."""
        self._remarks.append(record.getMessage())


def _checker(
    live: LiveArray, file: ArrayFile, roster: Sequence[RosterFinding], arguments: Arguments
) -> Callable[[Progress], Sequence[Finding]]:
    """The check of the array, as the conductor calls it."""
    presets = {
        entry.name: read_preset(entry.preset) for entry in file.devices if entry.preset is not None
    }
    subject = Subject(live=live, session=arguments.session, roster=roster, presets=presets)
    return lambda heard: preflight(subject, arguments.settings, progress=heard)


def _roster(file: ArrayFile) -> tuple[RosterFinding, ...]:
    """The roster against what is found; devices that are played can be opened unseen."""
    real = [
        entry for entry in file.devices if not isinstance(load_backend(entry.backend), LineOwner)
    ]
    backends = list(dict.fromkeys(entry.backend for entry in real))
    return compare(real, look(backends)) if real else ()


def _array_file(arguments: Arguments) -> ArrayFile:
    if (arguments.array is None) == (arguments.simulate is None):
        raise InputError("give either --array array.toml or --simulate NUMBER")
    if arguments.array is not None:
        return read_array_file(arguments.array)
    return simulated_array_file(arguments.simulate or 0)


def _check_console() -> None:
    if not sys.stdin.isatty():
        raise InputError(
            "the console needs a terminal and stdin is none; use --unattended to run all "
            "prompts without keys"
        )


def _report(view: View, remarks: list[str], everything: bool) -> dict[str, Any]:
    """Takes, colours and decisions; with --json every take with all that is known of it."""
    takes = view.takes
    colours = Counter(str(take.colour) for take in takes if take.colour is not None)
    decisions = Counter(str(take.note.status) for take in takes)
    left = [line.prompt.slate for line in view.prompts if line.status not in _SETTLED]
    check = [
        f"{one.colour}: {one.sentence} {one.remedy}".rstrip()
        for one in view.findings
        if one.colour != Colour.GREEN
    ]
    if not everything:
        return {
            "session": view.session,
            **{f"check {n}": told for n, told in enumerate(check, start=1)},
            "takes": f"{len(takes)} ({_counted(colours)}; {_counted(decisions)})",
            "prompts left": ", ".join(left) or "none",
            **{f"remark {n}": told for n, told in enumerate(remarks, start=1)},
            **{t.name: f"{t.colour}, {t.note.status}: {t.sentence}" for t in takes},
        }
    return {
        "session": view.session, "takes": len(takes), **colours, "decisions": dict(decisions),
        "finished": view.finished, "prompts_left": left, "remarks": remarks,
        "check": check,
        "list": [
            {
                "take": take.name, "slate": take.slate, "number": take.number,
                "phase": take.phase, "colour": take.colour, "sentence": take.sentence,
                "status": take.note.status, "rating": take.note.rating, "note": take.note.text,
                "superseded": take.superseded,
            }
            for take in takes
        ],
    }  # fmt: skip


def _counted(counts: Counter[str]) -> str:
    return ", ".join(f"{count} {word}" for word, count in counts.items()) or "none"
