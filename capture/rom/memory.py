"""Where a session stands, on disk: SESSION/rom.json, written at every change.

After a crash or a restart the session goes on at the same prompt. Decisions are not in here but in
the notes of the takes, so that each is told in one place only; takes that stand on the disk and are
not known here are taken up, so that none is ever lost.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from capture.documents import read_document, write_json
from capture.errors import TakeError
from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.rom.shot_list import PromptList
from capture.rom.state import RomState, TakeState
from capture.session import Session
from capture.take_notes import NoteBook, OperatorNote

FORMAT = "likeness-rom"
VERSION = 1
_CUT_SHORT = "The program ended before it was written and read back; run `likeness recover`."


def save_document(session: Session, document: Mapping[str, Any]) -> None:
    """Write down where a session stands, whole or not at all.

    Args:
        session: the session.
        document: of `as_document`.

    Raises:
        WorkError: when the disk does not take it.
    """
    write_json(_path(session), document)


def as_document(prompts: PromptList, state: RomState) -> dict[str, Any]:
    """What is written of a state; the same document means there is nothing to write."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "shot_list": prompts.name,
        "prompt": prompts.slates[state.place],
        "skipped": sorted(state.skipped),
        "takes": [
            {
                "name": take.name,
                "slate": take.slate,
                "number": take.number,
                "phase": str(take.phase),
                "colour": None if take.colour is None else str(take.colour),
                "sentence": take.sentence,
                "problems": list(take.problems),
            }
            for take in state.takes
        ],
    }


def load_state(session: Session, prompts: PromptList) -> tuple[RomState, tuple[str, ...]]:
    """Take up a session where it stood; a new one begins at the first prompt.

    Args:
        session: the session.
        prompts: its shot list; it may have changed since.

    Returns:
        The state, idle; and what the operator should know, one sentence each.

    Raises:
        TakeError: when rom.json or a note is damaged; the message names the file.
    """
    path = _path(session)
    told: list[str] = []
    state = RomState()
    if path.exists():
        document = read_document(path, FORMAT, VERSION, TakeError)
        try:
            state = _state_of(document, prompts, told)
        except (KeyError, TypeError, ValueError) as error:
            raise TakeError(
                f"{path}: damaged: {type(error).__name__} {error}; move it away to begin anew "
                "with the takes on disk"
            ) from error
    state = _with_takes_on_disk(session, state, told)
    told += [f"{take.name}: {_CUT_SHORT}" for take in state.takes if take.problems == (_CUT_SHORT,)]
    state = _with_remains(session, state, told)
    notes = NoteBook.of_session(session.folder).all()
    takes = tuple(_with_note(take, notes.get(take.name)) for take in state.takes)
    return replace(state, takes=takes), tuple(told)


def _path(session: Session) -> Path:
    return session.folder / "rom.json"


def _state_of(document: Mapping[str, Any], prompts: PromptList, told: list[str]) -> RomState:
    slate = str(document["prompt"])
    place = prompts.slates.index(slate) if slate in prompts.slates else 0
    if slate not in prompts.slates:
        told.append(f"The session stood at {slate}, which the shot list no longer has.")
    elif place:
        told.append(f"The session goes on at prompt {place + 1}, {slate}.")
    takes = tuple(_take_of(table) for table in document["takes"])
    skipped = frozenset(str(name) for name in document["skipped"])
    return RomState(place=place, takes=takes, skipped=skipped)


def _take_of(table: Mapping[str, Any]) -> TakeState:
    colour = table["colour"]
    take = TakeState(
        name=str(table["name"]),
        slate=str(table["slate"]),
        number=int(table["number"]),
        phase=TakePhase(table["phase"]),
        colour=None if colour is None else Colour(colour),
        sentence=str(table["sentence"]),
        problems=tuple(str(line) for line in table["problems"]),
    )
    if take.phase in (TakePhase.DONE, TakePhase.FAILED):
        return take
    return replace(take, phase=TakePhase.FAILED, problems=(_CUT_SHORT,))


def _with_takes_on_disk(session: Session, state: RomState, told: list[str]) -> RomState:
    damaged: list[str] = []
    for found in session.takes(damaged):
        name = found.folder.name
        known = state.take(name)
        if known is not None and known.problems != (_CUT_SHORT,):
            continue
        # A folder gets its name when it is whole: what was cut short has been recovered since.
        state = state.with_take(
            TakeState(
                name=name,
                slate=found.slate,
                number=found.take_number,
                phase=TakePhase.DONE,
                colour=Colour(found.colour),
                sentence=found.sentence,
            )
        )
        told.append(f"{name} stands on the disk and is taken up; decide about it.")
    told += [f"A take cannot be read: {problem}" for problem in damaged]
    return state


def _with_remains(session: Session, state: RomState, told: list[str]) -> RomState:
    """Folders of takes that nobody knows: the crash was faster than rom.json."""
    for folder in sorted((session.folder / "takes").glob("*.partial")):
        matched = re.fullmatch(r"(.+)_(\d+)", folder.stem)
        if matched is None or state.take(folder.stem) is not None:
            continue
        cut = TakeState(
            name=folder.stem,
            slate=matched[1],
            number=int(matched[2]),
            phase=TakePhase.FAILED,
            problems=(_CUT_SHORT,),
        )
        state = state.with_take(cut)
        told.append(f"{cut.name}: {_CUT_SHORT}")
    return state


def _with_note(take: TakeState, note: OperatorNote | None) -> TakeState:
    if note is None:
        return take
    return replace(take, status=note.status, decided_by=note.decided_by, overruled=note.overruled)
