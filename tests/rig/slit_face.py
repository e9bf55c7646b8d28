"""A grid face with a slit across it that a shape called blink closes exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rig.template import Template
from tests.rig.grid_face import grid_template

NAMES = ("blink", "smile", "raise", "turn")
_SIDE = 8


def slit_template() -> Template:
    """64 vertices; two rows of the grid are the rims of an 9 mm slit, without polygons between."""
    plain = grid_template(_SIDE)
    neutral = plain.neutral.copy()
    row, column = np.divmod(np.arange(_SIDE**2), _SIDE)
    rim = (column >= 2) & (column <= 5)
    lower, upper = np.flatnonzero(rim & (row == 3)), np.flatnonzero(rim & (row == 4))
    neutral[lower, 1], neutral[upper, 1] = -4.0, 5.0
    neutral[upper, 0], neutral[upper, 2] = neutral[lower, 0], neutral[lower, 2]
    near = np.exp(-((np.abs(row - 3.5) - 0.5) ** 2) / 2.0) * np.exp(-((column - 3.5) ** 2) / 8.0)
    rng = np.random.default_rng(8)
    deltas = np.zeros((len(NAMES), _SIDE**2, 3))
    deltas[0, :, 1] = -9.0 * near * (row >= 4)
    deltas[0, upper] = neutral[lower] - neutral[upper]
    deltas[1] = near[:, None] * rng.normal(0.0, 3.0, 3) * np.where(row >= 4, 1.1, 1.0)[:, None]
    deltas[2] = (column >= 4)[:, None] * np.array([0.0, 3.0, 1.0]) * (0.2 + near[:, None])
    deltas[3] = (column <= 4)[:, None] * np.array([2.0, 0.5, 1.0]) * (0.2 + near[:, None])
    between = (row[plain.polygons[:, 0]] == 3) & np.isin(column[plain.polygons[:, 0]], (2, 3, 4))
    return replace(
        plain,
        neutral=neutral,
        deltas=deltas,
        names=NAMES,
        polygons=plain.polygons[~between],
        lid_pairs=np.column_stack([upper, lower]),
    )
