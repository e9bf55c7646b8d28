"""Flow in the reference's pixels turned into observations of samples in the frame's pixels."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from capture.arrays import Bools, Floats
from track.beyond import own_slope
from track.flow import FlowMatches
from track.guide import GuidedView
from track.lift import Observations
from track.reference import ReferenceLevel

_WINDOW_GAIN = 50.0  # independent pixels of a window, about: turns the windows' shape into px^-2
_NOISE = 0.02  # of two perfect windows, in unit variances: no match is surer than this
_FOLDED = 0.05  # area that a reference pixel keeps in the frame below which it is turned away


def believable(matches: FlowMatches, least: float, longest_px: float) -> Bools:
    """Which matches (M,) correlate by more than `least` and are shorter than `longest_px`."""
    size = np.abs(np.nan_to_num(matches.displacement, nan=np.inf)).max(axis=1)
    believed: Bools = (matches.correlation > least) & (size < longest_px)
    return believed


def observe(
    level: ReferenceLevel,
    view: GuidedView,
    matches: FlowMatches,
    points: Floats,
    believed: Bools,
) -> Observations:
    """Carry a view's matches from the reference into the frame.

    A displacement e in the reference's pixels is the offset A e in the frame's, A being the
    derivative of the guide; its information I becomes A^-T I A^-1, over the noise that the
    correlation shows.

    Args:
        level: the view's reference.
        view: the guide that the matches were measured with.
        matches: of the level's M samples.
        points: (N, 3) all samples on the mesh's estimate, world mm.
        believed: (M,) the matches to use.
    """
    offset, information, good = _carry(
        view.place, level.centres, level.windows, matches.displacement, matches.correlation,
        matches.information, believed,
    )  # fmt: skip
    which = level.samples[good]
    return Observations(
        sample=which,
        offset=offset[good],
        jacobian=level.camera.project_jacobian(points[which]),
        information=information[good],
    )


@numba.njit(cache=True, nogil=True)
def _carry(
    place: Any,
    centres: Any,
    windows: Any,
    displacement: Any,
    correlation: Any,
    information: Any,
    believed: Any,
) -> tuple[Any, Any, Any]:
    count = len(centres)
    offset = np.zeros((count, 2))
    out = np.zeros((count, 3))
    good = np.zeros(count, np.bool_)
    for n in range(count):
        if not believed[n]:
            continue
        ax, bx, ay, by = own_slope(place, windows[n], centres[n, 0], centres[n, 1])
        area = ax * by - bx * ay
        if not abs(area) > _FOLDED:
            continue
        e, f = displacement[n]
        offset[n, 0], offset[n, 1] = ax * e + bx * f, ay * e + by * f
        p, q, r, s = by / area, -bx / area, -ay / area, ax / area  # the inverse of A
        xx, xy, yy = information[n]
        gain = _WINDOW_GAIN / (2.0 * (1.0 - correlation[n]) + _NOISE)
        out[n, 0] = gain * (p * p * xx + 2.0 * p * r * xy + r * r * yy)
        out[n, 1] = gain * (p * q * xx + (p * s + q * r) * xy + r * s * yy)
        out[n, 2] = gain * (q * q * xx + 2.0 * q * s * xy + s * s * yy)
        good[n] = True
    return offset, out, good
