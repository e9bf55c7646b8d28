"""Lifting: flow of many views into one motion of each surface sample, by robust triangulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np

from capture.arrays import Floats, Ints, Ints32, check_shape

_ITERATIONS = 5


@dataclass(frozen=True, eq=False, kw_only=True)
class Observations:
    """Where views say that samples have moved to; L of them, in any order.

    Attributes:
        sample: (L,) int32 which of the N samples.
        offset: (L, 2) px, from the image of the sample's estimate to its match.
        jacobian: (L, 2, 3) px per mm of the projection at the estimate.
        information: (L, 3) xx, xy, yy of the inverse covariance of `offset`, px^-2.
    """

    sample: Ints32
    offset: Floats
    jacobian: Floats
    information: Floats

    def __post_init__(self) -> None:
        check_shape(
            sample=(self.sample, "L"),
            offset=(self.offset, "L 2"),
            jacobian=(self.jacobian, "L 2 3"),
            information=(self.information, "L 3"),
        )

    def chosen(self, which: Ints) -> Observations:
        """Some of them, by index."""
        return Observations(
            sample=self.sample[which],
            offset=self.offset[which],
            jacobian=self.jacobian[which],
            information=self.information[which],
        )

    def at(self, share: float) -> Observations:
        """The same at a share of their information."""
        return replace(self, information=share * self.information)


def merged(parts: Sequence[Observations]) -> Observations:
    """Observations of several views in one; none of none."""
    if not parts:
        return Observations(
            sample=np.zeros(0, np.int32),
            offset=np.zeros((0, 2)),
            jacobian=np.zeros((0, 2, 3)),
            information=np.zeros((0, 3)),
        )
    return Observations(
        sample=np.concatenate([part.sample for part in parts]),
        offset=np.concatenate([part.offset for part in parts]),
        jacobian=np.concatenate([part.jacobian for part in parts]),
        information=np.concatenate([part.information for part in parts]),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Lifted:
    """Motions of N samples.

    Attributes:
        motion: (N, 3) mm from the estimate; 0 where no view agrees.
        information: (N,) mm^-2, the harmonic mean of the three principal informations, prior
            included: 3 over the trace of the covariance.
        views: (N,) int64 how many views agree on it.
        residual_px: (N,) median distance between matches and the projected result; NaN for none.
    """

    motion: Floats
    information: Floats
    views: Ints
    residual_px: Floats


def triangulate(observations: Observations, count: int, scale_px: float, prior_mm: float) -> Lifted:
    """Triangulate every sample from its views, robustly.

    Minimises sum_l rho(|J_l x - o_l|) in each observation's metric plus |x|^2 / prior^2 by
    reweighted least squares with Geman and McClure's rho; the projection is linear over the
    millimetres that are left to move. The prior, weak beside any second view, keeps a sample that
    one view alone sees at its depth: it then moves across that view only.

    Args:
        observations: L matches.
        count: N.
        scale_px: the residual at which a match has lost three quarters of its weight.
        prior_mm: standard deviation of the prior.

    References:
        Geman and McClure 1987; Hartley and Sturm 1997 for triangulation in the image's metric.
    """
    order = np.argsort(observations.sample, kind="stable")
    starts = np.searchsorted(observations.sample[order], np.arange(count + 1))
    motion, information, views, residual = _triangulate(
        starts,
        observations.offset[order],
        observations.jacobian[order],
        observations.information[order],
        scale_px,
        1.0 / prior_mm**2,
    )
    return Lifted(motion=motion, information=information, views=views, residual_px=residual)


@numba.njit(cache=True, nogil=True)
def _triangulate(
    starts: Any, offset: Any, jacobian: Any, information: Any, scale: float, prior: float
) -> tuple[Any, Any, Any, Any]:
    count = len(starts) - 1
    motion = np.zeros((count, 3))
    strength = np.zeros(count)
    views = np.zeros(count, np.int64)
    residual = np.full(count, np.nan)
    for n in range(count):
        low, high = starts[n], starts[n + 1]
        if low == high:
            continue
        weight = np.ones(high - low)
        miss = np.empty(high - low)
        normal = np.empty((3, 3))
        right = np.empty(3)
        for _ in range(_ITERATIONS):
            _accumulate(low, high, offset, jacobian, information, weight, prior, normal, right)
            x, y, z, spread = _solve(normal, right)
            for k in range(low, high):
                one, two = jacobian[k, 0], jacobian[k, 1]
                u = one[0] * x + one[1] * y + one[2] * z - offset[k, 0]
                v = two[0] * x + two[1] * y + two[2] * z - offset[k, 1]
                miss[k - low] = np.sqrt(u * u + v * v)
                weight[k - low] = 1.0 / (1.0 + (miss[k - low] / scale) ** 2) ** 2
        agree = miss[weight > 0.25]
        views[n] = len(agree)
        if len(agree) == 0:
            continue
        motion[n, 0], motion[n, 1], motion[n, 2] = x, y, z
        residual[n] = np.median(agree)
        strength[n] = 3.0 / spread
    return motion, strength, views, residual


@numba.njit(cache=True)
def _solve(a: Any, b: Any) -> tuple[float, float, float, float]:
    """Solution of a symmetric 3 x 3 system, and the trace of the inverse."""
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    c11 = a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2]
    c12 = a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]
    c22 = a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]
    whole = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    x = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / whole
    y = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / whole
    z = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / whole
    return x, y, z, (c00 + c11 + c22) / whole


@numba.njit(cache=True)
def _accumulate(
    low: int,
    high: int,
    offset: Any,
    jacobian: Any,
    information: Any,
    weight: Any,
    prior: float,
    normal: Any,
    right: Any,
) -> None:
    """Normal equations of one sample."""
    for a in range(3):
        right[a] = 0.0
        for b in range(3):
            normal[a, b] = prior if a == b else 0.0
    for k in range(low, high):
        w = weight[k - low]
        xx, xy, yy = w * information[k, 0], w * information[k, 1], w * information[k, 2]
        for a in range(3):
            u = xx * jacobian[k, 0, a] + xy * jacobian[k, 1, a]
            v = xy * jacobian[k, 0, a] + yy * jacobian[k, 1, a]
            right[a] += u * offset[k, 0] + v * offset[k, 1]
            for b in range(3):
                normal[a, b] += u * jacobian[k, 0, b] + v * jacobian[k, 1, b]
