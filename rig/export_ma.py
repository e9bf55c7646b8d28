"""Maya ASCII (.ma): the mesh, its blendShape node, and animation curves for weights and head."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from capture.arrays import Floats, Floats32, Ints32
from capture.errors import InputError
from capture.product import replacing
from rig.exchange import polygon_corners, single, sparse_rows
from rig.face_rig import FaceRig

_TIME_UNITS = {15: "game", 24: "film", 25: "pal", 30: "ntsc", 48: "show", 50: "palf", 60: "ntscf"}
_NUMBERED = (2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 40, 75, 80, 100, 120, 125, 150, 200, 240, 250, 300)
_ROW = 8  # values a line


def write_ma(path: Path, rig: FaceRig, fps: float) -> None:
    """Write the rig as a Maya scene: blendShape with sparse targets, weights and head keyed.

    Args:
        path: the file to write or replace.
        rig: the rig; without motion no curve is written.
        fps: frames per second, one of Maya's own time units.

    Raises:
        InputError: when Maya has no time unit of that frame rate.
    """
    unit = _TIME_UNITS.get(round(fps)) or (f"{round(fps)}fps" if round(fps) in _NUMBERED else "")
    if not unit or fps != round(fps):
        known = ", ".join(str(rate) for rate in sorted({*_TIME_UNITS, *_NUMBERED}))
        raise InputError(f"{path}: Maya has no time unit of {fps:g} frames/s; it has {known}")
    names = maya_names(rig.names)
    with replacing(path) as partial, partial.open("w", encoding="ascii") as handle:
        for line in _scene(rig, names, unit):
            handle.write(line + "\n")


def maya_names(names: Iterable[str]) -> list[str]:
    """Names as Maya accepts them: letters, digits and `_`, not beginning with a digit, unique."""
    out: list[str] = []
    for name in names:
        plain = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name)
        if not plain or plain[0].isdigit():
            plain = f"_{plain}"
        unique, number = plain, 2
        while unique in out:
            unique, number = f"{plain}_{number}", number + 1
        out.append(unique)
    return out


def _scene(rig: FaceRig, names: list[str], unit: str) -> Iterator[str]:
    yield "//Maya ASCII 2020 scene"
    yield "//Codeset: UTF-8"
    yield 'requires maya "2020";'
    yield f"currentUnit -l millimeter -a degree -t {unit};"
    yield 'createNode transform -n "head";'
    yield 'createNode mesh -n "headShape" -p "head";'
    yield '\tsetAttr -k off ".v";'
    yield 'createNode mesh -n "headShapeOrig" -p "head";'
    yield '\tsetAttr -k off ".v";'
    yield '\tsetAttr ".io" yes;'
    yield from _mesh(single(rig.neutral), rig.polygons)
    yield 'createNode blendShape -n "shapes";'
    yield from _targets(rig, names)
    yield from _curves(rig, names)
    yield 'connectAttr "headShapeOrig.w" "shapes.ip[0].ig";'
    yield 'connectAttr "headShapeOrig.o" "shapes.orggeom[0]";'
    yield 'connectAttr "shapes.og[0]" "headShape.i";'
    yield 'connectAttr "headShape.iog" ":initialShadingGroup.dsm" -na;'


def _mesh(neutral: Floats32, polygons: Ints32) -> Iterator[str]:
    yield f'\tsetAttr -s {len(neutral)} ".vt[0:{len(neutral) - 1}]"'
    yield from _wrapped([_number(value) for value in neutral.ravel().tolist()], 3 * 4)
    counts, corners = polygon_corners(polygons)
    ends = np.cumsum(counts)
    follower = np.arange(1, len(corners) + 1)
    follower[ends - 1] = ends - counts
    directed = np.stack([corners, corners[follower]], axis=1)
    edges, edge = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    reversed_ = directed[:, 0] > directed[:, 1]
    signed = np.where(reversed_, -edge - 1, edge)
    yield f'\tsetAttr -s {len(edges)} ".ed[0:{len(edges) - 1}]"'
    yield from _wrapped([f"{a} {b} 1" for a, b in edges.tolist()], _ROW)
    last = len(counts) - 1
    yield f'\tsetAttr -s {last + 1} -ch {len(corners)} ".fc[0:{last}]" -type "polyFaces"'
    faces = []
    for count, end in zip(counts.tolist(), ends.tolist(), strict=True):
        faces.append(f"f {count} " + " ".join(str(e) for e in signed[end - count : end].tolist()))
    yield from _wrapped(faces, 4)


def _targets(rig: FaceRig, names: list[str]) -> Iterator[str]:
    count = len(names)
    if not count:
        return
    yield '\taddAttr -ci true -h true -sn "aal" -ln "attributeAliasList" -dt "attributeAlias";'
    yield f'\tsetAttr -s {count} ".w[0:{count - 1}]" ' + " ".join("0" for _ in names) + ";"
    for index, delta in enumerate(rig.deltas):
        moved, rows = sparse_rows(single(delta))
        if not len(moved):  # Maya's own way to say that a shape moves nothing
            moved, rows = np.zeros(1, np.int32), np.zeros((1, 3), np.float32)
        place = f".it[0].itg[{index}].iti[6000]"
        values = [" ".join(_number(value) for value in row.tolist()) + " 1" for row in rows]
        yield f'\tsetAttr "{place}.ipt" -type "pointArray" {len(moved)}'
        yield from _wrapped(values, 4)
        runs = [f'"vtx[{a}]"' if a == b else f'"vtx[{a}:{b}]"' for a, b in _runs(moved)]
        yield f'\tsetAttr "{place}.ict" -type "componentList" {len(runs)}'
        yield from _wrapped(runs, _ROW)
    alias = ",".join(f'"{name}","weight[{index}]"' for index, name in enumerate(names))
    yield f'\tsetAttr ".aal" -type "attributeAlias" {{{alias}}};'


def _curves(rig: FaceRig, names: list[str]) -> Iterator[str]:
    if not len(rig.weights):
        return
    links = []
    weights = rig.weights.astype(np.float32).astype(np.float64)
    for index, name in enumerate(names):
        yield from _curve("animCurveTU", f"shapes_{name}", weights[:, index])
        links.append(f'connectAttr "shapes_{name}.o" "shapes.w[{index}]";')
    angles = np.degrees(np.unwrap(euler_xyz(rig.head_from_rig[:, :3, :3]), axis=0))
    for axis, letter in enumerate("xyz"):
        yield from _curve("animCurveTL", f"head_t{letter}", rig.head_from_rig[:, axis, 3])
        yield from _curve("animCurveTA", f"head_r{letter}", angles[:, axis])
        links.append(f'connectAttr "head_t{letter}.o" "head.t{letter}";')
        links.append(f'connectAttr "head_r{letter}.o" "head.r{letter}";')
    yield from links


def euler_xyz(rotations: Floats) -> Floats:
    """Angles (F, 3) in radians with R = Rz Ry Rx, Maya's default order, of rotations (F, 3, 3)."""
    r = rotations
    y = np.arcsin(np.clip(-r[:, 2, 0], -1.0, 1.0))
    x = np.arctan2(r[:, 2, 1], r[:, 2, 2])
    z = np.arctan2(r[:, 1, 0], r[:, 0, 0])
    locked = np.abs(r[:, 2, 0]) > 1.0 - 1e-12  # looking straight up or down: z is free
    x = np.where(locked, np.arctan2(-r[:, 1, 2], r[:, 1, 1]), x)
    z = np.where(locked, 0.0, z)
    return np.stack([x, y, z], axis=1)


def _curve(kind: str, name: str, values: Floats) -> Iterator[str]:
    yield f'createNode {kind} -n "{name}";'
    yield '\tsetAttr ".tan" 2;'
    yield '\tsetAttr ".wgt" no;'
    yield f'\tsetAttr -s {len(values)} ".ktv[0:{len(values) - 1}]"'
    pairs = [f"{frame} {_exact(value)}" for frame, value in enumerate(values.tolist())]
    yield from _wrapped(pairs, _ROW)


def _runs(indices: Ints32) -> list[tuple[int, int]]:
    if len(indices) == 0:
        return []
    breaks = np.flatnonzero(np.diff(indices) != 1)
    firsts = [int(indices[0]), *(int(i) for i in indices[breaks + 1])]
    lasts = [*(int(i) for i in indices[breaks]), int(indices[-1])]
    return list(zip(firsts, lasts, strict=True))


def _wrapped(items: list[str], row: int) -> Iterator[str]:
    for start in range(0, len(items), row):
        yield "\t\t" + " ".join(items[start : start + row])
    yield "\t;"


def _number(value: float) -> str:
    return f"{float(value):.9g}"


def _exact(value: float) -> str:
    return repr(value) if math.isfinite(value) else "0"
