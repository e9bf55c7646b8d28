"""A take solved anew in part: eased into what was there, and filled where nothing is solved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Bools, Floats, Ints, check_shape
from capture.errors import ShapeError
from capture.pose import Pose
from track.rigid import fit_similarity

_GAP_MM = 1.0  # two solutions this far apart leave half the confidence in their middle
_STEEPEST = 3.0  # a tangent over the chord, beyond which a cubic overshoots

_Any = TypeVar("_Any", np.float32, np.float64)


def blend_weights(solved: Bools, ease_frames: int) -> Floats:
    """How much the new solution counts in each frame.

    0 where a frame was not solved anew, so exactly what it was; within a run of frames that were,
    a smoothstep from 0 in the frame before the run to 1 in its frame ease_frames + 1 after that,
    and likewise at its end. An end of the take is no end of a run: there is nothing to ease into.
    A run too short for both keeps a frame of weight 1 in its middle.

    Args:
        solved: (F,) which frames were solved anew; locked ones were not.
        ease_frames: how many frames of a run are eased at each end; 0 cuts.

    Returns:
        (F,) 0..1, with second differences of at most 6 / (ease_frames + 1)^2.

    Raises:
        ShapeError: when ease_frames is below 0.
    """
    check_shape(solved=(solved, "F"))
    if ease_frames < 0:
        raise ShapeError(f"ease_frames: expected 0 or more, found {ease_frames}")
    weights = solved.astype(np.float64)
    for start, stop in _runs(solved):
        inner_start, inner_end = start > 0, stop < len(solved)
        sides = int(inner_start) + int(inner_end)
        if sides == 0:
            continue
        ease = min(ease_frames, (stop - start - 1) // sides)
        away = np.arange(1, stop - start + 1) / (ease + 1)
        if inner_start:
            weights[start:stop] *= _smoothstep(away)
        if inner_end:
            weights[start:stop] *= _smoothstep(away[::-1])
    return weights


def blend(old: NDArray[_Any], new: NDArray[_Any], solved: Bools, ease_frames: int) -> NDArray[_Any]:
    """Ease vertices that were solved anew into those that were not, smoothly in time.

    Args:
        old: (F, V, 3) the performance as it was, mm.
        new: (F, V, 3) the new solution; frames that were not solved anew are not looked at.
        solved: (F,) which were.
        ease_frames: see `blend_weights`.

    Returns:
        (F, V, 3): the old vertices, bit by bit, where the weight is 0, and the new where it is 1.
    """
    check_shape(old=(old, "F V 3"), new=(new, "F V 3"), solved=(solved, "F"))
    weights = blend_weights(solved, ease_frames)
    out = np.where((weights == 1.0)[:, None, None], new, old)
    for frame in np.flatnonzero((weights > 0.0) & (weights < 1.0)):
        share = weights[frame]
        out[frame] = (1.0 - share) * old[frame] + share * new[frame]
    return out


def blend_confidence(
    old: tuple[NDArray[_Any], NDArray[_Any]],
    new: tuple[NDArray[_Any], NDArray[_Any]],
    solved: Bools,
    ease_frames: int,
) -> NDArray[_Any]:
    """The confidence of what `blend` gives.

    The mean of both by their shares w and 1 - w, over 1 + 4 w (1 - w) (gap / 1 mm)^2: a place
    between two solutions that differ is neither's.

    Args:
        old: vertices (F, V, 3), mm, and confidence (F, V).
        new: the same of the new solution.
        solved: (F,) see `blend`.
        ease_frames: see `blend_weights`.

    Returns:
        (F, V) 0..1.
    """
    check_shape(
        vertices=(old[0], "F V 3"), confidence=(old[1], "F V"), new_vertices=(new[0], "F V 3"),
        new_confidence=(new[1], "F V"), solved=(solved, "F"),
    )  # fmt: skip
    weights = blend_weights(solved, ease_frames)
    out = np.where((weights == 1.0)[:, None], new[1], old[1])
    for frame in np.flatnonzero((weights > 0.0) & (weights < 1.0)):
        share = weights[frame]
        gap = np.linalg.norm(new[0][frame].astype(np.float64) - old[0][frame], axis=1) / _GAP_MM
        mean = (1.0 - share) * old[1][frame] + share * new[1][frame]
        out[frame] = mean / (1.0 + 4.0 * share * (1.0 - share) * gap**2)
    return out


def ease_to_held(
    vertices: NDArray[_Any], held: Mapping[int, NDArray[_Any]], reach_frames: int
) -> NDArray[_Any]:
    """Set some frames to given vertices, and ease the frames around into them.

    What a held frame differs by from what stood there is spread to both sides, turned with the
    head, and falls to 0 as a smoothstep over `reach_frames` frames or up to the next held one. A
    frame that is to keep what it has is held to that.

    Args:
        vertices: (F, V, 3) mm.
        held: by place in F, the vertices (V, 3) of that frame.
        reach_frames: frames on each side that are moved at all; 0: none but the held ones.

    Returns:
        (F, V, 3): the held frames, and those out of reach of any, bit by bit.

    Raises:
        ShapeError: when reach_frames is below 0.
        SolveError: when the vertices of a frame lie on one line.
    """
    check_shape(vertices=(vertices, "F V 3"))
    if reach_frames < 0:
        raise ShapeError(f"reach_frames: expected 0 or more, found {reach_frames}")
    out, places = vertices.copy(), sorted(held)
    added: dict[int, Floats] = {}
    for index, place in enumerate(places):
        away = held[place].astype(np.float64) - vertices[place]
        low = places[index - 1] if index > 0 else -len(vertices)
        high = places[index + 1] if index + 1 < len(places) else 2 * len(vertices)
        spans = {-1: min(place - low, reach_frames + 1), 1: min(high - place, reach_frames + 1)}
        first, last = place - spans[-1] + 1, place + spans[1] - 1
        for frame in range(max(first, 0), min(last, len(vertices) - 1) + 1):
            if frame == place or not away.any():
                continue
            side = spans[1 if frame > place else -1]
            share = 1.0 - float(_smoothstep(np.array(abs(frame - place) / side)))
            turn = fit_similarity(
                vertices[place].astype(np.float64), vertices[frame].astype(np.float64)
            ).rotation
            added[frame] = added.get(frame, np.zeros_like(away)) + share * (away @ turn.T)
    for frame, shift in added.items():
        out[frame] = vertices[frame] + shift
    for place, target in held.items():
        out[place] = target
    return out


def interpolate(vertices: NDArray[_Any], known: Bools, frames: Ints) -> NDArray[_Any]:
    """Fill frames that were not solved from their neighbours that were, smoothly in time.

    The head's rigid motion and what the face does in its own space are interpolated apart, by
    cubics whose ends go on as their neighbours move, held back where they would overshoot; so a
    turning head does not shrink. Before the first known frame and after the last, that one stays.

    Args:
        vertices: (F, V, 3) mm.
        known: (F,) which frames hold; the others are not looked at.
        frames: (F,) their numbers, ascending.

    Returns:
        (F, V, 3), the known frames bit by bit.

    Raises:
        ShapeError: when no frame is known.
        SolveError: when the vertices lie on one line.

    References:
        Fritsch and Carlson 1980, "Monotone piecewise cubic interpolation", for the bound.
    """
    check_shape(vertices=(vertices, "F V 3"), known=(known, "F"), frames=(frames, "F"))
    if not known.any():
        raise ShapeError("known: expected at least one frame to interpolate from")
    out = vertices.copy()
    held = np.flatnonzero(known)
    for start, stop in _runs(np.logical_not(known)):
        before, after = held[held < start][-2:], held[held >= stop][:2]
        if len(before) == 0 or len(after) == 0:
            out[start:stop] = vertices[before[-1] if len(before) else after[0]]
            continue
        around = np.concatenate([before, after])
        keys, origin = _in_head_space(vertices[around].astype(np.float64), len(before) - 1)
        curve = _Cubic(frames[around].astype(np.float64), keys, len(before) - 1)
        for index in range(start, stop):
            out[index] = _in_world(curve.at(float(frames[index])), origin)
    return out


class _Cubic:
    """A cubic between keys `left` and left + 1 of K keys (K, N, 3), by Hermite's form."""

    def __init__(self, times: Floats, keys: Floats, left: int) -> None:
        self._start, self._span = times[left], times[left + 1] - times[left]
        self._ends = keys[left], keys[left + 1]
        slopes = np.diff(keys, axis=0) / np.diff(times)[:, None, None]
        chord = slopes[left]
        go = _tangent(times, slopes, left) if left > 0 else chord
        come = _tangent(times, slopes, left + 1) if left + 2 < len(times) else chord
        self._tangents = _bounded(go, chord), _bounded(come, chord)

    def at(self, time: float) -> Floats:
        """The interpolated key (N, 3)."""
        s = (time - self._start) / self._span
        first, last = self._ends
        go, come = self._tangents
        rise = s * s * (3.0 - 2.0 * s)
        found: Floats = (
            (1.0 - rise) * first
            + rise * last
            + self._span * (s * (1.0 - s) ** 2 * go - s * s * (1.0 - s) * come)
        )
        return found


