"""The rig: weights over time, what refinement gained, a picture of every shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats
from recon.mesh import Mesh
from rig.face_rig import FaceRig
from rig.template import Template
from tools.report.charts import Labels, Series, bar_chart, colour_scale, line_chart
from tools.report.inputs import ReportInputs
from tools.report.page import Section, Verdict, facts, figure, folded, gallery
from tools.report.picture import jpeg_tag, stops, warm
from tools.report.shade import Studio, studio_camera
from tools.report.svg import number

_NAMED = 12  # shapes with a colour of their own; others are grey
_ACTIVE = 0.05  # a shape that never passes this is not drawn
_THUMB = 150  # px
_FRAMED = 0.3  # of a shape's largest displacement: what moves as far is in the picture
_GOOD_RATIO, _FAIR_RATIO = 0.5, 0.8
_DARKEST_MM = 8.0


def rig_section(inputs: ReportInputs) -> list[Section]:
    """Weights, residuals and shape thumbnails of the solved rig."""
    rig = inputs.face_rig
    if rig is None:
        return []
    report = inputs.rig_report
    parts = []
    known = {
        "residual of the transferred template, mm": "residual_transferred_mm",
        "residual of the refined rig, mm": "residual_refined_mm",
        "refined / transferred": "ratio",
        "active shapes a frame": "active_shapes_mean",
        "worst vertex, mm": "worst_mm",
        "frame taken as the neutral": "neutral_frame",
    }
    parts.append(
        facts(
            {"shapes": len(rig.names), "frames": len(rig.weights)}
            | {name: report[key] for name, key in known.items() if key in report}
        )
    )
    if {"residual_transferred_mm", "residual_refined_mm"} <= set(report):
        values = [float(report["residual_transferred_mm"]), float(report["residual_refined_mm"])]
        labels = Labels(title="rig residual", x="residual, mm RMS")
        chart = bar_chart(["transferred template", "refined rig"], values, labels)
        parts.append(figure(chart, "What refinement gained on all frames."))
    if len(rig.weights):
        parts.append(weight_figure(rig, take_borders(inputs, len(rig.weights))))
    per_frame = report.get("residual_per_frame_mm")
    if isinstance(per_frame, list) and len(per_frame) == len(rig.weights) > 1:
        line = Series(name="refined rig", x=list(map(float, range(len(per_frame)))), y=per_frame)
        labels = Labels(title="rig residual over time", x="frame", y="residual, mm RMS")
        chart = line_chart([line], labels, height=150.0)
        parts.append(figure(chart, "Distance of the rig from the tracked mesh."))
    parts.append("<h3>Shapes</h3>" + thumbnails(rig, inputs.artist))
    body = "".join(parts)
    verdicts = rig_verdicts(rig, report)
    return [Section(anchor="rig", title="Face rig", body=body, verdicts=verdicts)]


def weight_figure(rig: FaceRig, borders: Sequence[tuple[float, str]]) -> str:
    """Weights of the shapes that act, the strongest in colour."""
    peak = rig.weights.max(axis=0)
    active = [b for b in np.argsort(-peak, kind="stable").tolist() if peak[b] > _ACTIVE]
    frames = [float(frame) for frame in range(len(rig.weights))]
    series = [
        Series(name=rig.names[b], x=frames, y=rig.weights[:, b].tolist(), muted=rank >= _NAMED)
        for rank, b in enumerate(active)
    ]
    labels = Labels(title="blendshape weights over time", x="frame of all takes", y="weight")
    words = f"{len(active)} of {len(rig.names)} shapes pass {_ACTIVE:g}"
    if len(active) > _NAMED:
        words += f"; the {_NAMED} strongest are named, the others grey"
    return figure(line_chart(series, labels, marks=borders, height=280.0), words + ".")


def take_borders(inputs: ReportInputs, count: int) -> list[tuple[float, str]]:
    """Where each take begins among the rig's frames; nothing when their counts do not add up."""
    tracked = [item for item in inputs.takes if item.performance is not None]
    lengths = [0 if t.performance is None else len(t.performance.frames) for t in tracked]
    if sum(lengths) != count or len(tracked) < 2:
        return []
    starts = np.cumsum([0, *lengths[:-1]])
    return [(float(s), item.take.name) for s, item in zip(starts, tracked, strict=True)]


