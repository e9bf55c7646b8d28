"""Example-based facial rigging with known weights: shapes fitted as local frames (Li et al.)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from capture.arrays import Floats, Ints, Ints32, check_finite, check_shape
from capture.settings import check_ranges
from rig.dense_blocks import solve_blocks
from rig.evidence import Evidence
from rig.gradient import components
from rig.transfer import MASK_TOLERANCE, factorised


@dataclass(frozen=True, kw_only=True)
class EbfrSettings:
    """Settings of example-based facial rigging.

    Attributes:
        beta: strength of the pull towards the targets' frames.
        beta_first: where an alternation of weights and shapes starts; see `at_turn`.
        kappa: how much less a frame that moves is held than one that does not.
        theta: exponent of the same.
        unit_mm: the unit of length in which frames are measured for it, mm: 1, 10 (cm) or 1000
            (m). The method is not invariant to it, and in metres hardly leaves the targets.
    """

    beta: float = 0.1
    beta_first: float = 0.5
    kappa: float = 0.1
    theta: float = 2.0
    unit_mm: float = 1.0

    def __post_init__(self) -> None:
        check_ranges(
            "ebfr", self, beta=(1e-12, 1e9), beta_first=(1e-12, 1e9), kappa=(1e-6, 1.0),
            theta=(0.0, 10.0), unit_mm=(1e-3, 1e6),
        )  # fmt: skip

    def at_turn(self, turn: int, turns: int) -> EbfrSettings:
        """The settings of one turn of an alternation: beta goes from `beta_first` to `beta`.

        With known weights there is nothing to alternate, and only the last turn's beta matters.
        """
        share = min(max(turn / max(turns - 1, 1), 0.0), 1.0) if turns > 1 else 1.0
        return replace(self, beta=(1.0 - share) * self.beta_first + share * self.beta)


def solve_ebfr(
    neutral: Floats,
    triangles: Ints32,
    targets: Floats,
    evidence: Evidence,
    settings: EbfrSettings,
) -> Floats:
    """Fit the frames of every triangle to those of the poses, then vertices to the frames' edges.

    A frame is two edges and the normal; the columns of a triangle's frames share one small matrix
    over the shapes. The fit of the normals would not touch the edges, so it is left out. A
    triangle is as sure as its least sure corner. Vertices have the edges of all triangles as near
    as possible to the fitted ones (least squares), and the place of each connected component is
    that at which vertices which the target leaves still stay still, on average.

    Args:
        neutral: (V, 3), mm; it is kept.
        triangles: (T, 3).
        targets: (B, V, 3) the transferred shapes, mm.
        evidence: poses, their weights, and how sure each vertex is.
        settings: strengths and unit.

    Returns:
        (B, V, 3) displacements from the neutral, mm.

    References:
        Li, Weise, Pauly 2010, Example-based facial rigging, section 4.1.
    """
    check_shape(
        neutral=(neutral, "V 3"), targets=(targets, "B V 3"), triangles=(triangles, "T 3"),
        offsets=(evidence.offsets, "F V 3"), confidence=(evidence.confidence, "F V"),
        weights=(evidence.weights, "F B"),
    )  # fmt: skip
    check_finite(neutral=neutral, targets=targets, offsets=evidence.offsets)
    square = np.asarray(evidence.confidence, dtype=np.float64)[:, triangles].min(axis=2).T ** 2
    residual = evidence.offsets - np.tensordot(evidence.weights, targets, axes=1)
    edges = np.stack(_two_edges(np.ascontiguousarray(residual.transpose(1, 2, 0)), triangles))
    edges *= square[:, None]  # 2, T, 3, F
    right = (edges @ evidence.weights).transpose(1, 3, 0, 2).reshape(len(triangles), -1, 6)
    held = frame_stillness(neutral, triangles, targets, settings)
    change = solve_blocks(evidence.weights, square, settings.beta * held**2, right)
    shapes: Floats = targets + _from_edges(change, triangles, targets)
    return shapes


def frame_stillness(
    neutral: Floats, triangles: Ints32, targets: Floats, settings: EbfrSettings
) -> Floats:
    """w (T, B): how firmly each shape's frame is held, more where the target moves less.

    Frames are two edges and the normal, scaled to a length by the root of twice the area.
    """
    posed = neutral[:, :, None] + targets.transpose(1, 2, 0)  # V, 3, B
    total = np.zeros((len(triangles), len(targets)))
    for column, rest in zip(
        _frames(posed, triangles), _frames(neutral[:, :, None], triangles), strict=True
    ):
        total += ((column - rest) ** 2).sum(axis=1)
    norm = np.sqrt(total) / settings.unit_mm
    held: Floats = ((1.0 + norm) / (settings.kappa + norm)) ** settings.theta
    return held


def _two_edges(points: Floats, triangles: Ints32) -> tuple[Floats, Floats]:
    """Edges from the first corner, each (T, 3, n), of n sets of points (V, 3, n)."""
    first = points[triangles[:, 0]]
    return points[triangles[:, 1]] - first, points[triangles[:, 2]] - first


def _frames(points: Floats, triangles: Ints32) -> tuple[Floats, Floats, Floats]:
    """Two edges and the normal of each triangle, each (T, 3, n), of points (V, 3, n)."""
    a, b = _two_edges(points, triangles)
    normal = np.stack([a[:, k - 2] * b[:, k - 1] - a[:, k - 1] * b[:, k - 2] for k in range(3)], 1)
    length = np.sqrt(np.sqrt((normal**2).sum(axis=1, keepdims=True)))
    return a, b, normal / np.where(length > 0.0, length, 1.0)


def _from_edges(edges: Floats, triangles: Ints32, targets: Floats) -> Floats:
    """Displacements (B, V, 3) whose differences along all edges are nearest to edges (T, B, 6)."""
    count, shapes = targets.shape[1], len(targets)
    wanted = edges.reshape(len(triangles), shapes, 2, 3)
    first, second = wanted[:, :, 0], wanted[:, :, 1]
    along = np.concatenate([first, second - first, -second]).reshape(-1, 3 * shapes)
    begin = np.concatenate([triangles[:, 0], triangles[:, 1], triangles[:, 2]])
    end = np.concatenate([triangles[:, 1], triangles[:, 2], triangles[:, 0]])
    rows = np.repeat(np.arange(len(begin)), 2)
    signs = np.tile([-1.0, 1.0], len(begin))
    entries = (signs, (rows, np.column_stack([begin, end]).ravel()))
    difference = sparse.csr_array(sparse.coo_array(entries, shape=(len(begin), count)))
    transposed = difference.T.tocsr()
    labels = components(triangles, count)
    free = np.ones(count, dtype=bool)
    free[np.unique(labels, return_index=True)[1]] = False
    kept = np.flatnonzero(free)
    solved = np.zeros((count, 3 * shapes))
    if kept.size:
        normal = sparse.csr_array(transposed @ difference)
        right = transposed @ along
        solved[kept] = factorised(normal[kept][:, kept]).solve(right[kept])
    moved = solved.reshape(count, shapes, 3)
    return (moved - _drift(moved, targets, labels)).transpose(1, 0, 2)


def _drift(moved: Floats, targets: Floats, labels: Ints) -> Floats:
    """Mean motion (V, B, 3) of each component's still vertices, or of all where none is still."""
    norms = np.linalg.norm(targets, axis=2)
    still = (norms <= np.maximum(MASK_TOLERANCE * norms.max(axis=1, initial=0.0), 1e-9)[:, None]).T
    ones = np.ones(len(labels))
    members = sparse.csr_array(sparse.coo_array((ones, (labels, np.arange(len(labels))))))
    chosen = np.where((members @ still.astype(np.float64) > 0.0)[labels], still, True)
    total = members @ chosen.astype(np.float64)
    sums = np.asarray(members @ (moved * chosen[:, :, None]).reshape(len(labels), -1))
    mean: Floats = sums.reshape(len(total), -1, 3) / total[:, :, None]
    return mean[labels]
