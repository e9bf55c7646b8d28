"""Strict reading of a table of a board file into a dataclass, and the check of the printed scale.

A sheet is drawn at true scale with a bar of known length, and printers scale. So the table
`[print]` holds what was drawn, which is never edited, and what a calliper reads on the printed bar:

::

    [print]
    bar_mm = 100.0            # as drawn
    measured_bar_mm = 95.3    # what the calliper reads on the paper
    drawn_square_mm = 20.0    # as drawn
    drawn_marker_mm = 15.0

The board's own sizes are always the true ones, on the paper. They must be the drawn ones times
measured over drawn bar; a file that still holds the drawn ones of a shrunken sheet is refused.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from capture.errors import SettingsError
from capture.names import known_hint

_AGREE = 2e-3  # sizes and bar may disagree by this ratio: two calliper readings
_BAR, _MEASURED, _DRAWN = "bar_mm", "measured_bar_mm", "drawn_"
_NOUNS = {"square_mm": "squares", "marker_mm": "markers", "tag_mm": "tags", "gap_mm": "gaps"}


def unknown(found: Mapping[str, Any], known: tuple[str, ...], what: str) -> list[str]:
    """One line for each key that is not known, with what it may have meant."""
    return [
        f"unknown {what} {key!r}; {known_hint(key, known)}" for key in found if key not in known
    ]


def field_values(
    kind: type[Any], table: Mapping[str, Any], apart: tuple[str, ...] = ()
) -> tuple[dict[str, Any], list[str]]:
    """The values of a table, each of the type of its field, and what does not fit.

    Args:
        kind: the dataclass.
        table: as parsed.
        apart: keys that the table may hold besides, which are read elsewhere.

    Returns:
        What `kind` is to be made with, and one line for each unknown, missing or mistyped key.
    """
    fields = dataclasses.fields(kind)
    problems = unknown(table, (*(field.name for field in fields), *apart), "key")
    values: dict[str, Any] = {}
    for field in fields:
        if field.name in table:
            try:
                values[field.name] = _typed(field.name, str(field.type), table[field.name])
            except SettingsError as error:
                problems.append(str(error))
        elif field.default is dataclasses.MISSING:
            problems.append(f"missing key {field.name!r}")
    return values, problems


def print_problems(sizes: Mapping[str, float], table: object) -> list[str]:
    """What does not agree between a board's sizes and how its sheet was printed.

    Args:
        sizes: the board's true sizes by key, mm: those that `sizes_mm` gives.
        table: the table `[print]` as parsed.
    """
    drawn = {key: _DRAWN + key for key in sizes}
    wanted = (_BAR, _MEASURED, *drawn.values())
    if not isinstance(table, Mapping):
        return [f"print: expected a table with {', '.join(wanted)}, found {table!r}"]
    problems = [f"print: {line}" for line in unknown(table, wanted, "key")]
    for key in wanted:
        value = table.get(key)
        if key == _MEASURED and key not in table:
            bar = f" of {table[_BAR]} mm" if _BAR in table else ""
            problems.append(
                f"print: missing key {key!r}; measure the bar{bar} on the printed sheet with a "
                f"calliper and write what it reads, as in {key} = 100.0"
            )
        elif key not in table:
            problems.append(f"print: missing key {key!r}")
        elif not _is_length(value):
            problems.append(f"print: {key}: expected a length above 0 mm, found {value!r}")
    if problems:
        return problems
    ratio = table[_MEASURED] / table[_BAR]
    for key, size in sizes.items():
        true = table[drawn[key]] * ratio
        if abs(size - true) > _AGREE * true:
            problems.append(
                f"{key} says {size}, but the printed bar of {table[_BAR]:g} mm measures "
                f"{table[_MEASURED]:g} mm: the {_NOUNS.get(key, key)} are {true:.6g} mm; write that"
            )
    return problems


def sizes_mm(board: Any) -> dict[str, float]:
    """The lengths of a board, a dataclass, by key: every field whose name ends in `_mm`."""
    names = [field.name for field in dataclasses.fields(board)]
    return {name: getattr(board, name) for name in names if name.endswith("_mm")}


def _is_length(value: object) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(float(str(value))) and float(str(value)) > 0


def _typed(name: str, kind: str, value: Any) -> Any:
    wanted: dict[str, tuple[type, ...]] = {
        "int": (int,),
        "float": (int, float),
        "str": (str,),
        "bool": (bool,),
    }
    if not isinstance(value, wanted[kind]) or (kind != "bool" and isinstance(value, bool)):
        raise SettingsError(f"{name}: expected {kind}, found {value!r}")
    return float(str(value)) if kind == "float" else value