def thumbnails(rig: FaceRig, template: Template | None) -> str:
    """A picture of every shape at weight 1, coloured by displacement; the template's beside it."""
    size = np.linalg.norm(rig.deltas, axis=2)
    face = framed_vertices(rig.deltas)
    studio = Studio(Mesh(rig.neutral, rig.polygons))
    camera = studio_camera(rig.neutral[face], 0.25, _THUMB)
    beside = template is not None and template.deltas.shape == rig.deltas.shape
    template_camera = None
    if beside and template is not None:
        template_camera = studio_camera(template.neutral[face], 0.25, _THUMB)
    peak = rig.weights.max(axis=0) if len(rig.weights) else np.ones(len(rig.names))
    shown: list[str] = []
    quiet: list[str] = []
    for b, name in enumerate(rig.names):
        picture = studio.portrait(rig.neutral + rig.deltas[b], camera, _tint(rig.deltas[b]))
        tag = jpeg_tag(picture, f"shape {name}")
        words = f"{name}, {number(float(size[b].max(initial=0.0)))} mm"
        if template_camera is not None and template is not None:
            other = studio.portrait(
                template.neutral + template.deltas[b], template_camera, _tint(template.deltas[b])
            )
            tag = f"{tag}{jpeg_tag(other, f'template shape {name}')}"
        (shown if peak[b] > _ACTIVE else quiet).append(figure(tag, words))
    note = " The actor's above, the template's below." if beside else ""
    lead = f"<p>Each shape at weight 1, with its largest displacement.{note}</p>"
    scale = colour_scale(stops("warm"), 0.0, _DARKEST_MM, "displacement, mm")
    out = lead + scale + gallery(shown, "small")
    if quiet:
        words = f"{len(quiet)} shapes that these takes do not exercise"
        out += folded(words, gallery(quiet, "small")) if shown else gallery(quiet, "small")
    return out


def framed_vertices(deltas: Floats) -> Bools:
    """Which vertices (V,) of shapes (B, V, 3) belong into a picture: those that move; else all."""
    size = np.linalg.norm(deltas, axis=2)
    share = size / np.maximum(size.max(axis=1, keepdims=True, initial=0.0), 1e-9)
    moving: Bools = share.max(axis=0, initial=0.0) > _FRAMED
    return moving if int(moving.sum()) > 3 else np.ones(deltas.shape[1], dtype=bool)


def _tint(delta: Floats) -> Floats:
    return warm(np.linalg.norm(delta, axis=1), 0.0, _DARKEST_MM)


def rig_verdicts(rig: FaceRig, report: Mapping[str, Any]) -> tuple[Verdict, ...]:
    """What refinement gained, and weights outside 0..1."""
    out = []
    if "ratio" in report:
        ratio = float(report["ratio"])
        level = "good" if ratio <= _GOOD_RATIO else "warn" if ratio <= _FAIR_RATIO else "bad"
        words = (
            f"residual {number(float(report.get('residual_refined_mm', float('nan'))))} mm after "
            f"refinement, {ratio:.2f} of the transferred template's"
        )
        out.append(Verdict(level=level, subject="Rig:", words=words))
    if rig.weights.size:
        low, high = float(rig.weights.min()), float(rig.weights.max())
        if low < -1e-9 or high > 1 + 1e-9:
            words = f"weights run from {number(low)} to {number(high)}, outside 0 to 1"
            out.append(Verdict(level="bad", subject="Rig:", words=words))
    return tuple(out)
