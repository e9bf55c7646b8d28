"""The page of a calibration, section by section: what the report lacks is left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from capture.arrays import Floats
from capture.camera import CameraArray
from tools.report.array_view import Measure, Surroundings, array_view, view_script
from tools.report.calibration import calibration_style, calibration_verdicts, pose_chart, remarks
from tools.report.calibration_devices import (
    BLUES,
    device_cards,
    device_table,
    length_of,
    plain_numbers,
    residual_bars,
)
from tools.report.calibration_gate import (
    SPLIT_PX,
    asked_um,
    gate_marks,
    key_numbers,
    level_of,
    other_numbers,
)
from tools.report.calibration_keys import (
    Grid,
    count_of,
    grid_of,
    mapping_of,
    names_of,
    number_of,
    rows_of,
    table_of,
    vector_of,
    words_of,
)
from tools.report.cell_charts import Scale, front_layers, middle_slices
from tools.report.charts import Labels, bar_chart, colour_scale
from tools.report.inputs import ReportInputs
from tools.report.overview import array_facts, array_plans, scene_centre
from tools.report.page import Section, Verdict, facts, figure, folded, gallery
from tools.report.picture import stops
from tools.report.svg import MICRO, element, escape, number

_VOLUME_MM = 120.0  # radius of the drawn face volume when the report names none
_MOST_BOARDS = 120


def calibration_sections(inputs: ReportInputs) -> list[Section]:
    """All sections of a calibration's page; a key that the report lacks is not drawn."""
    report = inputs.calibration_report
    out = [
        Section(
            anchor="calibration",
            title="Key numbers",
            body=calibration_style() + remarks(report) + key_numbers(report)
            + other_numbers(report),
            verdicts=() if mapping_of(report, "gate") else calibration_verdicts(report),
        )
    ]  # fmt: skip
    out += _array(inputs)
    for part in (_uncertainty, _volume):
        out += part(report)
    out += _devices(inputs)
    for part in (_poses, _split_half, _table):
        out += part(report)
    out += _rejected(inputs)
    last = out[-1]
    return [*out[:-1], replace(last, body=last.body + view_script())]


def _array(inputs: ReportInputs) -> list[Section]:
    array, report = inputs.array, inputs.calibration_report
    if array is None:
        return []
    plans = folded("from above and from the side, to scale", array_plans(inputs))
    body = _view(array, report) + array_facts(array) + plans
    return [Section(anchor="layout", title="Camera array", body=body)]


def _view(array: CameraArray, report: Mapping[str, Any]) -> str:
    volume = mapping_of(report, "volume")
    centre, radius = vector_of(volume, "centre_mm"), number_of(volume, "radius_mm")
    around = Surroundings(
        centre=scene_centre(array) if centre is None else centre,
        radius_mm=radius if radius > 0 else _VOLUME_MM,
        boards=_boards(report),
        marked=gate_marks(report),
    )
    return array_view(array, _measures(array, report), around)


def _boards(report: Mapping[str, Any]) -> list[Floats]:
    """Corners (4, 3) of the board at each pose, mm, of many an even choice."""
    places = report.get("board_places")
    places = places if isinstance(places, list) else []
    tables = [table_of({"place": place}, "place") for place in places]
    good = [t for t in tables if t is not None and t.shape == (4, 3) and np.isfinite(t).all()]
    if len(good) <= _MOST_BOARDS:
        return good
    return [good[k] for k in np.linspace(0, len(good) - 1, _MOST_BOARDS).round().astype(int)]


def _measures(array: CameraArray, report: Mapping[str, Any]) -> list[Measure]:
    devices = rows_of(report, "devices")
    entries = dict(zip(names_of(devices), devices, strict=True))
    halves = mapping_of(mapping_of(report, "split_half"), "by_device")
    mine = [entries.get(camera.name, {}) for camera in array]
    sigmas = [mapping_of(entry, "sigmas") for entry in mine]
    found = {
        "mean residual, px": [number_of(entry, "mean_reprojection_px") for entry in mine],
        f"place known to, ± {MICRO}": [length_of(entry, "place_um") for entry in sigmas],
        "turn known to, ± mdeg": [length_of(entry, "turn_mdeg") for entry in sigmas],
        "focal length known to, ± px": [number_of(entry, "fx_px") for entry in sigmas],
        "split-half difference, px": [number_of(halves, camera.name) for camera in array],
    }
    return [
        Measure(name=name, values=np.array(values))
        for name, values in found.items()
        if np.isfinite(values).any()
    ]


