"""The sections that need no picture: array layout, timings, numbers and settings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from tools.report.charts import Labels, bar_chart
from tools.report.inputs import ReportInputs
from tools.report.page import (
    Section,
    facts,
    figure,
    flattened,
    folded,
    gallery,
    table,
)
from tools.report.svg import drawing, element, escape, text

_VIEW = 480.0
_VOLUME_MM = 150.0  # radius of the drawn volume when there is no neutral


def layout_section(inputs: ReportInputs) -> list[Section]:
    """The array from above and from the side, to scale, with its distances and angles."""
    array = inputs.array
    if array is None:
        return []
    body = array_facts(array) + array_plans(inputs)
    return [Section(anchor="layout", title="Camera array", body=body)]


def array_plans(inputs: ReportInputs) -> str:
    """The array from above and from the side, to scale; nothing without cameras."""
    array = inputs.array
    if array is None:
        return ""
    target = scene_centre(array)
    neutral = next((take.neutral for take in inputs.takes if take.neutral is not None), None)
    points = None if neutral is None else neutral.vertices
    views = [
        figure(_plan(array, target, points, (0, 2), (1, 1)), "From above; the face looks down."),
        figure(
            _plan(array, target, points, (2, 1), (1, -1)), "From the side; the face looks right."
        ),
    ]
    return gallery(views, "wide")


def array_facts(array: CameraArray) -> str:
    """Distances, sizes and angles of the array as a list of facts."""
    target = scene_centre(array)
    away = np.array([np.linalg.norm(camera.centre - target) for camera in array])
    sample = [d / camera.fx for d, camera in zip(away, array, strict=True)]
    sizes = sorted({f"{camera.width} x {camera.height}" for camera in array})
    numbers = {
        "cameras": len(array),
        "image size, px": ", ".join(sizes),
        "distance to the scene, mm": _span(away),
        "one pixel at the scene, mm": _span(sample),
        "focal length, px": _span([camera.fx for camera in array]),
        "widest angle between cameras, deg": round(_widest(array, target)),
    }
    return facts(numbers)


def timing_section(inputs: ReportInputs) -> list[Section]:
    """Seconds of each stage as bars."""
    if not inputs.timings:
        return []
    names, seconds = list(inputs.timings), [float(s) for s in inputs.timings.values()]
    title = f"{sum(seconds):.0f} s in all"
    chart = bar_chart(names, seconds, Labels(title=title, x="seconds of wall clock"))
    return [
        Section(anchor="timings", title="Time", body=figure(chart, f"Stages in order; {title}."))
    ]


def numbers_section(inputs: ReportInputs) -> list[Section]:
    """Every number that the stages reported, and the settings that they ran with."""
    parts = []
    reports: dict[str, Mapping[str, Any]] = {"calibration": inputs.calibration_report}
    records: dict[str, Mapping[str, Any]] = {}
    for item in inputs.takes:
        for scan in item.scans:
            reports[f"{item.take.name}: scan of frame {scan.frame}"] = scan.report
        reports[f"{item.take.name}: tracking"] = item.track_report
        records |= {f"{item.take.name}: {stage}": record for stage, record in item.records.items()}
    reports["rig"] = inputs.rig_report
    for name, report in reports.items():
        if report:
            rows = list(flattened(report).items())
            parts.append(folded(f"{name}: {len(rows)} numbers", table(("what", "value"), rows)))
    for name, settings in inputs.settings.items():
        rows = list(flattened({name: settings}).items())
        parts.append(folded(f"settings of {name}", table(("setting", "value"), rows)))
    for name, record in records.items():
        shown = json.dumps(record, indent=1, sort_keys=True)
        parts.append(folded(f"{name}: how it was made", f"<pre>{escape(shown)}</pre>"))
    if not parts:
        return []
    return [Section(anchor="numbers", title="Numbers and settings", body="".join(parts))]


def scene_centre(array: CameraArray) -> Floats:
    """The point (3,) nearest to all optical axes in the least-squares sense, world mm."""
    across, right = np.zeros((3, 3)), np.zeros(3)
    for camera in array:
        axis = camera.camera_from_world.rotation[2]
        plane = np.eye(3) - np.outer(axis, axis)
        across += plane
        right += plane @ camera.centre
    centre: Floats = np.linalg.pinv(across) @ right
    if len(array) == 1:
        centre = array[0].centre + 600.0 * array[0].camera_from_world.rotation[2]
    return centre


def _plan(
    array: CameraArray,
    target: Floats,
    neutral: Floats | None,
    axes: tuple[int, int],
    signs: tuple[int, int],
) -> str:
    flip = np.array(signs, dtype=float)
    centres = np.array([camera.centre for camera in array])
    places = np.vstack([centres, target])[:, list(axes)] * flip
    low, high = places.min(axis=0) - _VOLUME_MM, places.max(axis=0) + _VOLUME_MM
    scale = (_VIEW - 60.0) / float((high - low).max())
    height = float((high - low)[1]) * scale + 60.0

    def place(points: Floats) -> Floats:
        flat: Floats = (np.atleast_2d(points)[:, list(axes)] * flip - low) * scale + 30.0
        return flat

    parts = []
    reach = 0.16 * float(np.median(np.linalg.norm(centres - target, axis=1)))
    for camera in array:
        parts.append(_hull(place(_frustum(camera, reach)), "frustum"))
    middle = place(target)[0]
    if neutral is None:
        parts.append(
            element("circle", cx=middle[0], cy=middle[1], r=_VOLUME_MM * scale, class_="volume")
        )
    else:
        parts.append(_hull(place(neutral), "head"))
    for camera, at in zip(array, _labelled(place(centres), middle), strict=True):
        words = {"class_": "tick", "text_anchor": "middle"}
        parts.append(text(float(at[0]), float(at[1] + 4), camera.name, **words))
    bar = 100.0 * scale
    parts.append(element("line", x1=12, x2=12 + bar, y1=height - 10, y2=height - 10, class_="axis"))
    parts.append(text(12, height - 15, "100 mm", class_="tick"))
    return drawing(_VIEW, height, "".join(parts), "camera array")


def _labelled(places: Floats, middle: Floats) -> list[Floats]:
    """Where to write a name beside each place (C, 2), outwards, no two on top of each other."""
    chosen: list[Floats] = []
    for at in places:
        away = at - middle
        out = away / max(float(np.linalg.norm(away)), 1e-9)
        spots = [at + (14.0 + 6.0 * step) * out for step in range(12)]
        spots += [at + 14.0 * out + [0.0, 7.0 * step] for step in (-3, 3, -2, 2)]
        free = [
            spot
            for spot in spots
            if all(abs(spot[0] - c[0]) > 40.0 or abs(spot[1] - c[1]) > 12.0 for c in chosen)
        ]
        chosen.append(np.asarray((free or spots)[0], dtype=np.float64))
    return chosen


def _frustum(camera: Camera, reach: float) -> Floats:
    corners = np.array(
        [[-0.5, -0.5], [camera.width - 0.5, -0.5],
         [camera.width - 0.5, camera.height - 0.5], [-0.5, camera.height - 0.5]]
    )  # fmt: skip
    rays = np.nan_to_num(camera.rays(corners))
    return np.vstack([camera.centre, camera.centre + reach * rays])


def _hull(points: Floats, kind: str) -> str:
    order = np.lexsort((points[:, 1], points[:, 0]))
    chain: list[Floats] = []
    for direction in (order, order[::-1]):  # Andrew's monotone chain: lower, then upper hull
        start = len(chain)
        for index in direction:
            point = points[index]
            while len(chain) - start >= 2 and _turn(chain[-2], chain[-1], point) <= 0:
                chain.pop()
            chain.append(point)
        chain.pop()
    d = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in chain) + "Z"
    return element("path", d=d, class_=kind)


def _turn(a: Floats, b: Floats, c: Floats) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _widest(array: CameraArray, target: Floats) -> float:
    rays = np.array([camera.centre - target for camera in array])
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    return float(np.degrees(np.arccos(np.clip(rays @ rays.T, -1.0, 1.0)).max()))


def _span(values: Any) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    digits = 0 if high >= 100 else 2
    return (
        f"{low:.{digits}f}"
        if high - low < 10**-digits
        else f"{low:.{digits}f} to {high:.{digits}f}"
    )
