"""A small face with eyes and a shut mouth, made at any resolution: the same surface, its shapes.

The lips touch exactly along the slit and along two sheets that run inwards from it; the eyes are
open holes. Every vertex knows where it is on the surface, so that its shapes are known in any
topology.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from capture.arrays import Floats, Ints
from recon.mesh import Mesh
from rig.template import Template

NAMES = ("jawOpen", "eyeBlink_L", "eyeBlink_R", "mouthSmile_L", "browInnerUp", "noseSneer")
_X = (-80.0, -46.0, -25.0, -18.0, 0.0, 18.0, 25.0, 46.0, 80.0)
_Y = (-95.0, -35.0, 35.0, 90.0)
_SLITS = ((-35.0, -25.0, 25.0, 0.0), (35.0, -46.0, -18.0, 4.0), (35.0, 18.0, 46.0, 4.0))
_DEPTHS_MM = (2.5, 5.0, 8.0)
_BAG_MM = tuple(np.linspace(1.5, 15.0, 10))


@dataclass(frozen=True, eq=False, kw_only=True)
class ToyFace:
    """The face: flat (V, 2) mm and depth (V,) mm inwards are where a vertex is on the surface,
    side (V,) is +1 above a slit's line, -1 below, also far from it, and slit (V,) 0 for lips."""

    mesh: Mesh
    deltas: Floats
    flat: Floats
    depth: Floats
    side: Ints

    @property
    def lips(self) -> Ints:
        """1 on the upper lip, -1 on the lower one, 0 elsewhere and at the corners."""
        x, y = self.flat.T
        return np.where((np.abs(x) < 24.0) & (np.abs(y + 35.0) < 15.0), self.side, 0)

    def template(self) -> Template:
        return Template(
            neutral=self.mesh.vertices, deltas=self.deltas, names=NAMES,
            polygons=self.mesh.polygons,
            rigid_vertices=np.flatnonzero(self.flat[:, 1] > 75.0),
        )  # fmt: skip


def toy_face(spacing_mm: float, *, slant: int = 0, bag: bool = False) -> ToyFace:
    """The face with vertices about so far apart; slant 1 triangulates the other way than 0.

    With a bag the lips' sheets are longer and joined at their ends, so that no hole tells a mouth.
    """
    x, y = _axis(_X, spacing_mm), _axis(_Y, spacing_mm)
    build = _Build(x, y)
    for line, low, high, _ in _SLITS:
        build.cut(line, low, high)
    build.inner_lips(*_SLITS[0][:3], _BAG_MM if bag else _DEPTHS_MM, joined=bag)
    flat, depth, side = np.array(build.flat), np.array(build.depth), np.array(build.side)
    triangles = []
    for a, b, c, d in build.quads:
        halves = [(a, b, c), (a, c, d)] if slant == 0 else [(a, b, d), (b, c, d)]
        triangles += [t for t in halves if len(set(t)) == 3]
    polygons = np.array(triangles, dtype=np.int32)
    mesh = Mesh(_surface(flat, depth, side), polygons)
    return ToyFace(
        mesh=mesh, deltas=_shapes(flat, side), flat=flat, depth=depth, side=side.astype(np.int64)
    )


class _Build:
    """A grid of quads with slits cut into it."""

    def __init__(self, x: Floats, y: Floats) -> None:
        self.x, self.y = x, y
        columns = len(x)
        grid = np.arange(len(x) * len(y)).reshape(len(y), columns)
        self.grid = grid
        self.flat = [(float(u), float(v)) for v in y for u in x]
        self.depth = [0.0] * len(self.flat)
        self.side = [1 if v >= line(u) else -1 for u, v in self.flat]
        self.quads = [
            [int(v) for v in (grid[r, c], grid[r, c + 1], grid[r + 1, c + 1], grid[r + 1, c])]
            for r in range(len(y) - 1)
            for c in range(columns - 1)
        ]
        self.lower: dict[int, int] = {}

    def add(self, flat: tuple[float, float], depth: float, side: int) -> int:
        self.flat.append(flat)
        self.depth.append(depth)
        self.side.append(side)
        return len(self.flat) - 1

    def cut(self, at: float, low: float, high: float) -> None:
        row = int(np.abs(self.y - at).argmin())
        for column in np.flatnonzero((self.x > low + 1e-9) & (self.x < high - 1e-9)):
            above = int(self.grid[row, column])
            self.lower[above] = self.add(self.flat[above], 0.0, -1)
        for quad in self.quads:
            if min(self.flat[v][1] for v in quad) < at - 1e-9:
                quad[:] = [self.lower.get(v, v) if self._on(v, row) else v for v in quad]

    def _on(self, vertex: int, row: int) -> bool:
        return vertex in self.lower and vertex in self.grid[row]

    def inner_lips(
        self, at: float, low: float, high: float, depths: tuple[float, ...], *, joined: bool
    ) -> None:
        row = int(np.abs(self.y - at).argmin())
        inside = np.flatnonzero((self.x > low - 1e-9) & (self.x < high + 1e-9))
        rim = [int(self.grid[row, column]) for column in inside]
        ends: list[int] = []
        for side in (1, -1):
            last = rim if side == 1 else [self.lower.get(v, v) for v in rim]
            for deep in depths:
                shared = joined and deep == depths[-1]
                following = ends if shared and ends else self.ring(last, deep, high, side)
                ends = following if shared else ends
                for n in range(len(last) - 1):
                    quad = [last[n + 1], last[n], following[n], following[n + 1]]
                    self.quads.append(quad if side == 1 else [quad[n] for n in (1, 0, 3, 2)])
                last = following

    def ring(self, last: list[int], deep: float, high: float, side: int) -> list[int]:
        """A loop deeper than the last one, with the same corners."""
        inner = [
            self.add(self.flat[v], deep * (1.0 - (self.flat[v][0] / high) ** 2), side)
            for v in last[1:-1]
        ]
        return [last[0], *inner, last[-1]]


