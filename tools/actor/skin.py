"""The actor's skin: what is painted at the vertices, and the fine detail as tiles in rest space."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import sparse

from capture.arrays import Floats, Floats32
from tools.actor.identity import Identity
from tools.actor.lattice import Lattice
from tools.actor.lumps import wave
from tools.actor.sculpt import EYE_LEVEL, Sculpture, bump, lip_heights, smooth_step, stomion_level

TILE_MM = 96.0
_TILE = 1024


@dataclass(frozen=True, eq=False)
class Paint:
    """What the shader reads at each vertex.

    Attributes:
        albedo: (V,) of the plain surface, blotches and shade of hollows included.
        brow: (V,) 0..1 how much eyebrow.
        hair: (V,) 0..1 how much cropped hair.
        lip: (V,) 0..1 how much the red of the lips.
        wet: (V,) 0..1 inside of the mouth and the edges of the lids.
    """

    albedo: Floats
    brow: Floats
    hair: Floats
    lip: Floats
    wet: Floats


def paint_skin(lattice: Lattice, sculpture: Sculpture, normals: Floats, who: Identity) -> Paint:
    """Paint the skin of one identity.

    Args:
        lattice: the topology.
        sculpture: the neutral.
        normals: (V, 3) of the neutral.
        who: the identity.
    """
    points = sculpture.vertices
    x, y, z = points.T
    wide = np.abs(x)
    outer = lattice.ring == 0
    blotches = 0.05 * wave(points, who.seed + 5, 42.0) + 0.05 * wave(points, who.seed + 6, 13.0)
    albedo = who.skin * (1.0 + who.blotches * blotches)
    albedo *= 1.0 - 0.10 * bump((wide - 34) / 14, (y + 22) / 12)  # the red of the cheeks
    albedo *= 1.0 - 0.12 * bump(x / 11, (y + 27) / 8)
    albedo *= 1.0 - 0.10 * bump((wide - 30) / 15, (y - EYE_LEVEL + 9) / 4) * (y < EYE_LEVEL)
    albedo *= _hollows(lattice, points, normals)
    nostril = (
        bump((wide - 6.2) / 3.4, (y + who.nose_length + 34.0) / 2.2)
        * (z > 80)
        * (normals[:, 1] < 0.1)
    )
    albedo *= 1.0 - 0.75 * nostril
    lip = _lips(points, who) * (z > 60)
    albedo *= 1.0 - 0.34 * lip
    wet = np.where(outer, 0.0, 1.0)
    mouth = lattice.mouth
    for ring, shade in enumerate((0.72, 0.5, 0.4, 0.3, 0.18, 0.1, 0.05, 0.03)):
        albedo[mouth.rings[ring]] = who.skin * shade
    for eye in lattice.eyes:
        count = len(eye.upper)
        albedo[eye.rings[1]] = who.skin * 0.55
        albedo[eye.rings[1, : count + 2]] = who.skin * 0.12  # lashes
        albedo[eye.rings[2:].ravel()] = who.skin * 0.25
        albedo[eye.upper] = who.skin * 0.3
        albedo[eye.lower] = who.skin * 0.62
        albedo[eye.corners] = who.skin * 0.5
    hair = smooth_step(0.0, 1.1, _hairline(points) + 0.10 * wave(points, who.seed + 8, 16.0))
    ear = smooth_step(1.2, 0.9, np.hypot((z + 25.0) / 26.0, (y + 6.0) / 35.0))
    hair *= outer * (1.0 - ear * smooth_step(68.0, 75.0, wide))
    return Paint(albedo, _brows(points, who), hair, lip, wet)


def _hollows(lattice: Lattice, points: Floats, normals: Floats) -> Floats:
    """Shade of hollows (V,), 1 in the open: how far the smoothed surface lies above the skin."""
    triangles = np.concatenate([lattice.polygons[:, [0, 1, 2]], lattice.polygons[:, [0, 2, 3]]])
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    count = len(points)
    link = sparse.coo_matrix(
        (np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count)
    ).tocsr()
    link = link + link.T
    degree = np.asarray(link.sum(axis=1)).ravel()
    mean = sparse.diags_array(1.0 / degree) @ link
    shade = np.ones(count)
    smooth = points
    for steps, depth in ((6, 0.9), (20, 3.2)):
        for _ in range(steps):
            smooth = np.asarray(mean @ smooth)
        rise = ((smooth - points) * normals).sum(axis=1)
        shade *= 1.0 - 0.26 * np.tanh(np.clip(rise, 0.0, None) / depth)
    result: Floats = np.where(lattice.ring == 0, shade, 1.0)
    return result


def _lips(points: Floats, who: Identity) -> Floats:
    x, y, _ = points.T
    upper, lower = lip_heights(x, who)
    level = y - stomion_level(who)
    share = np.where(level > 0, level / upper, -level / lower)
    ends = smooth_step(who.mouth_half_width + 1.5, who.mouth_half_width - 1.0, np.abs(x))
    return smooth_step(1.12, 0.88, share) * ends


def _brows(points: Floats, who: Identity) -> Floats:
    """Signed closeness to the eyebrows' strokes: 0.5 at the edge, more inside, 0 far away."""
    x, y, z = points.T
    lift = who.brow_height
    place = np.clip((np.abs(x) - 10.0) / 44.0, 0.0, 1.0)
    level = 20.5 + lift + 9.0 * place**0.8 - 9.5 * np.clip(place - 0.62, 0.0, 1.0) ** 1.4 * 2.0
    thick = who.brow_thickness * (1.0 - 0.62 * place**1.6)
    beyond = np.maximum(np.maximum(10.0 - np.abs(x), np.abs(x) - 54.0), 0.0)
    away = np.hypot((y - level) / thick, beyond / 3.0)
    inside: Floats = np.clip(1.2 - 0.7 * away, 0.0, 1.0) * (z > 20)
    return inside


