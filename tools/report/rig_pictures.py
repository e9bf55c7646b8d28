"""Pictures of a rig: shapes before and after refinement, and where it misses what was tracked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, Ints
from recon.mesh import Mesh
from rig.fit import Fit, Observations
from rig.solve import pose_frames
from tools.report.charts import colour_scale
from tools.report.page import figure, folded, gallery
from tools.report.picture import Pixels, jpeg_tag, stops, warm
from tools.report.rig_charts import round_up
from tools.report.rig_inputs import RigInputs
from tools.report.shade import Studio, cropped, studio_camera
from tools.report.shapes import framed_vertices, thumbnails
from tools.report.svg import number

_TILE, _MARGIN = 176, 8  # px
_YAW = 0.25
CHANGED_MM = 0.1  # a shape that changed by less anywhere is folded away
_FRAMES = 24  # at most, in the error maps
_WORST = 10  # of them, by residual


def shape_pictures(inputs: RigInputs) -> str:
    """Every shape at weight 1 before and after, the after coloured by the change; biggest first.

    The neutral stands first where what is before has another one.
    """
    rig, before, change = inputs.rig, inputs.before, inputs.change_mm
    if before is None or change is None:
        return thumbnails(rig, inputs.template)
    tiles = _Tiles(inputs)
    moved = change.max(axis=1, initial=0.0)
    top = round_up(0.6 * float(moved.max(initial=0.0)))
    shift = np.linalg.norm(rig.neutral - before.neutral, axis=1)
    shift_mm = float(shift.max(initial=0.0))
    first = [] if shift_mm < CHANGED_MM else [
        _pair(
            tiles.plain(before.neutral), tiles.coloured(rig.neutral, shift, top),
            "neutral before and after", f"neutral, {number(shift_mm)} mm",
        )
    ]  # fmt: skip
    shown: list[str] = []
    quiet: list[str] = []
    for b in np.argsort(-moved, kind="stable").tolist():
        name = rig.names[b]
        picture = _pair(
            tiles.plain(before.neutral + before.deltas[b]),
            tiles.coloured(rig.neutral + rig.deltas[b], change[b], top),
            f"shape {name} before and after",
            f"{name}, {number(float(moved[b]))} mm",
        )
        (shown if moved[b] > CHANGED_MM else quiet).append(picture)
    words = (
        "<p>Each shape at weight 1: left as the template was transferred, right as refined, "
        "coloured by how far refinement moved the shape itself; the number is the furthest. "
        f"{len(shown)} of {len(rig.names)} changed by more than {CHANGED_MM:g} mm.</p>"
    )
    scale = colour_scale(stops("warm"), 0.0, top, "change of the shape, mm")
    rest = folded(f"{len(quiet)} shapes that hardly changed", gallery(quiet))
    return words + scale + gallery(first + shown) + (rest if quiet else "")


def error_pictures(inputs: RigInputs) -> str:
    """How far the rig is from what was tracked, on the face, for the worst and the key frames."""
    if not inputs.performances:
        return ""
    chosen = key_frames(inputs)
    errors = frame_errors(inputs, sorted(chosen))
    top = round_up(_percentile(errors.after, 99.5))
    sides = "The refined rig"
    if errors.before is not None:
        top = max(top, round_up(_percentile(errors.before, 95.0)))
        sides = "Left the transferred template with its own best weights, right the refined rig"
    tiles = _Tiles(inputs)
    figures = []
    for place, frame in enumerate(sorted(chosen)):
        after = errors.after[place]
        picture = tiles.coloured(inputs.rig.shape(inputs.rig.weights[frame]), after, top)
        words = _rms(after)
        if errors.before is not None:
            before = errors.before[place]
            left = tiles.coloured(errors.template_posed[place], before, top)
            picture = np.concatenate([left, picture], axis=1)
            words = f"{_rms(before)} to {words}"
        label = inputs.labels[frame]
        words = f"{label}: {words} mm, worst {number(_percentile(after, 100.0))} ({chosen[frame]})"
        figures.append(figure(jpeg_tag(picture, f"errors of {label}"), words))
    lead = (
        f"<p>{sides}, coloured by the distance from the tracked mesh; grey where nothing was seen. "
        f"The numbers are root mean squares. {len(chosen)} of {len(inputs.labels)} frames: those "
        "it fits worst, the strongest expression of each take, and some in between.</p>"
    )
    return lead + colour_scale(stops("warm"), 0.0, top, "error, mm") + gallery(figures)


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameErrors:
    """Distances (N, V) from the tracked mesh at some frames, mm; NaN where nothing was seen.

    Attributes:
        after: of the refined rig with its solved weights.
        before: of the transferred template with the best weights for these frames, or None.
        template_posed: (N, V, 3) that template in rig space, mm; empty without it.
    """

    after: Floats
    before: Floats | None
    template_posed: Floats


def frame_errors(inputs: RigInputs, frames: list[int]) -> FrameErrors:
    """Errors of the rig, and of the template before refinement, at `frames` in rising order."""
    rig, seen = inputs.rig, inputs.observations(frames)
    unseen = seen.confidence <= 0
    own = Fit(rig.neutral, rig.deltas, rig.weights[frames], rig.head_from_rig[frames])
    after = np.where(unseen, np.nan, own.residuals(seen.points))
    if inputs.before is None:
        return FrameErrors(after=after, before=None, template_posed=np.zeros((0, 0, 3)))
    moving = inputs.before.moves()
    known = rig.weights[frames][:, moving] if inputs.report.get("weights_known") else None
    seen = Observations(seen.points, seen.confidence, seen.contiguous, known)
    priors = inputs.settings.schedule().weights
    fit = pose_frames(inputs.before.neutral, inputs.before.deltas[moving], seen, priors)
    before = np.where(unseen, np.nan, fit.residuals(seen.points))
    posed = fit.neutral + np.tensordot(fit.weights, fit.deltas, axes=1)
    return FrameErrors(after=after, before=before, template_posed=posed)


def key_frames(inputs: RigInputs) -> dict[int, str]:
    """Which frames to show, and why: "worst", "peak" of a take, or "in between"."""
    count = len(inputs.rig.weights)
    chosen: dict[int, str] = {}
    told = inputs.report.get("residual_per_frame_mm", [])
    if len(told) == count:
        worst = np.argsort(-np.asarray(told, dtype=float), kind="stable")[:_WORST]
        chosen |= dict.fromkeys(worst.tolist(), "worst")
    strength = inputs.rig.weights.sum(axis=1)
    ends = [start for start, _ in inputs.starts[1:]] + [count]
    for (start, _), end in zip(inputs.starts, ends, strict=True):
        if end > start and len(chosen) < _FRAMES:
            chosen.setdefault(start + int(strength[start:end].argmax()), "peak")
    for frame in _spread(count, _FRAMES).tolist():
        if len(chosen) < _FRAMES:
            chosen.setdefault(frame, "in between")
    return chosen


class _Tiles:
    """Small pictures of one face, all from the same place."""

    def __init__(self, inputs: RigInputs) -> None:
        rig = inputs.rig
        face = rig.neutral[framed_vertices(rig.deltas)]
        whole = studio_camera(face, _YAW, _TILE)
        columns = whole.project(face)[:, 0]
        left = max(int(columns.min()) - _MARGIN, 0)
        width = min(int(columns.max()) + _MARGIN, _TILE) - left
        self._camera = cropped(whole, left, 0, max(width, 1), _TILE)
        self._studio = Studio(Mesh(rig.neutral, rig.polygons))

    def plain(self, vertices: Floats) -> Pixels:
        """The face in the colour of 0."""
        return self.coloured(vertices, np.zeros(len(vertices)), 1.0)

    def coloured(self, vertices: Floats, values: Floats, top: float) -> Pixels:
        """The face with values (V,) from 0 to `top` in colour; NaN is grey."""
        return self._studio.portrait(vertices, self._camera, warm(values, 0.0, top))


def _pair(left: Pixels, right: Pixels, alt: str, words: str) -> str:
    return figure(jpeg_tag(np.concatenate([left, right], axis=1), alt), words)


def _rms(values: Floats) -> str:
    seen = values[np.isfinite(values)]
    return number(float(np.sqrt((seen**2).mean()))) if len(seen) else "n/a"


def _percentile(values: Floats, share: float) -> float:
    seen = values[np.isfinite(values)]
    return float(np.percentile(seen, share)) if len(seen) else 0.0


def _spread(count: int, wanted: int) -> Ints:
    places: Ints = np.unique(np.linspace(0, max(count - 1, 0), min(wanted, count)).round()).astype(
        np.int64
    )
    return places
