"""What each frame's weights and motion depend on, summed over the vertices once.

After these sums neither the rotation nor the weights step knows how many vertices there are. All
are divided by the frame's summed squared confidence, so that strengths of priors are in mm^2 of
mean squared error, whatever the vertex count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from capture.arrays import Bools, Floats, check_shape
from rig.ranges import run_ranges

_FRAMES = 256  # whose points are held centred and weighted at once
_VERTICES = 1024  # whose products of shapes are held at once
_RIGID_SEEN = 3  # rigid vertices that a frame must see to take its motion from them


@dataclass(frozen=True, eq=False)
class FrameSums:
    """What a frame's weights and motion depend on, summed over the vertices with confidence.

    Attributes:
        gram: (F or 1, B+1, B+1) mean products of the centred neutral (0) and shapes, mm^2.
        cross: (F, B+1, 3, 3) mean of centred shape times centred point^T, mm^2.
        inertia: (F, 3, 3) mean of centred point times itself^T, mm^2.
        shape_means: (F or 1, B+1, 3) confidence-weighted means of neutral and shapes, mm.
        point_means: (F, 3) mm.
        seen: (F,) whether any vertex of the frame has confidence.
        rigid: sums over the rigid vertices alone, from which the head's motion is then taken in
            the frames that see enough of them (its `seen`); None: motion from all vertices.
    """

    gram: Floats
    cross: Floats
    inertia: Floats
    shape_means: Floats
    point_means: Floats
    seen: Bools
    rigid: FrameSums | None = None


def sum_frames(
    neutral: Floats,
    deltas: Floats,
    points: Floats,
    confidence: Floats,
    rigid_weights: Floats | None = None,
) -> FrameSums:
    """Sum the products that the weights and rigid steps need, one pass over the vertices.

    Args:
        neutral: (V, 3) rig space, mm.
        deltas: (B, V, 3) mm.
        points: (F, V, 3) world, mm; anything where confidence is 0.
        confidence: (F, V) 0..1; enters squared, as the diagonal M of Ma et al. Eq 2.
        rigid_weights: (V,) how far each vertex may place the head, multiplied into the confidence;
            given, the motion comes from these vertices alone. A frame that sees fewer than three of
            them takes it from all.
    """
    check_shape(
        neutral=(neutral, "V 3"),
        deltas=(deltas, "B V 3"),
        points=(points, "F V 3"),
        confidence=(confidence, "F V"),
    )
    basis = np.concatenate([neutral[None], deltas])
    every = _sum(basis, points, confidence, np.ones(len(neutral)))
    if rigid_weights is None:
        return every
    check_shape(neutral=(neutral, "V 3"), rigid_weights=(rigid_weights, "V"))
    kept = np.flatnonzero(np.asarray(rigid_weights) > 0.0)
    share = np.asarray(rigid_weights, dtype=np.float64)[kept]
    confidence = np.asarray(confidence)[:, kept]
    enough = (confidence > 0.0).sum(axis=1) >= _RIGID_SEEN
    rigid = _sum(basis[:, kept], points[:, kept], confidence, share)
    return FrameSums(
        gram=every.gram,
        cross=every.cross,
        inertia=every.inertia,
        shape_means=every.shape_means,
        point_means=every.point_means,
        seen=every.seen,
        rigid=FrameSums(
            gram=rigid.gram,
            cross=rigid.cross,
            inertia=rigid.inertia,
            shape_means=rigid.shape_means,
            point_means=rigid.point_means,
            seen=rigid.seen & enough,
        ),
    )


def _sum(basis: Floats, points: Floats, confidence: Floats, factors: Floats) -> FrameSums:
    """Sums of basis (K, V, 3) and points (F, V, 3); confidence (F, V) times factors (V,)."""
    frames, width, count = len(points), len(basis), basis.shape[1]
    share = _Shares(confidence, factors)
    flat = np.ascontiguousarray(basis.transpose(1, 0, 2)).reshape(count, -1)
    basis_mean = flat.mean(axis=0)
    flat = flat - basis_mean
    cross = np.empty((frames, width, 3, 3))
    inertia, point_means = np.empty((frames, 3, 3)), np.empty((frames, 3))
    kinds = 1 if share.same else frames
    local = np.empty((kinds, 3 * width))
    room = np.empty((min(_FRAMES, frames), 3, count))
    for begin in range(0, frames, _FRAMES):
        span = slice(begin, min(begin + _FRAMES, frames))
        part = share.of(slice(0, 1) if share.same else span)
        size = span.stop - begin
        chunk = np.ascontiguousarray(points[span], dtype=np.float64)
        run_ranges(_centre, size, chunk, part, room, point_means[span], inertia[span])
        products = room[:size].reshape(3 * size, count) @ flat
        cross[span] = products.reshape(size, 3, width, 3).transpose(0, 2, 3, 1)
        if begin < kinds:
            local[span] = part @ flat
    means = local.reshape(kinds, width, 3)
    gram = _grams(flat.reshape(count, width, 3), share) - means @ means.transpose(0, 2, 1)
    held = np.where(share.seen[:kinds, None, None], basis_mean.reshape(-1, 3), 0.0)
    return FrameSums(gram, cross, inertia, means + held, point_means, share.seen)


class _Shares:
    """Squared confidence of each vertex over its frame's sum, computed for a few frames at once.

    Attributes:
        same: whether it is the same in every frame.
        seen: (F,) whether any vertex of the frame has confidence.
    """

    def __init__(self, confidence: Floats, factors: Floats) -> None:
        self._confidence, self._factors = np.asarray(confidence), factors
        frames = len(self._confidence)
        spans = [slice(b, b + _FRAMES) for b in range(0, frames, _FRAMES)]
        first = self._confidence[:1]
        equal = all(bool((self._confidence[span] == first).all()) for span in spans)
        if equal and spans:
            total = np.repeat(self._squares(slice(0, 1)).sum(axis=1), frames)
        else:
            total = np.concatenate([self._squares(span).sum(axis=1) for span in spans] or [[]])
        self.seen: Bools = total > 0.0
        self._mass = np.where(self.seen, total, 1.0)
        self.same = equal or all(
            bool((self.of(span) == self.of(slice(0, 1))).all()) for span in spans
        )

    def of(self, frames: slice, vertices: slice = slice(None)) -> Floats:
        """Shares (frames, vertices)."""
        return self._squares(frames, vertices) / self._mass[frames, None]

    def _squares(self, frames: slice, vertices: slice = slice(None)) -> Floats:
        part = np.asarray(self._confidence[frames, vertices], dtype=np.float64)
        squares: Floats = (part * self._factors[vertices]) ** 2
        return squares


def _grams(basis: Floats, share: _Shares) -> Floats:
    """Products of every two columns of basis (V, K, 3), summed with each frame's shares."""
    width = basis.shape[1]
    if share.same:
        single = np.zeros((1, width, width))
        rows = np.ascontiguousarray(basis.transpose(0, 2, 1)).reshape(-1, width)
        _gram(rows, np.repeat(share.of(slice(0, 1))[0], 3), single[0])
        return single
    row, column = np.triu_indices(width)
    frames = len(share.seen)
    total = np.zeros((frames, len(row)))
    room = np.empty((_VERTICES, len(row)))
    for begin in range(0, len(basis), _VERTICES):
        part = basis[begin : begin + _VERTICES]
        run_ranges(_multiply_shapes, len(part), part, room)
        total += share.of(slice(None), slice(begin, begin + _VERTICES)) @ room[: len(part)]
    grams = np.empty((frames, width, width))
    grams[:, row, column] = total
    grams[:, column, row] = total
    return grams


