"""One sparse factorisation for the blendshape update, shared by x, y and z."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from capture.arrays import Floats
from rig.transfer import factorised
from rig.update_system import UpdateSystem


def solve_direct(system: UpdateSystem) -> Floats:
    """Factorise the active system once and solve x, y and z with it: (N, 3), mm."""
    solved: Floats = factorised(sparse_matrix(system)).solve(system.right)
    return solved


def sparse_matrix(system: UpdateSystem) -> sparse.coo_array:
    """The matrix of the active system, (N, N), entry by entry."""
    counts = np.diff(system.starts)
    owner = np.repeat(np.arange(len(counts)), counts)
    rows = np.repeat(np.arange(len(system.columns)), counts[owner])
    within = np.arange(len(rows)) - np.repeat(system.block_starts[:-1], counts**2)
    cols = np.repeat(system.starts[:-1], counts**2) + within % np.repeat(counts, counts**2)
    coupling = system.laplacian.tocoo()
    pair = system.position[coupling.row], system.position[coupling.col]
    both = (pair[0] >= 0) & (pair[1] >= 0)
    data = np.broadcast_to(coupling.data[:, None], both.shape)[both]
    return sparse.coo_array(
        (
            np.concatenate([system.blocks, data]),
            (np.concatenate([rows, pair[0][both]]), np.concatenate([cols, pair[1][both]])),
        ),
        shape=(len(system.columns),) * 2,
    )
