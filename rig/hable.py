"""Shapes from poses with known weights: data, source and Laplacian rows in one solve (Hable)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Ints, Ints32, check_finite, check_shape
from capture.settings import check_ranges
from rig.contact import ContactRows, Contacts, Ties
from rig.dense_blocks import pose_grams
from rig.evidence import Evidence
from rig.hable_system import Smoothing, pack_blocks, solve_system
from rig.influence import neighbours


@dataclass(frozen=True, kw_only=True)
class HableSettings:
    """Settings of Hable's solve; all rows count against a sure observation at weight 1.

    Attributes:
        source_inside: weight of the source rows where a shape's influence is 1.
        source_outside: the same where it is 0; between them by the root of the influence.
        laplacian: weight of the Laplacian rows.
        hold_outside: hold each shape at its source, exactly, where it has no influence. That is
            the limit of a large `source_outside`, without what it does to the solver; what the
            held shapes show is then taken off the poses, which Hable leaves on.
        influence_floor: influence below which a shape is outside its mask.
        weight_floor: weight below which a pose does not show a shape.
        tolerance_mm: the solver ends when no displacement would be corrected by more.
        iterations: most steps of the solver.
    """

    source_inside: float = 1.0
    source_outside: float = 10.0
    laplacian: float = 1.0
    hold_outside: bool = False
    influence_floor: float = 1e-4
    weight_floor: float = 1e-5
    tolerance_mm: float = 1e-6
    iterations: int = 1000

    def __post_init__(self) -> None:
        check_ranges(
            "hable", self, source_inside=(1e-6, 1e6), source_outside=(1e-6, 1e6),
            laplacian=(0.0, 1e6), influence_floor=(0.0, 1.0), weight_floor=(0.0, 1.0),
            tolerance_mm=(1e-12, 1.0), iterations=(1, 1_000_000),
        )  # fmt: skip


def solve_hable(
    neutral: Floats,
    polygons: Ints32,
    sources: Floats,
    influence: Floats,
    evidence: Evidence,
    settings: HableSettings,
    contacts: Contacts | ContactRows | None = None,
) -> Floats:
    """Find the shapes that explain the poses, near their sources in place and in curvature.

    Rows, all linear: each pose's offsets from the shapes that act at the vertex, times how sure it
    is there; each shape's displacement equal to its source's, up to ten times firmer outside the
    mask; its uniform Laplacian equal to the source's; and pairs of lips and lids that meet or keep
    their distance. x, y and z are solved together.

    Args:
        neutral: (V, 3), mm; it is kept.
        polygons: (P, 4), -1 pads a triangle.
        sources: (B, V, 3) the transferred shapes, mm.
        influence: (B, V) masks 0..1, of `influence_masks`.
        evidence: poses, their weights, and how sure each vertex is.
        settings: strengths and when to stop.
        contacts: pairs that meet, in rows of the evidence; or rows of any other poses.

    Returns:
        (B, V, 3) displacements from the neutral, mm.

    Raises:
        SolveError: when the solver does not reach its tolerance.

    References:
        Hable, Solving blendshapes for ARKit; contact rows are his proposal.
    """
    check_shape(
        neutral=(neutral, "V 3"), sources=(sources, "B V 3"), influence=(influence, "B V"),
        offsets=(evidence.offsets, "F V 3"), confidence=(evidence.confidence, "F V"),
        weights=(evidence.weights, "F B"), polygons=(polygons, "P 4"),
    )  # fmt: skip
    check_finite(sources=sources, influence=influence, offsets=evidence.offsets)
    weights = np.where(evidence.weights >= settings.weight_floor, evidence.weights, 0.0)
    acting = np.greater_equal(influence.T, settings.influence_floor, order="C")
    free = acting if settings.hold_outside else np.ones_like(acting)
    share = np.sqrt(np.clip(influence.T, 0.0, 1.0))
    scale = settings.source_outside + share * (settings.source_inside - settings.source_outside)
    square = np.asarray(evidence.confidence, dtype=np.float64).T ** 2
    blocks = pack_blocks(pose_grams(weights, square), acting, scale**2, free)
    smoothing = Smoothing.of(neighbours(polygons, len(neutral)), settings.laplacian)
    ties = Ties.of(_rows(contacts, neutral, weights), sources)
    shown = sources if settings.hold_outside else sources * acting.T[:, :, None]
    right = _pulls(shown, weights, evidence, square, acting)
    ties.spread(ties.pull, right, blocks.free)
    change = solve_system(
        blocks, smoothing, ties, right, settings.tolerance_mm, settings.iterations
    )
    shapes: Floats = sources + change.transpose(2, 0, 1)
    return shapes


def _pulls(
    shown: Floats, weights: Floats, evidence: Evidence, square: Floats, acting: Bools
) -> Floats:
    """Right-hand side (V, 3, B) of the data rows for the departure from the sources."""
    residual = evidence.offsets - np.tensordot(weights, shown, axes=1)
    residual *= square.T[:, :, None]
    count = len(acting)
    pulls: Floats = (residual.reshape(len(weights), -1).T @ weights).reshape(count, 3, -1)
    pulls *= acting[:, None]
    return pulls


def _rows(contacts: Contacts | ContactRows | None, neutral: Floats, weights: Floats) -> ContactRows:
    if isinstance(contacts, ContactRows):
        check_shape(weights=(weights, "F B"), contacts=(contacts.weights, "R B"))
        return contacts
    if contacts is None:
        none: Ints = np.zeros((0, 2), dtype=np.int64)
        flags = np.zeros((len(weights), 0), dtype=bool)
        contacts = Contacts(pairs=none, closed=flags, kept=flags)
    return contacts.rows(neutral, weights)
