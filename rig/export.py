"""Export of rigs, performances and weights to exchange formats, chosen by suffix."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from capture.errors import InputError, SettingsError
from rig.exchange import Thing, read_thing
from rig.export_gltf import write_glb_performance, write_glb_rig
from rig.export_ma import write_ma
from rig.export_text import write_performance_obj, write_rig_obj, write_weights_csv
from rig.export_usd import write_usd_performance, write_usd_rig
from rig.face_rig import FaceRig, write_rig
from rig.weight_table import WeightTable, write_weights
from track.performance import Performance, write_performance

_Writer = Callable[[Path, Any, float], list[Path] | None]


def export(thing: Path, out: Path, *, fps: float = 75.0) -> list[Path]:
    """Export a rig, template, performance or weights file to the format that `out` is named for.

    A rig goes to .usdc, .usda, .glb, .ma, .obj (neutral, and a folder of shapes), .csv (its
    weights) or .npz; a performance to .usdc, .usda, .glb, .obj (a numbered sequence) or .npz;
    weights to .csv or .npz.

    Args:
        thing: rig.npz, template.npz, performance.npz or weights.npz, told apart by its arrays.
        out: the file to write or replace.
        fps: frames per second of the motion.

    Returns:
        The files and folders written: `out`, but for OBJ, which is many files.

    Raises:
        InputError: when `thing` is none of these, or cannot be held by that format.
        ExtraError: when the format's optional package is not installed.
        SettingsError: when `fps` is not a positive number.
    """
    if not (math.isfinite(fps) and fps > 0):
        raise SettingsError(f"fps: must be above 0 frames/s, found {fps}")
    out = Path(out)
    loaded = read_thing(Path(thing))
    return _writer(Path(thing), loaded, out)(out, loaded, fps) or [out]


def _writer(source: Path, thing: Thing, out: Path) -> _Writer:
    kind, writers = _writers(thing)
    suffix = out.suffix.lower()
    if suffix in writers:
        return writers[suffix]
    reason = ""
    if suffix == ".csv" and kind == "performance":
        reason = " (CSV holds weights, and a performance has none: solve a rig from it first)"
    elif suffix == ".ma" and kind == "performance":
        reason = " (a Maya scene holds the rig: solve a rig from it first, or take .usdc)"
    elif kind == "weights track" and suffix in _RIG:
        reason = " (weights alone have no mesh: export the rig that holds them)"
    elif suffix == ".csv":
        reason = " (CSV holds weights, and a template has none)"
    raise InputError(
        f"{out}: {source.name} is a {kind}, which cannot be exported to "
        f"{suffix or 'a file without suffix'}{reason}; supported: {', '.join(writers)}"
    )


def _writers(thing: Thing) -> tuple[str, dict[str, _Writer]]:
    if isinstance(thing, FaceRig):
        if len(thing.weights):
            return "rig", _RIG
        return "template", {
            suffix: _RIG[suffix] for suffix in (".usdc", ".usda", ".glb", ".ma", ".obj")
        }
    if isinstance(thing, Performance):
        return "performance", _PERFORMANCE
    return "weights track", _WEIGHTS


def _rig_csv(path: Path, rig: FaceRig, fps: float) -> None:
    write_weights_csv(path, WeightTable(weights=rig.weights, names=rig.names), fps)


_RIG: dict[str, _Writer] = {
    ".usdc": write_usd_rig,
    ".usda": write_usd_rig,
    ".glb": write_glb_rig,
    ".ma": write_ma,
    ".obj": lambda path, rig, fps: write_rig_obj(path, rig),
    ".csv": _rig_csv,
    ".npz": lambda path, rig, fps: write_rig(path, rig),
}
_PERFORMANCE: dict[str, _Writer] = {
    ".usdc": write_usd_performance,
    ".usda": write_usd_performance,
    ".glb": write_glb_performance,
    ".obj": lambda path, performance, fps: write_performance_obj(path, performance),
    ".npz": lambda path, performance, fps: write_performance(path, performance),
}
_WEIGHTS: dict[str, _Writer] = {
    ".csv": write_weights_csv,
    ".npz": lambda path, table, fps: write_weights(path, table),
}
