"""The rig in 3D: a GLB inside the page, sliders, and the script that draws it."""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Sequence
from importlib import resources
from string import Template as Text
from typing import NamedTuple

import numpy as np

from rig.face_rig import FaceRig
from rig.naming import mirrored_name, side_of
from tools.report.picture import stops
from tools.report.rig_charts import round_up
from tools.report.rig_glb import compact_glb, step_mm
from tools.report.rig_inputs import RigInputs
from tools.report.shapes import framed_vertices
from tools.report.svg import element, escape, number

_REGIONS = ("brow", "eye", "cheek", "nose", "jaw", "mouth", "lip", "tongue", "chin", "head")


class Row(NamedTuple):
    """Shapes that stand beside each other: one, or the face's own right and left."""

    region: str
    shapes: tuple[int, ...]


def rig_viewer(inputs: RigInputs) -> str:
    """The 3D view as HTML, with all that it needs inside."""
    rig = inputs.rig
    glb = compact_glb(rig, inputs.times_s, held=not inputs.is_motion)
    difference = _difference(inputs)
    told = (
        ""
        if difference is None
        else element("script", _coded(difference), type="text/plain", data_change="on")
    )
    many = len(rig.weights) > 0
    return _text("rig_viewer.html").substitute(
        before="" if difference is None else _option("before", "of the transferred template"),
        change="" if difference is None else _option("change", "what refinement changed"),
        gradient=f"linear-gradient(90deg,{','.join(stops('warm', 5))})",
        player=_player(len(rig.weights)) if many else "",
        sliders=slider_groups(rig.names),
        rig=_coded(glb),
        size=f"{len(glb) / 1e6:.1f}",
        step_mm=number(math.ceil(step_mm(rig) * 1e4) / 1e4),
        difference=told,
        config=_config(inputs),
        css=_text("rig_viewer.css").template,
        script=_text("rig_viewer.js").template,
    )


def slider_rows(names: Sequence[str]) -> list[Row]:
    """Shapes in rows of one or of a right and a left, gathered by region in a fixed order."""
    rows, taken = [], set[int]()
    index = {name: b for b, name in enumerate(names)}
    for b, name in enumerate(names):
        if b in taken:
            continue
        pair = _pair(name, index)
        taken.update(pair)
        rows.append(Row(_region(name), pair))
    order = {region: place for place, region in enumerate((*_REGIONS, "other"))}
    return sorted(rows, key=lambda row: order[row.region])


def slider_groups(names: Sequence[str]) -> str:
    """The sliders of all shapes as HTML, by region."""
    out = []
    rows = slider_rows(names)
    for region in dict.fromkeys(row.region for row in rows):
        body = "".join(
            f'<div class="pair">{"".join(_slider(names[b], b) for b in row.shapes)}</div>'
            for row in rows
            if row.region == region
        )
        out.append(f'<div class="group"><h4>{escape(region)}</h4>{body}</div>')
    return "".join(out)


def _pair(name: str, index: dict[str, int]) -> tuple[int, ...]:
    """The shape with its mirror image: the face's own right first, as one sees it on a screen."""
    here, twin = index[name], index.get(mirrored_name(name))
    if twin is None or twin == here:
        return (here,)
    return (here, twin) if side_of(name) == "right" else (twin, here)


def _region(name: str) -> str:
    first = re.match(r"[A-Za-z][a-z]*", name)
    word = "" if first is None else first.group(0).lower()
    return next((region for region in _REGIONS if word.startswith(region)), "other")


def _slider(name: str, b: int) -> str:
    slider = element(
        "input", type="range", min=0, max=1, step="any", value=0, data_shape=b, aria_label=name
    )
    button = element("button", escape(name), type="button")
    return f'<div class="shape" title="{escape(name)}">{button}<output>0.00</output>{slider}</div>'


def _player(count: int) -> str:
    slider = element(
        "input", type="range", min=0, max=count - 1, step=1, value=0, data_frame="on",
        aria_label="frame",
    )  # fmt: skip
    button = element("button", "play", type="button", data_play="on")
    return f'<div class="play">{button}{slider}<span data-label="">solved frames</span></div>'


def _difference(inputs: RigInputs) -> bytes | None:
    """What to add to the refined shapes to get those before, on the neutral before."""
    if inputs.before is None:
        return None
    rig = inputs.rig
    other = FaceRig(
        neutral=inputs.before.neutral,
        deltas=inputs.before.deltas - rig.deltas,
        names=rig.names,
        polygons=rig.polygons,
        weights=np.zeros((0, len(rig.names))),
        head_from_rig=np.zeros((0, 4, 4)),
    )
    return compact_glb(other, np.zeros(0), coarse=True)


def _config(inputs: RigInputs) -> str:
    rig = inputs.rig
    face = rig.neutral[framed_vertices(rig.deltas)]
    centre = 0.5 * (face.min(axis=0) + face.max(axis=0))
    half = 0.5 * float(np.ptp(face[:, :2], axis=0).max())
    largest = float(np.linalg.norm(rig.deltas, axis=2).max(initial=0.0))
    change = 0.0 if inputs.change_mm is None else float(inputs.change_mm.max(initial=0.0))
    values = {
        "ramp": [[int(stop[k : k + 2], 16) for k in (1, 3, 5)] for stop in stops("warm", 5)],
        "centre": [round(float(value), 3) for value in centre],
        "half": round(half, 3),
        "reach": round(1.2 * float(np.linalg.norm(rig.neutral - centre, axis=1).max()), 3),
        "displacementMm": round_up(0.6 * largest),
        "changeMm": round_up(0.6 * change),
        "labels": inputs.labels,
    }
    return json.dumps(values, separators=(",", ":")).replace("<", "\\u003c")


def _option(value: str, words: str) -> str:
    return element("option", words, value=value)


def _coded(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _text(name: str) -> Text:
    return Text(resources.files("tools.report").joinpath(name).read_text(encoding="utf-8"))
