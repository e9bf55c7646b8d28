"""What one may conclude of a rig, in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from tools.report.page import Verdict
from tools.report.rig_inputs import RigInputs
from tools.report.shapes import rig_verdicts
from tools.report.svg import number

_NAMED = 8  # names a line; the rest are counted
_SCALE = (0.67, 1.5)  # of a refined shape against the transferred one
_BUSY = 0.4  # share of the shapes that act in a frame: beyond it weights may stand in for others
_UNSEEN = 0.05  # share of the vertices
_SHUT_MM = 0.5  # mean gap beyond the template's
_APART_MM = 1.5


def rig_remarks(inputs: RigInputs) -> tuple[Verdict, ...]:
    """Verdicts on a rig, from its report, its health where that was looked at, and its shapes."""
    report = inputs.report
    health = report.get("health")
    health = health if isinstance(health, Mapping) else {}
    out = [
        *rig_verdicts(inputs.rig, report),
        *_fit(inputs, report),
        *_exercised(report),
        *_next(health),
        *_scales(inputs, health),
        *_contact(health),
        *_degenerate(health),
        *_frame(report),
    ]
    return tuple(out)


def named(names: Sequence[str]) -> str:
    """Names in a row, the rest counted."""
    few = ", ".join(names[:_NAMED])
    return f"{few} and {len(names) - _NAMED} more" if len(names) > _NAMED else few


def found(document: Mapping[str, Any], key: str) -> Any:
    """The first value of that key in a nested report, however deep; None without one."""
    if key in document:
        return document[key]
    inner = (found(value, key) for value in document.values() if isinstance(value, Mapping))
    return next((value for value in inner if value is not None), None)


def scales(inputs: RigInputs) -> dict[str, float]:
    """Size of each refined shape against the transferred one, <D, D*> / <D*, D*>."""
    if inputs.before is None:
        return {}
    old = inputs.before.deltas
    size = np.einsum("bvc,bvc->b", old, old)
    along = np.einsum("bvc,bvc->b", inputs.rig.deltas, old)
    moving = inputs.before.moves()
    rows = zip(inputs.rig.names, along, size, moving, strict=True)
    return {name: float(a / s) for name, a, s, moves in rows if moves}


def _fit(inputs: RigInputs, report: Mapping[str, Any]) -> Iterator[Verdict]:
    held = found(report, "held_out")
    ratio = held.get("ratio") if isinstance(held, Mapping) else None
    if isinstance(ratio, int | float):
        level = "good" if ratio <= 0.6 else "warn" if ratio <= 1.0 else "bad"
        words = f"the residual is {ratio:.2f} of the transferred template's"
        yield Verdict(level=level, subject="Held-out frames:", words=words)
    mean = report.get("active_shapes_mean")
    shapes = len(inputs.rig.names)
    if isinstance(mean, int | float) and shapes:
        busy = mean > max(_BUSY * shapes, 6.0)
        words = f"{number(float(mean))} of {shapes} act in a frame on average"
        words += "; so many may stand in for one another" if busy else ""
        yield Verdict(level="warn" if busy else "good", subject="Active shapes:", words=words)


def _exercised(report: Mapping[str, Any]) -> Iterator[Verdict]:
    never = _names(report.get("never_exercised"))
    if never:
        words = (
            f"{len(never)} {_are(never)} not in these takes and stay as transferred: "
            f"{named(never)}; capture expressions that use them"
        )
        yield Verdict(level="warn", subject="Never exercised:", words=words)
    elif "never_exercised" in report:
        yield Verdict(level="good", subject="Exercised:", words="every shape acts in these takes")
    dropped = _names(report.get("dropped_zero_shapes"))
    if dropped:
        words = f"{len(dropped)} of the template move nothing and were left out: {named(dropped)}"
        yield Verdict(level="warn", subject="Empty shapes:", words=words)


def _next(health: Mapping[str, Any]) -> Iterator[Verdict]:
    unknown = _names(found(health, "undetermined"))
    if unknown:
        told = [_expression(row, "shapes") for row in _rows(found(health, "shoot_next"))]
        after = f"; shoot next: {'; '.join(told[:3])}" if told else ""
        words = f"{len(unknown)} {_are(unknown)} hardly shown by these frames: {named(unknown)}"
        yield Verdict(level="warn", subject="Undetermined:", words=words + after)
    close = found(health, "mouth_close")
    if isinstance(close, Mapping):
        own, wanted = close.get("convention"), close.get("template_convention")
        if None not in (own, wanted) and own != wanted:
            words = f"{close.get('shape')} follows {own}, in the template {wanted}"
            yield Verdict(level="warn", subject="Mouth close:", words=words)


def _scales(inputs: RigInputs, health: Mapping[str, Any]) -> Iterator[Verdict]:
    own = scales(inputs)
    told = found(health, "drifted")
    low, high = _SCALE
    drifted = (
        _names(told)
        if told is not None
        else [name for name, scale in own.items() if not low <= scale <= high]
    )
    if drifted:
        shown = [f"{name} ({own[name]:.2f})" if name in own else name for name in drifted]
        words = (
            f"{len(drifted)} {_are(drifted)} no longer the template's size (below {low:g} or above "
            f"{high:g} of it), so that a weight of 1 means something else: {named(shown)}"
        )
        yield Verdict(level="warn", subject="Scale drifted:", words=words)
    elif told is not None or own:
        words = f"each shape keeps {low:g} to {high:g} of the template's size"
        yield Verdict(level="good", subject="Scale:", words=words)


def _contact(health: Mapping[str, Any]) -> Iterator[Verdict]:
    closed = [row for row in _rows(found(health, "closed")) if "gap_mean_mm" in row]
    for part in ("lids", "lips"):
        own = [row for row in closed if row.get("part", "") == part]
        open_ = [row for row in own if _beyond(row) > _SHUT_MM]
        if open_:
            worst = max(open_, key=_beyond)
            words = (
                f"{len(open_)} of {len(own)} expressions that shut in the template stay open, "
                f"worst {_expression(worst)}: {number(float(worst['gap_mean_mm']))} mm"
            )
            level = "bad" if _beyond(worst) > _APART_MM else "warn"
            yield Verdict(level=level, subject=f"{part.title()} do not shut:", words=words)
        elif own:
            words = f"shut in all {len(own)} expressions that shut them in the template"
            yield Verdict(level="good", subject=f"{part.title()}:", words=words)
    opened = [str(row.get("shape", "")) for row in _rows(found(health, "opened"))]
    if opened:
        words = f"{len(opened)} part them where the template's do not: {named(opened)}"
        yield Verdict(level="warn", subject="Lips:", words=words)


def _degenerate(health: Mapping[str, Any]) -> Iterator[Verdict]:
    duplicates = [
        f"{row.get('shape', '')} = {row.get('of', '')}"
        for row in _rows(found(health, "duplicates"))
    ]
    if duplicates:
        words = f"{len(duplicates)} move alike, and weights cannot tell them apart: "
        yield Verdict(level="warn", subject="Duplicates:", words=words + named(duplicates))
    dependent = [
        str(row.get("equals", row.get("shape", ""))) for row in _rows(found(health, "dependent"))
    ]
    if dependent:
        words = f"{len(dependent)} are made of others: {named(dependent)}"
        yield Verdict(level="warn", subject="Dependent shapes:", words=words)
    wrong = found(health, "not_shapes")
    if isinstance(wrong, Mapping) and wrong:
        words = named([f"{name}: {why}" for name, why in wrong.items()])
        yield Verdict(level="bad", subject="Not shapes:", words=words)


def _frame(report: Mapping[str, Any]) -> Iterator[Verdict]:
    if report.get("topology_matches") is False:
        words = "the performances' polygons are not the template's: only vertex counts agree"
        yield Verdict(level="bad", subject="Topology:", words=words)
    unseen, residuals = report.get("unseen_vertices"), report.get("vertices")
    if isinstance(unseen, int) and isinstance(residuals, int) and unseen > _UNSEEN * residuals:
        words = f"{unseen} of {residuals} vertices were never seen and follow the template"
        yield Verdict(level="warn", subject="Unseen:", words=words)


def _beyond(row: Mapping[str, Any]) -> float:
    return float(row["gap_mean_mm"]) - float(row.get("template_gap_mean_mm") or 0.0)


def _expression(row: Mapping[str, Any], key: str = "expression") -> str:
    names = row.get(key, "")
    return names if isinstance(names, str) else " + ".join(map(str, names))


def _are(names: Sequence[str]) -> str:
    return "shape is" if len(names) == 1 else "shapes are"


def _names(values: Any) -> list[str]:
    if isinstance(values, Mapping):
        return [str(name) for name in values]
    return [str(value) for value in values] if isinstance(values, list | tuple) else []


def _rows(values: Any) -> list[Mapping[str, Any]]:
    return [v for v in values if isinstance(v, Mapping)] if isinstance(values, list | tuple) else []
