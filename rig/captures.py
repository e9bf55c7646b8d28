"""Which captures a rig does not need, which shapes they leave unknown, and what to shoot next.

With weights known, every vertex of the rig is a linear regression: frames are rows w_f of W, shapes
are unknowns with a prior. Its posterior covariance is noise^2 A^-1 with A = W^T W + diag(ridge),
the same for every vertex, so that B x B matrices answer what millions of unknowns would. The ridge
of a shape is (noise / expected departure from the template)^2: how many full-weight frames the
prior is worth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, check_finite, check_shape
from capture.errors import InputError

_ALIKE = 0.2  # cosine above which two shapes are not asked for in one expression
_ROOM = 1e-9  # a leverage is never nearer to 1 than this


@dataclass(frozen=True, eq=False)
class Captures:
    """The regression that captured weights make.

    Attributes:
        weights: (F, B) of every frame or pose.
        ridge: (B,) > 0, what the prior of each shape is worth in frames at weight 1.
        areas: (B,) how much each shape's error matters: the share of the face that it moves.
    """

    weights: Floats
    ridge: Floats
    areas: Floats

    def __post_init__(self) -> None:
        check_shape(weights=(self.weights, "F B"), ridge=(self.ridge, "B"), areas=(self.areas, "B"))
        check_finite(weights=self.weights, ridge=self.ridge, areas=self.areas)
        if self.ridge.size and float(self.ridge.min()) <= 0.0:
            least = float(self.ridge.min())
            raise InputError(
                f"captures: every shape needs a ridge above 0, found {least:.3g}: "
                "without a prior a shape that was never shown has no finite variance"
            )

    def covariance(self) -> Floats:
        """(B, B) A^-1: the posterior covariance of the shapes, the noise's variance being 1."""
        inverse = np.linalg.inv(self.weights.T @ self.weights + np.diag(self.ridge))
        even: Floats = (inverse + inverse.T) / 2.0
        return even


@dataclass(frozen=True)
class Drop:
    """A capture that can be left out after all that stand before it in the list.

    Attributes:
        frame: its row.
        growth: of the shapes' total variance, with this and all before it left out, as a share.
    """

    frame: int
    growth: float


@dataclass(frozen=True)
class Suggestion:
    """An expression to shoot: one shape, or two at once, at weight 1.

    Attributes:
        shapes: their rows.
        gain: share of the remaining variance that it takes away, those before it being shot.
    """

    shapes: tuple[int, ...]
    gain: float


def leverages(captures: Captures) -> Floats:
    """(F,) h_f = w_f^T A^-1 w_f: share of a frame's own fit that only it determines, 0..1."""
    spread = captures.weights @ captures.covariance()
    shares: Floats = np.einsum("fb,fb->f", spread, captures.weights)
    return shares


def variance_growth(captures: Captures) -> Floats:
    """(F,) how much the shapes' total variance grows when one frame is left out, as a share.

    The total is sum_b area_b (A^-1)_bb; leaving a frame out adds (A^-1 w)(A^-1 w)^T / (1 - h).
    """
    covariance = captures.covariance()
    return _growth(covariance @ captures.weights.T, captures) / _total(covariance, captures)


def redundant_captures(
    captures: Captures, allowed_growth: float = 0.1, most: int = 500
) -> list[Drop]:
    """Frames to leave out, the least missed first, while the total variance grows by no more.

    Greedy: each time the frame goes whose loss raises the total variance least, the covariance is
    brought up to date (Sherman and Morrison), and the rest are judged again.

    Args:
        captures: weights and priors.
        allowed_growth: of the total variance of all frames together, as a share.
        most: how many are named at most: a long take holds thousands.
    """
    covariance = captures.covariance()
    start = _total(covariance, captures)
    spread = covariance @ captures.weights.T
    left = np.ones(len(captures.weights), dtype=bool)
    drops: list[Drop] = []
    grown = 0.0
    while left.any() and len(drops) < most:
        growth = np.where(left, _growth(spread, captures), np.inf)
        frame = int(np.argmin(growth))
        if grown + growth[frame] > allowed_growth * start:
            break
        grown += float(growth[frame])
        left[frame] = False
        drops.append(Drop(frame, grown / start))
        column = spread[:, frame].copy()
        room = max(1.0 - float(captures.weights[frame] @ column), _ROOM)
        spread += np.outer(column, captures.weights @ column) / room
    return drops


def remaining_uncertainty(captures: Captures) -> Floats:
    """(B,) share of each shape's prior variance that the captures leave; 1: nothing was learnt."""
    shares: Floats = np.diag(captures.covariance()) * captures.ridge
    return shares


def suggest_captures(
    captures: Captures, count: int = 5, overlap: Floats | None = None, pairs: bool = True
) -> list[Suggestion]:
    """Expressions to shoot next: those that take most off the shapes' total variance.

    Greedy over single shapes at weight 1 and, when asked, over two at once. Shooting w takes
    sum_b area_b (A^-1 w)_b^2 / (1 + w^T A^-1 w) off the total.

    Args:
        captures: weights and priors.
        count: how many.
        overlap: (B, B) cosines between shapes; two that overlap by more than 0.2 either way are not
            asked for together, since no solver could tell their shares apart.
        pairs: whether two shapes at once are suggested as well.
    """
    covariance = captures.covariance()
    size = len(covariance)
    apart = np.triu(np.full((size, size), pairs), 1)
    if overlap is not None:
        check_shape(overlap=(overlap, "B B"), ridge=(captures.ridge, "B"))
        apart &= np.abs(overlap) <= _ALIKE
    apart &= (captures.areas > 0)[:, None] & (captures.areas > 0)
    found: list[Suggestion] = []
    for _ in range(count if size else 0):
        gains = _gains(covariance, captures.areas, apart)
        first, second = (int(i) for i in np.unravel_index(int(np.argmax(gains)), gains.shape))
        gain = float(gains[first, second]) / max(_total(covariance, captures), 1e-300)
        if gain <= 0.0:
            break
        shapes = (first,) if first == second else (first, second)
        found.append(Suggestion(shapes, gain))
        column = covariance[:, list(shapes)].sum(axis=1)
        covariance = covariance - np.outer(column, column) / (1.0 + column[list(shapes)].sum())
    return found


def _total(covariance: Floats, captures: Captures) -> float:
    return float((captures.areas * np.diag(covariance)).sum())


def _growth(spread: Floats, captures: Captures) -> Floats:
    """What leaving out each frame adds to the total, from A^-1 W^T (B, F)."""
    room = 1.0 - np.einsum("fb,bf->f", captures.weights, spread)
    added: Floats = (captures.areas @ spread**2) / np.maximum(room, _ROOM)
    return added


def _gains(covariance: Floats, areas: Floats, apart: Bools) -> Floats:
    """(B, B) what shooting shapes i and j at once takes off the total; the diagonal, i alone."""
    weighted = (covariance * areas) @ covariance
    own, spread = np.diag(weighted), np.diag(covariance)
    both = (own[:, None] + own + 2.0 * weighted) / (
        1.0 + spread[:, None] + spread + 2.0 * covariance
    )
    gains: Floats = np.where(apart, both, 0.0)
    np.fill_diagonal(gains, own / (1.0 + spread))
    return gains
