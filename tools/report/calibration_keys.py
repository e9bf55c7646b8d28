"""What a calibration's report says, read with care: a key that is missing or odd is not drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.arrays import Floats


@dataclass(frozen=True, eq=False, kw_only=True)
class Grid:
    """Values at the nodes of a regular grid in the world.

    Attributes:
        values: (nz, ny, nx); NaN outside the volume.
        origin_mm: (3,) place of node 0, 0, 0: x, y, z.
        step_mm: distance of neighbours.
    """

    values: Floats
    origin_mm: Floats
    step_mm: float

    def place_mm(self, axis: int, index: int) -> float:
        """Where a layer is along x (0), y (1) or z (2), mm."""
        return float(self.origin_mm[axis] + self.step_mm * index)


def mapping_of(entry: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """The object under a key; empty when there is none."""
    value = entry.get(key)
    return value if isinstance(value, Mapping) else {}


def rows_of(entry: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
    """The objects of the list under a key; empty when there are none."""
    value = entry.get(key)
    return [row for row in value if isinstance(row, Mapping)] if isinstance(value, list) else []


def words_of(entry: Mapping[str, Any], key: str) -> list[str]:
    """The texts of the list under a key; empty when there are none."""
    value = entry.get(key)
    return [str(row) for row in value if row is not None] if isinstance(value, list) else []


def number_of(entry: Mapping[str, Any], key: str) -> float:
    """The number under a key; NaN when there is none."""
    return _number(entry.get(key))


def count_of(entry: Mapping[str, Any], key: str) -> int:
    """The count under a key; 0 when there is none."""
    value = number_of(entry, key)
    return round(value) if np.isfinite(value) else 0


def table_of(entry: Mapping[str, Any], key: str) -> Floats | None:
    """The rows and columns of numbers under a key, null as NaN; None when it is no such table."""
    value = entry.get(key)
    if not isinstance(value, list) or not value or not all(isinstance(v, list) for v in value):
        return None
    widths = {len(row) for row in value}
    if len(widths) != 1 or widths == {0}:
        return None
    table: Floats = np.array([[_number(cell) for cell in row] for row in value])
    return table


def vector_of(entry: Mapping[str, Any], key: str, length: int = 3) -> Floats | None:
    """So many finite numbers under a key; None when they are not there."""
    value = entry.get(key)
    if not isinstance(value, list) or len(value) != length:
        return None
    numbers: Floats = np.array([_number(cell) for cell in value])
    return numbers if np.isfinite(numbers).all() else None


def grid_of(entry: Mapping[str, Any], values: str, step: str) -> Grid | None:
    """The grid whose values, x fastest, and whose step stand under two keys; None without it."""
    shape, origin = vector_of(entry, "shape"), vector_of(entry, "origin_mm")
    step_mm, cells = number_of(entry, step), entry.get(values)
    if shape is None or origin is None or not step_mm > 0 or not isinstance(cells, list):
        return None
    nx, ny, nz = (int(size) for size in shape)
    if min(nx, ny, nz) < 1 or nx * ny * nz != len(cells):
        return None
    found: Floats = np.array([_number(cell) for cell in cells]).reshape(nz, ny, nx)
    if not np.isfinite(found).any():
        return None
    return Grid(values=found, origin_mm=origin, step_mm=step_mm)


def names_of(devices: Sequence[Mapping[str, Any]]) -> list[str]:
    """The names of devices; their place in the list where they have none."""
    return [str(entry.get("name", index)) for index, entry in enumerate(devices)]


def _number(value: Any) -> float:
    good = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if good and abs(value) < 1e300 else float("nan")
