"""Search beyond the edge of a piece of surface: what a parting mouth or a lid hides from the guide.

The reference shows closed lips side by side. Once they have parted, the guided view jumps at
their line from one lip's place in the frame to the other's, and what lies between is in no pixel
of it. A lower lip that comes up by more than its samples' distance from that line would be
searched for everywhere except where it is. Here each piece's motion goes on beyond its edge.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from capture.arrays import Bools, Floats32, check_shape
from track.flow import FlowMatches, correlation_at, descend, padded, template, window_weights
from track.guide import GuidedView, interpolated
from track.reference import ReferenceLevel


def search_beyond(
    level: ReferenceLevel,
    view: GuidedView,
    image: Floats32,
    chosen: Bools,
    reach: tuple[int, int],
) -> FlowMatches:
    """Find samples that have left what the guide shows beside the edge of their piece of surface.

    Beyond that edge the guided view shows another piece: past the lower lip's edge the upper lip,
    wherever that has gone. A parted mouth that closes, or a lid, then hides from the search what
    lies between. Here the piece's own motion goes on beyond its edge, straight into the frame.

    Args:
        level: the reference of the view.
        view: the frame's image, guided into it.
        image: (H, W) the frame's own image at the level.
        chosen: (M,) which samples to search.
        reach: half side of the whole-pixel search, and Gauss-Newton steps after it.

    Returns:
        Matches of all M samples, refined.
    """
    check_shape(chosen=(chosen, "M"), samples=(level.samples, "M"))
    half = level.windows.shape[1] // 2
    displacement, correlation, information = _beyond(
        (level.image, level.gradient), (image, view.image, view.place, view.solid), level.centres,
        level.windows, chosen, reach, window_weights(half),
    )  # fmt: skip
    return FlowMatches(displacement=displacement, correlation=correlation, information=information)


@numba.njit(cache=True, nogil=True)
def _beyond(
    reference: Any,
    frame: Any,
    centres: Any,
    windows: Any,
    chosen: Any,
    reach: Any,
    weights: Any,
) -> tuple[Any, Any, Any]:
    image, guided, place, solid = frame
    radius, iterations = reach
    count, side = len(centres), windows.shape[1]
    found = np.full((count, 2), np.nan)
    score = np.full(count, -1.0)
    information = np.zeros((count, 3))
    width, margin = padded(side), radius + 3
    patch = np.empty((4, side, width), np.float32)
    scratch = np.empty((side + 3, width), np.float32), np.empty((side, width), np.float32)
    around = np.empty((side + 2 * margin + 3, width + 2 * margin + 3, 2))
    shown = np.empty(around.shape[:2], np.float32)
    for n in range(count):
        x0, y0 = centres[n, 0] - side // 2, centres[n, 1] - side // 2
        if not chosen[n]:
            continue
        if not template(reference, solid, windows[n], (x0, y0), (0, 0), weights, patch):
            continue
        slope = own_slope(place, windows[n], centres[n, 0], centres[n, 1])
        if not _extended(place, windows[n], x0 - margin, y0 - margin, margin, slope, around):
            continue
        if not _shown(image, guided, around, (x0 - margin, y0 - margin, margin), windows[n], shown):
            continue
        best, shift = np.float32(-1.0), np.zeros(2)
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                here = correlation_at(patch, shown, margin + dx, margin + dy)
                if here > best:
                    best = here
                    shift[0], shift[1] = dx, dy
        score[n] = descend(
            shown, patch, scratch, (margin, margin), shift, iterations, (found[n], information[n])
        )
        if score[n] <= -1.0:
            found[n] = np.nan
    return found, score, information


@numba.njit(cache=True)
def own_slope(place: Any, window: Any, x: int, y: int) -> tuple[float, float, float, float]:
    """Derivative of the guide at a pixel, from neighbours on its own piece: xx, xy, yx, yy.

    Args:
        place: (H, W, 2) of the guide.
        window: (S, S) of the sample whose pixel this is.
        x: column of the pixel.
        y: its row.

    Returns:
        d place_x / dx, d place_x / dy, d place_y / dx, d place_y / dy; NaN when unknown.
    """
    half = window.shape[0] // 2
    out = np.full(4, np.nan)
    for axis in range(2):
        dx, dy = 1 - axis, axis
        ends = np.zeros((2, 2))
        span = 0
        for end in range(2):
            side = 1 - 2 * end
            u, v = x + side * dx, y + side * dy
            inside = 0 <= u < place.shape[1] and 0 <= v < place.shape[0]
            own = inside and window[half + side * dy, half + side * dx] == 1
            if own and not np.isnan(place[v, u, 0]):
                span += 1
            else:
                u, v = x, y
            ends[end, 0], ends[end, 1] = place[v, u, 0], place[v, u, 1]
        if span > 0:
            out[axis] = (ends[0, 0] - ends[1, 0]) / span
            out[2 + axis] = (ends[0, 1] - ends[1, 1]) / span
    return out[0], out[1], out[2], out[3]


@numba.njit(cache=True)
def _extended(
    place: Any, window: Any, left: int, top: int, margin: int, slope: Any, around: Any
) -> bool:
    """Places in the frame of the pixels around a window: its own, and from them straight on."""
    xx, xy, yx, yy = slope
    if np.isnan(xx) or np.isnan(xy):
        return False
    rows, columns, side = around.shape[0], around.shape[1], window.shape[0]
    around[:] = np.nan
    for j in range(side):
        for i in range(side):
            if window[j, i] == 1:
                around[margin + j, margin + i, 0] = place[top + margin + j, left + margin + i, 0]
                around[margin + j, margin + i, 1] = place[top + margin + j, left + margin + i, 1]
    for sweep in range(2):
        back = 1 if sweep == 0 else -1
        for j in range(rows):
            y = j if sweep == 0 else rows - 1 - j
            for i in range(columns):
                x = i if sweep == 0 else columns - 1 - i
                if not np.isnan(around[y, x, 0]):
                    continue
                if 0 <= x - back < columns and not np.isnan(around[y, x - back, 0]):
                    around[y, x, 0] = around[y, x - back, 0] + back * xx
                    around[y, x, 1] = around[y, x - back, 1] + back * yx
                elif 0 <= y - back < rows and not np.isnan(around[y - back, x, 0]):
                    around[y, x, 0] = around[y - back, x, 0] + back * xy
                    around[y, x, 1] = around[y - back, x, 1] + back * yy
    return not np.isnan(around[0, 0, 0]) and not np.isnan(around[-1, -1, 0])


@numba.njit(cache=True, forceinline=True)
def _shown(image: Any, guided: Any, around: Any, corner: Any, window: Any, shown: Any) -> bool:
    """What the frame shows at those places; False where they leave the image."""
    left, top, margin = corner
    rows, columns = image.shape
    for j in range(around.shape[0]):
        for i in range(around.shape[1]):
            y, x = j - margin, i - margin
            if 0 <= y < window.shape[0] and 0 <= x < window.shape[1] and window[y, x] == 1:
                shown[j, i] = guided[top + j, left + i]
                continue
            u, v = around[j, i, 0], around[j, i, 1]
            if not (1.0 <= u < columns - 2.0 and 1.0 <= v < rows - 2.0):
                return False
            shown[j, i] = interpolated(image, u, v)
    return True
