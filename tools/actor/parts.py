"""The parts that are no skin: eyeballs and teeth, true surfaces with their own motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats
from recon.mesh import Mesh
from tools.actor.sculpt import BALL_RADIUS

_RINGS = 26
_SECTORS = 36
_CORNEA_RADIUS = 7.8
_TEETH_COLUMNS = 57


@dataclass(frozen=True, eq=False)
class ActorPart:
    """One rigid part of the actor.

    Attributes:
        name: eye_right, eye_left, teeth_upper or teeth_lower.
        kind: "eye" or "teeth", for the shader.
        mesh: the part in head space at rest, mm.
        local: (V, 3) rest coordinates the shader paints by: for an eye from its centre with +Z
            along the gaze, for teeth (arc length, height above the cutting edge, 0), mm.
        centre: (3,) what the gaze turns about, head space, mm.
        deltas: (B, V, 3) mm at weight 1 of each shape.
        gaze: (B, 2) radians at weight 1: turn to +X about +Y, and turn up.
    """

    name: str
    kind: str
    mesh: Mesh
    local: Floats
    centre: Floats
    deltas: Floats
    gaze: Floats


def eyeball(centre: Floats) -> tuple[Mesh, Floats]:
    """A ball with a cornea that looks along +Z: mesh in head space, its points from the centre."""
    angle = np.concatenate(
        [np.linspace(0.02, 0.75, _RINGS // 2), np.linspace(0.82, 2.6, _RINGS // 2)]
    )
    around = 2.0 * np.pi * np.arange(_SECTORS) / _SECTORS
    radius = np.full(_RINGS, BALL_RADIUS)
    # The cornea is a smaller sphere set forward; the larger radius of the two shows.
    forward = BALL_RADIUS + 0.5 - _CORNEA_RADIUS
    inside = np.maximum(_CORNEA_RADIUS**2 - (forward * np.sin(angle)) ** 2, 0.0)
    bulge = forward * np.cos(angle) + np.sqrt(inside)
    radius = np.where(angle < 0.75, np.maximum(radius, bulge), radius)
    sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
    points = np.stack(
        [sine * np.cos(around), sine * np.sin(around), np.broadcast_to(cosine, (_RINGS, _SECTORS))],
        axis=2,
    )
    local = (points * radius[:, None, None]).reshape(-1, 3)
    quads = _grid_quads(_RINGS, _SECTORS, wrap=True)
    cap = [[0, k + 1, k + 2, -1] for k in range(_SECTORS - 2)]
    polygons = np.concatenate([quads, np.array(cap, np.int32)])
    return Mesh(local + centre, polygons), local


def teeth(stomion: Floats, *, upper: bool) -> tuple[Mesh, Floats]:
    """A row of teeth on its arch: mesh in head space, (arc length, height, 0) of each vertex."""
    turn = np.linspace(-1.15, 1.15, _TEETH_COLUMNS)
    breadth, depth = (27.0, 34.0) if upper else (25.5, 33.0)
    front = stomion[2] - (10.5 if upper else 13.5)
    x = breadth * np.sin(turn)
    z = front - depth * (1.0 - np.cos(turn)) ** 0.9
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
    arc -= arc.mean()
    up = 1.0 if upper else -1.0
    edge = stomion[1] - (3.6 if upper else 0.6)
    heights = np.array([11.0, 8.5, 5.0, 2.0, 0.3, 0.0, 0.6, 6.0])
    inward = np.array([1.2, 0.0, 0.0, 0.2, 0.7, 1.6, 2.6, 5.0])
    gap = 0.5 * (1.0 - np.abs(np.cos(np.pi * arc / 7.6)) ** 0.35)
    points = np.empty((len(heights), _TEETH_COLUMNS, 3))
    local = np.zeros_like(points)
    for k, (height, inset) in enumerate(zip(heights, inward, strict=True)):
        shrink = 1.0 - (inset + gap * (height < 8.0)) / breadth
        points[k, :, 0] = x * shrink
        points[k, :, 1] = edge + up * (height + (0.5 * gap if height < 1.0 else 0.0))
        points[k, :, 2] = front + (z - front) * shrink - (inset + gap) * np.cos(turn)
        local[k, :, 0], local[k, :, 1] = arc, height
    quads = _grid_quads(len(heights), _TEETH_COLUMNS, wrap=False)
    if not upper:
        quads = quads[:, ::-1]
    return Mesh(points.reshape(-1, 3), np.ascontiguousarray(quads)), local.reshape(-1, 3)


def _grid_quads(
    rows: int, columns: int, *, wrap: bool
) -> np.ndarray[tuple[int, int], np.dtype[np.int32]]:
    count = columns if wrap else columns - 1
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(count), indexing="ij")
    right = (column + 1) % columns
    quads = np.stack(
        [row * columns + column, (row + 1) * columns + column,
         (row + 1) * columns + right, row * columns + right], axis=2,
    )  # fmt: skip
    return quads.reshape(-1, 4).astype(np.int32)
