"""Settings of the tracking stage (`track.stage`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from capture.settings import check_ranges


@dataclass(frozen=True, kw_only=True)
class TrackSettings:
    """Settings of the tracking stage.

    Attributes:
        spacing_mm: triangles wider than this get samples inside; every vertex is one anyway.
        search_mm: how far skin may move from one frame to the next beyond the head's motion.
        passes: rounds of guide, match, lift and solve at full resolution.
        half_window_px: matching windows have 2 half + 1 px a side at full resolution.
        half_window_coarse_px: the same at the coarser pyramid levels.
        bending_coarse_mm: stiffness of the first round; bumps shorter than about six times this
            are left for later rounds.
        bending_mm: stiffness of the last round.
        min_cosine: least cosine between the skin's normal and the view.
        min_correlation: least correlation of a match.
        search_stride: in the first round every how manieth sample is matched.
        rotation_iterations: updates of the local frames in each solve.
        extrapolation: share of the head's last motion expected again.
        use_scan: use the scans that `likeness recon` made. The first frame's tells how far the
            skin lies over the neutral, which matters where the neutral is not quite on it; that
            of any other frame the depth of skin that one or two views alone see there.
        follow_back: match the last round both ways, and drop what does not lead home.
        anchors: register frames that show the neutral directly, and cut the take there.
        second_look: look again, from the far end of a segment, at what the first sweep lost.
        contact: push crossed lips and lids apart.
        features: look by sparse features for skin that moved farther than flow searches.
        second_reference: match skin that looks unlike the neutral to a nearer frame as well.
        flow: who measures dense flow, "cpu" or "gpu"; both give the same within rounding.
        correction_reach: frames on each side of a corrected one that are followed from it.
        correction_ease: frames at each end of a solved run that are eased into what was there.
    """

    spacing_mm: float = 6.0
    search_mm: float = 12.0
    passes: int = 2
    half_window_px: int = 6
    half_window_coarse_px: int = 4
    bending_coarse_mm: float = 4.0
    bending_mm: float = 2.0
    min_cosine: float = 0.35
    min_correlation: float = 0.6
    search_stride: int = 3
    rotation_iterations: int = 2
    extrapolation: float = 0.7
    use_scan: bool = True
    follow_back: bool = False
    anchors: bool = True
    second_look: bool = True
    contact: bool = True
    features: bool = True
    second_reference: bool = False
    flow: Literal["cpu", "gpu"] = "cpu"
    correction_reach: int = 6
    correction_ease: int = 3

    def __post_init__(self) -> None:
        check_ranges(
            "track", self, spacing_mm=(0.2, 100.0), search_mm=(0.1, 50.0), passes=(1, 10),
            half_window_px=(3, 20), half_window_coarse_px=(3, 20),
            bending_coarse_mm=(0.05, 100.0), bending_mm=(0.05, 100.0), min_cosine=(0.05, 0.95),
            min_correlation=(0.0, 0.99), search_stride=(1, 100), rotation_iterations=(1, 10),
            extrapolation=(0.0, 1.0), correction_reach=(0, 1000), correction_ease=(0, 100),
        )  # fmt: skip
