"""Vertices with a meaning: dlib's 68 landmarks, and the skin that expressions hardly move."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats, Ints
from tools.actor.identity import Identity
from tools.actor.lattice import Lattice, Slit
from tools.actor.sculpt import Sculpture, lip_heights, stomion_level

_JAW_LEFT: list[tuple[float, float, float | None]] = [
    (74.0, 17.5, -4.0),
    (71.5, -3.5, 2.0),
    (68.5, -24.0, 6.0),
    (64.0, -44.0, 9.0),
    (57.5, -63.5, 16.0),
    (48.0, -81.0, 30.0),
    (34.5, -94.0, 49.0),
    (18.0, -101.0, 69.0),
]


def find_landmarks(lattice: Lattice, sculpture: Sculpture, who: Identity) -> Ints:
    """Vertex ids (68,) of dlib's landmarks, in its order: from the actor's right to the left.

    Args:
        lattice: the topology.
        sculpture: the neutral.
        who: the proportions.
    """
    places = _jaw() + _brows(who) + _nose(who)
    ids = [_nearest(lattice, sculpture.vertices, place) for place in places]
    for eye in lattice.eyes:
        ids += _eye(sculpture.vertices, eye)
    return np.array(ids + _mouth(lattice, sculpture, who), np.int64)


def rigid_vertices(lattice: Lattice, vertices: Floats, deltas: Floats) -> Ints:
    """Ids (n,) of the skin on bone: forehead, temples, bridge of the nose, crown.

    Args:
        lattice: the topology.
        vertices: (V, 3) the neutral.
        deltas: (B, V, 3) shapes; a vertex that one of them moves by 0.5 mm is left out.
    """
    x, y, z = vertices.T
    forehead = (y > 46) & (z > 20)
    temples = (np.abs(x) > 56) & (y > 18) & (z > -10)
    bridge = (np.abs(x) < 4.5) & (y > 0) & (y < 14) & (z > 60)
    crown = (y > 30) & (z <= 20)
    still = np.sqrt((deltas**2).sum(axis=2).max(axis=0)) < 0.5
    on_bone = (lattice.ring == 0) & (forehead | temples | bridge | crown)
    return np.flatnonzero(on_bone & still).astype(np.int64)


def _nearest(lattice: Lattice, vertices: Floats, place: tuple[float, float, float | None]) -> int:
    """The outer vertex nearest to a place; without a depth, nearest in the frontal plane."""
    x, y, z = place
    away = np.hypot(vertices[:, 0] - x, vertices[:, 1] - y)
    if z is not None:
        away = np.hypot(away, vertices[:, 2] - z)
    away[(lattice.ring > 0) | (vertices[:, 2] < -30)] = np.inf
    return int(np.argmin(away))


def _jaw() -> list[tuple[float, float, float | None]]:
    right = [(-x, y, z) for x, y, z in _JAW_LEFT]
    return [*right, (0.0, -102.5, 83.0), *_JAW_LEFT[::-1]]


def _brows(who: Identity) -> list[tuple[float, float, float | None]]:
    lift = who.brow_height
    left = [(11.0, 23.0), (21.0, 27.5), (32.0, 30.5), (43.0, 30.0), (55.0, 23.0)]
    outer_first = [(-x, y + lift, None) for x, y in left[::-1]]
    return [*outer_first, *[(x, y + lift, None) for x, y in left]]


def _nose(who: Identity) -> list[tuple[float, float, float | None]]:
    drop = who.nose_length
    bridge = [(0.0, 13.0, None), (0.0, 0.0, None), (0.0, -13.0, None), (0.0, -25.0 - drop, None)]
    base = [(x, y - 0.6 * drop, None) for x, y in
            ((-13.0, -33.0), (-6.5, -35.5), (0.0, -37.0), (6.5, -35.5), (13.0, -33.0))]  # fmt: skip
    return [*bridge, *base]


def _eye(vertices: Floats, eye: Slit) -> list[int]:
    """Six ids in dlib's order: image-left corner, two above, image-right corner, two below."""
    first, last = vertices[eye.corners, 0]

    def at(edge: Ints, share: float) -> int:
        return int(edge[np.argmin(np.abs(vertices[edge, 0] - first - share * (last - first)))])

    above = [at(eye.upper, 0.32), at(eye.upper, 0.68)]
    below = [at(eye.lower, 0.68), at(eye.lower, 0.32)]
    return [int(eye.corners[0]), *above, int(eye.corners[1]), *below]


def _mouth(lattice: Lattice, sculpture: Sculpture, who: Identity) -> list[int]:
    vertices, slit = sculpture.vertices, lattice.mouth
    half, level = who.mouth_half_width, stomion_level(who)
    across = [-0.62, -0.24, 0.0, 0.24, 0.62]
    upper, lower = lip_heights(np.array(across) * half, who)
    ids = [int(slit.corners[0])]
    above = [(s * half, level + h, None) for s, h in zip(across, upper, strict=True)]
    below = [(s * half, level - h, None) for s, h in zip(across[::-1], lower[::-1], strict=True)]
    ids += [_nearest(lattice, vertices, place) for place in above]
    ids.append(int(slit.corners[1]))
    ids += [_nearest(lattice, vertices, place) for place in below]
    inner_x = np.array([-0.3, 0.0, 0.3]) * half

    def on(edge: Ints, x: float) -> int:
        return int(edge[np.argmin(np.abs(vertices[edge, 0] - x))])

    ids.append(on(slit.upper, -0.88 * half))
    ids += [on(slit.upper, x) for x in inner_x]
    ids.append(on(slit.upper, 0.88 * half))
    ids += [on(slit.lower, x) for x in inner_x[::-1]]
    return ids
