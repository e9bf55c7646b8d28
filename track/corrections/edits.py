"""Changes to a take's corrections, each one step that can be undone and done again."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from capture.errors import InputError, TakeError, raise_all
from track.corrections.checks import Subject, claim, entry_problems
from track.corrections.entries import Correction, Entry, Lock, Pin, Remarks
from track.corrections.sidecar import (
    FILE,
    Book,
    LockedFrame,
    Step,
    lock_of,
    locked_path,
    read_book,
    write_book,
    write_locked,
)


@dataclass(frozen=True, kw_only=True)
class Change:
    """What a step did: entries that hold since, and entries that no longer do."""

    came: tuple[Entry, ...] = ()
    went: tuple[Entry, ...] = ()


def add(
    folder: Path,
    subject: Subject,
    corrections: Sequence[Correction],
    remarks: Remarks | None = None,
) -> Change:
    """Add corrections to a take, in one step.

    A pin of a point that is pinned at that frame already takes its place: it keeps the old one's
    other cameras. A curve takes the place of the same chain's in that view and frame.

    Args:
        folder: the take's.
        subject: what they must fit.
        corrections: to add; those that the take has already, word for word, are left out.
        remarks: on all of them.

    Returns:
        The entries made and those they replace; none when the take has them all already.

    Raises:
        InputError: listing what does not fit; nothing is changed then.
    """
    _check(folder, corrections, subject)
    book = read_book(folder, subject)
    held, fresh = list(book.entries), itertools.count(book.next_id)
    for what in corrections:
        rivals = [entry for entry in held if _same_place(entry.what, what)]
        merged = _successor(rivals[0].what, what) if rivals else what
        if any(merged == entry.what for entry in held):
            continue
        held = [entry for entry in held if entry not in rivals]
        held.append(Entry(id=next(fresh), what=merged, remarks=remarks or Remarks()))
    came = tuple(entry for entry in held if entry.id >= book.next_id)
    went = tuple(entry for entry in book.entries if entry not in held)
    if came:
        _save(folder, subject, book, held, Step(numbers=_ids(came), entries=went))
    return Change(came=came, went=went)


def remove(folder: Path, subject: Subject, numbers: Iterable[int]) -> Change:
    """Remove the entries of these ids from a take's corrections, in one step.

    Raises:
        InputError: naming ids that there are not; nothing is changed then.
    """
    book = read_book(folder, subject)
    wanted = set(numbers)
    strange = sorted(wanted - {entry.id for entry in book.entries})
    if strange:
        known = ", ".join(str(entry.id) for entry in book.entries) or "none"
        raise InputError(
            f"{folder}: no correction {', '.join(map(str, strange))}; there are: {known}"
        )
    went = tuple(entry for entry in book.entries if entry.id in wanted)
    if went:
        left = [entry for entry in book.entries if entry.id not in wanted]
        _save(folder, subject, book, left, Step(entries=went))
    return Change(went=went)


def lock(
    folder: Path, subject: Subject, frames: dict[int, LockedFrame], remarks: Remarks | None = None
) -> Change:
    """Lock frames to the vertices given; frames that are locked already get these instead."""
    locks = {lock_of(frame, locked): locked for frame, locked in sorted(frames.items())}
    _check(folder, locks, subject)
    for one, locked in locks.items():
        write_locked(folder, one, locked)
    return add(folder, subject, list(locks), remarks)


def undo(folder: Path, subject: Subject) -> Change:
    """Take back the last step of a take's corrections.

    Raises:
        InputError: when there is nothing to undo.
    """
    book = read_book(folder, subject)
    if not book.history:
        raise InputError(f"{folder}: nothing to undo")
    step, entries = _turned(book, book.history[-1])
    new = Book(entries=entries, history=book.history[:-1], undone=(*book.undone, step))
    write_book(folder, new, subject)
    return Change(came=book.history[-1].entries, went=step.entries)


def redo(folder: Path, subject: Subject) -> Change:
    """Do the last step again that was undone, if nothing was changed since.

    Raises:
        InputError: when there is nothing to do again.
    """
    book = read_book(folder, subject)
    if not book.undone:
        raise InputError(f"{folder}: nothing was undone since the last change")
    step, entries = _turned(book, book.undone[-1])
    new = Book(entries=entries, history=(*book.history, step), undone=book.undone[:-1])
    write_book(folder, new, subject)
    return Change(came=book.undone[-1].entries, went=step.entries)


def _check(folder: Path, corrections: Iterable[Correction], subject: Subject) -> None:
    problems = [
        f"{what}: {problem}" for what in corrections for problem in entry_problems(what, subject)
    ]
    raise_all(str(Path(folder) / FILE), problems, TakeError)


def _turned(book: Book, step: Step) -> tuple[Step, tuple[Entry, ...]]:
    """A step taken the other way: what turns it again, and the entries that hold after it."""
    went = tuple(entry for entry in book.entries if entry.id in step.numbers)
    stay = tuple(entry for entry in book.entries if entry.id not in step.numbers)
    return Step(numbers=_ids(step.entries), entries=went), stay + step.entries


def _save(folder: Path, subject: Subject, book: Book, entries: list[Entry], step: Step) -> None:
    """Write the book after a new step; what was undone before is forgotten."""
    new = Book(entries=tuple(entries), history=(*book.history, step))
    write_book(folder, new, subject)
    wanted = {locked_path(folder, e.what) for e in new.every if isinstance(e.what, Lock)}
    for entry in book.every:
        if isinstance(entry.what, Lock) and locked_path(folder, entry.what) not in wanted:
            locked_path(folder, entry.what).unlink(missing_ok=True)


def _ids(entries: Iterable[Entry]) -> tuple[int, ...]:
    return tuple(sorted(entry.id for entry in entries))


def _same_place(old: Correction, new: Correction) -> bool:
    """Whether the new correction says anew what the old one says."""
    return claim(old) is not None and claim(old) == claim(new)


def _successor(old: Correction, new: Correction) -> Correction:
    if isinstance(old, Pin) and isinstance(new, Pin):
        return replace(new, pixels={**old.pixels, **new.pixels})
    return new
