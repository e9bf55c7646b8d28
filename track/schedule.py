"""The rounds of a frame's registration, from coarse and stiff to fine and supple."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Step:
    """One round of guide, match, lift and solve.

    Attributes:
        level: pyramid level, 0 the finest.
        search_px: half side of the whole-pixel search, px of the level; 0 refines only.
        iterations: Gauss-Newton steps of the sub-pixel refinement.
        limit_px: longest displacement believed, px of the level.
        scale_px: robust scale of the triangulation, px of the level.
        bending_mm: stiffness of the solve.
    """

    level: int
    search_px: int
    iterations: int
    limit_px: float
    scale_px: float
    bending_mm: float


def schedule(
    levels: int, search_px: float, passes: int, bending_mm: Sequence[float]
) -> tuple[Step, ...]:
    """The steps of a frame: search at the coarsest level, refine at the others.

    Args:
        levels: how many pyramid levels.
        search_px: half side of the search, px of the finest level.
        passes: rounds at the finest level.
        bending_mm: stiffness at the coarsest level and in the last round; between, geometric.
    """
    coarse, fine = bending_mm
    order = [*range(levels - 1, 0, -1), *[0] * passes]
    share = np.linspace(0.0, 1.0, len(order)) if len(order) > 1 else np.ones(1)
    out = []
    for index, level in enumerate(order):
        radius = max(1, round(search_px / 2**level)) if index == 0 else 2
        last = index == len(order) - 1
        out.append(
            Step(
                level=level,
                search_px=radius,
                iterations=3 if not last else 2,
                limit_px=radius + 1.5,
                scale_px=1.5 if index == 0 else 1.0 if not last else 0.7,
                bending_mm=float(coarse * (fine / coarse) ** share[index]),
            )
        )
    return tuple(out)