@numba.njit(cache=True, nogil=True)
def _gram(rows: Any, factors: Any, out: Any) -> None:
    """Weighted products of the columns of rows (N, K), row by row in order: out (K, K)."""
    width = rows.shape[1]
    for r in range(rows.shape[0]):
        for i in range(width):
            part = factors[r] * rows[r, i]
            for j in range(numba.uintp(i), numba.uintp(width)):
                out[i, j] += part * rows[r, j]
    for i in range(width):
        for j in range(i):
            out[i, j] = out[j, i]


@numba.njit(cache=True, nogil=True)
def _multiply_shapes(begin: int, end: int, basis: Any, out: Any) -> None:
    """Upper triangles (V, K (K + 1) / 2) of the products of each vertex's K displacements."""
    width = basis.shape[1]
    for v in range(begin, end):
        place = 0
        for i in range(width):
            x, y, z = basis[v, i, 0], basis[v, i, 1], basis[v, i, 2]
            for j in range(i, width):
                out[v, place] = x * basis[v, j, 0] + y * basis[v, j, 1] + z * basis[v, j, 2]
                place += 1


@numba.njit(cache=True, nogil=True)
def _centre(
    begin: int, end: int, points: Any, share: Any, weighted: Any, means: Any, inertia: Any
) -> None:
    """Means and second moments of each frame's points; centred points times share, axis first."""
    count = points.shape[1]
    for f in range(begin, end):
        parts = share[f if share.shape[0] > 1 else 0]
        x, y, z = 0.0, 0.0, 0.0
        for v in range(count):
            part = parts[v]
            if part > 0.0:
                x += part * points[f, v, 0]
                y += part * points[f, v, 1]
                z += part * points[f, v, 2]
        means[f, 0], means[f, 1], means[f, 2] = x, y, z
        xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for v in range(count):
            part = parts[v]
            a, b, c = 0.0, 0.0, 0.0
            if part > 0.0:
                a, b, c = points[f, v, 0] - x, points[f, v, 1] - y, points[f, v, 2] - z
            weighted[f, 0, v] = part * a
            weighted[f, 1, v] = part * b
            weighted[f, 2, v] = part * c
            xx += part * a * a
            xy += part * a * b
            xz += part * a * c
            yy += part * b * b
            yz += part * b * c
            zz += part * c * c
        inertia[f, 0, 0], inertia[f, 1, 1], inertia[f, 2, 2] = xx, yy, zz
        inertia[f, 0, 1] = inertia[f, 1, 0] = xy
        inertia[f, 0, 2] = inertia[f, 2, 0] = xz
        inertia[f, 1, 2] = inertia[f, 2, 1] = yz
