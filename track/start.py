"""Where a frame's registration begins: of several guesses, by region, what the images fit.

The last mesh alone is a poor guess for skin that was lost, or that moves fast. Others cost little:
the neutral, moved with the head, since a face comes back to it; the last mesh with its deformation
going on. Every guess is judged by what it shows in place against the reference,
at the coarsest level and without search. So a region that was lost is found when it returns.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from capture.arrays import Floats, Ints
from track.flow import search_flow
from track.guide import GuidedView
from track.laplacian import Constraints, LaplacianDeformer
from track.reference import ReferenceLevel
from track.surface_samples import SurfaceSamples

_MARGIN = 0.1  # mean correlation by which another guess must beat the first
_FITS = 0.6  # mean correlation that another guess must reach: less is chance when none is right
_UNSURE = 0.1  # weight of samples that fit nowhere: they stay by the first guess
_MIN_VIEWS = 2
_ROUNDS = 2  # of averaging over the surface: windows of single samples chance to fit
_DATA_WEIGHT = 10.0


def place_scores(level: ReferenceLevel, seen: Sequence[GuidedView], count: int) -> Floats:
    """How a view correlates with its reference where each of K guesses puts the samples.

    Args:
        level: the view's reference.
        seen: the frame's image, guided by each guess.
        count: N samples in all.

    Returns:
        (K, N) correlation; NaN where the view does not see the sample.
    """
    scores = np.full((len(seen), count), np.nan)
    every = np.ones(len(level.samples), np.bool_)
    for k, view in enumerate(seen):
        found = search_flow(level, view, every, 0).correlation
        scores[k, level.samples] = np.where(found > -1.0, found, np.nan)
    return scores


def blended_start(
    starts: Sequence[Floats],
    scores: Floats,
    samples: SurfaceSamples,
    neighbours: sparse.csr_matrix,
    deformer: LaplacianDeformer,
) -> Floats:
    """Put together a mesh from the guesses that fit best, region by region.

    Args:
        starts: K meshes (V, 3), world mm; the first stays wherever none is clearly better.
        scores: (K, N, C) correlation of each sample in each view; NaN where not seen.
        samples: N points of the surface.
        neighbours: (N, N) which samples lie beside each other on the surface.
        deformer: of the mesh; it joins the regions and carries what no view tells of.

    Returns:
        (V, 3) world mm; the first guess itself when none beats it anywhere.
    """
    fit = _regional(scores, neighbours)
    rival = np.where(fit > _FITS, fit - _MARGIN, -1.0)
    rival[0] = fit[0]
    choice: Ints = rival.argmax(axis=0)
    if not (choice > 0).any():
        return starts[0]
    trust = np.maximum(np.take_along_axis(fit, choice[None], axis=0)[0] ** 2, _UNSURE)
    told = np.flatnonzero(fit.any(axis=0))
    chosen = samples.select(told.astype(np.int32))
    places = np.stack([chosen.points(start) for start in starts])
    constraints = Constraints(
        corners=chosen.corners,
        barycentric=chosen.barycentric,
        targets=places[choice[told], np.arange(len(told))],
        weights=trust[told],
    )
    return deformer.solve(
        constraints, start=starts[0], data_weight=_DATA_WEIGHT, rotation_iterations=2
    )


def _regional(scores: Floats, neighbours: sparse.csr_matrix) -> Floats:
    """Mean correlation (K, N) around each sample; 0 where fewer than two views tell."""
    views = np.isfinite(scores).sum(axis=2)
    told = views >= _MIN_VIEWS
    mean = np.where(told, np.nansum(scores, axis=2) / np.maximum(views, 1), 0.0)
    known = told.any(axis=0).astype(np.float64)  # a guess that hides a sample does not fit there
    for _ in range(_ROUNDS):
        total = neighbours @ known + known
        mean = (neighbours @ (known * mean).T).T + known * mean
        mean /= np.maximum(total, 1e-9)
        known = (total > 0).astype(np.float64)
    return mean