def line(x: float) -> float:
    """The height of the slit's line there: the mouth's in the middle, the eyes' beside it."""
    return 35.0 if abs(x) > 60.0 else -35.0


def _axis(breaks: tuple[float, ...], spacing: float) -> Floats:
    parts = [
        np.linspace(a, b, 1 + max(1, round((b - a) / spacing)))[:-1] for a, b in pairwise(breaks)
    ]
    return np.append(np.concatenate(parts), breaks[-1])


def _surface(flat: Floats, depth: Floats, side: Floats) -> Floats:
    x, y = flat.T
    z = 90.0 - 0.006 * x**2 - 0.003 * y**2
    z = z + 22.0 * np.exp(-((x / 11.0) ** 2) - ((y + 2.0) / 20.0) ** 2)
    z = z + 6.0 * np.exp(-((x / 30.0) ** 2) - ((y + 35.0) / 14.0) ** 2)
    z = z + 5.0 * np.exp(-(((np.abs(x) - 30.0) / 20.0) ** 2) - ((y - 55.0) / 9.0) ** 2)
    z = z - 5.0 * np.exp(-(((np.abs(x) - 32.0) / 14.0) ** 2) - ((y - 35.0) / 9.0) ** 2)
    up = np.where(y >= 35.0 - 1e-9, 1.0, -1.0)
    up = np.where(np.abs(y - 35.0) < 1e-9, side, up)
    gap = np.clip(1.0 - ((np.abs(x) - 32.0) / 14.0) ** 2, 0.0, None)
    gap = gap * np.exp(-np.abs(y - 35.0) / 10.0)
    return np.column_stack([x, y + up * 4.0 * gap, z - depth])


def _shapes(flat: Floats, side: Floats) -> Floats:
    """Shapes of the surface: the lower lip alone opens, lids meet, the rest is smooth."""
    x, y = flat.T

    def bump(u: float, v: float, radius: float) -> Floats:
        far = ((x - u) ** 2 + (y - v) ** 2) / radius**2
        return np.clip(1.0 - far, 0.0, None)[:, None] ** 2

    at_mouth = np.abs(y + 35.0) < 1e-9
    below = np.where(at_mouth, side < 0, y < -35.0)
    width = np.clip(1.0 - (x / 25.0) ** 2, 0.0, None)
    fall = np.clip(1.0 - ((y + 35.0) / 50.0) ** 2, 0.0, None)
    jaw = (below * width * fall)[:, None] * np.array([0.0, -9.0, -2.0])
    upper = np.where(np.abs(y - 35.0) < 1e-9, side > 0, y > 35.0)
    lids = []
    for centre in (32.0, -32.0):
        gap = np.clip(1.0 - ((x - centre) / 14.0) ** 2, 0.0, None)
        gap = gap * np.exp(-np.abs(y - 35.0) / 10.0) * (np.abs(y - 35.0) < 30.0)
        lids.append((np.where(upper, -7.0, 1.0) * gap)[:, None] * np.array([0.0, 1.0, 0.0]))
    smooth = [
        bump(28.0, -30.0, 30.0) * [5.0, 4.0, -1.0],
        bump(0.0, 60.0, 28.0) * [0.0, 5.0, 1.5],
        bump(0.0, 0.0, 24.0) * [0.0, 3.0, 1.0],
    ]
    return np.stack([jaw, *lids, *smooth])