def _tangent(times: Floats, slopes: Floats, key: int) -> Floats:
    """The slope at a key of the parabola through it and both its neighbours."""
    one, two = times[key] - times[key - 1], times[key + 1] - times[key]
    parabola: Floats = (two * slopes[key - 1] + one * slopes[key]) / (one + two)
    return parabola


def _bounded(tangent: Floats, chord: Floats) -> Floats:
    size = np.linalg.norm(tangent, axis=1, keepdims=True)
    most = _STEEPEST * np.linalg.norm(chord, axis=1, keepdims=True)
    held: Floats = tangent * np.minimum(1.0, most / np.maximum(size, 1e-300))
    return held


def _in_head_space(meshes: Floats, home: int) -> tuple[Floats, Floats]:
    """Keys (K, 2 + V, 3): rotation vector, translation and vertices in the space of mesh `home`.

    The rotation is about the middle (3,) of that mesh, which is returned too.
    """
    origin = meshes[home].mean(axis=0)
    keys = []
    for mesh in meshes:
        motion = fit_similarity(meshes[home] - origin, mesh - origin)
        pose = Pose(motion.rotation, motion.translation)
        still = pose.inverse().apply(mesh - origin)
        keys.append(np.concatenate([[pose.rotation_vector(), pose.translation], still]))
    return np.stack(keys), origin


def _in_world(key: Floats, origin: Floats) -> Floats:
    moved: Floats = Pose.from_rotation_vector(key[0], key[1]).apply(key[2:]) + origin
    return moved


def _smoothstep(value: Floats) -> Floats:
    inside = np.clip(value, 0.0, 1.0)
    eased: Floats = inside * inside * (3.0 - 2.0 * inside)
    return eased


def _runs(chosen: Bools) -> list[tuple[int, int]]:
    """Runs of True: start, and stop after the last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
