"""The structured system of Hable's solve: a dense block a vertex, mesh Laplacians, contact rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from scipy import sparse

from capture.arrays import Bools, Floats, Ints, Ints32
from capture.errors import SolveError
from rig.contact import Ties
from rig.ranges import run_ranges


@dataclass(frozen=True, eq=False, kw_only=True)
class Blocks:
    """What each vertex says of its own shapes: (A_v on the shapes that act there) + diag(scale^2).

    Attributes:
        starts: (V + 1,) ranges of `columns`.
        columns: (N,) the shapes that act at each vertex, ascending.
        block_starts: (V + 1,) where each vertex's dense block begins in `dense`.
        dense: the blocks over those shapes, row by row; scale^2 is in the diagonal.
        source: (V, B) scale^2 of every shape; 0 where held.
        free: (V, B) 1 for unknowns, 0 where a shape is held at its source.
    """

    starts: Ints
    columns: Ints
    block_starts: Ints
    dense: Floats
    source: Floats
    free: Floats

    def full(self, vertex: int) -> Floats:
        """One vertex's block over all shapes (B, B)."""
        block = np.diag(self.source[vertex])
        columns = self.columns[self.starts[vertex] : self.starts[vertex + 1]]
        flat = self.dense[self.block_starts[vertex] : self.block_starts[vertex + 1]]
        block[np.ix_(columns, columns)] = flat.reshape(len(columns), len(columns))
        return block


