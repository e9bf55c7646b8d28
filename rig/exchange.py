"""What can be exported, read by the arrays its file holds, and how meshes are packed for it."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import numpy as np

from capture.archive import read_archive
from capture.arrays import Floats, Floats32, Ints32
from capture.errors import InputError, ShapeError
from rig.face_rig import FaceRig, read_rig
from rig.template import read_template
from rig.weight_table import WeightTable, read_weights
from track.performance import Performance, read_performance

_TEMPLATE = ("neutral", "deltas", "names", "polygons")
_PERFORMANCE = ("vertices", "confidence")
_WEIGHTS = ("weights", "names")

Thing: TypeAlias = FaceRig | Performance | WeightTable


def read_thing(path: Path) -> Thing:
    """Read a rig, template, performance or weights file, told apart by the arrays it holds.

    A template comes back as a rig of no frames.

    Raises:
        InputError: naming the file and what it holds instead, or the array that does not fit.
    """
    keys = (*_TEMPLATE, *_PERFORMANCE, "weights")
    found = read_archive(path, required=(), optional=keys)
    if all(key in found for key in _PERFORMANCE):
        performance = read_performance(path)
        if len(performance.frames) == 0:
            raise InputError(f"{path}: a performance of no frames: there is nothing to export")
        _check_polygons(path, performance.polygons, performance.vertices.shape[1])
        return performance
    if all(key in found for key in _TEMPLATE):
        rig = read_rig(path) if "weights" in found else _still(path)
        _check_polygons(path, rig.polygons, len(rig.neutral))
        return rig
    if all(key in found for key in _WEIGHTS):
        return read_weights(path)
    raise InputError(
        f"{path}: expected a rig or template ({', '.join(_TEMPLATE)}), a performance "
        f"({', '.join(_PERFORMANCE)}) or weights ({', '.join(_WEIGHTS)}); of these arrays it holds "
        f"{', '.join(found) or 'none'}"
    )


def single(rows: Floats | Floats32) -> Floats32:
    """The rows as float32, the precision of exchange, in one block."""
    return np.ascontiguousarray(rows, dtype=np.float32)


def sparse_rows(offsets: Floats32) -> tuple[Ints32, Floats32]:
    """Indices (N,) and rows (N, 3) of the offsets (V, 3) that move their vertex at all."""
    moved = np.flatnonzero((offsets != 0).any(axis=1)).astype(np.int32)
    return moved, np.ascontiguousarray(offsets[moved], dtype=np.float32)


def polygon_corners(polygons: Ints32) -> tuple[Ints32, Ints32]:
    """Corner counts (P,), and the corners of all polygons (P, 4) in one row without padding."""
    counts = np.where(polygons[:, 3] < 0, 3, 4).astype(np.int32)
    return counts, np.ascontiguousarray(polygons[polygons >= 0], dtype=np.int32)


def _still(path: Path) -> FaceRig:
    template = read_template(path)
    return FaceRig(
        neutral=template.neutral,
        deltas=template.deltas,
        names=template.names,
        polygons=template.polygons,
        weights=np.zeros((0, len(template.names))),
        head_from_rig=np.zeros((0, 4, 4)),
    )


def _check_polygons(path: Path, polygons: Ints32, count: int) -> None:
    if len(polygons) == 0:
        raise ShapeError(f"{path}: polygons: expected at least one, found none")
    low, high = int(polygons[:, :3].min()), int(polygons.max())
    if low < 0 or high >= count or int(polygons[:, 3].min()) < -1:
        raise ShapeError(
            f"{path}: polygons: vertex ids must lie in 0..{count - 1} (-1 pads a triangle), "
            f"found {low}..{high}"
        )
