"""What the operator says of a take: status, rating, text, and why a verdict was overruled.

::

    SESSION/notes/<take>.json

Beside the takes and not inside them: a take's folder is renamed once it is written and has a
manifest of its hashes, and a note may change at any time. It is written at every change, whole or
not at all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from capture.documents import is_whole, key_problems, read_document, write_json
from capture.errors import TakeError, raise_all
from capture.judgement import Colour
from capture.names import is_plain_name

FORMAT = "likeness-note"
VERSION = 1
_MOST_STARS = 5
_LONGEST = 10_000
_KEYS = ("format", "version", "status", "decided_by", "rating", "text", "overruled")


class TakeStatus(StrEnum):
    """What was decided about a take."""

    UNDECIDED = "undecided"
    KEEP = "keep"
    FLAG = "flag"  # keep it, somebody must look at it
    RETAKE = "retake"  # it stays on disk, another one counts


@dataclass(frozen=True, kw_only=True)
class Overrule:
    """A verdict that the operator did not follow.

    Attributes:
        colour: of the verdict as it was.
        sentence: of the verdict as it was.
        reason: why it was not followed.
    """

    colour: Colour
    sentence: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class OperatorNote:
    """What the operator says of a take.

    Attributes:
        status: what was decided.
        decided_by: "operator" or "machine"; empty while undecided.
        rating: stars, 0 (none given) to 5.
        text: free.
        overruled: the verdict that was not followed, or None.
    """

    status: TakeStatus = TakeStatus.UNDECIDED
    decided_by: str = ""
    rating: int = 0
    text: str = ""
    overruled: Overrule | None = None

    def __post_init__(self) -> None:
        problems = []
        if not 0 <= self.rating <= _MOST_STARS:
            problems.append(f"rating must be 0 to {_MOST_STARS}, found {self.rating}")
        if len(self.text) > _LONGEST:
            problems.append(f"text must be at most {_LONGEST} letters, found {len(self.text)}")
        raise_all("note", problems, TakeError)


@dataclass(frozen=True)
class NoteBook:
    """The notes of a session.

    Attributes:
        folder: SESSION/notes.
    """

    folder: Path

    @classmethod
    def of_session(cls, session_folder: Path) -> NoteBook:
        """The notes of the session in a folder; nothing is read or made yet."""
        return cls(Path(session_folder) / "notes")

    def read(self, take: str) -> OperatorNote:
        """The note of a take; an empty one when there is none.

        Raises:
            TakeError: when the note is damaged or of a newer version.
        """
        path = self._path(take)
        return _read_note(path) if path.exists() else OperatorNote()

    def write(self, take: str, note: OperatorNote) -> None:
        """Write the note of a take, whole or not at all.

        Raises:
            WorkError: when the disk does not take it.
        """
        document = {"format": FORMAT, "version": VERSION, **dataclasses.asdict(note)}
        write_json(self._path(take), document)

    def all(self) -> dict[str, OperatorNote]:
        """All notes, by the take's name; raises as `read` does."""
        paths = sorted(path for path in self.folder.glob("*.json") if is_plain_name(path.stem))
        return {path.stem: _read_note(path) for path in paths}

    def _path(self, take: str) -> Path:
        if not is_plain_name(take):
            raise TakeError(f"note: expected the name of a take, found {take!r}")
        return self.folder / f"{take}.json"


def _read_note(path: Path) -> OperatorNote:
    document = read_document(path, FORMAT, VERSION, TakeError)
    raise_all(str(path), key_problems(document, _KEYS, _KEYS, "note"), TakeError)
    try:
        overruled = document["overruled"]
        return OperatorNote(
            status=TakeStatus(document["status"]),
            decided_by=_text(document, "decided_by"),
            rating=_stars(document["rating"]),
            text=_text(document, "text"),
            overruled=None if overruled is None else _overrule(overruled),
        )
    except (TakeError, ValueError, KeyError, TypeError) as error:
        raise TakeError(f"{path}: damaged note: {error}") from error


def _overrule(table: Mapping[str, Any]) -> Overrule:
    return Overrule(
        colour=Colour(table["colour"]),
        sentence=_text(table, "sentence"),
        reason=_text(table, "reason"),
    )


def _text(table: Mapping[str, Any], key: str) -> str:
    if not isinstance(table[key], str):
        raise TakeError(f"{key}: expected a text, found {table[key]!r}")
    return str(table[key])


def _stars(value: Any) -> int:
    if not is_whole(value):
        raise TakeError(f"rating: expected a whole number, found {value!r}")
    return value
