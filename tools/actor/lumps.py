"""Smooth seeded fields over the head: its irregularity, and how its expressions differ."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats

_WAVES = 14


def wave(points: Floats, seed: int, wavelength_mm: float) -> Floats:
    """A smooth random scalar field of about unit spread.

    Args:
        points: (N, 3) head space, mm.
        seed: equal seeds give the same field.
        wavelength_mm: the typical length of its waves.

    Returns:
        (N,) values, about -2..2.
    """
    random = np.random.default_rng([abs(seed), 23])
    directions = random.normal(size=(_WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rates = 2.0 * np.pi / (wavelength_mm * random.uniform(0.75, 1.6, _WAVES))
    phases = random.uniform(0.0, 2.0 * np.pi, _WAVES)
    total: Floats = np.sin(points @ (directions * rates[:, None]).T + phases).sum(axis=1)
    total /= np.sqrt(_WAVES / 2.0)
    return total


def lumps(points: Floats, amplitude_mm: float, seed: int) -> Floats:
    """Smooth displacements (N, 3), mm, mostly along the face's depth; 0 for no amplitude."""
    if amplitude_mm == 0.0:
        return np.zeros_like(points)
    fields = [wave(points, 1000 * seed + axis, 95.0) for axis in range(3)]
    return amplitude_mm * np.stack(fields, axis=1) * [0.5, 0.5, 1.0]
