"""Likely error of tracked skin in millimetres, from what the tracker measured of itself.

Physics first: a vertex can be off by what its triangulation leaves open, by what the last round
still found to move, by what neighbours and stiffness kept it from, and, where nothing was found,
by a share of the deformation around it that grows with the distance along the surface to skin
that was. How much of each turns into error is fitted on takes with a known truth
(`tools/bench/fit_error_model.py`), and checked on others; see docs/tracking_quality.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.special import ndtr

from capture.arrays import Bools, Floats, Floats32, Ints32, check_shape
from capture.errors import SettingsError
from recon.mesh import Mesh
from track.evidence import FrameEvidence

_FOUND_VIEWS = 1.5  # mean of agreeing views around a vertex from which its place was found
_REACH_CAP_MM = 40.0  # skin farther than this from any that was found counts as this far
_HALFWAY_MM = 8.0  # along the surface: unfound skin here is off by half of what the far is
_ROUNDS = 3  # of averaging over joined vertices: windows are wider than triangles
_TAIL = 0.95  # share of seen skin whose error is below a frame's likely error
_TINY_MM = 1e-4
_LARGEST_MM = 30.0  # skin farther off is lost, by however much
TERMS = (
    "triangulation", "reprojection", "motion_around", "misfit", "doubt_around", "carried",
    "reach", "deformation",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ErrorModel:
    """How much of each term becomes error; see `error_terms`.

    Attributes:
        shares: of the terms, in their order: the median error is the root of the sum of squares
            of share times term.
        haste: by how much all of a frame is worse for each mm that it still moved everywhere.
        spread: standard deviation of the logarithm of true over likely error.
    """

    shares: tuple[float, ...]
    haste: float
    spread: float

    def __post_init__(self) -> None:
        if len(self.shares) != len(TERMS):
            raise SettingsError(
                f"shares: expected {len(TERMS)}, one of each of {', '.join(TERMS)}; "
                f"found {len(self.shares)}"
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class Terms:
    """What may turn into error in a frame.

    Attributes:
        mm: (K, V) by term and vertex, K as in `TERMS`; none below 0.
        unsettled_mm: mean motion of the last round over all skin that was found.
    """

    mm: Floats
    unsettled_mm: float


# Fitted by tools/bench/fit_error_model.py; docs/tracking_quality.md tells on which takes.
FITTED = ErrorModel(
    shares=(0.0251, 0.4245, 0.6887, 0.5622, 0.0072, 0.9268, 0.002, 0.0023),
    haste=1.7975,
    spread=0.621,
)


def likely_errors(
    neutral: Mesh,
    still: Floats32,
    evidence: Sequence[FrameEvidence],
    mm_per_px: float,
    *,
    model: ErrorModel | None = None,
) -> Floats32:
    """Likely error of every vertex in every frame: the true one is as likely above as below.

    Args:
        neutral: the reference.
        still: (F, V, 3) mm, the tracked mesh with the head motion taken out, in its place.
        evidence: of the F frames.
        mm_per_px: how much skin a pixel of the full images spans.
        model: the fitted one by default.

    Returns:
        (F, V) mm; 0 in the first frame, which is the neutral itself.
    """
    chosen = model or FITTED
    graph = SkinGraph(neutral.vertices, neutral.triangles)
    out = np.zeros(still.shape[:2], np.float32)
    for row in range(1, len(still)):
        deformed = np.linalg.norm(still[row] - still[0], axis=1).astype(np.float64)
        terms = error_terms(graph, evidence[row], deformed, mm_per_px)
        out[row] = np.clip(combined(terms, chosen), 0.0, _LARGEST_MM)
    return out


def error_terms(
    graph: SkinGraph, told: FrameEvidence, deformed_mm: Floats, mm_per_px: float
) -> Terms:
    """What may turn into error at each vertex of a frame.

    ::

        triangulation  standard deviation along an axis, from windows, correlation and angles
        reprojection   distance of agreeing matches from the mesh
        motion_around  what the last round still found to move, in the mean around
        misfit         how far the mesh stayed from the triangulated points
        doubt_around   share of the views that see it and do not agree, in the mean around, times
                       the deformation
        carried        of skin that was not found: deformation, the more the farther from found
        reach          of skin that was not found: distance along the surface to skin that was
        deformation    distance from the neutral, head motion taken out

    Args:
        graph: of the neutral.
        told: the frame's evidence.
        deformed_mm: (V,) distance of each vertex from the neutral, head motion taken out.
        mm_per_px: how much skin a pixel of the full images spans.
    """
    check_shape(deformed_mm=(deformed_mm, "V"), views=(told.views, "V"))
    found = told.views >= _FOUND_VIEWS
    moved = told.motion_mm.astype(np.float64)
    able = np.maximum(told.views_open, 1e-6)
    doubt = np.where(told.views_open < 0.5, 1.0, 1.0 - np.minimum(told.views / able, 1.0))
    sure = np.maximum(told.information.astype(np.float64), 1e-3)
    reach = np.where(found, 0.0, graph.reach(found))
    rows = {
        "triangulation": np.where(told.information > 0, sure**-0.5, 0.0),
        "reprojection": told.reprojection_px * mm_per_px,
        "motion_around": graph.around(moved, _ROUNDS),
        "misfit": told.misfit_mm,
        "doubt_around": graph.around(doubt, _ROUNDS) * deformed_mm,
        "carried": deformed_mm * reach / (reach + _HALFWAY_MM),
        "reach": reach,
        "deformation": deformed_mm,
    }
    terms = np.nan_to_num(np.stack([rows[name] for name in TERMS]).astype(np.float64))
    return Terms(mm=terms, unsettled_mm=_mean(moved[found]))


def combined(terms: Terms, model: ErrorModel) -> Floats:
    """Likely error (V,) mm of a frame's terms."""
    check_shape(terms=(terms.mm, f"{len(TERMS)} V"))
    shares = np.array(model.shares)[:, None]
    settled = np.sqrt(((shares * terms.mm) ** 2).sum(axis=0))
    likely: Floats = settled * (1.0 + model.haste * terms.unsettled_mm)
    return likely


