"""One object of a JSON file, read key by key; what does not fit is told by its place."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from capture.names import known_hint

_LARGEST = 2**53  # beyond it JSON's numbers are not whole in every program
_MISSING = object()


class TableReader:
    """Reads an object of a file strictly.

    A value that does not fit is told in `problems` and read as an empty one; whoever reads looks
    at `sound` before using what was read.

    Args:
        table: the object.
        place: where it stands in the file, for messages.
        problems: grows by what does not fit.
    """

    def __init__(self, table: Mapping[str, Any], place: str, problems: list[str]) -> None:
        self._table, self._place, self._problems = table, place, problems
        self._asked: list[str] = []
        self._told = 0

    @property
    def sound(self) -> bool:
        """Whether all that was read so far fitted."""
        return self._told == 0

    def has(self, key: str) -> bool:
        """Whether the object has a key."""
        return key in self._table

    def tell(self, problem: str) -> None:
        """Add a problem of this object."""
        self._told += 1
        self._problems.append(f"{self._place}: {problem}" if self._place else problem)

    def close(self) -> None:
        """Tell every key that nobody asked for."""
        for key in self._table:
            if key not in self._asked:
                self.tell(f"unknown key {key!r}; {known_hint(key, self._asked)}")

    def whole(self, key: str, default: int | None = None) -> int:
        """A whole number."""
        value = self._value(key, default)
        if _is_whole(value):
            return int(value)
        self._misfit(key, "a whole number", value)
        return 0

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        value = self._value(key, default)
        if _is_number(value):
            return float(value)
        self._misfit(key, "a finite number", value)
        return 0.0

    def text(self, key: str, default: str | None = None) -> str:
        """A string."""
        value = self._value(key, default)
        if isinstance(value, str):
            return value
        self._misfit(key, "text", value)
        return ""

    def wholes(self, key: str, count: int | None = None) -> tuple[int, ...]:
        """A list of whole numbers, of a given length where there is one."""
        value = self._value(key, None)
        if isinstance(value, list) and all(map(_is_whole, value)) and count in (None, len(value)):
            return tuple(value)
        self._misfit(key, f"a list of {_many(count)}whole numbers", value)
        return ()

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """A list of finite numbers."""
        value = self._value(key, None)
        if isinstance(value, list) and all(map(_is_number, value)) and len(value) == count:
            return tuple(map(float, value))
        self._misfit(key, f"a list of {count} finite numbers", value)
        return (0.0,) * count

    def pixels(self, key: str) -> tuple[tuple[float, float], ...]:
        """A list of pixels."""
        value = self._value(key, None)
        if isinstance(value, list) and all(map(_is_pixel, value)):
            return tuple((float(x), float(y)) for x, y in value)
        self._misfit(key, "a list of pixels [column, row]", value)
        return ()

    def pixels_by_name(self, key: str) -> dict[str, tuple[float, float]]:
        """An object of pixels."""
        value = self._value(key, None)
        if isinstance(value, dict) and all(map(_is_pixel, value.values())):
            return {name: (float(x), float(y)) for name, (x, y) in value.items()}
        self._misfit(key, 'an object {"camera": [column, row]}', value)
        return {}

    def tables(self, key: str) -> list[TableReader]:
        """A list of objects; none where the key is absent."""
        value = self._value(key, [])
        if isinstance(value, list) and all(isinstance(item, dict) for item in value):
            place = f"{self._place}.{key}" if self._place else key
            return [
                TableReader(item, f"{place}[{index}]", self._problems)
                for index, item in enumerate(value)
            ]
        self._misfit(key, "a list of objects", value)
        return []

    def table(self, key: str) -> TableReader | None:
        """An object; None where the key is absent, or told to be none."""
        value = self._value(key, None)
        if isinstance(value, dict):
            place = f"{self._place}.{key}" if self._place else key
            return TableReader(value, place, self._problems)
        if value is not _MISSING:
            self._misfit(key, "an object", value)
        return None

    def _value(self, key: str, default: Any) -> Any:
        self._asked.append(key)
        if key in self._table:
            return self._table[key]
        return _MISSING if default is None else default

    def _misfit(self, key: str, wanted: str, value: Any) -> None:
        if value is _MISSING:
            self.tell(f"{key} is missing; expected {wanted}")
            return
        found = repr(value)
        short = found if len(found) <= 60 else f"{found[:57]}..."
        self.tell(f"{key}: expected {wanted}, found {short}")


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST


def _is_number(value: Any) -> bool:
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return plain and abs(value) <= _LARGEST and math.isfinite(value)


def _is_pixel(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))


def _many(count: int | None) -> str:
    return "" if count is None else f"{count} "
