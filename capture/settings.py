"""Settings: one frozen dataclass a stage, one strict TOML file a session."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from capture.documents import read_toml
from capture.errors import SettingsError, raise_all
from capture.names import known_hint


def read_settings(path: Path, stages: Mapping[str, type[Any]]) -> dict[str, Any]:
    """Read a session's settings file: tables named after stages, nothing unknown, types checked.

    Args:
        path: a TOML file such as ``[recon]`` followed by keys of that stage's settings.
        stages: the settings dataclass of every stage, by table name.

    Returns:
        By stage, the settings made from its table; a stage without a table gets its defaults.

    Raises:
        SettingsError: naming the file, the key, what was found and the nearest known key.
    """
    document = read_toml(path, SettingsError, absent="no such settings file")
    problems = [_unknown(key, stages, f"table [{key}]") for key in document if key not in stages]
    made: dict[str, Any] = {}
    for stage, kind in stages.items():
        table = document.get(stage, {})
        if not isinstance(table, Mapping):
            problems.append(f"{stage}: expected a table [{stage}], found {table!r}")
            continue
        try:
            made[stage] = settings_from_table(table, kind, stage)
        except SettingsError as error:
            problems.append(str(error))
    raise_all(str(path), problems, SettingsError)
    return made


def settings_from_table(table: Mapping[str, Any], kind: type[Any], where: str) -> Any:
    """Make a settings dataclass from a parsed table.

    Args:
        table: keys and values as TOML gives them.
        kind: the dataclass to make.
        where: the table's name, for messages.

    Raises:
        SettingsError: listing every unknown key and every value of the wrong type; or, from the
            dataclass itself, a value out of its range.
    """
    hints = typing.get_type_hints(kind)
    fields = {field.name: hints[field.name] for field in dataclasses.fields(kind)}
    problems, values = [], {}
    for key, value in table.items():
        if key not in fields:
            problems.append(_unknown(key, fields, f"{where}.{key}"))
            continue
        try:
            values[key] = _fitted(value, fields[key])
        except TypeError as error:
            problems.append(f"{where}.{key}: {error}")
    raise_all(where, problems, SettingsError)
    return kind(**values)


def settings_to_toml(stages: Mapping[str, Any]) -> str:
    """Write settings dataclasses as TOML text, one table a stage, that `read_settings` reads back.

    Fields that are None are left out: TOML has no null.
    """
    blocks = []
    for stage, settings in stages.items():
        lines = [f"[{stage}]"]
        for field in dataclasses.fields(settings):
            value = getattr(settings, field.name)
            if value is not None:
                lines.append(f"{field.name} = {_toml(value)}")
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks) + "\n"


def check_ranges(stage: str, settings: Any, /, **ranges: tuple[float, float]) -> None:
    """Refuse settings out of their ranges; to be called from a settings dataclass.

    Args:
        stage: that they belong to, for the message.
        settings: the dataclass.
        ranges: by name of a field, the smallest and the largest good value; NaN never is good.

    Raises:
        SettingsError: naming every such setting, the value found and the range.
    """
    problems = []
    for name, (low, high) in ranges.items():
        value = getattr(settings, name)
        if not low <= value <= high:
            most = f" and at most {high:g}" if high != float("inf") else ""
            problems.append(f"{stage}.{name} = {value!r}: must be at least {low:g}{most}")
    if problems:
        raise SettingsError("; ".join(problems))


def _fitted(value: Any, hint: Any) -> Any:
    options = typing.get_args(hint) if _is_union(hint) else (hint,)
    for option in options:
        origin = typing.get_origin(option) or option
        if origin is typing.Literal:
            if value in typing.get_args(option):
                return value
        elif origin is tuple and isinstance(value, list):
            inner = typing.get_args(option)
            kinds = [inner[0]] * len(value) if len(inner) == 2 and inner[1] is ... else list(inner)
            if len(kinds) == len(value):
                return tuple(_fitted(v, k) for v, k in zip(value, kinds, strict=True))
        elif origin is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
        elif origin is int and isinstance(value, int) and not isinstance(value, bool):
            return value
        elif origin is Path and isinstance(value, str):
            return Path(value)
        elif origin in (bool, str) and isinstance(value, origin):
            return value
    names = " or ".join(getattr(option, "__name__", str(option)) for option in options)
    raise TypeError(f"expected {names}, found {value!r}")


def _is_union(hint: Any) -> bool:
    return typing.get_origin(hint) in (typing.Union, types.UnionType)


def _unknown(key: str, known: Mapping[str, Any], label: str) -> str:
    return f"{label}: unknown; {known_hint(key, known)}"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    escaped = str(value).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
