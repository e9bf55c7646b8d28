"""The page of a rig: what to conclude, a 3D view, shapes, errors, weights, convergence, health."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from capture.progress import Progress, silent
from rig.rig_settings import RigSettings
from rig.template import Template
from tools.report.charts import Labels, Series, bar_chart, colour_scale, line_chart
from tools.report.page import Section, facts, figure, flattened, folded, table, write_page
from tools.report.picture import stops
from tools.report.rig_charts import convergence, weight_map
from tools.report.rig_inputs import RigInputs, read_rig_inputs
from tools.report.rig_pictures import error_pictures, shape_pictures
from tools.report.rig_remarks import rig_remarks
from tools.report.rig_viewer import rig_viewer
from tools.report.shapes import weight_figure
from tools.report.svg import escape, number
from track.performance import Performance

_KNOWN = {
    "residual of the transferred template, mm": "residual_transferred_mm",
    "residual of the refined rig, mm": "residual_refined_mm",
    "refined / transferred": "ratio",
    "active shapes a frame": "active_shapes_mean",
    "worst vertex, mm": "worst_mm",
    "change of the neutral, mm RMS": "neutral_change_mm",
    "frame taken as the neutral": "neutral_frame",
}
_ROWS, _FACTS = 8, 12  # of a table of the health; more are folded away


def write_rig_page(
    folder: Path,
    template: Template | None,
    out: Path,
    *,
    performances: Sequence[Performance] = (),
    takes: Sequence[str] = (),
    settings: RigSettings | None = None,
    progress: Progress = silent,
) -> Path:
    """Write one self-contained HTML page of what `likeness rig` made.

    Args:
        folder: what `solve_rig` wrote: rig.npz, report.json and, to show shapes and errors before
            refinement, transferred.npz.
        template: the artist's shapes, or None.
        out: the file.
        performances: what the rig was solved on, in that order; without them there are no errors.
        takes: a name for each performance.
        settings: of the solve.
        progress: told after each section.

    Returns:
        `out`.

    Raises:
        InputError: naming what is missing, damaged, or of another solve.
        WorkError: when there is no headless OpenGL to draw with.
    """
    inputs = read_rig_inputs(
        Path(folder),
        template=template, performances=performances, takes=takes, settings=settings,
    )  # fmt: skip
    sections = []
    for done, part in enumerate(_PARTS, start=1):
        sections += part(inputs)
        progress(done, len(_PARTS), "report")
    rig = inputs.rig
    words = f"{len(rig.names)} shapes on {len(rig.neutral)} vertices"
    if len(rig.weights):
        words += f", solved on {len(rig.weights)} frames"
    write_page("Face rig", f'<p class="lead">{escape(words)}</p>', sections, Path(out))
    return Path(out)


def _fit_section(inputs: RigInputs) -> list[Section]:
    rig, report = inputs.rig, inputs.report
    parts = [
        facts(
            {"shapes": len(rig.names), "vertices": len(rig.neutral), "frames": len(rig.weights)}
            | {name: report[key] for name, key in _KNOWN.items() if key in report}
        )
    ]
    if {"residual_transferred_mm", "residual_refined_mm"} <= set(report):
        values = [float(report[f"residual_{which}_mm"]) for which in ("transferred", "refined")]
        labels = Labels(title="rig residual", x="residual, mm RMS")
        chart = bar_chart(["transferred template", "refined rig"], values, labels)
        parts.append(figure(chart, "What refinement gained on all frames."))
    told = _best_fit(report)
    parts.append(facts(told) if told else "")
    verdicts = rig_remarks(inputs)
    return [Section(anchor="fit", title="Fit", body="".join(parts), verdicts=verdicts)]


def _best_fit(report: Mapping[str, Any]) -> dict[str, object]:
    """What the best possible weights reach, where the solver says so."""
    best = report.get("best_fit")
    if not isinstance(best, Mapping):
        return {}
    names = {
        "best possible, transferred, mm": "residual_transferred_mm",
        "best possible, refined, mm": "residual_refined_mm",
        "best possible, refined / transferred": "ratio",
    }
    return {name: best[key] for name, key in names.items() if key in best}


def _view_section(inputs: RigInputs) -> list[Section]:
    return [Section(anchor="view", title="3D view", body=rig_viewer(inputs))]


def _shape_section(inputs: RigInputs) -> list[Section]:
    title = "Shapes" if inputs.before is None else "Shapes before and after"
    return [Section(anchor="shapes", title=title, body=shape_pictures(inputs))]


def _error_section(inputs: RigInputs) -> list[Section]:
    parts = []
    told = inputs.report.get("residual_per_frame_mm")
    if isinstance(told, list) and len(told) == len(inputs.rig.weights) > 1:
        line = Series(name="refined rig", x=[float(f) for f in range(len(told))], y=told)
        labels = Labels(title="residual by frame", x="frame", y="residual, mm RMS")
        marks = [(float(start), name) for start, name in inputs.starts if start]
        parts.append(
            figure(
                line_chart([line], labels, marks=marks, height=150.0),
                "Distance of the refined rig from the tracked mesh.",
            )
        )
    parts.append(error_pictures(inputs))
    body = "".join(parts)
    return [Section(anchor="errors", title="Errors by expression", body=body)] if body else []


def _weight_section(inputs: RigInputs) -> list[Section]:
    rig = inputs.rig
    if not rig.weights.size:
        return []
    starts = inputs.starts if len(inputs.starts) > 1 else []
    chart = weight_map(rig.names, rig.weights, starts)
    scale = colour_scale(stops("sequential"), 0.0, 1.0, "weight")
    body = scale + figure(chart, "Every shape's weight at every frame.")
    if inputs.is_motion:
        body += weight_figure(rig, [(float(start), name) for start, name in starts])
    else:
        body += "<p>The frames are still expressions, no motion: there are no curves to draw.</p>"
    return [Section(anchor="weights", title="Weights", body=body)]


def _turn_section(inputs: RigInputs) -> list[Section]:
    told = inputs.report.get("iterations")
    turns = [t for t in told if isinstance(t, Mapping)] if isinstance(told, list) else []
    body = convergence(turns)
    return [Section(anchor="convergence", title="Convergence", body=body)] if body else []


def _health_section(inputs: RigInputs) -> list[Section]:
    health = inputs.report.get("health")
    if not isinstance(health, Mapping) or not health:
        return []
    return [Section(anchor="health", title="Health", body=document_body(health))]


def _number_section(inputs: RigInputs) -> list[Section]:
    plain = {k: v for k, v in inputs.report.items() if k not in ("health", "iterations")}
    values = [[name, value] for name, value in flattened(plain).items()]
    body = folded("everything in report.json", table(["number", "value"], values))
    chosen = [[name, value] for name, value in asdict(inputs.settings).items()]
    body += folded("settings of the solve", table(["setting", "value"], chosen))
    return [Section(anchor="numbers", title="Numbers and settings", body=body)]


def document_body(document: Mapping[str, Any], depth: int = 3) -> str:
    """A nested report as HTML: single values as facts, lists of alike entries as tables."""
    plain: dict[str, object] = {}
    parts = []
    for key, value in document.items():
        if isinstance(value, Mapping | list | tuple) and not value:
            plain[_spoken(key)] = "none"
        elif isinstance(value, Mapping) or _entries(value):
            level = min(depth, 5)
            parts.append(f"<h{level}>{escape(_spoken(key))}</h{level}>{_inner(value, depth + 1)}")
        else:
            plain[_spoken(key)] = flattened({key: value})[key]
    return (facts(plain) if plain else "") + "".join(parts)


def _inner(value: Mapping[str, Any] | Sequence[Any], depth: int) -> str:
    if not isinstance(value, Mapping):
        return _table(_entries(value))
    named = [{"name": k, **row} for k, row in value.items() if isinstance(row, Mapping)]
    if len(named) == len(value) and not _unlike(named):
        return _table(named)
    body = document_body(value, depth)
    single = not any(isinstance(v, Mapping | list | tuple) for v in value.values())
    return folded(f"{len(value)} entries", body) if single and len(value) > _FACTS else body


def _entries(value: Any) -> list[Mapping[str, Any]]:
    """The rows of a list that holds some."""
    some = value if isinstance(value, list | tuple) else ()
    return [row for row in some if isinstance(row, Mapping)]


def _unlike(rows: Sequence[Mapping[str, Any]]) -> bool:
    return any(set(row) != set(rows[0]) for row in rows) or any(
        isinstance(cell, Mapping) for row in rows for cell in row.values()
    )


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    keys = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[_cell(row.get(key)) for key in keys] for row in rows]
    head = [_spoken(key) for key in keys]
    if len(rows) <= _ROWS:
        return table(head, cells)
    rest = folded(f"{len(rows) - _ROWS} more", table(head, cells[_ROWS:]))
    return table(head, cells[:_ROWS]) + rest


def _cell(value: Any) -> object:
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {_cell(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(number(v) if isinstance(v, float) else str(v) for v in value)
    return value


def _spoken(key: str) -> str:
    return str(key).replace("_", " ")


_Part = Callable[[RigInputs], list[Section]]
_PARTS: tuple[_Part, ...] = (
    _fit_section,
    _view_section,
    _shape_section,
    _error_section,
    _weight_section,
    _turn_section,
    _health_section,
    _number_section,
)