def frame_error(likely_mm: Floats | Floats32, model: ErrorModel | None = None) -> float:
    """The error that 95 % of some skin stays below, from the likely errors of its N vertices.

    Errors are taken to scatter about the likely one by the model's log-normal law; the result is
    the 95th percentile of that mixture. NaN without vertices.
    """
    chosen = model or FITTED
    if len(likely_mm) == 0:
        return float("nan")
    centre = np.log(np.maximum(np.asarray(likely_mm, dtype=np.float64), _TINY_MM))
    low, high = float(centre.min()) - 6.0 * chosen.spread, float(centre.max()) + 6.0 * chosen.spread
    for _ in range(40):
        middle = 0.5 * (low + high)
        below = float(ndtr((middle - centre) / chosen.spread).mean())
        low, high = (middle, high) if below < _TAIL else (low, middle)
    return float(np.exp(0.5 * (low + high)))


def _mean(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else 0.0


class SkinGraph:
    """Distances along a mesh's edges, and the mean around each vertex.

    Args:
        vertices: (V, 3) the neutral, mm.
        triangles: (T, 3).
    """

    def __init__(self, vertices: Floats, triangles: Ints32) -> None:
        check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
        edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        edges = np.unique(np.sort(edges, axis=1), axis=0)
        self._edges = edges[edges[:, 0] != edges[:, 1]]
        self._count = len(vertices)
        one, two = self._edges.T
        self._lengths = np.maximum(np.linalg.norm(vertices[one] - vertices[two], axis=1), 1e-6)
        shape = (self._count, self._count)
        self._graph = sparse.csr_matrix((self._lengths, (one, two)), shape)
        ones = np.ones(len(one))
        joined = sparse.csr_matrix((ones, (one, two)), shape)
        self._joined = joined + joined.T + sparse.identity(self._count, format="csr")

    def reach(self, found: Bools) -> Floats:
        """Distance (V,) along the edges to the nearest found vertex, mm, at most 40."""
        check_shape(found=(found, "V"))
        out = np.full(self._count, _REACH_CAP_MM)
        if found.any():
            away = dijkstra(
                self._graph, directed=False, indices=np.flatnonzero(found), min_only=True,
                limit=_REACH_CAP_MM,
            )  # fmt: skip
            out = np.minimum(away, _REACH_CAP_MM)
        return out

    def around(self, values: Floats, rounds: int) -> Floats:
        """Values (V,) averaged over joined vertices, again and again; NaN has no say."""
        mean = values
        for _ in range(rounds):
            known = np.isfinite(mean).astype(np.float64)
            total = self._joined @ known
            mixed = self._joined @ np.nan_to_num(mean)
            mean = np.divide(mixed, total, out=np.full(self._count, np.nan), where=total > 0)
        return mean
