"""The blendshape update: neutral and shapes from frames whose weights and head motion are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from capture.arrays import Bools, Floats, Ints32, check_shape
from capture.errors import ShapeError
from rig.evidence import Evidence
from rig.update_direct import solve_direct
from rig.update_iterative import solve_iterative
from rig.update_system import (
    UpdatePriors,
    UpdateSystem,
    assemble,
    mean_vertex_area,
    offset_stiffness,
)

__all__ = [
    "UpdatePriors",
    "UpdateSystem",
    "assemble",
    "mean_vertex_area",
    "offset_stiffness",
    "prefers_direct",
    "solve_direct",
    "solve_iterative",
    "update_shapes",
]

# Relative costs, measured on one machine and used on all: the choice must not depend on timing.
_FACTOR_COST = 4.0  # a number of the blocks to the power 1.5, factorised
_BLOCK_COST = 1.0  # a number of the blocks, in one step of iterating
_UNKNOWN_COST = 40.0  # an unknown, in one step: its neighbours and the vectors
_STIFF_SHARE = 0.9  # of the unknowns are less in need of steps than the one that counts


def update_shapes(
    neutral: Floats,
    triangles: Ints32,
    targets: Floats,
    support: Bools,
    evidence: Evidence,
    priors: UpdatePriors,
    start: Floats | None = None,
) -> tuple[Floats, Floats]:
    """Solve Ma et al. Eq 7 with the neutral column: new neutral and shapes, x, y, z at once.

    Args:
        neutral: (V, 3) current neutral, mm.
        triangles: (T, 3).
        targets: (B, V, 3) D*, the transferred shapes, mm; taken as 0 outside the support.
        support: (B, V) where each shape may move, or (B, V, 3) in which coordinates, as the paper
            has it (three systems instead of one); the neutral's column is exempt.
        evidence: the frames.
        priors: strengths.
        start: (B, V, 3) shapes to start iterating from, mm; the targets when None.

    Returns:
        neutral (V, 3) and shapes (B, V, 3), mm, in the rig space of the input; exactly 0 outside
        the support.

    Raises:
        ShapeError: when arrays do not fit together.
        SolveError: when the mesh has no area, or the iteration does not reach its tolerance.

    References:
        Ma et al. 2016, section 3.2, Eqs 5-7 and "Neutral Vertex Positions".
    """
    check_shape(
        neutral=(neutral, "V 3"), targets=(targets, "B V 3"),
        offsets=(evidence.offsets, "F V 3"), confidence=(evidence.confidence, "F V"),
        weights=(evidence.weights, "F B"),
    )  # fmt: skip
    if support.shape not in (targets.shape, targets.shape[:2]):
        raise ShapeError(
            f"support: expected shape {targets.shape[:2]} or {targets.shape}, found {support.shape}"
        )
    each = support if support.ndim == 3 else support[:, :, None]
    targets = np.where(each, targets, 0.0)
    guess = np.zeros((len(neutral), len(targets) + 1, 3))
    if start is not None:
        guess[:, 1:] = (np.where(each, start, 0.0) - targets).transpose(1, 0, 2)
    moved = np.zeros_like(guess)
    for coordinates, mask in _masks(support):
        system = assemble(neutral, triangles, targets, mask, evidence, priors)
        active = system.position >= 0
        change = _solve(system, coordinates, guess[active], priors)
        for c in coordinates:
            moved[active, c] = change[:, c]
    full = moved.transpose(1, 0, 2)
    return neutral + full[0], targets + full[1:]


def prefers_direct(system: UpdateSystem, tolerance: float) -> bool:
    """Whether one factorisation is expected to cost less than iterating to `tolerance`.

    A factorisation of n unknowns at each of V vertices costs about (n^2 V)^1.5: it pays where few
    shapes act on each vertex. Steps of iterating grow with the square root of how much stronger
    neighbours pull than the offset does, and with the digits asked for; a step costs a pass
    over the blocks. Both are estimated from the system alone.
    """
    counts = np.diff(system.starts)
    pull = np.repeat(system.laplacian.diagonal(), counts) / np.maximum(system.stiffness, 1e-300)
    stiff = float(np.quantile(pull, _STIFF_SHARE))
    steps = 0.5 * np.log(2.0 / max(tolerance, 1e-16)) * np.sqrt(1.0 + stiff)
    step_cost = _BLOCK_COST * len(system.blocks) + _UNKNOWN_COST * len(system.columns)
    return bool(_FACTOR_COST * len(system.blocks) ** 1.5 < steps * step_cost)


def _masks(support: Bools) -> list[tuple[tuple[int, ...], Bools]]:
    """The coordinates that share each mask."""
    if support.ndim == 2:
        return [((0, 1, 2), support)]
    return [((c,), support[:, :, c]) for c in range(3)]


def _solve(
    system: UpdateSystem, coordinates: tuple[int, ...], guess: Floats, priors: UpdatePriors
) -> Floats:
    if prefers_direct(system, priors.tolerance):
        return solve_direct(system)
    if len(coordinates) < 3:  # what is not asked for is solved from the start: by zero
        wanted = np.isin(np.arange(3), coordinates)
        system = replace(system, right=np.where(wanted, system.right, 0.0))
        guess = np.where(wanted, guess, 0.0)
    return solve_iterative(system, guess, priors)
