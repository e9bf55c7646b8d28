"""Left and right halves of shapes that were captured in one piece, and one piece of two halves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from capture.arrays import Floats, check_shape
from capture.errors import InputError
from capture.names import known_hint
from rig.face_rig import FaceRig
from rig.health_symmetry import find_mirror
from rig.naming import Renaming, side_of
from rig.template import Template
from rig.weight_table import WeightTable

WIDTH_MM = 20.0  # over which one half fades into the other

_Rig = TypeVar("_Rig", bound=FaceRig | Template)
_Named = TypeVar("_Named", bound=FaceRig | Template | WeightTable)


def left_share(lateral_mm: Floats, width_mm: float = WIDTH_MM) -> Floats:
    """Share of a shape (V,) that goes to its left half; the right half takes 1 minus it.

    A smoothstep across the middle line: 0 right of -width/2, 1 left of +width/2, 1/2 between.

    Args:
        lateral_mm: (V,) distance left of the middle line, as of `Mirror.lateral_mm`.
        width_mm: > 0.

    Raises:
        InputError: when the width is not above 0.
    """
    if not width_mm > 0.0:
        raise InputError(f"split: width_mm must be above 0, found {width_mm:g}")
    t = np.clip(np.asarray(lateral_mm, dtype=np.float64) / width_mm + 0.5, 0.0, 1.0)
    share: Floats = t * t * (3.0 - 2.0 * t)
    return share


def split_delta(delta: Floats, share: Floats) -> tuple[Floats, Floats]:
    """Left and right half (V, 3) of a shape whose floating-point sum is the shape, bit for bit.

    Args:
        delta: (V, 3) mm.
        share: (V,) of the left half.
    """
    check_shape(delta=(delta, "V 3"), share=(share, "V"))
    right = delta - share[:, None] * delta
    left: Floats = delta - right  # one of the two is at least half of the shape: no rounding
    return left, delta - left


def half_names(name: str, like: Sequence[str] = ()) -> tuple[str, str]:
    """Names of the halves of a shape, spelt as the sides of other names are.

    "cheekPuff" becomes cheekPuffLeft and cheekPuffRight, or cheekPuff_L and cheekPuff_R where
    `like` holds names such as "eyeBlink_L", or AU34L and AU34R next to "AU12L".
    """
    for ends in (("_L", "_R"), ("_left", "_right"), ("Left", "Right"), (".L", ".R"), ("L", "R")):
        if any(other.endswith(ends[0]) and side_of(other) == "left" for other in like):
            return name + ends[0], name + ends[1]
    return name + "Left", name + "Right"


def split_shape(
    thing: _Rig,
    name: str,
    halves: tuple[str, str] | None = None,
    width_mm: float = WIDTH_MM,
    lateral_mm: Floats | None = None,
) -> _Rig:
    """Replace a shape by its left and right half; both keep its weights, so no frame changes.

    Args:
        thing: a rig or template.
        name: of the shape.
        halves: names of left and right; spelt like the other names when None.
        width_mm: over which one half fades into the other.
        lateral_mm: (V,) how far left of the middle line each vertex lies; from the mesh's own
            mirror (`find_mirror` on its neutral) when None. For an actor's rig the template's
            mirror is surer.

    Raises:
        InputError: when there is no such shape, or a half's name is taken.
    """
    if name not in thing.names:
        raise InputError(f"split: no shape {name!r}; {known_hint(name, thing.names)}")
    others = [n for n in thing.names if n != name]
    left, right = halves or half_names(name, others)
    taken = [half for half in (left, right) if half in others]
    if taken or left == right:
        raise InputError(f"split of {name}: {taken[0] if taken else left!r} is a shape already")
    new = tuple((left, right) if n == name else (n,) for n in thing.names)
    return apply_renaming(thing, Renaming(thing.names, new, ()), width_mm, lateral_mm)[0]


def apply_renaming(
    thing: _Named, renaming: Renaming, width_mm: float = WIDTH_MM, lateral_mm: Floats | None = None
) -> tuple[_Named, dict[str, float]]:
    """A rig, template or table of weights under new names, halves split and merged as they ask.

    Split shapes keep the frames as they are. A merged one is the sum of its halves at the mean of
    their weights: frames in which the halves' weights differ change.

    Args:
        thing: whose names are `renaming.old`.
        renaming: from `rig.naming.rename`.
        width_mm: as of `split_shape`.
        lateral_mm: as of `split_shape`; not used for a table of weights.

    Returns:
        the thing renamed, and for each merged name the largest difference between the weights of
        its two halves in a frame: 0 where nothing was lost.

    Raises:
        InputError: when the names are not those that the renaming was made for.
    """
    if tuple(thing.names) != renaming.old:
        wrong = [name for name in thing.names if name not in renaming.old]
        raise InputError(
            f"rename: made for {len(renaming.old)} other names; unknown to it: {', '.join(wrong)}"
        )
    names = renaming.names
    rows = [[k for k, news in enumerate(renaming.new) if name in news] for name in names]
    changes: dict[str, Any] = {"names": names}
    apart: dict[str, float] = {}
    if not isinstance(thing, Template):
        changes["weights"] = np.stack([thing.weights[:, r].mean(axis=1) for r in rows], axis=1)
        for name, r in zip(names, rows, strict=True):
            if len(r) > 1:
                apart[name] = float(np.ptp(thing.weights[:, r], axis=1).max(initial=0.0))
    if not isinstance(thing, WeightTable):
        changes["deltas"] = _renamed_deltas(thing, renaming, width_mm, lateral_mm)
    return replace(thing, **changes), apart


def _renamed_deltas(
    thing: FaceRig | Template, renaming: Renaming, width_mm: float, lateral_mm: Floats | None
) -> Floats:
    if renaming.splits and lateral_mm is None:
        lateral_mm = find_mirror(thing.neutral).lateral_mm(thing.neutral)
    pieces: dict[str, Floats] = {}
    for delta, news in zip(thing.deltas, renaming.new, strict=True):
        halves: tuple[Floats, ...] = (delta,)
        if lateral_mm is not None and len(news) == 2:
            halves = split_delta(delta, left_share(lateral_mm, width_mm))
        for name, piece in zip(news, halves, strict=True):
            pieces[name] = pieces[name] + piece if name in pieces else piece
    return np.stack(list(pieces.values()))
