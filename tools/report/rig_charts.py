"""Charts of a rig: a map of all weights, and how the solve converged."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from capture.arrays import Floats
from capture.errors import WorkError
from tools.report.charts import Labels, Series, line_chart
from tools.report.page import figure, table
from tools.report.picture import sequential
from tools.report.svg import Axis, drawing, element, text, ticks

_WIDTH, _RIGHT = 720.0, 14.0
_ROW = 13.0
_ENERGIES = {"data": "E_g, data", "gradient": "E_r, gradients", "offset": "E_d, offsets"}


def round_up(value: float) -> float:
    """The next of 1, 1.5, 2, 3, 5, 7 times a power of ten: ends for colour scales."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    ends = [factor * power for factor in (1, 1.5, 2, 3, 5, 7, 10)]
    return float(f"{next(end for end in ends if end >= value * (1 - 1e-9)):.6g}")


def weight_map(names: Sequence[str], weights: Floats, starts: Sequence[tuple[int, str]]) -> str:
    """All weights as one picture: a row a shape, a column a frame.

    Args:
        names: B shapes.
        weights: (F, B) in 0..1.
        starts: the first frame of each take, and its name.

    Returns:
        an SVG with the picture inside.
    """
    frames = len(weights)
    left = 20.0 + 6.6 * max((len(name) for name in names), default=4)
    top = 20.0 if any(name for _, name in starts) else 6.0
    tall = _ROW * len(names)
    x = Axis(low=0.0, high=float(frames), start=left, end=_WIDTH - _RIGHT)
    parts = [
        element(
            "image", x=left, y=top, width=x.end - left, height=tall, preserveAspectRatio="none",
            style="image-rendering:pixelated", href=_png(sequential(weights.T, 0.0, 1.0)),
        )
    ]  # fmt: skip
    for row, name in enumerate(names):
        y = top + _ROW * (row + 0.5) + 4.0
        parts.append(text(left - 6, y, name, class_="tick", text_anchor="end"))
    for start, name in starts:
        at = x(float(start))
        if start:
            parts.append(element("line", x1=at, x2=at, y1=top - 14, y2=top + tall, stroke="#fff"))
        parts.append(text(at + 3, top - 5, name, class_="tick"))
    for value in ticks(0.0, float(max(frames - 1, 1)), 10):
        if value == round(value) and value < frames:
            place = x(value + 0.5)
            parts.append(
                text(place, top + tall + 15, int(value), class_="tick", text_anchor="middle")
            )
    middle = (left + x.end) / 2
    label = "frame of all takes"
    parts.append(text(middle, top + tall + 31, label, class_="label", text_anchor="middle"))
    return drawing(_WIDTH, top + tall + 38, "".join(parts), "weight of every shape at every frame")


def convergence(turns: Sequence[Mapping[str, Any]]) -> str:
    """Energies and residual of every turn of the solve, as charts and a table; empty without.

    Args:
        turns: "iterations" of report.json.
    """
    if not turns:
        return ""
    places = [float(turn + 1) for turn in range(len(turns))]
    known = {key: words for key, words in _ENERGIES.items() if all(key in t for t in turns)}
    charts = []
    energies = [("total", "total"), *known.items()]
    lines = [
        Series(name=words, x=places, y=[float(t[key]) for t in turns])
        for key, words in energies
        if all(key in t for t in turns)
    ]
    if lines:
        labels = Labels(title="energies by turn", x="turn", y="energy, summed squared mm")
        charts.append(
            figure(line_chart(lines, labels), "What each turn of the alternation left to pay.")
        )
    if all("rms_mm" in t for t in turns):
        labels = Labels(title="residual by turn", x="turn", y="residual, mm RMS")
        line = Series(name="residual", x=places, y=[float(t["rms_mm"]) for t in turns])
        words = "After the shapes of that turn, before its weights are solved again."
        charts.append(figure(line_chart([line], labels, height=150.0), words))
    keys = [key for key in turns[0] if not isinstance(turns[0][key], list | dict)]
    rows = [[k + 1, *(turn.get(key) for key in keys)] for k, turn in enumerate(turns)]
    return "".join(charts) + table(["turn", *(key.replace("_", " ") for key in keys)], rows)


def _png(colours: Floats) -> str:
    """An image (H, W, 3) in 0..1 as the address of a PNG that holds it."""
    pixels = np.rint(255.0 * colours[..., ::-1]).astype(np.uint8)
    good, data = cv2.imencode(".png", np.ascontiguousarray(pixels))
    if not good:
        raise WorkError("weight map: PNG encoding failed")
    return f"data:image/png;base64,{base64.b64encode(data.tobytes()).decode('ascii')}"
