"""Marks of vertices: skin that was measured, skin that the prior carried, and what is inside."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Bools, Floats, Floats32, Ints32, check_shape
from track.visibility import count_views

_AGREED = 2  # views that measure skin


class Mark(IntEnum):
    """What a vertex's place rests on."""

    SEEN = 0
    """Two views or more agreed on it."""
    CARRIED = 1
    """Skin that fewer than two views agreed on: it follows its surroundings."""
    INNER = 2
    """Mouth bag, sockets, behind lids and lips: the neutral hides it from every camera."""


def inner_vertices(neutral: Floats, triangles: Ints32, eyes: Floats) -> Bools:
    """Which vertices (V,) the neutral hides from all cameras; unused ones are inner too.

    Args:
        neutral: (V, 3) world mm.
        triangles: (T, 3), counter-clockwise from outside.
        eyes: (C, 3) the cameras' centres, world mm.
    """
    return np.asarray(count_views(neutral, triangles, eyes) == 0)


def vertex_marks(views: Floats32 | Floats, inner: Bools) -> NDArray[np.int8]:
    """Mark the vertices of a frame.

    An inner vertex that two views agree on all the same, such as the inside of a lip that a smile
    turns out, counts as seen.

    Args:
        views: (V,) how many views agreed on each vertex in the frame; 0 where none.
        inner: (V,) see `inner_vertices`.

    Returns:
        (V,) int8 values of `Mark`.
    """
    check_shape(views=(views, "V"), inner=(inner, "V"))
    hidden = np.where(inner, np.int8(Mark.INNER), np.int8(Mark.CARRIED))
    return np.where(views >= _AGREED, np.int8(Mark.SEEN), hidden).astype(np.int8)
