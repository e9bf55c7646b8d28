"""A session without an operator: every prompt in turn, for tests and rehearsals."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from capture.errors import DeviceError, WorkError
from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.progress import Progress
from capture.rom.conductor import Conductor
from capture.rom.events import Key
from capture.rom.state import Stage
from capture.rom.view import View
from capture.take_notes import TakeStatus

_TICK_S = 0.02
_ENDED = (TakePhase.DONE, TakePhase.FAILED)
_CHECK_S = 120.0  # starting and checking the devices
_TAKE_S = 120.0  # from the end of a take until it is read back
_STILL_S = 10.0  # something is refused: a device is lost, or the disk is full


@dataclass(frozen=True, kw_only=True)
class Rehearsal:
    """How an unattended session decides.

    Attributes:
        retakes: how often a prompt is recorded again while its take is red; then it is flagged.
        overrule: whether a red check is overruled instead of ending the session.
    """

    retakes: int = 1
    overrule: bool = False


def run_unattended(conductor: Conductor, rehearsal: Rehearsal, progress: Progress) -> View:
    """Arm, record every prompt that has no good take yet, wait until all is read back.

    Green takes are kept, amber ones flagged, red ones taken again and in the end flagged.

    Args:
        conductor: entered already.
        rehearsal: how it decides.
        progress: told after each prompt.

    Returns:
        How the session stands at the end.

    Raises:
        DeviceError: when the devices cannot be started, or the check is red.
        WorkError: when the session stands still.
    """
    progress(0, len(conductor.view().prompts), "the devices are started and checked")
    view = _arm(conductor, rehearsal)
    while True:
        _tell(view, progress)
        view = _decide(conductor, view, rehearsal)
        slate = _open_slate(view)
        if slate is not None:
            if view.prompt.slate != slate:
                _ask(conductor, Key.JUMP, slate=slate)
            view = _record(conductor)
        elif view.undecided or not _quiet(view):
            view = _wait(conductor, _due, _TAKE_S, "takes are read back")
        else:
            break
    _ask(conductor, Key.DISARM)
    return conductor.view()


def _arm(conductor: Conductor, rehearsal: Rehearsal) -> View:
    view = conductor.view()
    if view.stage == Stage.ARMED:
        return view
    _ask(conductor, Key.ARM)
    view = _wait(conductor, _checked, _CHECK_S, "the devices are checked")
    if view.stage == Stage.PREFLIGHT and rehearsal.overrule:
        _ask(conductor, Key.OVERRULE, reason="unattended")
        view = conductor.view()
    if view.stage != Stage.ARMED:
        findings = [
            f"  - {finding.sentence}" + (f" -> {finding.remedy}" if finding.remedy else "")
            for finding in view.findings
            if finding.colour == Colour.RED
        ]
        if not findings:
            findings = [f"  - {view.headline}"]
        raise DeviceError("\n".join(["the array could not be armed:", *findings]))
    return view


def _record(conductor: Conductor) -> View:
    """Record the present prompt, and wait until its frames are written."""
    _ask(conductor, Key.GO)
    before = len(conductor.view().takes)
    limit_s = conductor.view().prompt.countdown_s + conductor.view().prompt.total_s + _TAKE_S
    view = _wait(conductor, lambda v: v.stage == Stage.ARMED, limit_s, "the take is written")
    if len(view.takes) == before:
        last = view.messages[-1].text if view.messages else "no reason is known"
        raise WorkError(f"{view.prompt.slate}: nothing was recorded: {last}")
    return view


def _decide(conductor: Conductor, view: View, rehearsal: Rehearsal) -> View:
    """Decide about takes that were read back and wait for it."""
    for name in view.undecided:
        take = next(take for take in view.takes if take.name == name)
        if take.phase in _ENDED:
            again = take.colour == Colour.RED and take.number <= rehearsal.retakes
            _ask(conductor, Key.RETAKE if again else Key.FLAG, take=name)
    return conductor.view()


def _open_slate(view: View) -> str | None:
    """The first prompt without a take, but for those that are to be taken again."""
    taken = {take.slate for take in view.takes if take.note.status != TakeStatus.RETAKE}
    for line in view.prompts:
        if line.prompt.slate not in taken and line.status != "skipped":
            return line.prompt.slate
    return None


def _quiet(view: View) -> bool:
    return all(take.phase in _ENDED for take in view.takes)


def _due(view: View) -> bool:
    """Whether there is something to decide, or nothing more to wait for."""
    return _quiet(view) or any(
        take.phase in _ENDED and take.name in view.undecided for take in view.takes
    )


def _checked(view: View) -> bool:
    waiting = view.stage == Stage.PREFLIGHT and view.preflight is None
    return not waiting


def _tell(view: View, progress: Progress) -> None:
    done = sum(take.note.status in (TakeStatus.KEEP, TakeStatus.FLAG) for take in view.takes)
    progress(min(done, len(view.prompts)), len(view.prompts), f"session {view.session}")


def _ask(
    conductor: Conductor, key: Key, *, slate: str = "", take: str = "", reason: str = ""
) -> None:
    """Ask until it is granted."""
    refusal = conductor.key(key, slate=slate, take=take, reason=reason)
    deadline = time.monotonic() + _STILL_S
    while refusal:
        if time.monotonic() > deadline:
            raise WorkError(f"{key} was refused for {_STILL_S:.0f} s: {refusal}")
        time.sleep(_TICK_S)
        conductor.tick()
        refusal = conductor.key(key, slate=slate, take=take, reason=reason)


def _wait(conductor: Conductor, done: Callable[[View], bool], limit_s: float, what: str) -> View:
    """Let time pass until a view is as wanted."""
    deadline = time.monotonic() + limit_s
    while not done(view := conductor.view()):
        if time.monotonic() > deadline:
            raise WorkError(f"waited {limit_s:.0f} s until {what}; it stands at: {view.headline}")
        time.sleep(_TICK_S)
        conductor.tick()
    return view
