"""`Evidence`: frames whose weights and head motion are known, as updates of shapes read them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from capture.arrays import Floats, check_shape


@dataclass(frozen=True, eq=False)
class Evidence:
    """What shapes are solved from: row f says `neutral_share[f] n + sum_b weights[f, b] D_b`.

    A tracked frame shows the neutral and the shapes; a sculpted target for one shape shows that
    shape alone, and has `neutral_share` 0.

    Attributes:
        offsets: (F, V, 3) what each row shows, minus the neutral, head motion undone, mm.
        confidence: (F, V) >= 0, squared inside; 0..1 for tracked frames.
        weights: (F, B).
        neutral_share: (F,) how much of the neutral's change each row shows; 1 throughout when None.
    """

    offsets: Floats
    confidence: Floats
    weights: Floats
    neutral_share: Floats | None = None

    def __post_init__(self) -> None:
        check_shape(
            offsets=(self.offsets, "F V 3"),
            confidence=(self.confidence, "F V"),
            weights=(self.weights, "F B"),
        )
        if self.neutral_share is not None:
            check_shape(weights=(self.weights, "F *"), neutral_share=(self.neutral_share, "F"))

    @cached_property
    def factors(self) -> Floats:
        """(F, B + 1): share of the neutral, then the weights."""
        share = np.ones(len(self.weights)) if self.neutral_share is None else self.neutral_share
        joined: Floats = np.concatenate([share[:, None], self.weights], axis=1)
        return joined

    def with_rows(self, other: Evidence) -> Evidence:
        """These rows, then those of `other`."""
        return Evidence(
            np.concatenate([self.offsets, other.offsets]),
            np.concatenate([self.confidence, other.confidence]),
            np.concatenate([self.weights, other.weights]),
            np.concatenate([self.factors[:, 0], other.factors[:, 0]]),
        )
