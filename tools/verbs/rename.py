"""Give the shapes of a rig, template or table of weights the names of another convention.

Shapes that the other convention has as two halves are split, two halves of one are merged; names
without a counterpart are kept and listed. docs/naming.md says more.
Example: likeness rename rig/rig.npz --to arkit --out rig_arkit.npz
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from capture.archive import read_archive
from capture.errors import InputError
from capture.names import known_hint
from capture.progress import Progress
from rig.exchange import read_thing
from rig.face_rig import FaceRig, write_rig
from rig.health_symmetry import find_mirror
from rig.mouth_close import convert_mouth_close
from rig.naming import NameMap, Renaming, detect_map, find_names, read_name_map, rename
from rig.split import WIDTH_MM, apply_renaming, split_shape
from rig.template import Template, read_template, write_template
from rig.weight_table import WeightTable, write_weights
from tools.verbs.options import Options


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness rename`."""

    thing: tyro.conf.Positional[Path]
    """rig.npz, template.npz or weights.npz."""
    out: Path
    """The file to write."""
    to: str | None = None
    """arkit, livelink, ict, facs, or a map of one's own in a .toml file."""
    source: str | None = None
    """The convention that the names are in; all that the project knows are read when left out."""
    split: tuple[str, ...] = ()
    """Names of shapes to split into a left and a right half before anything else."""
    width_mm: float = WIDTH_MM
    """The width over which one half fades into the other."""
    mirror: Path | None = None
    """A template.npz whose neutral tells left from right, for an actor's crooked face."""
    mouth_close: Literal["corrective", "combined"] | None = None
    """Convert mouthClose from the other convention into this one."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Rename, write, and report what was renamed, split, merged and kept."""
    if arguments.to is None and not arguments.split and arguments.mouth_close is None:
        raise InputError("rename: nothing to do; give --to, --split or --mouth-close")
    thing = _read(arguments.thing)
    report: dict[str, Any] = {"out": str(arguments.out)}
    lateral_mm = None
    if arguments.mirror is not None and not isinstance(thing, WeightTable):
        model = read_template(arguments.mirror).neutral
        if model.shape != thing.neutral.shape:
            raise InputError(
                f"{arguments.mirror}: {len(model)} vertices, {arguments.thing} has "
                f"{len(thing.neutral)}: --mirror wants the same topology"
            )
        lateral_mm = find_mirror(model).lateral_mm(thing.neutral)
    if isinstance(thing, WeightTable):
        if arguments.split or arguments.mouth_close or arguments.mirror:
            raise InputError(
                f"{arguments.thing}: --split, --mirror and --mouth-close need a rig or a template, "
                "this is a table of weights"
            )
    else:
        for name in arguments.split:
            thing = split_shape(thing, name, None, arguments.width_mm, lateral_mm)
        if arguments.mouth_close is not None:
            converted = convert_mouth_close(thing, arguments.mouth_close)
            thing = converted.thing
            report["clipped_frames"] = converted.clipped_frames
            report["worst_clip"] = converted.worst_clip
    if arguments.to is not None:
        source = None if arguments.source is None else read_name_map(arguments.source)
        called = source or detect_map(thing.names)
        renaming = rename(thing.names, read_name_map(arguments.to), source)
        thing, apart = apply_renaming(thing, renaming, arguments.width_mm, lateral_mm)
        report |= {"from": called.name, **_told(renaming, apart)}
        report["meant"] = _hints(renaming.unmapped, called)
    _write(arguments.out, thing)
    progress(1, 1, "rename")
    return report | {"shapes": len(thing.names)}


def _told(renaming: Renaming, apart: Mapping[str, float]) -> dict[str, Any]:
    changed = [
        (old, news[0]) for old, news in zip(renaming.old, renaming.new, strict=True)
        if len(news) == 1 and old != news[0]
    ]  # fmt: skip
    return {
        "renamed": len(changed),
        "split": {old: list(news) for old, news in renaming.splits.items()},
        "merged": {new: list(olds) for new, olds in renaming.merges.items()},
        "merged_weights_apart": dict(apart),
        "kept": list(renaming.unmapped),
    }


def _hints(unmapped: Sequence[str], source: NameMap) -> dict[str, str]:
    """For kept names that are in no convention, the nearest name of `source` if there is one."""
    known = [own for owns in source.shapes.values() for own in owns]
    hints = {
        name: known_hint(name, known)
        for name, anywhere in zip(unmapped, find_names(unmapped), strict=True)
        if anywhere is None and source.find(name) is None
    }
    return {name: hint for name, hint in hints.items() if hint.startswith("did you mean")}


def _read(path: Path) -> FaceRig | Template | WeightTable:
    thing = read_thing(path)
    if isinstance(thing, WeightTable):
        return thing
    if not isinstance(thing, FaceRig):
        raise InputError(f"{path}: a performance has no shapes to name")
    # A template is read again, for its pairs and rigid vertices.
    return thing if "weights" in read_archive(path, (), ("weights",)) else read_template(path)


def _write(path: Path, thing: FaceRig | Template | WeightTable) -> None:
    if isinstance(thing, FaceRig):
        write_rig(path, thing)
    elif isinstance(thing, Template):
        write_template(path, thing)
    else:
        write_weights(path, thing)
