"""What `mouthClose` means: a corrective that shuts an open jaw's lips, or jaw and lips in one.

In ARKit and ICT the shape is a corrective: lips shut at jawOpen + mouthClose. Other rigs (NVIDIA's
among them) hold both in one shape: lips shut, jaw open, at mouthClose alone. Read with the wrong
one, lips pass through each other or the jaw opens twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from capture.arrays import Floats, Ints, check_shape
from capture.errors import InputError
from capture.names import known_hint
from rig.face_rig import FaceRig
from rig.naming import find_names
from rig.template import Template

Convention = Literal["corrective", "combined"]

_CHIN = 0.3  # of the jaw's moving vertices, the lowest, that stand for the chin
_FAR = 0.5  # of the jaw's extent: what counts as moving with the jaw
_HALF = 0.5  # of the jaw's motion at the chin: what mouthClose must share to hold it


@dataclass(frozen=True, eq=False)
class Converted:
    """A rig or template in another convention.

    Attributes:
        thing: with the shape changed and, in a rig, the jaw's weights with it.
        clipped_frames: frames whose jaw weight left 0..1 and was clipped: they are not exact.
        worst_clip: by how much at most.
    """

    thing: FaceRig | Template
    clipped_frames: int
    worst_clip: float


def find_mouth_shapes(names: Sequence[str]) -> tuple[int, int] | None:
    """Rows of jawOpen and mouthClose, whatever map of the project names them; or None."""
    places = find_names(names)
    jaw, close = ("jawOpen", "middle"), ("mouthClose", "middle")
    if jaw not in places or close not in places:
        return None
    return places.index(jaw), places.index(close)


def guess_convention(
    neutral: Floats, jaw: Floats, close: Floats, lip_pairs: Ints | None = None
) -> Convention | None:
    """Which convention a rig's mouthClose follows; None when either shape moves nothing.

    With paired lips: is the gap smaller at jawOpen + mouthClose, or at mouthClose alone? Without:
    does mouthClose move the chin as jawOpen does?

    Args:
        neutral: (V, 3) mm.
        jaw: (V, 3) jawOpen, mm.
        close: (V, 3) mouthClose, mm.
        lip_pairs: (n, 2) upper and lower lip vertices; may be empty.
    """
    check_shape(neutral=(neutral, "V 3"), jaw=(jaw, "V 3"), close=(close, "V 3"))
    motion = np.linalg.norm(jaw, axis=1)
    extent = float(motion.max(initial=0.0))
    if min(extent, float(np.abs(close).max(initial=0.0))) <= 1e-3:
        return None
    if lip_pairs is not None and len(lip_pairs):
        together = _gap_mm(neutral + jaw + close, lip_pairs)
        alone = _gap_mm(neutral + close, lip_pairs)
        return "corrective" if together < alone else "combined"
    moving = motion >= _FAR * extent
    chin = moving & (neutral[:, 1] <= np.quantile(neutral[moving, 1], _CHIN))
    shared = float((jaw[chin] * close[chin]).sum() / (jaw[chin] ** 2).sum())
    return "combined" if shared > _HALF else "corrective"


def convert_mouth_close(
    thing: FaceRig | Template, to: Convention, jaw: str = "", close: str = ""
) -> Converted:
    """The same faces with mouthClose in the other convention.

    With J and C of jawOpen and mouthClose, combined C' = C + J, and j J + c C = (j - c) J + c C'.

    Args:
        thing: a rig or template whose mouthClose is in the convention that `to` is not.
        to: "corrective" or "combined".
        jaw: name of jawOpen; found by the maps of the project when empty.
        close: name of mouthClose; likewise.

    Raises:
        InputError: when either shape is not found.
    """
    first, second = _rows(thing.names, jaw, close)
    sign = 1.0 if to == "combined" else -1.0
    deltas = thing.deltas.copy()
    deltas[second] += sign * deltas[first]
    if isinstance(thing, Template):
        return Converted(replace(thing, deltas=deltas), 0, 0.0)
    weights = thing.weights.copy()
    exact = weights[:, first] - sign * weights[:, second]
    weights[:, first] = np.clip(exact, 0.0, 1.0)
    away = np.abs(weights[:, first] - exact)
    return Converted(
        replace(thing, deltas=deltas, weights=weights),
        int((away > 0.0).sum()),
        float(away.max(initial=0.0)),
    )


def _rows(names: Sequence[str], jaw: str, close: str) -> tuple[int, int]:
    found = find_mouth_shapes(names) if not (jaw and close) else None
    if not (jaw and close) and found is None:
        raise InputError(
            "mouthClose: no map of the project knows a jawOpen and a mouthClose among the shapes "
            f"{', '.join(list(names)[:6])}, ...; give their names"
        )
    wanted = (
        jaw or names[found[0] if found else 0],
        close or names[found[1] if found else 0],
    )
    for name in wanted:
        if name not in names:
            raise InputError(f"mouthClose: no shape {name!r}; {known_hint(name, names)}")
    return list(names).index(wanted[0]), list(names).index(wanted[1])


def _gap_mm(vertices: Floats, pairs: Ints) -> float:
    return float(np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1).mean())
