"""`TAKE/corrections.json`, the artist's file: read strictly, written whole.

::

    TAKE/corrections.json                     what is corrected, and what can be undone
    TAKE/corrections/locked_0012_3fa9c1d2.npz the vertices of a locked frame, by their hash

Tracking reads both and writes neither.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from capture.archive import read_archive, write_archive
from capture.arrays import Floats32, check_finite, check_shape
from capture.documents import read_json
from capture.errors import ShapeError, TakeError, raise_all
from capture.names import known_hint
from capture.product import replacing
from track.corrections.checks import Subject, entry_problems, together_problems
from track.corrections.entries import (
    Anchor,
    Correction,
    Curve,
    Entry,
    FrameExclusion,
    Lock,
    Pin,
    Remarks,
    ViewExclusion,
)
from track.corrections.table_reader import TableReader

FILE = "corrections.json"
_FORMAT, _VERSION = "likeness-corrections", 1
_HEX = set("0123456789abcdef")


@dataclass(frozen=True, kw_only=True)
class Step:
    """One change, as it must be known to be undone, or done again once undone.

    Attributes:
        numbers: ids of entries that stand in the file: added by a step that can be undone, to be
            removed by one that can be done again.
        entries: entries that do not: removed by the one, to be added by the other.
    """

    numbers: tuple[int, ...] = ()
    entries: tuple[Entry, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Book:
    """The content of the file.

    Attributes:
        entries: the corrections that hold; their order says nothing.
        history: changes that can be undone, oldest first.
        undone: changes that can be done again, the next one last.
    """

    entries: tuple[Entry, ...] = ()
    history: tuple[Step, ...] = ()
    undone: tuple[Step, ...] = ()

    @property
    def next_id(self) -> int:
        """An id that no entry has or had."""
        return 1 + max((entry.id for entry in self.every), default=0)

    @property
    def every(self) -> tuple[Entry, ...]:
        """The entries that hold and those that may hold again."""
        kept = [entry for step in self.history + self.undone for entry in step.entries]
        return self.entries + tuple(kept)


@dataclass(frozen=True, eq=False, kw_only=True)
class LockedFrame:
    """What a locked frame is.

    Attributes:
        vertices: (V, 3) world mm.
        confidence: (V,) 0..1, as it was tracked.
    """

    vertices: Floats32
    confidence: Floats32 = field(repr=False)

    def __post_init__(self) -> None:
        check_shape(vertices=(self.vertices, "V 3"), confidence=(self.confidence, "V"))
        check_finite(vertices=self.vertices, confidence=self.confidence)


def read_book(folder: Path, subject: Subject) -> Book:
    """Read the corrections of a take; a take without the file has none.

    Args:
        folder: the take's.
        subject: what they must fit.

    Raises:
        TakeError: listing everything that does not fit, by its place in the file.
    """
    path = Path(folder) / FILE
    if not path.exists():
        return Book()
    document = read_json(path, TakeError)
    if not isinstance(document, dict):
        raise TakeError(f"{path}: expected an object, found a {type(document).__name__}")
    problems: list[str] = []
    book = _book(TableReader(document, "", problems), subject)
    if not problems:
        problems += _contradictions(book, subject)
    raise_all(str(path), problems, TakeError)
    return book


def write_book(folder: Path, book: Book, subject: Subject) -> None:
    """Write the corrections of a take, whole or not at all; the same ones give the same bytes.

    Raises:
        TakeError: listing what does not fit; nothing is written then.
    """
    path = Path(folder) / FILE
    raise_all(str(path), _misfits(book, subject), TakeError)
    mesh = {"vertices": subject.vertex_count, "topology": subject.topology}
    lines = [
        f'{{"format": "{_FORMAT}",',
        f' "version": {_VERSION},',
        f' "mesh": {json.dumps(mesh)},',
        f' "entries": {_lines([entry.table() for entry in _ordered(book.entries)])},',
        f' "history": {_lines([_step_table(s, "added", "removed") for s in book.history])},',
        f' "undone": {_lines([_step_table(s, "removed", "added") for s in book.undone])}}}',
    ]
    with replacing(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")


def locked_path(folder: Path, lock: Lock) -> Path:
    """Where the vertices of a locked frame stand, by frame and content: a lock can be undone."""
    name = f"locked_{lock.frame:04d}_{lock.sha256[:8]}.npz"
    return Path(folder) / "corrections" / name


def read_locked(folder: Path, lock: Lock, vertex_count: int) -> LockedFrame:
    """Read the vertices of a locked frame.

    Raises:
        TakeError: when the file is missing, was changed, or is of another mesh.
    """
    path = locked_path(folder, lock)
    remedy = f"put it back, or `likeness correct {folder} unlock --frames {lock.frame}`"
    if not path.is_file():
        raise TakeError(f"{path}: the vertices of locked frame {lock.frame} are gone; {remedy}")
    try:
        held = read_archive(path, required=("vertices", "confidence"))
        check_shape(vertices=(held["vertices"], f"{vertex_count} 3"))
        locked = LockedFrame(
            vertices=held["vertices"].astype(np.float32),
            confidence=held["confidence"].astype(np.float32),
        )
    except ShapeError as error:
        raise TakeError(f"{path}: {error}; {remedy}") from error
    if _digest(locked) != lock.sha256:
        raise TakeError(f"{path}: it was changed since frame {lock.frame} was locked; {remedy}")
    return locked


def lock_of(frame: int, locked: LockedFrame) -> Lock:
    """The lock that keeps a frame at these vertices."""
    return Lock(frame=frame, sha256=_digest(locked))


def write_locked(folder: Path, lock: Lock, locked: LockedFrame) -> None:
    """Store the vertices that a lock names."""
    arrays = {"vertices": locked.vertices, "confidence": locked.confidence}
    write_archive(locked_path(folder, lock), arrays)


def _digest(locked: LockedFrame) -> str:
    content = locked.vertices.tobytes() + locked.confidence.tobytes()
    return hashlib.sha256(content).hexdigest()


def _contradictions(book: Book, subject: Subject) -> list[str]:
    return [*_history_problems(book), *together_problems(book.entries, subject)]


def _misfits(book: Book, subject: Subject) -> list[str]:
    problems = [
        f"entry {entry.id}: {text}"
        for entry in book.every
        for text in entry_problems(entry.what, subject)
    ]
    return problems or _contradictions(book, subject)


def _history_problems(book: Book) -> list[str]:
    """Every entry must stand at one place, and every step find the ids that it names."""
    ids = [entry.id for entry in book.every]
    problems = [
        f"id {number} is given twice" for number in sorted(set(ids)) if ids.count(number) > 1
    ]
    problems += [f"id {number}: expected 1 or more" for number in sorted(set(ids)) if number < 1]
    for name, steps in (("history", book.history), ("undone", book.undone)):
        standing = {entry.id for entry in book.entries}
        for index in reversed(range(len(steps))):
            step = steps[index]
            for number in step.numbers:
                if number not in standing:
                    problems.append(f"{name}[{index}]: there is no entry {number} at that point")
            standing = (standing - set(step.numbers)) | {entry.id for entry in step.entries}
    return problems


def _book(reader: TableReader, subject: Subject) -> Book:
    if (name := reader.text("format")) != _FORMAT and reader.sound:
        reader.tell(f'format: expected "{_FORMAT}", found {name!r}')
    version = reader.whole("version")
    if reader.sound and version != _VERSION:
        reader.tell(f"version: {version} is not known; this program reads version {_VERSION}")
        return Book()
    if (mesh := reader.table("mesh")) is not None:
        _check_mesh(mesh, subject)
    book = Book(
        entries=_entries(reader, "entries", subject),
        history=_steps(reader, "history", ("added", "removed"), subject),
        undone=_steps(reader, "undone", ("removed", "added"), subject),
    )
    reader.close()
    return book


def _check_mesh(mesh: TableReader, subject: Subject) -> None:
    count, topology = mesh.whole("vertices"), mesh.text("topology")
    mesh.close()
    if not mesh.sound:
        return
    if count != subject.vertex_count:
        mesh.tell(f"the corrections are of {count} vertices, this mesh has {subject.vertex_count}")
    elif topology != subject.topology:
        mesh.tell(f"the corrections are of another mesh of {count} vertices: its polygons differ")


def _entries(reader: TableReader, key: str, subject: Subject) -> tuple[Entry, ...]:
    return tuple(_entry(table, subject) for table in reader.tables(key))


def _steps(
    reader: TableReader, key: str, names: tuple[str, str], subject: Subject
) -> tuple[Step, ...]:
    steps = []
    for table in reader.tables(key):
        numbers = table.wholes(names[0]) if table.has(names[0]) else ()
        steps.append(Step(numbers=numbers, entries=_entries(table, names[1], subject)))
        table.close()
    return tuple(steps)


def _entry(reader: TableReader, subject: Subject) -> Entry:
    number, kind = reader.whole("id"), reader.text("kind")
    if kind not in _KINDS:
        if reader.sound:
            reader.tell(f"no kind {kind!r}; {known_hint(kind, _KINDS)}")
        return Entry(id=number, what=Anchor(frame=0))
    what = _KINDS[kind](reader)
    remarks = Remarks(
        by=reader.text("by", ""), time=reader.text("time", ""), note=reader.text("note", "")
    )
    reader.close()
    if reader.sound:
        for problem in entry_problems(what, subject):
            reader.tell(problem)
    return Entry(id=number, what=what, remarks=remarks)


def _pin(reader: TableReader) -> Pin:
    corners: tuple[int, ...]
    shares: tuple[float, ...] = (1.0,)
    if reader.has("vertex") and not reader.has("triangle"):
        corners = (reader.whole("vertex"),)
    elif reader.has("triangle") and not reader.has("vertex"):
        corners, shares = reader.wholes("triangle", 3), reader.numbers("barycentric", 3)
    else:
        reader.tell("a pin has either vertex, or triangle and barycentric")
        corners = (0,)
    return Pin(
        frame=reader.whole("frame"), corners=corners, barycentric=shares,
        pixels=reader.pixels_by_name("pixels"), weight=reader.number("weight", 1.0),
    )  # fmt: skip


def _curve(reader: TableReader) -> Curve:
    return Curve(
        frame=reader.whole("frame"), camera=reader.text("camera"), chain=reader.text("chain"),
        vertices=reader.wholes("vertices"), pixels=reader.pixels("pixels"),
        weight=reader.number("weight", 1.0),
    )  # fmt: skip


def _view_exclusion(reader: TableReader) -> ViewExclusion:
    return ViewExclusion(
        camera=reader.text("camera"), first=reader.whole("first"), last=reader.whole("last")
    )


def _frame_exclusion(reader: TableReader) -> FrameExclusion:
    return FrameExclusion(first=reader.whole("first"), last=reader.whole("last"))


def _lock(reader: TableReader) -> Lock:
    sha256 = reader.text("sha256")
    if reader.sound and (len(sha256) != 64 or not set(sha256) <= _HEX):
        reader.tell(f"sha256: expected 64 hexadecimal digits, found {sha256[:70]!r}")
    return Lock(frame=reader.whole("frame"), sha256=sha256)


def _anchor(reader: TableReader) -> Anchor:
    return Anchor(frame=reader.whole("frame"))


_KINDS: dict[str, Callable[[TableReader], Correction]] = {
    "pin": _pin, "curve": _curve, "exclude_view": _view_exclusion,
    "exclude_frame": _frame_exclusion, "lock": _lock, "anchor": _anchor,
}  # fmt: skip


def _step_table(step: Step, numbers: str, entries: str) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if step.numbers:
        out[numbers] = sorted(step.numbers)
    if step.entries:
        out[entries] = [entry.table() for entry in _ordered(step.entries)]
    return out


def _ordered(entries: tuple[Entry, ...]) -> list[Entry]:
    return sorted(entries, key=lambda entry: entry.id)


def _lines(rows: list[dict[str, Any]]) -> str:
    """A list in JSON, a line for each row."""
    if not rows:
        return "[]"
    return "[\n  " + ",\n  ".join(json.dumps(row, ensure_ascii=False) for row in rows) + "]"
