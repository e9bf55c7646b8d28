"""A chain of vertices drawn as a line in one view: each vertex is pulled across the line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from capture.arrays import Bools, Floats, Ints, check_shape
from capture.camera import Camera
from track.lift import Lifted
from track.sightings import Sightings

_STEP_PX = 0.5  # between the points that the line is cut into
_MOST_STEPS = 4000
_TANGENT_PX = 2.0  # the line's direction is taken over this length to both sides
_BEYOND_PX = 1.0  # a vertex farther than this past an end of the line is left alone


@dataclass(frozen=True, eq=False, kw_only=True)
class CurveSightings(Sightings):
    """Sightings of a chain by one camera, whose pixels are found anew for each estimate.

    Where along the line a vertex belongs is not said by the line. Each estimate is therefore laid
    along it in order, as near as it goes, and every vertex sees its foot across the line: rank-one
    information. What reaches past the ends of the line is not seen.

    Attributes:
        line: (M, 2) corners of the drawn line, px of the full image.
        sigma_px: how well it was drawn, across.
    """

    line: Floats
    sigma_px: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_shape(line=(self.line, "M 2"))

    def lifted(self, vertices: Floats, cameras: Mapping[str, Camera]) -> Lifted:
        """Triangulate the chain's points at their feet on the line; see `Sightings.lifted`."""
        name = self.cameras[0]
        if name not in cameras:
            return super().lifted(vertices, {})
        pixel, information = feet(
            cameras[name].project(self.surface.points(vertices)), self.line, self.sigma_px
        )
        placed = Sightings(
            surface=self.surface, cameras=self.cameras, point=self.point, view=self.view,
            pixel=pixel[self.point], information=information[self.point], scale_px=self.scale_px,
            accuracy_px=self.accuracy_px, weight=self.weight,
        )  # fmt: skip
        return _without_unseen(placed).lifted(vertices, cameras)


def feet(chain: Floats, line: Floats, sigma_px: float) -> tuple[Floats, Floats]:
    """Lay a chain along a line, in order, and find the foot of each point across the line.

    Args:
        chain: (L, 2) px, in order; NaN where a point is not in front of the camera.
        line: (M, 2) corners of the line, px; drawn in either direction, closed where its last
            corner is its first.
        sigma_px: standard deviation across the line.

    Returns:
        (L, 2) feet, px, and (L, 3) xx, xy, yy of their information, px^-2, none along the line;
        zero information for points beyond an end, which have themselves for a foot.
    """
    check_shape(chain=(chain, "L 2"), line=(line, "M 2"))
    there = np.isfinite(chain).all(axis=1)
    pixel, information = chain.copy(), np.zeros((len(chain), 3))
    if not there.any():
        return pixel, information
    closed = bool((line[0] == line[-1]).all()) and len(line) > 2
    points = _even(line)
    if closed:
        start = int(((points - chain[there][0]) ** 2).sum(axis=1).argmin())
        points = np.roll(points[:-1], -start, axis=0)
        points = np.concatenate([points, points[:1]])
    places, cost = _in_order(chain[there], points)
    turned, turned_cost = _in_order(chain[there], points[::-1])
    if turned_cost < cost:
        places = len(points) - 1 - turned
    tangent = _tangents(points, closed)[places]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    away = points[places] - chain[there]
    across = np.einsum("lx,lx->l", away, normal)
    along = np.einsum("lx,lx->l", away, tangent)
    past = _beyond(places, along, len(points)) & (not closed)
    pixel[there] += np.where(past, 0.0, across)[:, None] * normal
    outer = normal[:, [0, 0, 1]] * normal[:, [0, 1, 1]] / sigma_px**2
    information[there] = np.where(past[:, None], 0.0, outer)
    return pixel, information


def _beyond(places: Ints, along: Floats, count: int) -> Bools:
    """Which points (L,) lie past an end of the line, `along` being from them to their place."""
    before = (places == 0) & (along > _BEYOND_PX)
    after = (places == count - 1) & (along < -_BEYOND_PX)
    beyond: Bools = before | after
    return beyond


def _even(line: Floats) -> Floats:
    """The line (M, 2) cut into even steps, ends included."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    count = int(np.clip(np.ceil(length[-1] / _STEP_PX), 1, _MOST_STEPS))
    at = np.linspace(0.0, length[-1], count + 1)
    return np.stack([np.interp(at, length, line[:, k]) for k in (0, 1)], axis=1)


def _tangents(points: Floats, closed: bool) -> Floats:
    """Unit directions (S, 2) of an evenly cut line."""
    step = float(np.linalg.norm(np.diff(points, axis=0), axis=1).mean())
    reach = min(max(1, round(_TANGENT_PX / max(step, 1e-9))), len(points) - 1)
    index = np.arange(len(points))
    if closed:
        ring = len(points) - 1
        way = points[(index + reach) % ring] - points[(index - reach) % ring]
    else:
        way = (
            points[np.minimum(index + reach, len(points) - 1)]
            - points[np.maximum(index - reach, 0)]
        )
    size = np.linalg.norm(way, axis=1, keepdims=True)
    unit: Floats = way / np.where(size > 0.0, size, 1.0)
    return unit


def _in_order(chain: Floats, points: Floats) -> tuple[Ints, float]:
    """The places (L,) among points (S, 2), never falling, of least summed squared distance.

    References:
        Sakoe and Chiba 1978, dynamic time warping; here a point of the line may be passed over.
    """
    square = ((chain[:, None] - points[None]) ** 2).sum(axis=2)
    back = np.zeros(square.shape, dtype=np.int64)
    total = square[0]
    index = np.arange(len(points))
    for row in range(1, len(chain)):
        least = np.minimum.accumulate(total)
        back[row] = np.maximum.accumulate(np.where(total <= least, index, 0))
        total = square[row] + least
    place = int(total.argmin())
    cost = float(total[place])
    places = np.empty(len(chain), dtype=np.int64)
    for row in range(len(chain) - 1, -1, -1):
        places[row] = place
        place = int(back[row, place])
    return places, cost


def _without_unseen(sightings: Sightings) -> Sightings:
    """Only the sightings that say something: a point without any is not lifted."""
    kept = np.flatnonzero(sightings.information.any(axis=1))
    return replace(
        sightings,
        point=sightings.point[kept], view=sightings.view[kept],
        pixel=sightings.pixel[kept], information=sightings.information[kept],
    )  # fmt: skip
