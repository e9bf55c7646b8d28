"""Matches followed back: a match that does not lead home again is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from capture.arrays import Bools, Floats
from track.flow import FlowMatches, refine_flow, search_flow
from track.guide import GuidedView
from track.reference import ReferenceLevel

_AROUND_PX = 2  # beyond the longest match, how far a window is searched for on its way back


def return_miss(
    level: ReferenceLevel, view: GuidedView, matches: FlowMatches, wanted: Bools, iterations: int
) -> Floats:
    """Match the frame's windows back to the reference: how far each misses where it came from.

    The guided view and the reference change places; a window of the first, about the place that
    was found, is searched for and refined in the second. Where the flow is even over a window both
    displacements cancel. A window that correlates well where it came from is not searched for.

    Args:
        level: the reference of the view.
        view: the frame's image, guided into it.
        matches: of the level's M samples, forwards.
        wanted: (M,) which to follow back.
        iterations: Gauss-Newton steps.

    Returns:
        (M,) px; inf where there is no way back, NaN where it was not wanted.
    """
    rows, columns = np.gradient(view.image)
    whole = np.rint(np.nan_to_num(matches.displacement)).astype(np.int32)
    turned = replace(
        level,
        image=view.image,
        gradient=np.stack([columns, rows]).astype(np.float32),
        centres=level.centres + whole,
    )
    back = GuidedView(image=level.image, place=view.place, solid=view.solid)
    start = search_flow(turned, back, wanted, int(np.abs(whole).max(initial=0)) + _AROUND_PX)
    found = refine_flow(turned, back, start.displacement, iterations).displacement
    miss = np.linalg.norm(matches.displacement + found, axis=1)
    miss = np.where(np.isfinite(miss), miss, np.inf)
    miss[~wanted] = np.nan
    return miss