def _uncertainty(report: Mapping[str, Any]) -> list[Section]:
    known = mapping_of(report, "uncertainty")
    parts = []
    for key, title, words in (
        ("calibration_um", "Of the calibration alone",
         "How far off a point may be because the cameras are not known better."),
        ("with_noise_um", "With noise",
         "The same with the noise of finding the point in each image that sees it, once."),
    ):  # fmt: skip
        grid = grid_of(known, key, "step_mm")
        if grid is not None:
            parts.append(f"<h3>{title}</h3><p>{words}</p>{_sliced(grid, title.lower())}")
    if not parts:
        return []
    rms, p95 = number_of(known, "rms_um"), number_of(known, "p95_um")
    verdicts: tuple[Verdict, ...] = ()
    if np.isfinite(rms):
        limits = asked_um(report)
        told = f"{number(rms)} {MICRO} rms over the face volume"
        told += f", 95 % of it under {number(p95)} {MICRO}" if np.isfinite(p95) else ""
        verdicts = (Verdict(level=level_of(rms, *limits), subject="Uncertainty:",
                            words=f"{told}; {number(limits[0])} {MICRO} are asked"),)  # fmt: skip
    lead = (
        "<p>One standard deviation of a triangulated point, all three directions together "
        "(root of the trace of its covariance), in slices through the middle of the volume."
        f"{_own_axes(report)}</p>"
    )
    return [
        Section(anchor="uncertainty", title="Uncertainty of triangulation",
                body=lead + "".join(parts), verdicts=verdicts)
    ]  # fmt: skip


def _sliced(grid: Grid, words: str) -> str:
    known = grid.values[np.isfinite(grid.values)]
    low, high = float(known.min()), float(np.percentile(known, 99))
    high = max(high, low + 1e-3)
    colours = stops("sequential", 32)
    scale = Scale(low=low, high=high, stops=colours)
    figures = [
        figure(chart, told)
        for chart, told in middle_slices(grid, scale, f"uncertainty {words}, {MICRO}")
    ]
    index = np.unravel_index(int(np.nanargmax(grid.values)), grid.values.shape)
    x, y, z = (grid.place_mm(axis, int(index[2 - axis])) for axis in range(3))
    told = (
        f"Least {number(low)} {MICRO}, largest {number(float(known.max()))} {MICRO} "
        f"at x {x:.0f}, y {y:.0f}, z {z:.0f} mm."
    )
    legend = colour_scale(colours, low, high, MICRO)
    return legend + gallery(figures, "slices three") + f"<p>{escape(told)}</p>"


def _volume(report: Mapping[str, Any]) -> list[Section]:
    volume = mapping_of(report, "volume")
    grid, thin = grid_of(volume, "corners", "edge_mm"), words_of(volume, "thin")
    if grid is None and not thin:
        return []
    verdict = Verdict(level="good", subject="Coverage:", words="no part of the volume is thin")
    if thin:
        count = "1 part" if len(thin) == 1 else f"{len(thin)} parts"
        words = f"{count} of the face volume saw too little of the board"
        verdict = Verdict(level="warn", subject="Coverage:", words=words)
    body = "".join(f"<li>{escape(line)}</li>" for line in thin)
    body = f"<ul>{body}</ul>" if body else ""
    shown = number_of(volume, "shown")
    if np.isfinite(shown):
        body += (
            f"<p>The board was in {100 * shown:.0f} % of the part of the face volume that two "
            "devices have in their images.</p>"
        )
    if grid is not None:
        known = grid.values[np.isfinite(grid.values)]
        top = max(float(np.ceil(np.percentile(known, 90))), 1.0)
        scale = Scale(low=0.0, high=top, stops=BLUES)
        figures = [
            figure(chart, told)
            for chart, told in front_layers(grid, scale, "corners seen, from the front")
        ]
        body += (
            "<p>Board corners that two or more devices saw together, in cells of "
            f"{grid.step_mm:g} mm, layer by layer as seen from the front. "
            f"Red cells have none, nor do their neighbours.{_own_axes(report)}</p>"
            f"{colour_scale(BLUES, 0.0, top, 'corners in a cell')}{gallery(figures, 'slices')}"
        )
    return [
        Section(anchor="volume", title="Coverage of the face volume", body=body,
                verdicts=(verdict,))
    ]  # fmt: skip


def _own_axes(report: Mapping[str, Any]) -> str:
    """Where x, y, z of the volume lie, when a named pose or an earlier session gave the world."""
    motion = table_of(report, "world_from_volume")
    if motion is None or motion.shape != (4, 4) or not np.isfinite(motion).all():
        return ""
    x, y, z = (f"{round(value) + 0}" for value in motion[:3, 3].tolist())
    return (
        " Here x, y and z are those of the volume, not of the world: from its middle, which is at "
        f"x {x}, y {y}, z {z} mm in the world, to the right, up and towards the array."
    )


