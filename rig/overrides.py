"""Artist overrides: a shape sculpted by hand is one more constraint of the same solve.

Nothing that was solved is touched: the overrides stand in a file of their own, and the rig without
them comes back when they are taken out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats, check_finite, check_shape
from capture.documents import read_toml
from capture.errors import InputError, raise_all
from capture.names import known_hint
from capture.settings import check_ranges, settings_from_table
from recon.mesh import read_obj
from rig.evidence import Evidence
from rig.face_rig import FaceRig, read_rig

_TOUCHED_MM = 1e-3  # a sculpt that differs by less than this from the rig was not touched there


@dataclass(frozen=True, eq=False)
class Override:
    """One shape as the artist wants it.

    Attributes:
        name: of the shape.
        delta: (V, 3) displacement from the neutral at weight 1, mm; anything where not touched.
        touched: (V,) where the artist's word counts.
        strength: against one sure observation at weight 1; 10 all but decides.
    """

    name: str
    delta: Floats
    touched: Bools
    strength: float = 10.0

    def __post_init__(self) -> None:
        check_shape(delta=(self.delta, "V 3"), touched=(self.touched, "V"))
        check_finite(delta=self.delta)
        if not 0.0 < self.strength <= 1e6:
            raise InputError(
                f"override of {self.name}: strength must be above 0 and at most 1e6, "
                f"found {self.strength:g}"
            )


@dataclass(frozen=True, kw_only=True)
class _Entry:
    shape: str
    mesh: str
    strength: float = 10.0
    everywhere: bool = False

    def __post_init__(self) -> None:
        check_ranges("override", self, strength=(1e-6, 1e6))


def read_overrides(path: Path, out: Path | None = None) -> list[Override]:
    """Read overrides.toml: which rig was sculpted on, and a mesh for each shape.

    ```toml
    base = "rig/rig.npz"      # the rig whose shapes were opened in the sculpting tool
    [[override]]
    shape = "jawOpen"
    mesh = "jawOpen.obj"      # neutral plus shape at weight 1, in the rig's vertex order
    strength = 10.0           # against one sure observation; optional
    everywhere = false        # true: untouched vertices are meant to stay as well
    ```

    Paths are relative to the file and may not leave its folder.

    Args:
        path: of the file.
        out: folder that a rig is about to be written to, which must not be the base's.

    Raises:
        InputError: naming the file, the entry and what does not fit.
    """
    document = read_toml(path, absent="no such file of overrides")
    unknown = [f"{key}: unknown; {known_hint(key, _KEYS)}" for key in document if key not in _KEYS]
    raise_all(str(path), unknown)
    entries = document.get("override", [])
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: expected one or more [[override]] tables, found none")
    where = _inside(path, document.get("base"), "base")
    if out is not None and where == (Path(out) / "rig.npz").resolve():
        raise InputError(
            f"{path}: base: {document['base']} is the rig that would be written over; the sculpts "
            f"are told against it, so keep it and write to another folder"
        )
    base = read_rig(where)
    found = [_override(path, base, table, index) for index, table in enumerate(entries, 1)]
    names = [override.name for override in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"{path}: each shape can be overridden once, found twice: {twice}")
    return found


def check_overrides(
    overrides: Sequence[Override], names: Sequence[str], moving: Bools, count: int
) -> None:
    """Refuse overrides of shapes that the template lacks or leaves empty, or of another topology.

    Args:
        overrides: the artist's word.
        names: B shapes of the template.
        moving: (B,) which of them move anything.
        count: vertices of the template.

    Raises:
        InputError: listing them all.
    """
    problems = [
        f"{item.name}: the template has no such shape; {known_hint(item.name, names)}"
        for item in overrides
        if item.name not in names
    ]
    problems += [
        f"{item.name}: moves nothing in the template: no shape to solve; sculpt it there instead"
        for item in overrides
        if item.name in names and not moving[list(names).index(item.name)]
    ]
    problems += [
        f"{item.name}: {len(item.delta)} vertices, the template has {count}"
        for item in overrides
        if len(item.delta) != count
    ]
    raise_all("overrides", problems)


def override_evidence(overrides: Sequence[Override], names: Sequence[str]) -> Evidence:
    """One row an override, that shows its shape alone; shapes not in `names` are left out."""
    kept = [item for item in overrides if item.name in names]
    count = len(overrides[0].delta)
    offsets = np.zeros((len(kept), count, 3))
    confidence = np.zeros((len(kept), count))
    weights = np.zeros((len(kept), len(names)))
    for row, item in enumerate(kept):
        offsets[row] = np.where(item.touched[:, None], item.delta, 0.0)
        confidence[row] = np.sqrt(item.strength) * item.touched
        weights[row, list(names).index(item.name)] = 1.0
    return Evidence(offsets, confidence, weights, np.zeros(len(kept)))


def sculpted(shapes: Floats, overrides: Sequence[Override], names: Sequence[str]) -> Floats:
    """Shapes (B, V, 3) with the artist's where he touched them: what they are drawn to."""
    told = shapes.copy()
    for item in overrides:
        told[list(names).index(item.name), item.touched] = item.delta[item.touched]
    return told


def overridden(overrides: Sequence[Override], names: Sequence[str], count: int) -> Bools:
    """Where an override moves a vertex of its shape: (B, V)."""
    moved = np.zeros((len(names), count), dtype=bool)
    for item in overrides:
        far = item.touched & (np.linalg.norm(item.delta, axis=1) > _TOUCHED_MM)
        moved[list(names).index(item.name)] = far
    return moved


_KEYS = ("base", "override")


def _override(path: Path, base: FaceRig, table: Mapping[str, Any], index: int) -> Override:
    where = f"{path}: override {index}"
    entry: _Entry = settings_from_table(table, _Entry, where)
    if entry.shape not in base.names:
        raise InputError(
            f"{where}: the base rig has no shape {entry.shape!r}; "
            f"{known_hint(entry.shape, base.names)}"
        )
    mesh = read_obj(_inside(path, entry.mesh, f"override {index}: mesh"))
    if len(mesh.vertices) != len(base.neutral):
        raise InputError(
            f"{where}: {entry.mesh} has {len(mesh.vertices)} vertices, the base rig "
            f"{len(base.neutral)}: sculpt on the rig's own mesh"
        )
    delta = np.asarray(mesh.vertices, dtype=np.float64) - base.neutral
    own = base.deltas[base.names.index(entry.shape)]
    touched = np.linalg.norm(delta - own, axis=1) > _TOUCHED_MM
    if entry.everywhere:
        touched = np.ones(len(delta), dtype=bool)
    if not touched.any():
        raise InputError(f"{where}: {entry.mesh} equals the base rig's {entry.shape}: no change")
    return Override(entry.shape, delta, touched, entry.strength)


def _inside(path: Path, name: object, key: str) -> Path:
    if not isinstance(name, str) or not name:
        raise InputError(f"{path}: {key}: expected a path beside the file, found {name!r}")
    folder = Path(path).resolve().parent
    wanted = (folder / name).resolve()
    if not wanted.is_relative_to(folder):
        raise InputError(f"{path}: {key}: {name} leaves the folder of the file")
    return wanted
