"""`Template`: an artist's generic rig - neutral, named deltas, polygons - and its file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.archive import read_archive, whole_numbers, write_archive
from capture.arrays import Bools, Floats, Ints, Ints32, check_finite, check_shape
from capture.errors import InputError, ShapeError, raise_all
from recon.mesh import Mesh

ZERO_SHAPE_MM = 1e-3  # a shape that moves nothing by more than this has no effect to solve for
_HEAD_MM = (60.0, 1000.0)  # a face to a bust: the longest side of the neutral's box
_UNITS = ((10.0, "centimetres"), (1000.0, "metres"), (25.4, "inches"))
_REQUIRED = ("neutral", "deltas", "names", "polygons")
_PAIRS = ("lid_pairs", "lip_pairs")


def _no_ids() -> Ints:
    return np.zeros(0, dtype=np.int64)


def _no_pairs() -> Ints:
    return np.zeros((0, 2), dtype=np.int64)


@dataclass(frozen=True, eq=False, kw_only=True)
class Template:
    """A generic rig with the meaning the artist gave to each shape.

    Attributes:
        neutral: (V, 3) float64, template space, mm.
        deltas: (B, V, 3) float64 displacements from the neutral at weight 1, mm.
        names: B names, all different.
        polygons: (P, 4) int32; -1 in the last column pads a triangle.
        rigid_vertices: (n,) vertices that move with the skull alone; may be empty.
        lid_pairs: (n, 2) upper and lower lid vertices that meet when the eye shuts, in order.
        lip_pairs: (n, 2) upper and lower lip vertices that meet when the mouth shuts, in order.
    """

    neutral: Floats
    deltas: Floats
    names: tuple[str, ...]
    polygons: Ints32
    rigid_vertices: Ints = field(default_factory=_no_ids)
    lid_pairs: Ints = field(default_factory=_no_pairs)
    lip_pairs: Ints = field(default_factory=_no_pairs)

    def __post_init__(self) -> None:
        check_shape(
            neutral=(self.neutral, "V 3"),
            deltas=(self.deltas, "B V 3"),
            names=(np.asarray(self.names), "B"),
            polygons=(self.polygons, "P 4"),
            rigid_vertices=(self.rigid_vertices, "n"),
            lid_pairs=(self.lid_pairs, "* 2"),
            lip_pairs=(self.lip_pairs, "* 2"),
        )
        check_finite(neutral=self.neutral, deltas=self.deltas)
        problems = duplicate_names(self.names) + _index_problems(self)
        raise_all("template", problems, ShapeError)

    @property
    def mesh(self) -> Mesh:
        """The neutral as a mesh."""
        return Mesh(self.neutral, self.polygons)

    @cached_property
    def extents_mm(self) -> Floats:
        """(B,) the furthest that each shape moves a vertex, mm."""
        extents: Floats = np.linalg.norm(self.deltas, axis=2).max(axis=1, initial=0.0)
        return extents

    def moves(self) -> Bools:
        """(B,) whether each shape moves any vertex by more than `ZERO_SHAPE_MM`."""
        moving: Bools = self.extents_mm > ZERO_SHAPE_MM
        return moving

    def with_shapes(self, kept: Bools) -> Template:
        """The same template with the shapes `kept` (B,) alone."""
        names = tuple(name for name, keep in zip(self.names, kept, strict=True) if keep)
        return replace(self, deltas=self.deltas[kept], names=names)

    def support(self, tolerance: float) -> Bools:
        """Where each shape acts: (B, V), displacement above `tolerance` of the shape's extent.

        A tolerance is needed because sculpting tools and deformation transfer leave dust of about
        1e-6 of a shape's size on vertices that the artist never touched.
        """
        norms = np.linalg.norm(self.deltas, axis=2)
        acting: Bools = norms > np.maximum(tolerance * self.extents_mm, 1e-9)[:, None]
        return acting


def check_head_size(points: Floats, expected: str, scaled: str) -> None:
    """Refuse a face whose size is not that of a face in millimetres.

    Args:
        points: (N, 3).
        expected: the beginning of the message, such as "neutral: expected a head".
        scaled: what is to be multiplied when it is in another unit.

    Raises:
        ShapeError: saying what was found and which factor would bring it to mm.
    """
    size = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    low, high = _HEAD_MM
    if low <= size <= high:
        return
    fitting = [(factor, unit) for factor, unit in _UNITS if low <= size * factor <= high]
    hint = (
        f"; it looks like {fitting[0][1]}: multiply {scaled} by {fitting[0][0]:g}"
        if fitting
        else ""
    )
    raise ShapeError(
        f"{expected} in millimetres ({low:g} to {high:g} along its longest side), "
        f"found {size:.4g}{hint}"
    )


def duplicate_names(names: Sequence[str]) -> list[str]:
    """One line that lists the names given more than once; empty when all differ."""
    twice = sorted({name for name in names if list(names).count(name) > 1})
    return [f"names: each shape needs its own, found twice: {', '.join(twice)}"] if twice else []


def read_template(path: Path) -> Template:
    """Read template.npz: millimetres, nothing unpickled.

    Raises:
        InputError: naming the file and what does not fit: a key, a shape, a name given twice, an
            index out of range, or a neutral whose size is not that of a head in millimetres.
    """
    arrays = read_archive(path, _REQUIRED, optional=("rigid_vertices", *_PAIRS))
    try:
        template = Template(
            neutral=arrays["neutral"].astype(np.float64),
            deltas=arrays["deltas"].astype(np.float64),
            names=text_names(arrays["names"]),
            polygons=_padded(arrays["polygons"]),
            **{key: whole_numbers(arrays[key], key) for key in arrays if key not in _REQUIRED},
        )
        check_head_size(template.neutral, "neutral: expected a head", "neutral and deltas")
    except InputError as error:
        raise ShapeError(f"{path}: {error}") from error
    return template


def write_template(path: Path, template: Template) -> None:
    """Write template.npz, whole or not at all; the same template gives the same bytes."""
    arrays: dict[str, NDArray[Any]] = {
        "neutral": template.neutral.astype(np.float32),
        "deltas": template.deltas.astype(np.float32),
        "names": np.array(template.names, dtype=np.str_),
        "polygons": template.polygons,
    }
    for key in ("rigid_vertices", *_PAIRS):
        if getattr(template, key).size:
            arrays[key] = getattr(template, key)
    write_archive(path, arrays)


def text_names(names: NDArray[Any]) -> tuple[str, ...]:
    """Names as text, from an array of unicode.

    Raises:
        ShapeError: when the array holds something else than text.
    """
    if names.dtype.kind != "U" or names.ndim != 1:
        raise ShapeError(
            f"names: expected a list of text, found {names.dtype} of shape {names.shape}"
        )
    return tuple(str(name) for name in names)


def _padded(polygons: NDArray[Any]) -> Ints32:
    if polygons.ndim == 2 and polygons.shape[1] == 3:
        polygons = np.concatenate([polygons, np.full((len(polygons), 1), -1)], axis=1)
    return np.ascontiguousarray(whole_numbers(polygons, "polygons"), dtype=np.int32)


def _index_problems(template: Template) -> list[str]:
    count = len(template.neutral)
    problems = []
    for key in ("rigid_vertices", *_PAIRS):
        ids = getattr(template, key)
        if ids.size and (ids.min() < 0 or ids.max() >= count):
            problems.append(
                f"{key}: vertex ids must lie in 0..{count - 1}, found {ids.min()}..{ids.max()}"
            )
    corners = template.polygons
    if corners.size and (corners[:, :3].min() < 0 or corners.min() < -1 or corners.max() >= count):
        problems.append(
            f"polygons: vertex ids must lie in 0..{count - 1} (-1 pads a triangle), "
            f"found {corners.min()}..{corners.max()}"
        )
    return problems