def _devices(inputs: ReportInputs) -> list[Section]:
    report = inputs.calibration_report
    devices = rows_of(report, "devices")
    if not devices:
        return []
    body = residual_bars(devices) + device_cards(report, inputs.array)
    return [Section(anchor="devices", title="Device by device", body=body)]


def _poses(report: Mapping[str, Any]) -> list[Section]:
    poses = rows_of(report, "poses")
    if not poses:
        return []
    return [Section(anchor="poses", title="Residual by board pose", body=pose_chart(poses))]


def _split_half(report: Mapping[str, Any]) -> list[Section]:
    halves = mapping_of(report, "split_half")
    by_device = mapping_of(halves, "by_device")
    p95, middle = number_of(halves, "p95_px"), number_of(halves, "median_px")
    remark = halves.get("remark")
    if not by_device and not np.isfinite(p95) and not remark:
        return []
    parts = [
        "<p>The array is calibrated twice, from one half of the poses and from the other, and "
        "both project the same points of the face volume. By chance alone the two differ by about "
        "twice the error of the calibration from all poses.</p>"
    ]
    if remark:
        parts.append(f"<p>{escape(remark)}</p>")
    if by_device:
        names = [str(name) for name in by_device]
        values = [number_of(by_device, name) for name in names]
        levels = [level_of(value, *SPLIT_PX) for value in values]
        labels = Labels(title="split-half by device", x="difference of projections, 95 %, px")
        limit = (SPLIT_PX[0], f"{SPLIT_PX[0]:g} px")
        chart = bar_chart(names, values, labels, levels=levels, limit=limit)
        parts.append(figure(chart, "95th percentile over the points of the volume."))
    verdicts: tuple[Verdict, ...] = ()
    if np.isfinite(p95):
        words = f"95 % of projections differ by less than {number(p95)} px"
        words += f", half of them by less than {number(middle)} px" if np.isfinite(middle) else ""
        level = level_of(p95, *SPLIT_PX)
        verdicts = (Verdict(level=level, subject="Split-half:", words=words),)
    return [
        Section(anchor="split_half", title="Split-half check", body="".join(parts),
                verdicts=verdicts)
    ]  # fmt: skip


def _table(report: Mapping[str, Any]) -> list[Section]:
    devices = rows_of(report, "devices")
    if not devices:
        return []
    body = device_table(report) + plain_numbers(devices)
    return [Section(anchor="table", title="Table of devices", body=body)]


def _rejected(inputs: ReportInputs) -> list[Section]:
    report = inputs.calibration_report
    devices, poses = rows_of(report, "devices"), rows_of(report, "poses")
    count, used = count_of(report, "corners_rejected"), count_of(report, "corners_used")
    if not count + used and not report.get("log"):
        return []
    told: dict[str, object] = {"rejected": count, "used": used}
    if report.get("rejection"):
        told["rule"] = str(report["rejection"])
    reasons = mapping_of(mapping_of(report, "rejected"), "reasons")
    told |= {str(reason): count_of(reasons, reason) for reason in reasons}
    parts = [facts(told)]
    shares = [_share(entry) for entry in devices]
    if any(share > 0 for share in shares):
        labels = Labels(title="rejected corners by device", x="corners rejected, %")
        chart = bar_chart(names_of(devices), shares, labels)
        parts.append(figure(chart, "Many of one device: its focus, its trigger, a reflection."))
    worst = max(poses, key=lambda pose: count_of(pose, "corners_rejected"), default=None)
    if worst is not None and count_of(worst, "corners_rejected"):
        parts.append(
            f"<p>Most of one pose: {count_of(worst, 'corners_rejected')} of frame "
            f"{count_of(worst, 'frame')}.</p>"
        )
    parts.append(_log(inputs))
    return [Section(anchor="rejected", title="Rejected corners", body="".join(parts))]


def _log(inputs: ReportInputs) -> str:
    """Where every rejected corner is listed; a link only to a file beside the page."""
    name = inputs.calibration_report.get("log")
    if not name:
        return ""
    plain = isinstance(name, str) and PurePosixPath(name).name == name and "\\" not in name
    address = "" if inputs.out is None or not plain else inputs.address(inputs.out.parent / name)
    told = element("a", escape(name), href=address) if address else escape(name)
    return f"<p>Every one with its device, frame, corner and size: {told}</p>"


def _share(entry: Mapping[str, Any]) -> float:
    rejected, used = count_of(entry, "corners_rejected"), count_of(entry, "corners_used")
    return 100.0 * rejected / max(rejected + used, 1)
