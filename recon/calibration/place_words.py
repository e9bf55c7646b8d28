"""Where in a volume or an image something is missing: regions found, merged and put in words.

The operator stands behind the cameras and looks at the actor, along -Z of the world: +X is to the
operator's right and to the actor's left, +Y is up, +Z comes towards the cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from capture.arrays import Bools, Floats, check_shape

_EDGE = 0.3  # a side begins at this share of the half extent
_MIDDLE = 0.5  # and the middle ends at this one
_LEAST_CELLS = 3  # a region of fewer cells says nothing
_NEAR = 0.1  # of the radius: a shorter way is not worth saying
_ROUND_MM = 10.0


@dataclass(frozen=True, eq=False)
class Gap:
    """One region in which too little was shown.

    Attributes:
        signs: (D,) -1, 0 or 1 along each axis; all 0 is the middle; empty is the whole.
        middle: (D,) centroid of the cells that are missing, in half extents.
        missing: how many cells are missing.
        share: of the region that was shown.
    """

    signs: tuple[int, ...]
    middle: Floats
    missing: int
    share: float


def find_gaps(places: Floats, shown: Bools, least: float) -> list[Gap]:
    """Regions of which less than a share was shown; one that lies in another is not repeated.

    Regions are the whole, the middle, and every side, edge and corner; larger ones come first.

    Args:
        places: (N, D) centres of the cells, in half extents: -1..1 along each axis.
        shown: (N,) whether each was shown.
        least: share of a region that must be shown.
    """
    check_shape(places=(places, "N D"), shown=(shown, "N"))
    if not len(places):
        return []
    axes = places.shape[1]
    if shown.mean() < least:
        return [_gap((), places, shown, np.ones(len(places), np.bool_))]
    gaps: list[Gap] = []
    told = np.zeros(len(places), np.bool_)
    for signs in sorted(product((0, -1, 1), repeat=axes), key=lambda s: sum(map(abs, s))):
        inside = _region(places, np.array(signs))
        if inside.sum() < _LEAST_CELLS or shown[inside].mean() >= least:
            continue
        missing = inside & ~shown
        part = any(any(gap.signs) and _lies_in(signs, gap.signs) for gap in gaps)
        if not part and told[missing].mean() <= 0.5:
            gaps.append(_gap(signs, places, shown, inside))
            told |= inside
    return gaps


def toward(direction: Floats) -> tuple[int, ...]:
    """The signs of the side, edge or corner that a direction (D,), in half extents, points to."""
    size = np.abs(direction)
    strong = size >= max(_EDGE, 0.5 * float(size.max(initial=0.0)))
    return tuple(int(s) for s in np.where(strong, np.sign(direction), 0))


def volume_region(signs: Sequence[int]) -> str:
    """A region of the face volume in words: "the upper left front of the face volume"."""
    if not any(signs):
        return "the middle of the face volume" if len(signs) else "the face volume"
    return f"the {_corner(signs)} of the face volume"


def viewpoint(signs: Sequence[int]) -> str:
    """Whose left that is, in brackets, with a blank before; empty where it makes no difference."""
    side = signs[0] if signs else 0
    if side == 0:
        return ""
    return f" (as the operator sees it from the cameras; to the actor's {_ACTOR[side]})"


def way_from_middle(offset_mm: Floats, radius_mm: float) -> str:
    """How to go there from the middle, as the operator sees it: "about 70 mm up and ..."; or ""."""
    across, up, front = (float(x) for x in np.round(offset_mm / _ROUND_MM) * _ROUND_MM)
    steps = [
        (up, f"{abs(up):.0f} mm {'up' if up > 0 else 'down'}"),
        (across, f"{abs(across):.0f} mm to the {'right' if across > 0 else 'left'}"),
        (front, f"{abs(front):.0f} mm {'towards' if front > 0 else 'away from'} the cameras"),
    ]
    ways = [words for size, words in steps if abs(size) >= max(_NEAR * radius_mm, 1.0)]
    return f"about {listed(ways)}, counted from its middle" if ways else ""


def image_regions(gaps: Sequence[Sequence[int]]) -> str:
    """Regions of an image in words, axes right and up: "the left and the lower right of its image".

    Args:
        gaps: signs (right, up) of each.
    """
    if any(not len(signs) for signs in gaps):
        return "all parts of its image"
    parts = [f"the {_corner((*signs, 0)) if any(signs) else 'middle'}" for signs in gaps]
    return f"{listed(parts)} of its image"


def listed(words: Sequence[str], most: int = 99) -> str:
    """Words in a row: "a, b and c"; of more than `most`, the first ones and how many more."""
    if len(words) > most:
        return f"{', '.join(words[: most - 1])} and {len(words) - most + 1} more"
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


_ACTOR = {-1: "right", 1: "left"}
_SIDE = {-1: "left", 1: "right", 0: ""}
_HEIGHT = {-1: "lower", 1: "upper", 0: ""}
_DEPTH = {-1: "back", 1: "front", 0: ""}


def _corner(signs: Sequence[int]) -> str:
    side, height, depth = signs
    if height and not side and not depth:
        return "top" if height > 0 else "bottom"
    return " ".join(word for word in (_HEIGHT[height], _SIDE[side], _DEPTH[depth]) if word)


def _lies_in(signs: tuple[int, ...], other: tuple[int, ...]) -> bool:
    """Whether a region is a part of another one: the upper left lies in the left."""
    return all(theirs in (0, own) for own, theirs in zip(signs, other, strict=True))


def _region(places: Floats, signs: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Bools:
    if not signs.any():
        middle: Bools = np.all(np.abs(places) <= _MIDDLE, axis=1)
        return middle
    start = 0.0 if signs.all() else _EDGE  # a corner of a ball is small: all of its octant
    used = signs != 0
    inside: Bools = np.all(places[:, used] * signs[used] > start, axis=1)
    return inside


def _gap(signs: tuple[int, ...], places: Floats, shown: Bools, inside: Bools) -> Gap:
    missing = inside & ~shown
    return Gap(
        signs=signs, middle=places[missing].mean(axis=0), missing=int(missing.sum()),
        share=float(shown[inside].mean()),
    )  # fmt: skip