@dataclass(frozen=True, eq=False)
class Smoothing:
    """Uniform mesh Laplacian rows: neighbours (CSR), 1 / their count, squared strength.

    Attributes:
        indptr: (V + 1,).
        indices: ids of neighbours.
        inverse: (V,) 1 / number of neighbours; 0 for a lone vertex, which gets no row.
        strength: what a squared row counts.
    """

    indptr: Ints32
    indices: Ints32
    inverse: Floats
    strength: float

    @classmethod
    def of(cls, link: sparse.csr_array, weight: float) -> Smoothing:
        """From the neighbours (V, V) and the rows' weight."""
        degree = np.diff(link.indptr).astype(np.float64)
        inverse = np.where(degree > 0.0, 1.0 / np.maximum(degree, 1.0), 0.0)
        pointers = link.indptr.astype(np.int32), link.indices.astype(np.int32)
        return cls(*pointers, inverse, weight**2)

    @property
    def diagonal(self) -> Floats:
        """(V,) of the squared Laplacian, strength included."""
        owner = np.repeat(np.arange(len(self.inverse)), np.diff(self.indptr))
        others = np.bincount(owner, self.inverse[self.indices] ** 2, minlength=len(self.inverse))
        return np.asarray(self.strength * ((self.inverse > 0.0) + others), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Clusters:
    """G sets of n vertices that ties join in one coordinate, and the inverse of each joint block.

    `vertices` (G, n), `axis` (G, 1), `inverse` (G, n B, n B).
    """

    vertices: Ints
    axis: Ints
    inverse: Floats


def pack_blocks(grams: Floats, acting: Bools, source: Floats, free: Bools) -> Blocks:
    """Gather each vertex's dense block from packed Grams.

    Args:
        grams: (V or 1, B (B + 1) / 2) of `dense_blocks.pose_grams`.
        acting: (V, B) where data speak of a shape.
        source: (V, B) scale^2.
        free: (V, B) what is solved for; includes all of `acting`.
    """
    counts = acting.sum(axis=1)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    block_starts = np.concatenate([[0], np.cumsum(counts**2)]).astype(np.int64)
    columns = np.nonzero(acting)[1].astype(np.int64)
    dense = np.empty(int(block_starts[-1]))
    source = np.where(free, source, 0.0)
    run_ranges(_gather, len(acting), starts, columns, block_starts, grams, source, dense)
    return Blocks(
        starts=starts, columns=columns, block_starts=block_starts, dense=dense,
        source=source, free=free.astype(np.float64),
    )  # fmt: skip


def solve_system(
    blocks: Blocks,
    smoothing: Smoothing,
    ties: Ties,
    right: Floats,
    tolerance_mm: float,
    iterations: int,
) -> Floats:
    """Conjugate gradients for x, y, z at once, preconditioned by each vertex's inverted block.

    Vertices that contact rows tie together share one block in that coordinate, so that strong
    contacts cost no iterations.

    Args:
        blocks: of every vertex.
        smoothing: Laplacian rows.
        ties: contact rows; may be empty.
        right: (V, 3, B), 0 where held.
        tolerance_mm: it ends when no unknown would be corrected by more, mm.
        iterations: most steps.

    Returns:
        (V, 3, B).

    Raises:
        SolveError: when corrections stay above the tolerance.
    """
    count = len(right)
    diagonal = smoothing.diagonal
    layout = (blocks.starts, blocks.columns, blocks.block_starts)
    mesh = (smoothing.indptr, smoothing.indices, smoothing.inverse)
    inverse = np.empty_like(blocks.dense)
    run_ranges(_invert, count, blocks.starts, blocks.block_starts, blocks.dense, diagonal, inverse)
    loose = np.where(blocks.free > 0.0, 1.0 / (blocks.source + diagonal[:, None] + 1e-300), 0.0)
    clusters = _clusters(blocks, diagonal, ties)
    residual = np.array(right)
    solved, product, step, gathered = (np.zeros_like(residual) for _ in range(4))
    direction = np.zeros_like(residual)
    energies, largest = np.empty((count, 3)), np.empty((count, 3))
    length, ratio, energy = np.zeros(3), np.zeros(3), np.zeros(3)
    for _ in range(iterations + 1):
        run_ranges(
            _advance, count, *layout, inverse, loose, length, direction, product,
            solved, residual, step, energies, largest,
        )  # fmt: skip
        _advance_clusters(clusters, residual, step, energies, largest)
        reached = float(largest.max(initial=0.0))
        if reached <= tolerance_mm:
            return solved
        renewed = energies.sum(axis=0)
        ratio = np.where(energy > 0.0, renewed / np.where(energy > 0.0, energy, 1.0), 0.0)
        energy = renewed
        run_ranges(_turn, count, step, ratio, direction)
        run_ranges(_differ, count, *mesh, smoothing.strength, direction, gathered)
        run_ranges(
            _multiply, count, *layout, blocks.dense, blocks.source, blocks.free, *mesh,
            gathered, direction, product, energies,
        )  # fmt: skip
        values, stretch = ties.apply(direction)
        ties.spread(values, product, blocks.free)
        curvature = energies.sum(axis=0) + stretch
        length = np.where(curvature > 0.0, energy / np.where(curvature > 0.0, curvature, 1.0), 0.0)
    raise SolveError(
        f"Hable's solve: corrections of {reached:.2g} mm remain after {iterations} iterations, "
        f"asked for {tolerance_mm:.2g}; raise the source's strength or the tolerance"
    )


def _clusters(blocks: Blocks, diagonal: Floats, ties: Ties) -> list[_Clusters]:
    """The vertices that ties join, those of equal number together."""
    found: dict[int, list[tuple[Ints, int, Floats]]] = {}
    for axis in range(3):
        chosen = np.flatnonzero(ties.axis == axis)
        ends = np.concatenate([ties.upper[chosen], ties.lower[chosen]])
        vertices, place = np.unique(ends, return_inverse=True)
        upper, lower = place[: len(chosen)], place[len(chosen) :]
        entries = (np.ones(len(chosen)), (upper, lower))
        graph = sparse.coo_array(entries, shape=(len(vertices),) * 2)
        labels = sparse.csgraph.connected_components(graph, directed=False)[1]
        for label in range(int(labels.max(initial=-1)) + 1):
            own = chosen[labels[upper] == label]
            members = vertices[labels == label]
            matrix = _joint_block(blocks, diagonal, ties, own, members)
            found.setdefault(len(members), []).append((members, axis, matrix))
    return [_inverted(found[size]) for size in sorted(found)]


def _inverted(same: list[tuple[Ints, int, Floats]]) -> _Clusters:
    count, size = len(same), len(same[0][2])
    joint = np.array([matrix for _, _, matrix in same])
    starts, block_starts = np.arange(count + 1) * size, np.arange(count + 1) * size**2
    inverse = np.empty(joint.size)
    # a threaded LAPACK takes ten times as long for many small matrices
    run_ranges(_invert, count, starts, block_starts, joint.ravel(), np.zeros(count), inverse)
    return _Clusters(
        vertices=np.array([members for members, _, _ in same]),
        axis=np.array([[axis] for _, axis, _ in same]),
        inverse=inverse.reshape(joint.shape),
    )


def _joint_block(blocks: Blocks, diagonal: Floats, ties: Ties, own: Ints, members: Ints) -> Floats:
    """The common block of vertices that ties join: (n B, n B); 1 in the diagonal where held."""
    shapes = blocks.source.shape[1]
    joint = np.zeros((len(members), shapes, len(members), shapes))
    for place, vertex in enumerate(members.tolist()):
        joint[place, :, place] = blocks.full(vertex) + np.diag(np.full(shapes, diagonal[vertex]))
    upper = np.searchsorted(members, ties.upper[own])
    lower = np.searchsorted(members, ties.lower[own])
    for u, w, matrix in zip(upper.tolist(), lower.tolist(), ties.matrix[own], strict=True):
        joint[u, :, u] += matrix
        joint[w, :, w] += matrix
        joint[u, :, w] -= matrix
        joint[w, :, u] -= matrix
    free = blocks.free[members].ravel()
    flat: Floats = joint.reshape(len(free), len(free)) * np.outer(free, free)
    flat[np.diag_indices(len(free))] += 1.0 - free
    return flat


def _advance_clusters(
    clusters: list[_Clusters], residual: Floats, step: Floats, energies: Floats, largest: Floats
) -> None:
    """The same as `_advance` for the coordinates of vertices that ties join."""
    for cluster in clusters:
        at = (cluster.vertices, cluster.axis)
        own = residual[at]  # G, n, B
        solved = (cluster.inverse @ own.reshape(len(own), -1, 1)).reshape(own.shape)
        step[at] = solved
        energies[at] = (own * solved).sum(axis=2)
        largest[at] = np.abs(solved).max(axis=2)


@numba.njit(cache=True, nogil=True)
def _gather(
    begin: int, end: int, starts: Any, columns: Any, block_starts: Any, grams: Any, source: Any,
    dense: Any,
) -> None:  # fmt: skip
    for v in range(begin, end):
        own = v if grams.shape[0] > 1 else 0
        first, base = starts[v], block_starts[v]
        n = starts[v + 1] - first
        for i in range(n):
            a = columns[first + i]
            for j in range(i + 1):
                value = grams[own, a * (a + 1) // 2 + columns[first + j]]
                dense[base + i * n + j] = value
                dense[base + j * n + i] = value
            dense[base + i * n + i] += source[v, a]


@numba.njit(cache=True, nogil=True)
def _invert(
    begin: int, end: int, starts: Any, block_starts: Any, dense: Any, diagonal: Any, inverse: Any
) -> None:
    """Invert each block, its Laplacian diagonal added, by symmetric sweeps of the lower half."""
    for v in range(begin, end):
        n = starts[v + 1] - starts[v]
        base = block_starts[v]
        a = np.empty((n, n))
        column = np.empty(n)
        for i in range(n):
            for j in range(i + 1):
                a[i, j] = dense[base + i * n + j]
            a[i, i] += diagonal[v]
        for p in range(n):
            pivot = 1.0 / a[p, p]
            for j in range(p):
                column[j] = a[p, j]
            for i in range(p + 1, n):
                column[i] = a[i, p]
            for i in range(n):
                if i != p:
                    factor = column[i] * pivot
                    for j in range(i + 1):
                        a[i, j] -= factor * column[j]
            for j in range(p):
                a[p, j] = column[j] * pivot
            for i in range(p + 1, n):
                a[i, p] = column[i] * pivot
            a[p, p] = -pivot
        for i in range(n):
            for j in range(i + 1):
                inverse[base + i * n + j] = -a[i, j]
                inverse[base + j * n + i] = -a[i, j]


@numba.njit(cache=True, nogil=True)
def _advance(
    begin: int, end: int, starts: Any, columns: Any, block_starts: Any, inverse: Any, loose: Any,
    length: Any, direction: Any, product: Any, solved: Any, residual: Any, step: Any,
    energies: Any, largest: Any,
) -> None:  # fmt: skip
    """Go along the direction; then, preconditioned, the next step, its energy, and its size."""
    shapes = solved.shape[2]
    gathered = np.empty(shapes)
    for v in range(begin, end):
        first, base = starts[v], block_starts[v]
        n = starts[v + 1] - first
        for c in range(3):
            for k in range(shapes):
                solved[v, c, k] += length[c] * direction[v, c, k]
                residual[v, c, k] -= length[c] * product[v, c, k]
                step[v, c, k] = loose[v, k] * residual[v, c, k]
            gathered[:n] = 0.0
            for j in range(n):
                value = residual[v, c, columns[first + j]]
                for i in range(n):
                    gathered[i] += inverse[base + j * n + i] * value
            for i in range(n):
                step[v, c, columns[first + i]] = gathered[i]
            energy, most = 0.0, 0.0
            for k in range(shapes):
                energy += residual[v, c, k] * step[v, c, k]
                most = max(most, abs(step[v, c, k]))
            energies[v, c] = energy
            largest[v, c] = most


@numba.njit(cache=True, nogil=True)
def _turn(begin: int, end: int, step: Any, ratio: Any, direction: Any) -> None:
    for v in range(begin, end):
        for c in range(3):
            for k in range(step.shape[2]):
                direction[v, c, k] = step[v, c, k] + ratio[c] * direction[v, c, k]


@numba.njit(cache=True, nogil=True)
def _differ(
    begin: int, end: int, indptr: Any, indices: Any, inverse: Any, strength: float, x: Any, out: Any
) -> None:
    """The uniform Laplacian of x, times its strength."""
    shapes = x.shape[2]
    for v in range(begin, end):
        for c in range(3):
            own = strength if inverse[v] > 0.0 else 0.0
            for k in range(shapes):
                out[v, c, k] = own * x[v, c, k]
            share = strength * inverse[v]
            for e in range(indptr[v], indptr[v + 1]):
                u = indices[e]
                for k in range(shapes):
                    out[v, c, k] -= share * x[u, c, k]


@numba.njit(cache=True, nogil=True)
def _multiply(
    begin: int, end: int, starts: Any, columns: Any, block_starts: Any, dense: Any, source: Any,
    free: Any, indptr: Any, indices: Any, inverse: Any, laplacian: Any, x: Any, out: Any,
    energies: Any,
) -> None:  # fmt: skip
    """Blocks times x plus the transposed Laplacian of `laplacian`; and x . out of each vertex."""
    shapes = x.shape[2]
    gathered = np.empty(shapes)
    for v in range(begin, end):
        first, base = starts[v], block_starts[v]
        n = starts[v + 1] - first
        for c in range(3):
            for k in range(shapes):
                out[v, c, k] = source[v, k] * x[v, c, k]
            gathered[:n] = 0.0
            for j in range(n):
                value = x[v, c, columns[first + j]]
                for i in range(n):
                    gathered[i] += dense[base + j * n + i] * value
            for i in range(n):
                out[v, c, columns[first + i]] = gathered[i]
            for k in range(shapes):
                out[v, c, k] += laplacian[v, c, k]
            for e in range(indptr[v], indptr[v + 1]):
                u = indices[e]
                share = inverse[u]
                for k in range(shapes):
                    out[v, c, k] -= share * laplacian[u, c, k]
            energy = 0.0
            for k in range(shapes):
                out[v, c, k] *= free[v, k]
                energy += x[v, c, k] * out[v, c, k]
            energies[v, c] = energy
