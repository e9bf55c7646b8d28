"""The check with board poses that a solve has not seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations

_PHASE = 3  # the poses left out are every k-th, from this one


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOut:
    """How poses that a solve has not seen fit it, only their board pose being refitted.

    Attributes:
        poses: indices of the poses left out; empty when the check was not made.
        training_px: per-coordinate rms of the poses that were solved for.
        held_out_px: per-coordinate rms of those left out.
        remark: why the check was not made, or "".
    """

    poses: tuple[int, ...]
    training_px: float
    held_out_px: float
    remark: str = ""

    @property
    def ratio(self) -> float:
        """Held-out over training rms; NaN when the check was not made."""
        return self.held_out_px / self.training_px if self.poses else float("nan")


def held_out(
    state: ArrayState,
    used: BoardObservations,
    adjust: Callable[[ArrayState, BoardObservations], ArrayState],
    refit: Callable[[ArrayState, BoardObservations], ArrayState],
    share: float,
    least_views: int,
) -> HeldOut:
    """Solve again without every k-th pose, from the answer, and refit only those poses to it.

    Args:
        state: the whole solution.
        used: the sightings it used.
        adjust: solves everything from a start and sightings.
        refit: finds board poses alone.
        share: fraction of the poses to leave out; 0 makes no check.
        least_views: views every device must keep.
    """
    none = float("nan")
    if share == 0:
        return HeldOut(poses=(), training_px=none, held_out_px=none, remark="switched off")
    step = max(2, round(1.0 / share))
    poses = np.unique(used.pose)
    left = poses[min(_PHASE, step - 1) :: step]
    out = np.isin(used.pose, left)
    training, test = used.select(~out), used.select(out)
    if len(left) == 0 or ((training.view_counts() > 0).sum(axis=1) < least_views).any():
        return HeldOut(
            poses=(), training_px=none, held_out_px=none, remark="too few poses to leave any out"
        )
    found = adjust(state, training)
    again = refit(found, test)
    return HeldOut(
        poses=tuple(left.tolist()),
        training_px=_rms(found.residuals(training)),
        held_out_px=_rms(again.residuals(test)),
    )


def _rms(residuals: Floats) -> float:
    return float(np.sqrt(np.nanmean(residuals**2)))
