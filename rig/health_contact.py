"""Lips and lids that must meet: how wide they stay open, and how far they pass through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from capture.arrays import Floats, Ints, check_shape
from rig.mouth_close import find_mouth_shapes, guess_convention
from rig.naming import find_names
from rig.template import Template

_OPEN_MM = 0.5  # a pair nearer than this has nothing left to shut
_SHUTS = 0.25  # of a pair's gap: what the template leaves where it means to shut
_SHUTS_MM = 0.3  # or this, whichever is more
_NAMED = (
    0.8  # the same, of an expression whose name says that it shuts: rims may lie inside the skin
)
_ENOUGH = 3  # pairs that an expression must shut to count as shutting
_STAYS_MM = 0.2  # a shape by which the template's lips open no further keeps them sealed
_PARTS_MM = 0.5  # the rig's lips opening further than the template's by this is a fault


@dataclass(frozen=True, eq=False)
class Closing:
    """An expression in which the template shuts lips or lids.

    Attributes:
        part: "lids" or "lips".
        before: rows of the shapes, at weight 1, that it starts from; none: the neutral.
        after: rows of the shapes at weight 1 that shut.
        pairs: (n, 2) vertices that the template brings together.
    """

    part: Literal["lids", "lips"]
    before: tuple[int, ...]
    after: tuple[int, ...]
    pairs: Ints


@dataclass(frozen=True)
class Gap:
    """How far paired vertices are apart, mm.

    Attributes:
        mean_mm: of all pairs.
        max_mm: the widest.
        penetration_mm: the furthest that a pair has passed each other, 0 when none has.
    """

    mean_mm: float
    max_mm: float
    penetration_mm: float


def measure_gap(after: Floats, before: Floats, pairs: Ints) -> Gap:
    """Gaps of pairs in a face, and how far each has passed the point where it met.

    Args:
        after: (V, 3) the face that should be shut, mm.
        before: (V, 3) the face it was shut from: the line from lower to upper vertex there says
            which way is open. A pair nearer than 0.01 mm there cannot be said to have passed.
        pairs: (n, 2) upper and lower vertex, n >= 1.
    """
    check_shape(after=(after, "V 3"), before=(before, "V 3"), pairs=(pairs, "* 2"))
    way = before[pairs[:, 0]] - before[pairs[:, 1]]
    length = np.linalg.norm(way, axis=1)
    apart = after[pairs[:, 0]] - after[pairs[:, 1]]
    gaps = np.linalg.norm(apart, axis=1)
    along = (apart * way).sum(axis=1) / np.where(length > 0.01, length, np.inf)
    return Gap(float(gaps.mean()), float(gaps.max()), float(np.maximum(-along, 0.0).max()))


def closing_expressions(template: Template) -> list[Closing]:
    """Every expression of a template that shuts lids or lips which were open before.

    Single shapes that leave at most a quarter of a pair's gap; and, where they leave at most 0.8 of
    it, those that shut by their name: the blinks, and jawOpen with mouthClose from jawOpen, in
    whichever convention the template holds mouthClose.
    """
    found: list[Closing] = []
    if len(template.lid_pairs):
        for k, place in enumerate(find_names(template.names)):
            blinks = place is not None and place[0] in ("eyeBlinkLeft", "eyeBlinkRight")
            share = _NAMED if blinks else _SHUTS
            found += _closing("lids", template, (), (k,), share)
    if len(template.lip_pairs):
        mouth = _mouth(template)
        for k in range(len(template.names)):
            found += _closing("lips", template, (), (k,), _SHUTS)
        if mouth is not None:
            found += _closing("lips", template, *mouth, _NAMED)
    return found


def contact_report(neutral: Floats, deltas: Floats, template: Template) -> dict[str, Any]:
    """Gaps of a rig's lids and lips where the template shuts them, mm.

    Args:
        neutral: (V, 3) of the rig, mm.
        deltas: (B, V, 3) of the rig, in the template's order, mm.
        template: with its pairs; without any, the report says so by empty lists.

    Returns:
        "neutral": mean gap of lids and lips at rest, rig and template; "closed": one entry an
        expression that the template shuts; "opened": shapes that keep the template's lips as they
        are and part the rig's by more than 0.5 mm.
    """
    check_shape(
        template=(template.deltas, "B V 3"), deltas=(deltas, "B V 3"), neutral=(neutral, "V 3")
    )
    closed = [_closed(c, neutral, deltas, template) for c in closing_expressions(template)]
    return {
        "neutral": {
            part: {
                "gap_mm": _rest(neutral, pairs),
                "template_gap_mm": _rest(template.neutral, pairs),
            }
            for part, pairs in (("lids", template.lid_pairs), ("lips", template.lip_pairs))
        },
        "closed": closed,
        "opened": _opened(neutral, deltas, template),
    }


def _mouth(template: Template) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Shapes of the open and of the shut mouth, jaw open in both."""
    found = find_mouth_shapes(template.names)
    if found is None:
        return None
    jaw, close = found
    convention = guess_convention(
        template.neutral, template.deltas[jaw], template.deltas[close], template.lip_pairs
    )
    return (jaw,), (close,) if convention == "combined" else (jaw, close)


