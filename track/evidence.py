"""What the last round of a frame's registration measured: the evidence that its quality is told by.

By vertex, what the samples around it found; by view, how many of its matches agreed with the
others. The error model (`track.error_model`) turns it into millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from capture.arrays import Bools, Floats, Floats32, Ints32, check_shape
from track.guide import GuidedView
from track.lift import Lifted, Observations, merged
from track.reference import ReferenceLevel
from track.surface_samples import SurfaceSamples

_AGREES_PX = 0.7  # a match no farther than this from the triangulated point agrees with it
_MEASURED = ("residual_px", "reprojection_px", "correlation", "motion_mm", "misfit_mm")
_COUNTED = ("views", "views_open", "information", "agreement", "leaning")
_VERTEX = (*_MEASURED, *_COUNTED)
_TALLIES = ("view_seen", "view_believed", "view_sum", "view_agreed")
_JUDGED = ("view_correlation", "view_residual_px")
_VIEW = (*_TALLIES, *_JUDGED)
EVIDENCE_KEYS: tuple[str, ...] = (*_VERTEX, *_VIEW, "view_offset_px")


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameEvidence:
    """Evidence of one frame: V vertices, C views of the take, all float32.

    Attributes:
        residual_px: (V,) distance of agreeing matches from the triangulated points; NaN: none.
        reprojection_px: (V,) distance of the same matches from the solved mesh; NaN: none.
        correlation: (V,) mean NCC of believed matches; NaN where there is none.
        views: (V,) how many agreed on the place.
        views_open: (V,) how many could have: what the mesh lets them see, here and in the
            reference. Skin is seen where two or more can.
        information: (V,) mm^-2 of the triangulation; 0: none.
        agreement: (V,) 0..1, how well the samples fit their neighbours' motions; 0: none.
        motion_mm: (V,) what the last round still found to move: convergence. NaN: not measured.
        leaning: (V,) 0..1, share of the matches that were to another frame than the neutral.
        misfit_mm: (V,) how far the solved mesh stayed from the triangulated points. NaN likewise.
        view_seen: (C,) samples the view could have matched; 0 for a view without this frame.
        view_believed: (C,) matches that correlated and were near enough.
        view_sum: (C,) sum of the NCC of these.
        view_agreed: (C,) matches that agreed with the other views.
        view_correlation: (C,) mean NCC of all its matches, believed or not; NaN: no view.
        view_residual_px: (C,) median distance of believed matches from the points; NaN: none.
        view_offset_px: (C, 2) median of match minus point; NaN: none. A device that is late
            shows all skin behind, so its offsets point one way, others' average out.
    """

    residual_px: Floats32
    reprojection_px: Floats32
    correlation: Floats32
    views: Floats32
    views_open: Floats32
    information: Floats32
    agreement: Floats32
    motion_mm: Floats32
    misfit_mm: Floats32
    leaning: Floats32
    view_seen: Floats32
    view_believed: Floats32
    view_sum: Floats32
    view_agreed: Floats32
    view_correlation: Floats32
    view_residual_px: Floats32
    view_offset_px: Floats32

    def __post_init__(self) -> None:
        check_shape(
            **{key: (getattr(self, key), "V") for key in _VERTEX},
            **{key: (getattr(self, key), "C") for key in _VIEW},
            view_offset_px=(self.view_offset_px, "C 2"),
        )

    @classmethod
    def nothing(cls, vertices: int, views: int) -> FrameEvidence:
        """The evidence of a frame that nothing was measured in, or of the reference itself."""
        none, zero = np.zeros(vertices, np.float32), np.zeros(views, np.float32)
        blank = dict.fromkeys(_COUNTED, none) | dict.fromkeys(_TALLIES, zero)
        blank |= {key: np.full(vertices, np.nan, np.float32) for key in _MEASURED}
        blank |= {key: np.full(views, np.nan, np.float32) for key in _JUDGED}
        return cls(view_offset_px=np.full((views, 2), np.nan, np.float32), **blank)

    def arrays(self) -> dict[str, Floats32]:
        """The arrays by name, in the order of the attributes."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def mean_correlation(self) -> float:
        """Mean NCC of all believed matches of all views; 0 without any."""
        return float(self.view_sum.sum() / max(float(self.view_believed.sum()), 1.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewMatches:
    """One view's share of a round.

    Attributes:
        seen: (S,) samples that it sees in the reference and, by the mesh, in the frame.
        correlation: mean NCC over them; NaN of none.
        observations: its believed matches.
        believed: (L,) the NCC of each of these.
        second: (L,) whether it was matched to another frame than the neutral.
    """

    seen: Ints32
    correlation: float
    observations: Observations
    believed: Floats
    second: Bools

    def at(self, share: float) -> ViewMatches:
        """The same of a second reference, at a share of their information."""
        return replace(
            self, observations=self.observations.at(share), second=np.ones_like(self.second)
        )


def view_matches(
    level: ReferenceLevel, view: GuidedView, correlation: Floats, believed: Observations
) -> ViewMatches:
    """One view's matches: the NCC (M,) of all its samples, and those of them that were believed."""
    column, row = level.centres.T
    height, width = view.solid.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    shown = inside & (view.solid[np.where(inside, row, 0), np.where(inside, column, 0)] > 0)
    tried = shown & (correlation > -1.0)
    return ViewMatches(
        seen=level.samples[shown],
        correlation=float(correlation[tried].mean()) if tried.any() else float("nan"),
        observations=believed,
        believed=correlation[np.searchsorted(level.samples, believed.sample)],
        second=np.zeros(len(believed.sample), np.bool_),
    )


def preferred(one: ViewMatches, other: ViewMatches, margin: float) -> ViewMatches:
    """Of a view's matches to two references, sample by sample the first or what beats it.

    Args:
        one: its matches to the neutral.
        other: to another frame.
        margin: by how much the second must correlate more.
    """
    count = 1 + max(int(part.observations.sample.max(initial=0)) for part in (one, other))
    first, second = np.full(count, -1.0), np.full(count, -1.0)
    first[one.observations.sample] = one.believed
    second[other.observations.sample] = other.believed
    wins = second > first + margin
    parts = []
    for part, keep in ((one, ~wins), (other, wins)):
        parts.append((part, np.flatnonzero(keep[part.observations.sample])))
    return replace(
        one,
        seen=np.union1d(one.seen, other.seen).astype(np.int32),
        observations=merged([part.observations.chosen(kept) for part, kept in parts]),
        believed=np.concatenate([part.believed[kept] for part, kept in parts]),
        second=np.concatenate([part.second[kept] for part, kept in parts]),
    )


def frame_evidence(
    samples: SurfaceSamples,
    vertex_count: int,
    views: Mapping[str, ViewMatches],
    names: Sequence[str],
    lifted: Lifted,
    solved: tuple[Floats, Floats],
) -> FrameEvidence:
    """Gather what one round measured, by vertex and by view.

    Args:
        samples: N points of the surface.
        vertex_count: V.
        views: matches of the views that had the frame, by name.
        names: all views of the take, in its order.
        lifted: the round's motions of the samples.
        solved: (N,) agreement of each sample with its neighbours, 0..1, and (N, 3) how each was
            moved by the solve, mm.
    """
    agreement, moved = solved
    found = lifted.views > 0
    count = len(samples)
    total, times, able, away, near, leaning = np.zeros((6, count))
    for matches in views.values():
        seen = matches.observations
        total += np.bincount(seen.sample, matches.believed, minlength=count)
        times += np.bincount(seen.sample, minlength=count)
        leaning += np.bincount(seen.sample, matches.second, minlength=count)
        able[matches.seen] += 1.0
        agrees = _distance(seen, lifted.motion) < _AGREES_PX
        away += np.bincount(seen.sample, agrees * _distance(seen, moved), minlength=count)
        near += np.bincount(seen.sample, agrees, minlength=count)
    correlation = np.divide(total, times, out=np.full(count, np.nan), where=times > 0)
    length = np.linalg.norm(lifted.motion, axis=1)
    misfit = np.linalg.norm(lifted.motion - moved, axis=1)
    measured = {
        "residual_px": lifted.residual_px,
        "reprojection_px": np.divide(away, near, out=np.full(count, np.nan), where=near > 0),
        "correlation": correlation,
        "motion_mm": np.where(found, length, np.nan),
        "misfit_mm": np.where(found, misfit, np.nan),
    }
    counted = {
        "views": lifted.views.astype(np.float64),
        "views_open": able,
        "information": lifted.information,
        "agreement": np.where(found, agreement, 0.0),
        "leaning": leaning / np.maximum(times, 1.0),
    }
    vertex = {key: _around(samples, value, vertex_count) for key, value in measured.items()}
    vertex |= {
        key: np.nan_to_num(_around(samples, value, vertex_count)) for key, value in counted.items()
    }
    return FrameEvidence(**vertex, **_by_view(views, names, lifted))


def blended_evidence(one: FrameEvidence, other: FrameEvidence, share: Floats) -> FrameEvidence:
    """Evidence of a frame whose mesh was put together from two solves.

    Args:
        one: of the first solve.
        other: of the second.
        share: (V,) 0..1 of the second in each vertex. Where one of them has no number, the other's
            is taken; numbers of views are those of the solve with the larger share over all.
    """
    check_shape(share=(share, "V"), one=(one.views, "V"), other=(other.views, "V"))
    mixed: dict[str, Floats32] = {}
    for key in _VERTEX:
        a, b = getattr(one, key), getattr(other, key)
        both = (1.0 - share) * np.nan_to_num(a) + share * np.nan_to_num(b)
        value = np.where(np.isnan(a), b, np.where(np.isnan(b), a, both))
        mixed[key] = value.astype(np.float32)
    main = other if float(share.mean()) > 0.5 else one
    mixed |= {key: getattr(main, key) for key in (*_VIEW, "view_offset_px")}
    return FrameEvidence(**mixed)


def _around(samples: SurfaceSamples, values: Floats, count: int) -> Floats32:
    """Mean (V,) of the samples' numbers (N,) around each vertex; NaN where there is none."""
    known = np.isfinite(values)
    corners = samples.corners[known].ravel()
    share = samples.barycentric[known].ravel()
    total = np.bincount(corners, share, minlength=count)
    mixed = np.bincount(corners, share * np.repeat(values[known], 3), minlength=count)
    mean = np.divide(mixed, total, out=np.full(count, np.nan), where=total > 1e-9)
    rounded: Floats32 = mean.astype(np.float32)
    return rounded


def _away(seen: Observations, motion: Floats) -> Floats:
    """Where matches lie from their samples (L, 2) px, once these have moved by (N, 3) mm."""
    away: Floats = seen.offset - np.einsum("lij,lj->li", seen.jacobian, motion[seen.sample])
    return away


def _distance(seen: Observations, motion: Floats) -> Floats:
    distance: Floats = np.linalg.norm(_away(seen, motion), axis=1)
    return distance


def _by_view(
    views: Mapping[str, ViewMatches], names: Sequence[str], lifted: Lifted
) -> dict[str, Floats32]:
    rows = {key: np.zeros(len(names), np.float32) for key in _TALLIES}
    rows |= {key: np.full(len(names), np.nan, np.float32) for key in _JUDGED}
    offset = np.full((len(names), 2), np.nan, np.float32)
    for place, name in enumerate(names):
        if name not in views:
            continue
        matches = views[name]
        seen = matches.observations
        rows["view_seen"][place] = len(matches.seen)
        rows["view_correlation"][place] = matches.correlation
        rows["view_believed"][place] = len(seen.sample)
        rows["view_sum"][place] = matches.believed.sum()
        if len(seen.sample) == 0:
            continue
        away = _away(seen, lifted.motion)
        distance = np.linalg.norm(away, axis=1)
        rows["view_agreed"][place] = (distance < _AGREES_PX).sum()
        rows["view_residual_px"][place] = np.median(distance)
        offset[place] = np.median(away, axis=0)
    return {**rows, "view_offset_px": offset}
