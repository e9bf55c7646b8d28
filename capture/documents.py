"""JSON and TOML files: read so that whatever is wrong is told in one line, and JSON kept safe."""

from __future__ import annotations

import json
import math
import os
import tomllib
from collections.abc import Callable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeGuard

from capture.durable import sync_folder
from capture.errors import InputError, WorkError
from capture.names import known_hint
from capture.product import replacing

_FAULTS = (OSError, ValueError, RecursionError)
"""Unreadable; not text, not that language, a number of too many digits; nested without end."""


def read_json(path: Path, kind: type[InputError] = InputError, *, absent: str = "") -> Any:
    """The parsed JSON of a file.

    Args:
        path: the file.
        kind: the class of error to raise.
        absent: what to say when there is no such file, after its name.

    Raises:
        InputError: (as `kind`) naming the file, when it is missing or is not JSON.
    """
    return _read(path, json.loads, "JSON", kind, absent)


def read_document(
    path: Path, form: str, version: int, kind: type[InputError] = InputError
) -> dict[str, Any]:
    """The parsed JSON of a document of ours, which names its format and version.

    Args:
        path: the file.
        form: what its "format" must say.
        version: the newest that is read; all older ones are.
        kind: the class of error to raise.

    Raises:
        InputError: (as `kind`) naming the file, when it is not such a document, or a newer one.
    """
    document = read_json(path, kind)
    if not isinstance(document, dict) or document.get("format") != form:
        raise kind(f'{path}: expected "format": "{form}"')
    found = document.get("version")
    if not is_whole(found) or found < 1:
        raise kind(f"{path}: version must be a whole number, found {found!r}")
    if found > version:
        raise kind(
            f"{path}: written in format version {found}, this program reads up to {version}; "
            "update likeness"
        )
    return document


def is_whole(value: object) -> TypeGuard[int]:
    """Whether a parsed value is a whole number, as JSON means it: true and false are none."""
    return isinstance(value, int) and not isinstance(value, bool)


def read_toml(path: Path, kind: type[InputError] = InputError, *, absent: str = "") -> Any:
    """The parsed TOML of a file; arguments and errors as of `read_json`."""
    return _read(path, tomllib.loads, "TOML", kind, absent)


def key_problems(
    found: Mapping[str, Any], required: tuple[str, ...], known: tuple[str, ...], what: str
) -> list[str]:
    """Keys that an object of a strict file lacks, and those that it must not have, in words.

    Args:
        found: the object as parsed.
        required: keys it must have.
        known: keys it may have.
        what: the name of the object in the words.
    """
    problems = [f"{what}: missing key {key!r}" for key in required if key not in found]
    for key in found:
        if key not in known:
            problems.append(f"{what}: unknown key {key!r}; {known_hint(key, known)}")
    return problems


def plain_json(value: Any) -> Any:
    """The value as reading its JSON back gives it, with null for NaN and infinity."""
    if isinstance(value, Mapping):
        return {key: plain_json(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(inner) for inner in value]
    if isinstance(value, StrEnum):
        return value.value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all, and wait until the disk holds it.

    Raises:
        WorkError: naming the file, when the disk does not take it; the old file stays.
    """
    try:
        with replacing(path) as partial, partial.open("w", encoding="utf-8") as file:
            file.write(json.dumps(document, indent=1) + "\n")
            file.flush()
            os.fsync(file.fileno())
        sync_folder(Path(path).parent)
    except OSError as error:
        raise WorkError(f"{path}: not written: {error.strerror or error}") from error


def _read(
    path: Path, parse: Callable[[str], Any], language: str, kind: type[InputError], absent: str
) -> Any:
    try:
        return parse(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise kind(f"{path}: {absent or 'no such file'}") from error
    except _FAULTS as error:
        raise kind(f"{path}: not readable as {language}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    if isinstance(error, RecursionError):
        return "nested too deeply"
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return str(error)
