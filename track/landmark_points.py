"""Landmarks of several views met in space: most detections of some views may be grossly wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from capture.arrays import Floats, Ints, check_shape
from capture.camera import CameraArray
from track.face_landmarks import LANDMARKS, Detection

_ROUNDS = 10
_LEAST_SINE = float(np.sin(np.radians(4.0)))  # rays nearer to parallel meet anywhere
_PAIRS = 400  # at most so many pairs of views are tried, spread over all of them


@dataclass(frozen=True, eq=False, kw_only=True)
class LandmarkPoints:
    """The 68 landmarks in space, from the views of one frame.

    Attributes:
        positions: (68, 3) world mm; NaN where no two views agree.
        views: (68,) how many views agree.
        miss_mm: (68,) rms distance of their rays from the position; NaN likewise.
    """

    positions: Floats
    views: Ints
    miss_mm: Floats


def meet_landmarks(
    cameras: CameraArray, detections: Mapping[str, Detection], *, scale_mm: float = 4.0
) -> LandmarkPoints:
    """Triangulate each landmark from the views that agree on it.

    The points where two views' rays come nearest are hypotheses; the one that costs least over
    all views, by Geman and McClure's function of the rays' distances, is refined by reweighting.
    A view that is off by much more than `scale_mm` has no say, so that half the views may be wrong.

    Args:
        cameras: the array's.
        detections: by camera; views that found no face are left out.
        scale_mm: the distance at which a ray has lost three quarters of its weight.

    References:
        Fischler and Bolles 1981; Geman and McClure 1987.
    """
    names = [name for name in cameras.names if name in detections]
    positions = np.full((LANDMARKS, 3), np.nan)
    views = np.zeros(LANDMARKS, dtype=np.int64)
    miss = np.full(LANDMARKS, np.nan)
    if len(names) < 2:
        return LandmarkPoints(positions=positions, views=views, miss_mm=miss)
    eyes = np.array([cameras.by_name(name).centre for name in names])
    rays = np.stack([cameras.by_name(name).rays(detections[name].pixels) for name in names])
    for index in range(LANDMARKS):
        seen = np.isfinite(rays[:, index]).all(axis=1)
        found = meet_rays(eyes[seen], rays[seen, index], scale_mm)
        positions[index], views[index], miss[index] = found
    return LandmarkPoints(positions=positions, views=views, miss_mm=miss)


def meet_rays(eyes: Floats, rays: Floats, scale_mm: float) -> tuple[Floats, int, float]:
    """The point that most rays come near to, how many do, and their rms distance from it, mm.

    Args:
        eyes: (C, 3) origins, world mm.
        rays: (C, 3) unit directions.
        scale_mm: see `meet_landmarks`.

    Returns:
        Position (3,), NaN when fewer than two rays agree; then 0 and NaN follow.
    """
    check_shape(eyes=(eyes, "C 3"), rays=(rays, "C 3"))
    nothing = (np.full(3, np.nan), 0, float("nan"))
    starts = _pairwise(eyes, rays)
    if len(starts) == 0:
        return nothing
    square = _distances(starts, eyes, rays) ** 2
    point = starts[int(np.argmin((square / (square + scale_mm**2)).sum(axis=1)))]
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    for _ in range(_ROUNDS):
        weight = 1.0 / (1.0 + (_distances(point[None], eyes, rays)[0] / scale_mm) ** 2) ** 2
        system = np.einsum("c,cxy->xy", weight, across)
        if np.linalg.cond(system) > 1e6:
            return nothing
        point = np.linalg.solve(system, np.einsum("c,cxy,cy->x", weight, across, eyes))
    distance = _distances(point[None], eyes, rays)[0]
    agree = distance < scale_mm
    if agree.sum() < 2:
        return nothing
    return point, int(agree.sum()), float(np.sqrt((distance[agree] ** 2).mean()))


def _pairwise(eyes: Floats, rays: Floats) -> Floats:
    """Where the rays of two views come nearest to each other, (N, 3), before both cameras."""
    pairs = np.array(list(combinations(range(len(eyes)), 2)), dtype=np.int64).reshape(-1, 2)
    if len(pairs) > _PAIRS:
        pairs = pairs[np.linspace(0, len(pairs) - 1, _PAIRS).astype(np.int64)]
    (one, two), (first, second) = rays[pairs.T], eyes[pairs.T]
    cosine = np.einsum("nx,nx->n", one, two)
    sine2 = 1.0 - cosine**2
    wide = sine2 > _LEAST_SINE**2
    between = second - first
    between = second - first
    a, b = np.einsum("nx,nx->n", between, one), np.einsum("nx,nx->n", between, two)
    safe = np.where(wide, sine2, 1.0)
    along, back = (a - cosine * b) / safe, (cosine * a - b) / safe
    good = wide & (along > 0.0) & (back > 0.0)
    middle = 0.5 * (first + along[:, None] * one + second + back[:, None] * two)
    return np.asarray(middle[good])


def _distances(points: Floats, eyes: Floats, rays: Floats) -> Floats:
    """Distance (N, C) of points (N, 3) from rays; behind a camera it is that from the camera."""
    away = points[:, None] - eyes
    along = np.maximum(np.einsum("ncx,cx->nc", away, rays), 0.0)
    distance: Floats = np.linalg.norm(away - along[..., None] * rays, axis=2)
    return distance