def _hairline(points: Floats) -> Floats:
    """Above 0.5 where hair grows: over the forehead, around the ears, down to the nape."""
    x, y, z = points.T
    rear = smooth_step(45.0, -35.0, z)
    line = 66.0 - 2.0 * np.exp(-((np.abs(x) - 30.0) ** 2) / 200.0) - rear**1.4 * 120.0
    line = np.where(z < -30, -55.0, line)
    temple = 22.0 * bump((z - 12.0) / 12.0)
    grown: Floats = 0.5 + (y - line + temple * (y < 40)) / 22.0
    return grown


@lru_cache(maxsize=4)
def make_tile(seed: int, freckles: float) -> Floats32:
    """Fine detail that tiles, `TILE_MM` a side: pores, mottling, freckles, strands of hair.

    Args:
        seed: equal seeds give the same tile.
        freckles: strength of the freckles.

    Returns:
        (1024, 1024, 4) 0..1: albedo factor (0.5 is 1), slope along x and y (0.5 is flat), and a
        noise drawn out along x for hair.
    """
    random = np.random.default_rng([abs(seed), 29])
    frequency = np.fft.fftfreq(_TILE, d=TILE_MM / _TILE)
    across, down = np.meshgrid(frequency[: _TILE // 2 + 1], frequency)
    across = np.abs(across)
    rate = np.hypot(across, down)

    def band(wavelength_mm: float, stretch: float = 1.0) -> Floats:
        white = np.fft.rfft2(random.standard_normal((_TILE, _TILE)))
        scaled = np.hypot(across * stretch, down) * wavelength_mm
        field = np.fft.irfft2(white * scaled * np.exp(-0.5 * scaled**2))
        normed: Floats = field / field.std()
        return normed

    def dots(per_mm2: float, radius_mm: float) -> Floats:
        count = int(per_mm2 * TILE_MM**2)
        seeds = np.zeros((_TILE, _TILE))
        seeds[random.integers(0, _TILE, count), random.integers(0, _TILE, count)] = random.uniform(
            0.4, 1.0, count
        )
        blur = np.exp(-2.0 * (np.pi * radius_mm * rate) ** 2)
        field: Floats = np.fft.irfft2(np.fft.rfft2(seeds) * blur)
        return field * (2.0 * np.pi * (radius_mm * _TILE / TILE_MM) ** 2)

    pores = dots(0.55, 0.26) + dots(0.9, 0.16)
    spots = np.clip(dots(0.035, 0.62), 0.0, 1.2)
    mottle = 0.55 * band(1.1) + 0.6 * band(2.2) + 0.55 * band(5.0)
    albedo = 0.5 + 0.045 * mottle - 0.12 * np.clip(pores, 0, 1.6) - 0.15 * freckles * spots
    height = 0.035 * band(0.6) + 0.05 * band(1.4) - 0.10 * pores
    step = TILE_MM / _TILE
    slope_x = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) / (2.0 * step)
    slope_y = (np.roll(height, -1, 0) - np.roll(height, 1, 0)) / (2.0 * step)
    strands = 0.5 + 0.22 * band(0.75, stretch=7.0)
    tile = np.stack([albedo, 0.5 + 0.5 * slope_x, 0.5 + 0.5 * slope_y, strands], axis=2)
    return np.clip(tile, 0.0, 1.0).astype(np.float32)