def _closing(
    part: Literal["lids", "lips"],
    template: Template,
    before: tuple[int, ...],
    after: tuple[int, ...],
    share: float,
) -> list[Closing]:
    """The expression with the pairs that it shuts to a share of their gap, if they are enough."""
    pairs = template.lid_pairs if part == "lids" else template.lip_pairs
    start = _distances(_face(template.neutral, template.deltas, before), pairs)
    end = _distances(_face(template.neutral, template.deltas, after), pairs)
    shut = (start >= _OPEN_MM) & (end <= np.maximum(share * start, _SHUTS_MM))
    enough = int(shut.sum()) >= min(_ENOUGH, len(pairs))
    return [Closing(part, before, after, pairs[shut])] if enough else []


def _closed(
    closing: Closing, neutral: Floats, deltas: Floats, template: Template
) -> dict[str, Any]:
    gaps: dict[str, float] = {}
    for prefix, rest, shapes in (
        ("", neutral, deltas),
        ("template_", template.neutral, template.deltas),
    ):
        before = _face(rest, shapes, closing.before)
        gap = measure_gap(_face(rest, shapes, closing.after), before, closing.pairs)
        gaps |= {
            f"{prefix}gap_before_mm": float(_distances(before, closing.pairs).mean()),
            f"{prefix}gap_mean_mm": gap.mean_mm,
            f"{prefix}gap_max_mm": gap.max_mm,
            f"{prefix}penetration_mm": gap.penetration_mm,
        }
    names = [template.names[k] for k in closing.after]
    return {"expression": names, "part": closing.part, "pairs": len(closing.pairs), **gaps}


def _opened(neutral: Floats, deltas: Floats, template: Template) -> list[dict[str, Any]]:
    pairs = template.lip_pairs
    if not len(pairs):
        return []
    found = []
    for k, name in enumerate(template.names):
        wanted = _widening(template.neutral, template.deltas[k], pairs)
        here = _widening(neutral, deltas[k], pairs)
        if wanted <= _STAYS_MM and here > wanted + _PARTS_MM:
            found.append({"shape": name, "opens_mm": here, "template_opens_mm": wanted})
    return found


def _widening(neutral: Floats, delta: Floats, pairs: Ints) -> float:
    return float((_distances(neutral + delta, pairs) - _distances(neutral, pairs)).mean())


def _rest(neutral: Floats, pairs: Ints) -> float | None:
    return float(_distances(neutral, pairs).mean()) if len(pairs) else None


def _face(neutral: Floats, deltas: Floats, shapes: Sequence[int]) -> Floats:
    posed: Floats = neutral + deltas[list(shapes)].sum(axis=0)
    return posed


def _distances(vertices: Floats, pairs: Ints) -> Floats:
    apart: Floats = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    return apart
