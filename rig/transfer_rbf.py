"""Shapes carried onto an actor's neutral by a smooth warp of space, instead of by gradients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator

from capture.arrays import Floats, Ints, check_finite, check_shape
from capture.errors import SolveError
from capture.settings import check_ranges
from rig.template import Template

_APART = 1e-6  # of the face's size: centres nearer to one another make the system singular


@dataclass(frozen=True, kw_only=True)
class WarpSettings:
    """How space is warped from one neutral to another.

    Attributes:
        centres: vertices that the warp meets exactly, spread evenly.
        tolerance: of each shape's extent, below which the template's vertex counts as static.
    """

    centres: int = 400
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        check_ranges("warp", self, centres=(4, 5000), tolerance=(0.0, 0.5))


def transfer_shapes_rbf(
    template: Template, neutral: Floats, settings: WarpSettings | None = None
) -> Floats:
    """Carry every shape of a template onto another neutral of the same topology by a warp.

    The warp w takes the template's neutral to the actor's at a few hundred vertices and is smooth
    between: an affine map and one function phi(r) = r a centre, biharmonic in space. A shape's
    displacement is `w(neutral + d) - w(neutral)`. It needs no mesh, so that seams and loose parts
    do not matter; against gradients it lets a shape's size follow the face's local size in all
    directions, and does not keep lids and lips in touch.

    Args:
        template: the artist's rig.
        neutral: (V, 3) the actor's neutral, in the template's place and axes, mm.
        settings: of the warp.

    Returns:
        (B, V, 3) displacements from `neutral`, mm; exactly zero at static vertices.

    Raises:
        SolveError: when fewer than four vertices are apart, or all lie in one plane.

    References:
        Ribera et al. 2017, section 5 (thin-plate warp of the shapes); Carr et al. 2001,
        "Reconstruction and representation of 3D objects with radial basis functions", section 2.
    """
    check_shape(template=(template.neutral, "V 3"), neutral=(neutral, "V 3"))
    check_finite(neutral=neutral)
    chosen = settings or WarpSettings()
    warp = _warp(template.neutral, neutral, chosen.centres)
    support = template.support(chosen.tolerance)
    deltas = np.zeros_like(template.deltas)
    for index, delta in enumerate(template.deltas):
        moved = support[index]
        if moved.any():
            rest = template.neutral[moved]
            deltas[index, moved] = warp(rest + delta[moved]) - warp(rest)
    return deltas


def spread_vertices(points: Floats, count: int) -> Ints:
    """Up to `count` of points (N, 3), each as far as can be from those before it.

    References:
        Gonzalez 1985, "Clustering to minimize the maximum intercluster distance".
    """
    check_shape(points=(points, "N 3"))
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    size = float(np.ptp(points, axis=0).max())
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    away = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        farthest = int(away.argmax())
        if away[farthest] <= _APART * size:
            break
        chosen.append(farthest)
        away = np.minimum(away, np.linalg.norm(points - points[farthest], axis=1))
    return np.array(chosen, dtype=np.int64)


def _warp(source: Floats, target: Floats, count: int) -> RBFInterpolator:
    centres = spread_vertices(source, count)
    spread = source[centres] - source[centres].mean(axis=0)
    extent = np.linalg.svd(spread, compute_uv=False)
    if len(centres) < 4 or extent[2] <= _APART * extent[0]:
        raise SolveError(
            f"warp: {len(centres)} vertices apart from one another in one plane; it takes four "
            "that span space"
        )
    return RBFInterpolator(source[centres], target[centres], kernel="linear", degree=1)
