"""`RigSettings`: every choice of the rig stage, in one place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from capture.errors import SettingsError
from capture.settings import check_ranges
from rig.solve import Schedule
from rig.update import UpdatePriors
from rig.weights import WeightPriors

Method = Literal["ma", "hable", "menzel", "ebfr", "transfer"]


@dataclass(frozen=True, kw_only=True)
class RigSettings:
    """Settings of the rig stage.

    Attributes:
        method: how shapes are solved. "ma": all of it, with or without known weights. The others
            want known weights and keep the neutral: "hable", "menzel", "ebfr" (Li et al. 2010), and
            "transfer", which leaves the shapes as the template's were carried over.
        transfer: how shapes come to the actor: by deformation "gradient", or by a warp, "rbf".
        iterations: most turns of weights and shapes.
        relative_change: of the total energy, below which the turns end.
        sparsity: "squared" L1 as in the paper, true "l1", or "reweighted" l1.
        sparsity_mm2: strength of "squared", (sum of a frame's weights)^2, as mean squared mm.
        l1_mm2: strength of "l1" and of "reweighted", as mean squared mm.
        smoothness: strength of the change of a weight between contiguous frames, as a fraction of
            its shape's mean squared displacement; 0 turns it off.
        temporal: "causal" ties a frame to the one before, "joint" to both its neighbours.
        evidence: share of a frame's mean squared residual that a shape must explain to be active.
        strict_evidence: the same in the first turn; it falls towards `evidence` turn by turn, so
            that what a shape lacks is learnt by that shape before others stand in for it.
        debias: undo the shrinking that sparsity causes, keeping its choice of shapes.
        symmetry: strength of equal weights for left and right shapes, as a fraction of their mean
            squared displacement; 0 turns it off.
        exclusive: pairs of shapes, "jawLeft:jawRight", of which one at most is active in a frame.
        head: "all" vertices place the head together with the weights, or the template's "rigid"
            vertices do alone.
        rescale: choose each shape's size against its weights from how far it was exercised.
        size_variation: expected departure of the sizes of the actor's shapes from the template's,
            as a share.
        variation: expected departure of their forms from the transferred ones, as a share of their
            own displacement.
        gradient_mm2: strength of the shapes' deformation gradients against the template's.
        offset: strength of the shapes' displacements against the template's.
        neutral_offset: strength of the neutral against the chosen frame.
        hold_out: choose `gradient_mm2` and `variation` by frames held out.
        mask: "vertex": a vertex that the template holds still in a shape stays still; "soft": it
            may move, at a price that rises; "literal": as in the paper, by coordinate.
        mask_tolerance: of a shape's extent, below which the template counts as still.
        neutral_frame: which frame shows the neutral, counted over all performances; -1 chooses.
    """

    method: Method = "ma"
    transfer: Literal["gradient", "rbf"] = "gradient"
    iterations: int = 8
    relative_change: float = 0.005
    sparsity: Literal["squared", "l1", "reweighted"] = "squared"
    sparsity_mm2: float = 0.01
    l1_mm2: float = 0.02
    smoothness: float = 0.002
    temporal: Literal["causal", "joint"] = "causal"
    evidence: float = 0.12
    strict_evidence: float = 0.6
    debias: bool = True
    symmetry: float = 0.0
    exclusive: tuple[str, ...] = ()
    head: Literal["all", "rigid"] = "all"
    rescale: bool = True
    size_variation: float = 0.25
    variation: float = 0.12
    gradient_mm2: float = 10.0
    offset: float = 0.05
    neutral_offset: float = 0.05
    hold_out: bool = False
    mask: Literal["vertex", "soft", "literal"] = "vertex"
    mask_tolerance: float = 1e-3
    neutral_frame: int = -1

    def __post_init__(self) -> None:
        check_ranges(
            "rig", self, iterations=(1, 100), relative_change=(0.0, 1.0), sparsity_mm2=(0.0, 1e3),
            l1_mm2=(0.0, 1e3), smoothness=(0.0, 1e3), evidence=(0.0, 1.0),
            strict_evidence=(0.0, 1.0), symmetry=(0.0, 1e3), size_variation=(1e-3, 10.0),
            variation=(1e-3, 1e3),
            gradient_mm2=(0.0, 1e6), offset=(1e-6, 1e6), neutral_offset=(1e-6, 1e6),
            mask_tolerance=(0.0, 0.5), neutral_frame=(-1, 1_000_000),
        )  # fmt: skip
        pairs = [[name.strip() for name in pair.split(":")] for pair in self.exclusive]
        wrong = [pair for pair in pairs if len(pair) != 2 or pair[0] == pair[1]]
        if wrong:
            raise SettingsError(
                f"rig.exclusive = {list(self.exclusive)}: expected pairs of two shapes such as "
                f'"jawLeft:jawRight", found {":".join(wrong[0])!r}'
            )
        if self.hold_out and self.method != "ma":
            raise SettingsError(f'rig.hold_out goes with method = "ma", found "{self.method}"')

    def schedule(self) -> Schedule:
        """The same settings as the solver takes them."""
        return Schedule(
            transfer=self.transfer,
            iterations=self.iterations,
            relative_change=self.relative_change,
            strict_evidence=self.strict_evidence,
            rescale=self.rescale,
            mask=self.mask,
            mask_tolerance=self.mask_tolerance,
            size_variation=self.size_variation,
            variation=self.variation,
            weights=WeightPriors(
                sparsity=self.sparsity,
                sparsity_mm2=self.sparsity_mm2,
                l1_mm2=self.l1_mm2,
                reweighted_mm2=self.l1_mm2,
                temporal=self.temporal,
                smoothness=self.smoothness,
                symmetry=self.symmetry,
                evidence=self.evidence,
                debias=self.debias,
            ),
            update=UpdatePriors(
                gradient_mm2=self.gradient_mm2,
                offset=self.offset,
                neutral_offset=self.neutral_offset,
            ),
        )
