"""Lips and lids that meet: pairs of vertices and the poses in which they do, as linear rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Ints, check_shape
from capture.errors import ShapeError, raise_all
from rig.evidence import Evidence
from rig.template import Template

_Y = (False, True, False)


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactRows:
    """R rows `scale * (sum_b weights[b] (D_b[lower] - D_b[upper]) - target)`, per coordinate.

    Attributes:
        weights: (R, B) of the pose that each row is about.
        upper: (R,) vertices.
        lower: (R,) vertices.
        scale: (R, 3) strength of each coordinate; 0 where the row says nothing about it.
        target_mm: (R, 3) how the vector from upper to lower should change from the neutral's.
    """

    weights: Floats
    upper: Ints
    lower: Ints
    scale: Floats
    target_mm: Floats

    def __post_init__(self) -> None:
        check_shape(
            weights=(self.weights, "R B"), upper=(self.upper, "R"), lower=(self.lower, "R"),
            scale=(self.scale, "R 3"), target_mm=(self.target_mm, "R 3"),
        )  # fmt: skip

    def with_rows(self, other: ContactRows) -> ContactRows:
        """These rows, then those of `other`."""
        return ContactRows(
            weights=np.concatenate([self.weights, other.weights]),
            upper=np.concatenate([self.upper, other.upper]),
            lower=np.concatenate([self.lower, other.lower]),
            scale=np.concatenate([self.scale, other.scale]),
            target_mm=np.concatenate([self.target_mm, other.target_mm]),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Contacts:
    """Which pairs of vertices meet, or keep their distance, in which rows of the evidence.

    Attributes:
        pairs: (n, 2) upper and lower vertex.
        closed: (F, n) whether the pair meets in that pose.
        kept: (F, n) whether the pair keeps the neutral's distance in that pose.
        axes: which of x, y, z that is asked of.
        strength: what a row counts against one sure observation at weight 1; squared inside.
    """

    pairs: Ints
    closed: Bools
    kept: Bools
    axes: tuple[bool, bool, bool] = _Y
    strength: float = 100.0

    def __post_init__(self) -> None:
        check_shape(pairs=(self.pairs, "n 2"), closed=(self.closed, "F n"), kept=(self.kept, "F n"))
        problems = []
        twice = self.closed & self.kept
        if twice.any():
            pose, pair = np.argwhere(twice)[0].tolist()
            problems.append(f"pose {pose}, pair {pair}: either closed or kept, found both")
        if not self.strength >= 0.0:
            problems.append(f"strength = {self.strength}: must be at least 0")
        raise_all("contacts", problems, ShapeError)

    def rows(self, neutral: Floats, weights: Floats) -> ContactRows:
        """The same as linear rows, for poses of a neutral (V, 3) with weights (F, B)."""
        check_shape(
            pairs=(self.pairs, "n 2"), closed=(self.closed, "F n"), weights=(weights, "F B"),
            neutral=(neutral, "V 3"),
        )  # fmt: skip
        _check_pairs(self.pairs, len(neutral))
        pose, pair = np.nonzero(self.closed | self.kept)
        upper, lower = self.pairs[pair, 0], self.pairs[pair, 1]
        meets = self.closed[pose, pair][:, None]
        return ContactRows(
            weights=weights[pose],
            upper=upper,
            lower=lower,
            scale=np.tile(self.strength * np.array(self.axes, dtype=np.float64), (len(pose), 1)),
            target_mm=np.where(meets, neutral[upper] - neutral[lower], 0.0),
        )


@dataclass(frozen=True, eq=False)
class Ties:
    """Contact rows gathered by pair and coordinate: E ties with a (B, B) matrix each.

    Attributes:
        upper: (E,) vertices.
        lower: (E,) vertices.
        axis: (E,) coordinate.
        matrix: (E, B, B) sum of scale^2 w w^T over the rows of a tie.
        pull: (E, B) sum of scale^2 w target, what is left of it at the sources.
    """

    upper: Ints
    lower: Ints
    axis: Ints
    matrix: Floats
    pull: Floats

    @classmethod
    def of(cls, rows: ContactRows, sources: Floats) -> Ties:
        """From rows, with what the sources (B, V, 3) already do taken off the targets."""
        pairs, which = np.unique(
            np.column_stack([rows.upper, rows.lower]), axis=0, return_inverse=True
        )
        between = sources[:, rows.lower] - sources[:, rows.upper]  # B, R, 3
        left = rows.target_mm - np.einsum("rb,brc->rc", rows.weights, between)
        found = []
        for number, (upper, lower) in enumerate(pairs.tolist()):
            own = np.flatnonzero(which == number)
            for axis in range(3):
                asked = own[rows.scale[own, axis] > 0.0]
                if asked.size:
                    weighed = rows.weights[asked].T * rows.scale[asked, axis] ** 2
                    matrix = weighed @ rows.weights[asked]
                    found.append((upper, lower, axis, matrix, weighed @ left[asked, axis]))
        shapes = rows.weights.shape[1]
        ends = np.array([tie[:3] for tie in found], dtype=np.int64).reshape(-1, 3)
        return cls(
            upper=ends[:, 0],
            lower=ends[:, 1],
            axis=ends[:, 2],
            matrix=np.array([tie[3] for tie in found]).reshape(-1, shapes, shapes),
            pull=np.array([tie[4] for tie in found]).reshape(-1, shapes),
        )

    def spread(self, per_tie: Floats, out: Floats, free: Floats) -> None:
        """Add values (E, B) at the lower vertices of `out` (V, 3, B), subtract at the upper."""
        np.add.at(out, (self.lower, self.axis), per_tie * free[self.lower])
        np.subtract.at(out, (self.upper, self.axis), per_tie * free[self.upper])

    def apply(self, vector: Floats) -> tuple[Floats, Floats]:
        """Values to spread (E, B), and what they add to the squared length (3,)."""
        apart = vector[self.lower, self.axis] - vector[self.upper, self.axis]
        values: Floats = np.matmul(apart[:, None], self.matrix)[:, 0]
        energy = np.bincount(self.axis, (apart * values).sum(axis=1), minlength=3)
        return values, energy.astype(np.float64)


def template_pairs(template: Template) -> Ints:
    """All the lid pairs of a template, then all its lip pairs: (n, 2) upper and lower."""
    return np.concatenate([template.lid_pairs, template.lip_pairs]).astype(np.int64)


def contacts_in_poses(
    pairs: Ints, count: int, *, closed: Sequence[int] = (), kept: Sequence[int] = ()
) -> Contacts:
    """Contacts of all pairs in poses that someone lists.

    Args:
        pairs: (n, 2) upper and lower vertex.
        count: how many poses (rows of the evidence) there are.
        closed: the poses in which the pairs meet.
        kept: the poses in which the pairs keep the neutral's distance.

    Raises:
        ShapeError: naming the poses that do not exist.
    """
    wrong = sorted({pose for pose in [*closed, *kept] if not 0 <= pose < count})
    if wrong:
        raise ShapeError(f"contacts: poses must lie in 0..{count - 1}, found {wrong}")
    flags = np.zeros((2, count, len(pairs)), dtype=bool)
    flags[0, list(closed)] = True
    flags[1, list(kept)] = True
    return Contacts(pairs=pairs, closed=flags[0], kept=flags[1])


def closed_pairs(
    neutral: Floats, pairs: Ints, evidence: Evidence, tolerance_mm: float = 1.0
) -> Bools:
    """Where a pair is seen to meet: both vertices seen, and nearer than a tolerance.

    Args:
        neutral: (V, 3), mm.
        pairs: (n, 2) upper and lower vertex.
        evidence: the poses.
        tolerance_mm: of the distance; tracking noise and a little sliding must fit in.

    Returns:
        (F, n), for `Contacts.closed`.
    """
    _check_pairs(pairs, len(neutral))
    seen = (evidence.confidence[:, pairs] > 0.0).all(axis=2)
    between = np.diff(neutral[pairs] + evidence.offsets[:, pairs], axis=2)[:, :, 0]
    near: Bools = seen & (np.linalg.norm(between, axis=2) < tolerance_mm)
    return near


def contact_gaps(neutral: Floats, deltas: Floats, weights: Floats, contacts: Contacts) -> Floats:
    """What is left of each gap: distance along the contacts' axes from what was asked, mm.

    Args:
        neutral: (V, 3), mm.
        deltas: (B, V, 3), mm.
        weights: (F, B).
        contacts: what was asked.

    Returns:
        (F, n); NaN where nothing was asked.
    """
    check_shape(
        neutral=(neutral, "V 3"), deltas=(deltas, "B V 3"), weights=(weights, "F B"),
        closed=(contacts.closed, "F n"), pairs=(contacts.pairs, "n 2"),
    )  # fmt: skip
    rows = contacts.rows(neutral, weights)
    between = np.diff(deltas[:, contacts.pairs], axis=2)[:, :, 0]  # B, n, 3
    pose, pair = np.nonzero(contacts.closed | contacts.kept)
    left = np.tensordot(weights, between, axes=1)[pose, pair] - rows.target_mm
    gaps = np.full(contacts.closed.shape, np.nan)
    gaps[pose, pair] = np.linalg.norm(left[:, np.array(contacts.axes)], axis=1)
    return gaps


def _check_pairs(pairs: Ints, count: int) -> None:
    check_shape(pairs=(pairs, "n 2"))
    if pairs.size and (pairs.min() < 0 or pairs.max() >= count):
        raise ShapeError(
            f"contact pairs: vertex ids must lie in 0..{count - 1}, "
            f"found {pairs.min()}..{pairs.max()}"
        )
