"""Keypoints matched inside a region around where the motion field puts them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from scipy.spatial import cKDTree

from capture.arrays import Bools, Floats, Ints, check_shape
from track.features_detect import Keypoints

_SAME = 0.5  # candidates nearer to the best than this share of its size are the best once more
STRETCH = 0.3  # share of their distance by which the motions of neighbours may differ


@dataclass(frozen=True, kw_only=True)
class MatchGates:
    """What a match must pass.

    Attributes:
        distance: largest distance of the descriptors, 0..sqrt 2.
        ratio: largest share of the distance to the second best in the region.
        octaves: largest difference of scale from that of the motion field, octaves.
        turn: largest difference of direction from that of the motion field, radians.
    """

    distance: float
    ratio: float
    octaves: float
    turn: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Expected:
    """Where M keypoints of the reference are looked for.

    Attributes:
        pixel: (M, 2) px of the frame; NaN: nowhere.
        radius: (M,) of the region, px.
        size: (M,) diameter, px of the frame.
        angle: (M,) radians.
    """

    pixel: Floats
    radius: Floats
    size: Floats
    angle: Floats

    def __post_init__(self) -> None:
        check_shape(
            pixel=(self.pixel, "M 2"),
            radius=(self.radius, "M"),
            size=(self.size, "M"),
            angle=(self.angle, "M"),
        )


def match_keypoints(
    reference: Keypoints, expected: Expected, frame: Keypoints, gates: MatchGates
) -> Ints:
    """Match keypoints inside regions: nearest descriptor, best against second, mutual.

    Args:
        reference: M keypoints.
        expected: where each is looked for in the frame.
        frame: K keypoints.
        gates: what a match must pass.

    Returns:
        (M,) index of the frame's keypoint; -1 where there is no match.

    References:
        Lowe 2004, section 7.1, here among the candidates of the region; Ma et al. 2016, 2.1.
    """
    if len(reference) == 0 or len(frame) == 0:
        return np.full(len(reference), -1, np.int64)
    radius = np.where(np.isfinite(expected.pixel).all(axis=1), expected.radius, 0.0)
    cell = max(4.0, float(radius.max()))
    low = frame.pixel.min(axis=0)
    place = ((frame.pixel - low) / cell).astype(np.int64)
    columns, rows = place.max(axis=0) + 1
    order = np.argsort(place[:, 1] * columns + place[:, 0], kind="stable")
    starts = np.searchsorted(
        (place[:, 1] * columns + place[:, 0])[order], np.arange(rows * columns + 1)
    )
    found: Ints = _match(
        reference.descriptor, expected.pixel, radius, np.log2(expected.size), expected.angle,
        frame.descriptor, frame.pixel, np.log2(frame.size), frame.angle,
        order, starts, (low[0], low[1], cell), (columns, rows),
        (gates.distance, gates.ratio, gates.octaves, gates.turn),
    )  # fmt: skip
    return found


def agreeing(places: Floats, motion: Floats, slack: float, votes: tuple[int, int]) -> Bools:
    """Which matches move as some of their neighbours do.

    Not as most of them: where a mouth opens, half of a match's neighbours go another way. Chance
    alone makes two wrong matches agree about as often as their tolerance fits into the region.

    Args:
        places: (N, D) where the matches are in the reference.
        motion: (N, D) from where each was expected to where it was found.
        slack: by how much the motions of neighbours may differ, beside a share of their distance.
        votes: how many of the nearest matches are asked, and how many of them must agree.

    Returns:
        (N,) bool; none when there are too few matches to ask.
    """
    asked, least = votes
    if len(places) <= least:
        return np.zeros(len(places), np.bool_)
    away, near = cKDTree(places).query(places, k=min(asked + 1, len(places)))
    differs = np.linalg.norm(motion[near] - motion[:, None], axis=2)
    same = differs < slack + STRETCH * away
    voted: Bools = same.sum(axis=1) - 1 >= least  # it agrees with itself
    return voted


def gathered(
    group: Ints, motion: Floats, precision: Floats, slack_px: float
) -> tuple[Ints, Floats, Floats]:
    """Make one match of all that lie on one patch of skin in one view.

    It is the mean, by precision, of those that move about as the match does with which most agree.

    Args:
        group: (N,) the patch of each match.
        motion: (N, 2) px.
        precision: (N,) px^-2.
        slack_px: largest difference of motion inside a patch.

    Returns:
        The G patches, ascending, their motions (G, 2) and precisions (G,).
    """
    order = np.argsort(group, kind="stable")
    patches, starts = np.unique(group[order], return_index=True)
    ends = np.append(starts, len(group)).astype(np.int64)
    mean, total = _gather(ends, motion[order], precision[order], slack_px)
    return patches, mean, total


@numba.njit(cache=True, nogil=True)
def _gather(ends: Any, motion: Any, precision: Any, slack: float) -> tuple[Any, Any]:
    mean = np.zeros((len(ends) - 1, 2))
    total = np.zeros(len(ends) - 1)
    for g in range(len(ends) - 1):
        most = 0.0
        for a in range(ends[g], ends[g + 1]):
            x, y, weight = 0.0, 0.0, 0.0
            for b in range(ends[g], ends[g + 1]):
                u, v = motion[b, 0] - motion[a, 0], motion[b, 1] - motion[a, 1]
                if u * u + v * v <= slack * slack:
                    x += precision[b] * motion[b, 0]
                    y += precision[b] * motion[b, 1]
                    weight += precision[b]
            if weight > most:
                most = weight
                mean[g, 0], mean[g, 1] = x / weight, y / weight
        total[g] = most
    return mean, total


@numba.njit(cache=True, nogil=True)
def _match(
    reference: Any,
    expected: Any,
    radius: Any,
    octave: Any,
    angle: Any,
    descriptor: Any,
    pixel: Any,
    octaves: Any,
    angles: Any,
    order: Any,
    starts: Any,
    grid: Any,
    cells: Any,
    gates: Any,
) -> Any:
    count = len(reference)
    best = np.full(count, -1, np.int64)
    back = np.full(len(pixel), -1, np.int64)
    nearest = np.full(len(pixel), np.float32(np.inf))
    held = np.empty(len(pixel), np.int64)
    apart = np.empty(len(pixel), np.float32)
    for m in range(count):
        if radius[m] <= 0.0:
            continue
        number = _candidates(
            expected[m], radius[m], octave[m], angle[m],
            pixel, octaves, angles, order, starts, grid, cells, gates, held,
        )  # fmt: skip
        if number == 0:
            continue
        first = 0
        for n in range(number):
            j = held[n]
            apart[n] = _distance(reference[m], descriptor[j])
            if apart[n] < nearest[j]:
                nearest[j], back[j] = apart[n], m
            if apart[n] < apart[first]:
                first = n
        best[m] = held[first]
        limit = gates[0] * gates[0]
        reach = (_SAME * 2.0 ** octaves[held[first]]) ** 2
        for n in range(number):
            dx = pixel[held[n], 0] - pixel[held[first], 0]
            dy = pixel[held[n], 1] - pixel[held[first], 1]
            if dx * dx + dy * dy > reach:
                limit = min(limit, gates[1] * gates[1] * apart[n])
        if apart[first] > limit:
            best[m] = -1
    for m in range(count):
        if best[m] >= 0 and back[best[m]] != m:
            best[m] = -1
    return best


@numba.njit(cache=True, nogil=True)
def _candidates(
    centre: Any,
    radius: float,
    octave: float,
    angle: float,
    pixel: Any,
    octaves: Any,
    angles: Any,
    order: Any,
    starts: Any,
    grid: Any,
    cells: Any,
    gates: Any,
    held: Any,
) -> int:
    """Write the keypoints that are in the region, of fitting scale and direction, into `held`."""
    column = int(np.floor((centre[0] - grid[0]) / grid[2]))
    row = int(np.floor((centre[1] - grid[1]) / grid[2]))
    number = 0
    for r in range(max(0, row - 1), min(cells[1], row + 2)):
        for c in range(max(0, column - 1), min(cells[0], column + 2)):
            for place in range(starts[r * cells[0] + c], starts[r * cells[0] + c + 1]):
                j = order[place]
                dx, dy = pixel[j, 0] - centre[0], pixel[j, 1] - centre[1]
                if dx * dx + dy * dy > radius * radius or abs(octaves[j] - octave) > gates[2]:
                    continue
                turn = abs(angles[j] - angle) % (2.0 * np.pi)
                if min(turn, 2.0 * np.pi - turn) <= gates[3]:
                    held[number] = j
                    number += 1
    return number


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"}, forceinline=True)
def _distance(one: Any, two: Any) -> Any:
    """Squared Euclidean distance of two descriptors."""
    total = np.float32(0.0)
    for k in range(128):
        step = one[k] - two[k]
        total += step * step
    return total
