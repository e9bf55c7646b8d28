"""The section of likely errors: strip of all frames, the worst in pictures, flags in words, CSV."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from capture.arrays import Floats
from capture.camera import Camera
from recon.mesh import Mesh
from tools.report.charts import Labels, Series, colour_scale, line_chart
from tools.report.inputs import ReportInputs, TakeInputs
from tools.report.page import Section, Verdict, figure, folded, gallery, table
from tools.report.picture import displayable, jpeg_tag, stops, warm
from tools.report.shade import Studio, studio_camera
from tools.report.surfaces import framed, front_views
from tools.report.svg import element, escape, number
from tools.report.track_strip import StripRow, strip_chart
from tools.report.track_texture import texture_part
from track.performance import Performance
from track.quality import CARRIED, TrackQuality
from track.quality_report import FLAG_MM

_WORST = 6  # frames with pictures, of all takes together
_WATCHED = 6  # frames whose texture is watched, of all takes together
_LISTED = 24  # flagged frames in words
_DARK_MM = 2.0  # the dark end of likely errors
_PORTRAIT = 300  # px
_YAWS = (-0.7, 0.7)
_ROWS = (  # of the strip: figure, words, light end, dark end
    ("likely_error_mm", "likely error, mm", 0.0, 2.0),
    ("ncc", "correlation", 1.0, 0.7),
    ("reprojection_px", "reprojection, px", 0.0, 0.5),
    ("views_used", "views used", 8.0, 2.0),
    ("found_share", "share found", 1.0, 0.6),
    ("jitter_mm", "jitter, mm", 0.0, 2.0),
    ("scan_distance_mm", "to the scan, mm", 0.0, 0.5),
)


def likely_error_section(inputs: ReportInputs) -> list[Section]:
    """How far off each tracked frame is likely to be, and why; a verdict on each take."""
    judged = [item for item in inputs.takes if item.quality is not None and _rows(item)]
    parts: list[str] = []
    verdicts: list[Verdict] = []
    for item in judged:
        rows = _rows(item)
        parts.append(f"<h3>{escape(item.take.name)}</h3>")
        parts.append(_strip(rows))
        parts.append(_curve(rows))
        parts.append(_remarks(item))
        parts.append(_flags(rows))
        parts += _pictures(item, rows, max(1, _WORST // len(judged)))
        parts.append(texture_part(item, _watched(rows, max(1, _WATCHED // len(judged)))))
        parts.append(folded("every frame in numbers", _numbers(item, rows)))
        verdicts.append(_verdict(item, rows))
    if not parts:
        return []
    body = "".join(parts)
    title = "Likely error of tracking"
    return [Section(anchor="likely", title=title, body=body, verdicts=tuple(verdicts))]


def worst_rows(rows: Sequence[Mapping[str, Any]], count: int) -> list[int]:
    """Indices of the frames likely to be off most, the worst first; flagged ones before others."""
    told = [k for k in range(len(rows)) if _value(rows[k], "likely_error_mm") > 0.0]
    told.sort(key=lambda k: (not rows[k].get("flagged"), -_value(rows[k], "likely_error_mm")))
    return told[:count]


def _watched(rows: Sequence[Mapping[str, Any]], count: int) -> list[int]:
    """The worst frames, and as many spread over the take."""
    spread = np.rint(np.linspace(0, len(rows) - 1, count // 2 + 2)).astype(int).tolist()[1:]
    return sorted({*worst_rows(rows, count - count // 2), *spread} - {0})


def _rows(item: TakeInputs) -> list[Mapping[str, Any]]:
    """Rows of the tracking report that tell a likely error; none of an older report."""
    rows = item.track_report.get("frames")
    if not isinstance(rows, list) or not rows or item.quality is None:
        return []
    told = [row for row in rows if isinstance(row, Mapping) and "likely_error_mm" in row]
    return told if len(told) == len(item.quality.frames) else []


def _strip(rows: Sequence[Mapping[str, Any]]) -> str:
    strips = []
    for key, words, good, bad in _ROWS:
        values = [_value(row, key) for row in rows]
        if np.isfinite(values).any():
            strips.append(StripRow(name=words, values=values, good=good, bad=bad))
    flagged = [bool(row.get("flagged")) for row in rows]
    chart = strip_chart(strips, [int(row["frame"]) for row in rows], flagged, "error strip")
    return figure(chart, "Every frame; dark is bad, grey was not measured, a mark is a flag.")


def _curve(rows: Sequence[Mapping[str, Any]]) -> str:
    x = [float(row["frame"]) for row in rows]
    series = [
        Series(name="95 % below", x=x, y=[_value(row, "likely_error_mm") for row in rows]),
        Series(name="half below", x=x, y=[_value(row, "likely_median_mm") for row in rows]),
    ]
    labels = Labels(title="likely error over time", x="frame", y="likely error, mm")
    limit = (FLAG_MM, f"flagged above {FLAG_MM:g} mm")
    chart = line_chart(series, labels, limit=limit, height=170.0)
    return figure(chart, "Likely error over the seen skin of the face, as the error model tells.")


def _remarks(item: TakeInputs) -> str:
    remarks = item.track_report.get("view_remarks")
    if not isinstance(remarks, list) or not remarks:
        return ""
    return "<ul>" + "".join(element("li", escape(words)) for words in remarks) + "</ul>"


def _flags(rows: Sequence[Mapping[str, Any]]) -> str:
    order = [k for k in worst_rows(rows, len(rows)) if rows[k].get("flagged")]
    if not order:
        return ""
    cells = [
        (int(rows[k]["frame"]), _value(rows[k], "likely_error_mm"), "; ".join(_why(rows[k])))
        for k in order[:_LISTED]
    ]
    more = len(order) - len(cells)
    rest = f"<p>{more} more flagged frames stand in the table below.</p>" if more else ""
    return table(("flagged frame", "likely error, mm", "why"), cells) + rest


def _pictures(item: TakeInputs, rows: Sequence[Mapping[str, Any]], count: int) -> list[str]:
    performance, quality = item.performance, item.quality
    if performance is None or quality is None:
        return []
    first = performance.vertices[0].astype(np.float64)
    studio = Studio(Mesh(first, performance.polygons))
    views = [] if item.cameras is None else front_views(item.cameras, first)[1:2]
    shown = worst_rows(rows, count)
    parts = [_frame_pictures(item, studio, k, views) for k in shown]
    if parts:
        words = "likely error, mm; grey skin is seen by fewer than two views"
        parts.append(colour_scale(stops("warm"), 0.0, _DARK_MM, words))
    return parts


def _frame_pictures(item: TakeInputs, studio: Studio, index: int, views: Sequence[Camera]) -> str:
    performance, quality = item.performance, item.quality
    if performance is None or quality is None:
        return ""
    frame = int(performance.frames[index])
    vertices = performance.vertices[index].astype(np.float64)
    colours = _coloured(quality, index)
    figures = []
    for camera in views:
        if item.take.present(camera.name, frame):
            plate = displayable(item.take.image(camera.name, frame))
            cut, view = framed(plate, camera, vertices)
            picture = studio.over(cut, vertices, view, colours)
            words = f"frame {frame} over {camera.name}"
            figures.append(figure(jpeg_tag(cut, f"plate of {words}"), f"{camera.name}: the plate"))
            figures.append(figure(jpeg_tag(picture, words), f"Likely error, {words}"))
    still = _upright(performance, index)
    for yaw in _YAWS:
        picture = studio.portrait(still, studio_camera(still, yaw, _PORTRAIT), colours)
        figures.append(figure(jpeg_tag(picture, f"frame {frame}"), f"Likely error, frame {frame}"))
    return gallery(figures, "four")


def _coloured(quality: TrackQuality, index: int) -> Floats:
    likely = quality.likely_error_mm[index].astype(np.float64)
    return warm(np.where(quality.marks[index] == CARRIED, np.nan, likely), 0.0, _DARK_MM)


def _upright(performance: Performance, index: int) -> Floats:
    """One frame (V, 3) with the head motion taken out."""
    motion = performance.head_from_neutral[index]
    away = performance.vertices[index].astype(np.float64) - motion[:3, 3]
    still: Floats = away @ motion[:3, :3]
    return still


def _numbers(item: TakeInputs, rows: Sequence[Mapping[str, Any]]) -> str:
    keys = [key for key, *_ in _ROWS if any(row.get(key) is not None for row in rows)]
    keys = ["frame", *keys, "likely_median_mm", "round_trip_mm", "seen_share"]
    cells = [
        [*("" if row.get(key) is None else row[key] for key in keys), "; ".join(_why(row))]
        for row in rows
    ]
    head = [key.replace("_", " ") for key in keys]
    return _download(item) + table([*head, "why"], cells)


def _download(item: TakeInputs) -> str:
    path = item.take.products / "track" / "quality.csv"
    if not path.is_file():
        return ""
    code = base64.b64encode(path.read_bytes()).decode("ascii")
    link = element(
        "a", "all figures as CSV", href=f"data:text/csv;base64,{code}",
        download=f"{item.take.name}_quality.csv",
    )  # fmt: skip
    return f"<p>{link}</p>"


def _verdict(item: TakeInputs, rows: Sequence[Mapping[str, Any]]) -> Verdict:
    subject = f"Likely error of {item.take.name}:"
    flagged = [row for row in rows if row.get("flagged")]
    errors = [_value(row, "likely_error_mm") for row in rows]
    worst = rows[int(np.nanargmax(errors))] if np.isfinite(errors).any() else rows[0]
    words = (
        f"95 % of the face within {number(float(np.nanmedian(errors)))} mm at a usual frame, "
        f"{number(_value(worst, 'likely_error_mm'))} mm at the worst ({int(worst['frame'])})"
    )
    if not flagged:
        return Verdict(level="good", subject=subject, words=words)
    level = "warn" if 4 * len(flagged) <= len(rows) else "bad"
    first = _why(flagged[0])
    told = f"; {len(flagged)} of {len(rows)} frames flagged, the first is {flagged[0]['frame']}"
    return Verdict(
        level=level, subject=subject, words=words + told + (f": {first[0]}" if first else "")
    )


def _why(row: Mapping[str, Any]) -> list[str]:
    why = row.get("why")
    return [str(words) for words in why] if isinstance(why, list) else []


def _value(row: Mapping[str, Any], key: str) -> float:
    value = row.get(key)
    return float(value) if isinstance(value, (int, float)) else float("nan")
