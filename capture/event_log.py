"""What happened in a session, line by line: SESSION/events.jsonl, only ever appended to.

Each line is one JSON object: `kind`, `t_wall_ns` (since 1970, UTC), `t_mono_ns` (the host's
monotonic clock, by which frames are dated too), and whatever belongs to the kind. A line is on the
disk once `add` returns, or `sync` after `append`. A crash can tear only the last line; it is
skipped on reading, and told.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from capture.durable import sync_folder
from capture.errors import TakeError, WorkError

_OWN = ("kind", "t_wall_ns", "t_mono_ns")


@dataclass(frozen=True)
class LoggedEvent:
    """One line.

    Attributes:
        kind: such as "key", "stage", "judged", "device".
        t_wall_ns: since 1970, UTC; for people, it may jump.
        t_mono_ns: the host's monotonic clock; compare times of one run by this.
        fields: what belongs to the kind.
    """

    kind: str
    t_wall_ns: int
    t_mono_ns: int
    fields: dict[str, Any]


@dataclass(frozen=True)
class EventHistory:
    """What a log holds.

    Attributes:
        events: in the order they were written.
        problems: lines that were skipped, one sentence each.
    """

    events: tuple[LoggedEvent, ...]
    problems: tuple[str, ...]


class EventLog:
    """A log that is written to. Used in a `with` block."""

    def __init__(
        self,
        path: Path,
        *,
        wall_ns: Callable[[], int] = time.time_ns,
        mono_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Open or begin a log; a line that a crash tore is closed, so that the next stands alone.

        Args:
            path: of the file; its folder is made.
            wall_ns: the clock for people.
            mono_ns: the clock that never jumps.

        Raises:
            WorkError: when the file cannot be opened for writing.
        """
        self.path = Path(path)
        self._wall_ns, self._mono_ns = wall_ns, mono_ns
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            new = not self.path.exists()
            self._file = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
        except OSError as error:
            raise WorkError(f"{path}: cannot be written: {error.strerror or error}") from error
        try:
            if new:
                sync_folder(self.path.parent)
            size = os.fstat(self._file).st_size
            if size and os.pread(self._file, 1, size - 1) != b"\n":
                self._write(b"\n")
        except BaseException:
            os.close(self._file)
            raise

    def add(self, kind: str, /, **fields: Any) -> None:
        """Append one line and wait until the disk holds it: `append` and `sync`.

        Args:
            kind: of the event.
            fields: what belongs to it; JSON values.

        Raises:
            WorkError: when the disk does not take it; nothing of the line stays.
        """
        self.append(kind, **fields)
        self.sync()

    def append(self, kind: str, /, **fields: Any) -> None:
        """Append one line; a killed program does not lose it, a power cut may. Else as `add`."""
        times = {"t_wall_ns": self._wall_ns(), "t_mono_ns": self._mono_ns()}
        self._write(json.dumps({"kind": kind, **times, **fields}).encode() + b"\n")

    def sync(self) -> None:
        """Wait until the disk holds all lines; may be called from another thread.

        Raises:
            WorkError: when the disk fails.
        """
        try:
            os.fdatasync(self._file)
        except OSError as error:
            raise WorkError(f"{self.path}: not synced: {error.strerror or error}") from error

    def close(self) -> None:
        """Close the file; a closed log may be closed again."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def __enter__(self) -> EventLog:
        """Use it in a `with` block."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close it."""
        self.close()

    def _write(self, line: bytes) -> None:
        size = os.fstat(self._file).st_size
        try:
            left = memoryview(line)
            while left:
                left = left[os.write(self._file, left) :]
        except OSError as error:
            with contextlib.suppress(OSError):  # what cannot be cut is skipped on reading
                os.ftruncate(self._file, size)
            raise WorkError(f"{self.path}: not written: {error.strerror or error}") from error


def read_events(path: Path) -> EventHistory:
    """Read a log back; lines that are torn or damaged are skipped and told.

    Raises:
        TakeError: when the file cannot be read at all.
    """
    path = Path(path)
    try:
        lines = path.read_bytes().split(b"\n")
    except OSError as error:
        raise TakeError(f"{path}: not readable: {error.strerror or error}") from error
    last = lines.pop()  # what follows the last end of line: nothing, or a torn line
    events, problems = [], []
    for number, line in enumerate(lines, start=1):
        event = _parsed(line)
        if event is not None:
            events.append(event)
        elif line:
            problems.append(f"{path}:{number}: torn or damaged, skipped: {_shown(line)}")
    if last:
        problems.append(f"{path}:{len(lines) + 1}: the last line is torn, skipped: {_shown(last)}")
    return EventHistory(tuple(events), tuple(problems))


def _parsed(line: bytes) -> LoggedEvent | None:
    try:
        document = json.loads(line.decode())
    except (ValueError, RecursionError):
        return None
    if not isinstance(document, dict):
        return None
    kind, wall, mono = (document.get(key) for key in _OWN)
    if not isinstance(kind, str) or not isinstance(wall, int) or not isinstance(mono, int):
        return None
    fields = {key: value for key, value in document.items() if key not in _OWN}
    return LoggedEvent(kind, wall, mono, fields)


def _shown(line: bytes) -> str:
    return repr(line[:40].decode(errors="replace"))
