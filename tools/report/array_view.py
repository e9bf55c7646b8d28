"""The array in 3D: devices, the face volume, where the board was; drag turns it, the wheel zooms.

The drawing is SVG that stands in the page without JavaScript; the script moves its pieces.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any

import numpy as np

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from tools.report.charts import colour_scale
from tools.report.picture import stops
from tools.report.svg import element, escape, number, text

_WIDTH, _HEIGHT = 720.0, 460.0
_YAW, _PITCH = 0.5, 0.42  # the first view, radians
_MIDDLE, _ROOM = np.array([_WIDTH / 2, _HEIGHT / 2]), np.array([34.0, 14.0])
_AWAY = 4.0  # distance of the viewer, in half sizes of the scene
_UNKNOWN = "#8a8f98"
_AXES = (("x", "#b3261e"), ("y", "#1b7f4b"), ("z", "#0072b2"))


@dataclass(frozen=True, eq=False, kw_only=True)
class Measure:
    """A number of each device to colour it by.

    Attributes:
        name: words with the unit.
        values: by device; NaN is grey.
    """

    name: str
    values: Floats


@dataclass(frozen=True, eq=False, kw_only=True)
class Surroundings:
    """What is drawn beside the devices.

    Attributes:
        centre: (3,) of the face volume, mm.
        radius_mm: of the face volume.
        boards: (4, 3) corners of the board at each pose, mm.
        marked: level, "warn" or "bad", of the devices that the gate names.
    """

    centre: Floats
    radius_mm: float
    boards: Sequence[Floats] = ()
    marked: Mapping[str, str] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class _Item:
    """One piece of the drawing: closed or open lines, and perhaps words at a point."""

    kind: str
    lines: Sequence[Floats]
    closed: bool = False
    words: str = ""
    at: Floats | None = None
    colour: str | None = None
    device: int = -1


@dataclass(frozen=True, eq=False, kw_only=True)
class _View:
    """Where the viewer is: turned about the vertical, then up; looking at `target`."""

    yaw: float
    pitch: float
    target: Floats
    away_mm: float
    zoom: float

    @property
    def turn(self) -> Floats:
        """To the right, up and towards the viewer, as rows (3, 3) in the world."""
        cy, sy, cp, sp = np.cos(self.yaw), np.sin(self.yaw), np.cos(self.pitch), np.sin(self.pitch)
        rows: Floats = np.array([[cy, 0, -sy], [-sy * sp, cp, -cy * sp], [sy * cp, sp, cy * cp]])
        return rows

    def project(self, points: Floats) -> Floats:
        """Points (N, 3) world mm to (N, 3): drawing units to the right and down, and nearness."""
        seen = (points - self.target) @ self.turn.T
        scale = self.zoom / np.maximum(self.away_mm - seen[:, 2], 0.05 * self.away_mm)
        x, y = _WIDTH / 2 + scale * seen[:, 0], _HEIGHT / 2 - scale * seen[:, 1]
        placed: Floats = np.stack([x, y, seen[:, 2]], axis=1)
        return placed


def array_view(array: CameraArray, measures: Sequence[Measure], around: Surroundings) -> str:
    """The 3D view as HTML, with all that it needs inside.

    Args:
        array: the devices.
        measures: what they can be coloured by; the first is shown first.
        around: the face volume and the board.
    """
    items = _scene(array, measures, around)
    view = _first_view(items)
    order = sorted(range(len(items)), key=lambda k: _nearness(items[k], view))
    drawn = "".join(_drawn(items[k], k, view) for k in order)
    title = element("title", "the camera array in 3D")
    picture = element(
        "svg", title + drawn, viewBox=f"0 0 {_WIDTH:g} {_HEIGHT:g}", role="img", tabindex=0,
        class_="chart turning", aria_label=(
            f"the array of {len(array)} cameras around the face volume; arrow keys turn it, "
            "plus and minus zoom"
        ),
    )  # fmt: skip
    data = json.dumps(_config(items, view, measures), separators=(",", ":"))
    safe = data.replace("<", "\\u003c").replace("&", "\\u0026")
    return (
        f'<div class="arrayview">{_controls(measures)}{picture}{_legends(measures)}'
        '<p class="hint">Drag turns, the wheel zooms once clicked, a double click goes home. '
        "Each pyramid is what a camera sees, the mark on it is the top of its image.</p>"
        f'<script type="application/json" data-scene="on">{safe}</script></div>'
    )


def view_script() -> str:
    """The script that turns the view and sorts tables; once on a page."""
    source = resources.files("tools.report").joinpath("calibration_page.js")
    return f"<script>{source.read_text(encoding='utf-8')}</script>"


def _scene(array: CameraArray, measures: Sequence[Measure], around: Surroundings) -> list[_Item]:
    centres = np.array([camera.centre for camera in array])
    reach = 0.2 * float(np.median(np.linalg.norm(centres - around.centre, axis=1)))
    reach = max(reach, 0.3 * around.radius_mm)
    marked = around.marked or {}
    items = [_Item(kind="board", lines=[quad], closed=True) for quad in around.boards]
    items += _ball(around.centre, around.radius_mm)
    for axis, (name, colour) in enumerate(_AXES):
        end = np.zeros(3)
        end[axis] = 1.35 * around.radius_mm
        line = np.stack([around.centre, around.centre + end])
        items.append(_Item(kind="axis", lines=[line], words=name, at=line[1], colour=colour))
    for index, camera in enumerate(array):
        colour = _colours(measures[0])[index] if measures else _UNKNOWN
        out = camera.centre - around.centre
        out = out / max(float(np.linalg.norm(out)), 1e-9)
        level = marked.get(camera.name, "")
        items.append(
            _Item(
                kind=f"device {level}".strip(), lines=_pyramid(camera, reach), closed=True,
                words=camera.name, at=camera.centre + 0.35 * reach * out, colour=colour,
                device=index,
            )
        )  # fmt: skip
    return items


def _pyramid(camera: Camera, reach: float) -> list[Floats]:
    """The four sides of what a camera sees, the far end, and a mark on its upper edge."""
    right, low = camera.width - 0.5, camera.height - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [right, low], [-0.5, low], [right / 2, -0.5]])
    rays = np.nan_to_num(camera.rays(corners))
    ends = camera.centre + reach * rays
    down = 0.5 * (ends[2] + ends[3] - ends[0] - ends[1])
    top = np.stack(
        [0.7 * ends[0] + 0.3 * ends[1], 0.3 * ends[0] + 0.7 * ends[1], ends[4] - 0.25 * down]
    )
    sides = [np.stack([camera.centre, ends[k], ends[(k + 1) % 4]]) for k in range(4)]
    return [*sides, ends[:4], top]


def _ball(centre: Floats, radius_mm: float) -> list[_Item]:
    turn = np.linspace(0.0, 2 * np.pi, 37)[:-1]
    flat = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    rings = [centre + radius_mm * np.roll(flat, axis, axis=1) for axis in range(3)]
    return [_Item(kind="ball", lines=[ring], closed=True) for ring in rings]


def _first_view(items: Sequence[_Item]) -> _View:
    """A view from the front, right and above in which everything fits."""
    places = [np.atleast_2d(item.at) for item in items if item.at is not None]
    points = np.concatenate([line for item in items for line in item.lines] + places)
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(0.5 * float(np.linalg.norm(high - low)), 1.0)
    target = 0.5 * (low + high)
    view = _View(yaw=_YAW, pitch=_PITCH, target=target, away_mm=_AWAY * half, zoom=_AWAY * half)
    for _ in range(4):  # at this zoom a drawing unit is a millimetre at the target
        flat = view.project(points)[:, :2] - _MIDDLE
        middle = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
        view = replace(view, target=view.target + middle @ (view.turn[:2] * [[1.0], [-1.0]]))
    room = np.abs(view.project(points)[:, :2] - _MIDDLE).max(axis=0)
    fits = ((_MIDDLE - _ROOM) / np.maximum(room, 1e-9)).min()
    return replace(
        view, target=np.round(view.target, 2), away_mm=round(view.away_mm, 2),
        zoom=round(float(fits) * view.zoom, 2),
    )  # fmt: skip


def _nearness(item: _Item, view: _View) -> float:
    points = np.concatenate([np.round(line, 1) for line in item.lines])
    return float(view.project(points)[:, 2].mean())


def _drawn(item: _Item, index: int, view: _View) -> str:
    inner = element("title", escape(item.words)) if item.device >= 0 else ""
    for line in item.lines:
        placed = view.project(np.round(line, 1))[:, :2].tolist()
        d = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in placed) + ("Z" if item.closed else "")
        inner += element("path", d=d)
    if item.at is not None:
        x, y, _ = view.project(np.round(item.at[None], 1))[0].tolist()
        inner += text(round(x, 1), round(y + 4, 1), item.words, text_anchor="middle")
    style = None if item.colour is None else f"--own:{item.colour}"
    return element("g", inner, class_=item.kind, data_item=index, style=style)


def _config(items: Sequence[_Item], view: _View, measures: Sequence[Measure]) -> dict[str, Any]:
    return {
        "size": [_WIDTH, _HEIGHT],
        "view": {
            "yaw": view.yaw, "pitch": view.pitch, "target": view.target.tolist(),
            "away": view.away_mm, "zoom": view.zoom,
        },
        "items": [
            {
                "lines": [np.round(line, 1).tolist() for line in item.lines],
                "closed": item.closed,
                "at": None if item.at is None else np.round(item.at, 1).tolist(),
                "device": item.device,
            }
            for item in items
        ],
        "colours": [_colours(measure) for measure in measures],
        "told": [
            [f"{measure.name}: {number(float(value))}" for value in measure.values]
            for measure in measures
        ],
    }  # fmt: skip


def _colours(measure: Measure) -> list[str]:
    """A colour for each device, grey where its value is not known; usual values lie midway."""
    low, high = _range(measure)
    scale = stops("warm")
    place = np.clip((measure.values - low) / ((high - low) or 1.0), 0.0, 1.0)
    return [
        scale[4 + round(float(at) * (len(scale) - 5))] if np.isfinite(at) else _UNKNOWN
        for at in place
    ]


def _range(measure: Measure) -> tuple[float, float]:
    known = measure.values[np.isfinite(measure.values)]
    top = max(float(known.max()), 2.0 * float(np.median(known))) if len(known) else 1.0
    return 0.0, max(top, 1e-12)


def _controls(measures: Sequence[Measure]) -> str:
    buttons = "".join(
        element("button", words, type="button", data_yaw=yaw, data_pitch=pitch)
        for words, yaw, pitch in (
            ("front", 0, 0), ("above", 0, 1.5), ("from its left", 1.5, 0.1), ("behind", 3.1, 0.3),
        )
    )  # fmt: skip
    zooms = "".join(
        element("button", sign, type="button", data_zoom=by, aria_label=words)
        for sign, by, words in (("+", 1.25, "nearer"), ("\u2212", 0.8, "farther"))
    )
    chosen = ""
    if len(measures) > 1:
        options = "".join(
            element("option", escape(measure.name), value=index)
            for index, measure in enumerate(measures)
        )
        chosen = f"<label>colour by <select data-measure>{options}</select></label>"
    return f'<div class="look" hidden>{chosen}{buttons}{zooms}</div>'


def _legends(measures: Sequence[Measure]) -> str:
    out = []
    for index, measure in enumerate(measures):
        low, high = _range(measure)
        hidden = " hidden" if index else ""
        scale = colour_scale(stops("warm")[4:], low, high, measure.name)
        out.append(f'<div data-legend="{index}"{hidden}>{scale}</div>')
    return "".join(out)
