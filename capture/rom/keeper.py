"""What a session writes down of itself, at every change: its place, the notes, the log.

A disk that takes frames may let others wait for seconds: so all but the text of a note is written
by a thread of its own, the newest state of each file. A disk that refuses is told, not raised: the
session goes on, and it is tried again.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from capture.errors import TakeError, WorkError
from capture.event_log import EventLog
from capture.rom.memory import as_document, load_state, save_document
from capture.rom.shot_list import PromptList
from capture.rom.state import RomState
from capture.session import Session
from capture.take_notes import NoteBook, OperatorNote

_RETRY_S = 1.0  # after a disk has refused


class Keeper:
    """Writes a session down. Its methods are called from one thread."""

    def __init__(self, session: Session, prompts: PromptList) -> None:
        """Hold a session.

        Args:
            session: where to write.
            prompts: its shot list.
        """
        self._session, self._prompts = session, prompts
        self._book = NoteBook.of_session(session.folder)
        self._log: EventLog | None = None
        self._notes: dict[str, OperatorNote] = {}
        self._unsaved: set[str] = set()  # takes whose note the disk does not hold yet
        self._document: Mapping[str, Any] = {}
        self._saved: Mapping[str, Any] = {}
        self._unsynced = False
        self._writing = threading.Lock()  # one note at a time
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="likeness-keeper")
        self._job: Future[None] | None = None
        self._refused_s = float("-inf")
        self._problems: deque[str] = deque()

    def open(self) -> tuple[RomState, tuple[str, ...]]:
        """Take up the session where it stood.

        Returns:
            The state, and what the operator should know.

        Raises:
            TakeError: when what it left on disk is damaged.
            WorkError: when its log cannot be written.
        """
        state, told = load_state(self._session, self._prompts)
        self._notes = self._book.all()
        self._log = EventLog(self._session.folder / "events.jsonl")
        return state, told

    def close(self) -> None:
        """Write what is not written yet, and close the log."""
        self._writer.shutdown(wait=True)
        if self._log is not None:
            self._write_down()
            self._log.close()
            self._log = None

    def note(self, take: str) -> OperatorNote:
        """The note of a take, as it is in memory."""
        return self._notes.get(take, OperatorNote())

    def change_note(self, take: str, *, text: str | None = None, rating: int | None = None) -> str:
        """Change a note and write it at once.

        Args:
            take: by name.
            text: the new text, or None to leave it.
            rating: the new rating, or None to leave it.

        Returns:
            Why it was not written, or "". What was refused by the disk is tried again later.
        """
        note = self.note(take)
        try:
            note = replace(
                note,
                text=note.text if text is None else text,
                rating=note.rating if rating is None else rating,
            )
        except TakeError as error:
            return str(error)
        self._notes[take] = note
        return self._write_note(take)

    def keep(self, state: RomState) -> None:
        """See to it that what has changed is written: place, takes, decisions, log."""
        for take in state.takes:
            old = self.note(take.name)
            note = replace(
                old, status=take.status, decided_by=take.decided_by, overruled=take.overruled
            )
            if note != old:
                self._notes[take.name] = note
                self._unsaved.add(take.name)
        self._document = as_document(self._prompts, state)
        changed = self._unsaved or self._unsynced or self._document != self._saved
        idle = self._job is None or self._job.done()
        if changed and idle and time.monotonic() >= self._refused_s + _RETRY_S:
            self._job = self._writer.submit(self._write_down)

    def log(self, kind: str, **fields: Any) -> None:
        """Append a line to the log.

        Args:
            kind: of the line.
            fields: what belongs to the kind.
        """
        if self._log is None:
            return
        try:
            self._log.append(kind, **fields)
        except WorkError as error:
            self._problems.append(str(error))
        self._unsynced = True

    def problems(self) -> tuple[str, ...]:
        """What could not be written since the last call."""
        found = []
        while self._problems:
            found.append(self._problems.popleft())
        return tuple(found)

    def _write_down(self) -> None:
        """Bring all that has changed to the disk; in the writer's thread."""
        problems = []
        if self._unsynced and self._log is not None:
            self._unsynced = False  # first: a line that comes meanwhile is synced next time
            try:
                self._log.sync()
            except WorkError as error:
                problems.append(str(error))
        told = [self._write_note(name) for name in sorted(self._unsaved)]
        problems += [problem for problem in told if problem]
        document = self._document
        if document != self._saved:
            try:
                save_document(self._session, document)
                self._saved = document
            except WorkError as error:
                problems.append(str(error))
        if problems:
            self._refused_s = time.monotonic()
            self._problems.extend(problems)

    def _write_note(self, take: str) -> str:
        with self._writing:
            self._unsaved.discard(take)  # first: a change that comes meanwhile is written next time
            try:
                self._book.write(take, self._notes[take])
            except WorkError as error:
                self._unsaved.add(take)
                return str(error)
        return ""
