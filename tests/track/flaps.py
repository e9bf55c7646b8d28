"""Analytic lips and lids: surfaces that face each other, with a known gap."""

import numpy as np

from capture.arrays import Floats, Ints32

HALF_LENGTH_MM = 20.0
GAP_MM = 0.3
ROLL_MM = 5.0  # radius of a lip's roll in its middle


def grid_triangles(rows: int, columns: int, first: int = 0) -> Ints32:
    index = first + np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
    c, d = index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)


def lips(gap_mm: float) -> tuple[Floats, Ints32, np.ndarray]:
    """Two rolls along x whose middles are gap_mm apart in y; and which vertices are the upper's."""
    along, around = np.linspace(-1.0, 1.0, 41), np.radians(np.linspace(-110.0, 110.0, 23))
    t, angle = (part.ravel() for part in np.meshgrid(along, around, indexing="ij"))
    radius = ROLL_MM * (1.0 - 0.15 * t**2)
    x = HALF_LENGTH_MM * t
    y, z = -radius * np.cos(angle), radius * np.sin(angle)
    shift = ROLL_MM + 0.5 * gap_mm
    upper = np.stack([x, y + shift, z], axis=1)
    lower = np.stack([x, -y - shift, z], axis=1)
    one = grid_triangles(41, 23)  # of the upper roll normals point down in its middle
    triangles = np.concatenate([one, one[:, ::-1] + len(upper)]).astype(np.int32)
    return np.concatenate([upper, lower]), triangles, np.arange(2 * len(upper)) < len(upper)


def closed(by_mm: float) -> Floats:
    """The lips that are GAP_MM apart, with the lower one raised by by_mm."""
    vertices, _, upper = lips(GAP_MM)
    return vertices + np.where(upper[:, None], 0.0, [0.0, by_mm, 0.0])


def eye(opening_mm: float) -> tuple[Floats, Ints32]:
    """Skin with an almond hole, opening_mm high, whose margins are folded back by 4 mm."""
    turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    away = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.5, 5.0, 9.0, 14.0, 20.0])
    back = np.array([4.0, 3.0, 2.0, 1.0, 0.3, 0.0, 0.0, 0.5, 1.0, 2.0, 3.0])
    share = 1.0 - away / 20.0
    x = (12.0 + away)[:, None] * np.cos(turn)
    height = 0.5 * opening_mm * share + (20.0 - 0.5 * opening_mm) * (1.0 - share)
    y = height[:, None] * np.sin(turn)
    vertices = np.stack([x, y, np.broadcast_to(-back[:, None], x.shape)], axis=2).reshape(-1, 3)
    ring = np.arange(48)
    after = (ring + 1) % 48
    strips = []
    for k in range(len(away) - 1):
        a, b, c, d = 48 * k + ring, 48 * (k + 1) + ring, 48 * (k + 1) + after, 48 * k + after
        strips += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    return vertices, np.concatenate(strips).astype(np.int32)


def lid_down(vertices: Floats, by_mm: float) -> Floats:
    """The upper lid lowered by by_mm in its middle, less towards the corners and the brow."""
    x, y = vertices[:, 0], vertices[:, 1]
    across = np.clip(1.0 - (x / 13.0) ** 2, 0.0, None)
    share = np.where(y > 1e-6, np.clip((18.0 - y) / 14.0, 0.0, 1.0), 0.0)
    out = vertices.copy()
    out[:, 1] -= by_mm * across * share
    return out
