"""Left and right of a face: which vertices mirror which, and how alike mirrored shapes are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from capture.arrays import Bools, Floats, Ints, check_shape
from rig.naming import mirrored_name, side_of

MIRROR_TOLERANCE_MM = 1.0
_TURNS = 5  # of finding the plane and matching the vertices
_FEW = 0.5  # of the vertices that must have a partner for symmetry to be judged


@dataclass(frozen=True, eq=False)
class Mirror:
    """The mirror image of each vertex across the plane x = middle_mm.

    Attributes:
        partner: (V,) vertex numbers, its own on the middle line; -1 where there is none.
        middle_mm: x of the plane.
    """

    partner: Ints
    middle_mm: float

    @property
    def matched(self) -> Bools:
        """(V,) which vertices have a mirror image."""
        found: Bools = self.partner >= 0
        return found

    def reflect(self, delta: Floats) -> Floats:
        """The mirror image of displacements (V, 3); 0 where a vertex has no partner."""
        check_shape(partner=(self.partner, "V"), delta=(delta, "V 3"))
        flipped: Floats = delta[self.partner] * np.array([-1.0, 1.0, 1.0])
        flipped[~self.matched] = 0.0
        return flipped

    def lateral_mm(self, neutral: Floats) -> Floats:
        """(V,) how far left (+) of the middle line of the mesh each vertex of a neutral lies, mm.

        Half the distance in x between a vertex and its partner: 0 on the mesh's middle line even
        where an actor's face is not symmetrical. Vertices without a partner take x - middle_mm.
        """
        check_shape(partner=(self.partner, "V"), neutral=(neutral, "V 3"))
        x = neutral[:, 0]
        lateral: Floats = np.where(self.matched, (x - x[self.partner]) / 2.0, x - self.middle_mm)
        return lateral


def find_mirror(neutral: Floats, tolerance_mm: float = MIRROR_TOLERANCE_MM) -> Mirror:
    """Match each vertex with the one nearest to its mirror image in x.

    The plane starts in the middle of the neutral's box and moves to the median of the matched
    vertices' middles. Two vertices are partners when each is the other's nearest.

    Args:
        neutral: (V, 3) mm, looking along z; a template's own neutral is the surest.
        tolerance_mm: furthest that a vertex may lie from its partner's image.
    """
    check_shape(neutral=(neutral, "V 3"))
    middle = float((neutral[:, 0].min() + neutral[:, 0].max()) / 2.0) if len(neutral) else 0.0
    tree = cKDTree(neutral)
    nearest = np.zeros(len(neutral), dtype=np.int64)
    away = np.zeros(len(neutral))
    for _ in range(_TURNS):
        image = neutral * np.array([-1.0, 1.0, 1.0]) + np.array([2.0 * middle, 0.0, 0.0])
        found = tree.query(image)
        away, nearest = np.asarray(found[0]), np.asarray(found[1], dtype=np.int64)
        near = away <= max(tolerance_mm, float(np.median(away)) if len(away) else 0.0)
        halves = (neutral[:, 0] + neutral[nearest, 0])[near] / 2.0
        moved = float(np.median(halves)) if len(halves) else middle
        if abs(moved - middle) <= 1e-9:
            break
        middle = moved
    mutual = nearest[nearest] == np.arange(len(neutral))
    return Mirror(np.where(mutual & (away <= tolerance_mm), nearest, -1), middle)


def symmetry_report(
    deltas: Floats, names: Sequence[str], mirror: Mirror, template_deltas: Floats | None = None
) -> dict[str, Any]:
    """How far each left shape's mirror image is from its right one, and middle ones from their own.

    Args:
        deltas: (B, V, 3) mm.
        names: B names; sides are read from them.
        mirror: of the topology.
        template_deltas: (B, V, 3) the artist's shapes, to compare with; or None.

    Returns:
        "matched_share" of vertices with a mirror image; "pairs" and "middle" (empty when fewer than
        half the vertices have one): asymmetry as a share of the shapes' root mean square, of the
        rig and of the template (None where it has none).
    """
    check_shape(deltas=(deltas, "B V 3"), names=(np.asarray(names), "B"))
    share = float(mirror.matched.mean()) if len(mirror.partner) else 0.0
    report: dict[str, Any] = {"matched_share": share, "pairs": [], "middle": []}
    if share < _FEW:
        return report
    place = {name: k for k, name in enumerate(names)}
    for k, name in enumerate(names):
        side, other = side_of(name), mirrored_name(name)
        if side == "right" or other not in place:
            continue
        entry: dict[str, Any] = {
            "asymmetry": asymmetry(deltas[k], deltas[place[other]], mirror),
            "template_asymmetry": None
            if template_deltas is None
            else asymmetry(template_deltas[k], template_deltas[place[other]], mirror),
        }
        if side == "left":
            report["pairs"].append({"left": name, "right": other, **entry})
        else:
            report["middle"].append({"shape": name, **entry})
    return report


def asymmetry(left: Floats, right: Floats, mirror: Mirror) -> float | None:
    """Root mean square of (image of left) - right over that of both: 0 mirrored, 2 opposite.

    Taken over the vertices that have a partner; None when neither shape moves any of them.
    """
    matched = mirror.matched
    size = np.sqrt(((left[matched] ** 2).sum() + (right[matched] ** 2).sum()) / 2.0)
    if size <= 1e-9:
        return None
    apart = mirror.reflect(left)[matched] - right[matched]
    return float(np.sqrt((apart**2).sum()) / size)
