"""Evidence of a round: what samples, neighbours and views say, by vertex and by view."""

from __future__ import annotations

import numpy as np
import pytest

from capture.arrays import Floats, Ints32
from capture.errors import ShapeError
from track.evidence import FrameEvidence, ViewMatches, blended_evidence, frame_evidence
from track.lift import Lifted, Observations, merged, triangulate
from track.surface_samples import SurfaceSamples

NAMES = ("front", "left", "right", "gone")
COUNT = 12


def _samples() -> SurfaceSamples:
    """One sample on each of 12 vertices; a thirteenth vertex has none."""
    corners = np.stack([np.arange(COUNT), np.full(COUNT, 12), np.full(COUNT, 12)], axis=1)
    return SurfaceSamples(
        triangle=np.arange(COUNT, dtype=np.int32),
        corners=corners.astype(np.int32),
        barycentric=np.tile([1.0, 0.0, 0.0], (COUNT, 1)),
    )


def _jacobian(yaw: float) -> Floats:
    """A camera at some yaw: 4 px a mm across its axis."""
    return 4.0 * np.array([[np.cos(yaw), 0.0, -np.sin(yaw)], [0.0, 1.0, 0.0]])


def _matches(motion: Floats, yaw: float, late_px: float = 0.0) -> ViewMatches:
    which: Ints32 = np.arange(COUNT, dtype=np.int32)
    jacobian = np.tile(_jacobian(yaw), (COUNT, 1, 1))
    offset = np.einsum("lij,lj->li", jacobian, motion) + [0.0, late_px]
    seen = Observations(
        sample=which,
        offset=offset,
        jacobian=jacobian,
        information=np.tile([9.0, 0.0, 9.0], (COUNT, 1)),
    )
    return ViewMatches(
        seen=which,
        correlation=0.9,
        observations=seen,
        believed=np.full(COUNT, 0.95),
        second=np.zeros(COUNT, np.bool_),
    )


def _told(late_px: float = 0.0, kept: float = 1.0) -> FrameEvidence:
    """Three views that agree on a motion of 1 mm; the solve follows a share of it."""
    motion = np.tile([0.6, 0.0, 0.8], (COUNT, 1))
    views = {
        "front": _matches(motion, 0.0),
        "left": _matches(motion, -0.7),
        "right": _matches(motion, 0.7, late_px),
    }
    parts = merged([matches.observations for matches in views.values()])
    lifted = triangulate(parts, COUNT, 0.7, 1.0)
    solved = (np.full(COUNT, 0.5), kept * lifted.motion)
    return frame_evidence(_samples(), COUNT + 1, views, NAMES, lifted, solved)


def test_views_that_agree_leave_nothing_over() -> None:
    told = _told()
    assert told.views[:COUNT] == pytest.approx(3.0)
    assert told.views_open[:COUNT] == pytest.approx(3.0)
    assert told.correlation[:COUNT] == pytest.approx(0.95)
    assert told.motion_mm[:COUNT] == pytest.approx(1.0, abs=0.03)
    assert told.misfit_mm[:COUNT] == pytest.approx(0.0, abs=1e-6)
    assert told.residual_px[:COUNT].max() < 0.05
    assert told.agreement[:COUNT] == pytest.approx(0.5)
    assert told.view_agreed.tolist() == [12.0, 12.0, 12.0, 0.0]
    assert told.mean_correlation() == pytest.approx(0.95)


def test_vertices_and_views_without_matches_have_no_numbers() -> None:
    told = _told()
    assert np.isnan([told.residual_px[12], told.motion_mm[12], told.correlation[12]]).all()
    assert told.views[12] == told.information[12] == 0.0
    assert told.view_seen[3] == 0.0
    assert np.isnan(told.view_correlation[3])
    assert np.isnan(told.view_offset_px[3]).all()


def test_what_the_solve_does_not_follow_is_misfit_and_reprojection() -> None:
    told = _told(kept=0.5)
    assert told.misfit_mm[:COUNT] == pytest.approx(0.5, abs=0.02)
    # 0.3 mm across the front view and 0.4 mm in depth: 1.2 px there, and as seen from the sides
    expected = np.mean([np.linalg.norm(_jacobian(yaw) @ [0.3, 0.0, 0.4]) for yaw in (0, -0.7, 0.7)])
    assert told.reprojection_px[:COUNT] == pytest.approx(expected, rel=0.03)


def test_a_view_apart_is_told_with_its_side() -> None:
    told = _told(late_px=3.0)
    assert told.view_agreed[2] == 0.0
    assert told.views[:COUNT].max() < 3.0
    assert told.view_offset_px[2, 1] > 1.5
    assert abs(told.view_offset_px[0, 1]) < 0.7


def test_blends_lie_between_and_gaps_are_filled() -> None:
    one, other = _told(kept=0.5), _told(kept=1.0)
    share = np.linspace(0.0, 1.0, COUNT + 1)
    mixed = blended_evidence(one, other, share)
    expected = (1.0 - share[:COUNT]) * one.misfit_mm[:COUNT]
    assert mixed.misfit_mm[:COUNT] == pytest.approx(expected, abs=1e-5)
    blank = FrameEvidence.nothing(COUNT + 1, len(NAMES))
    filled = blended_evidence(blank, one, np.full(COUNT + 1, 0.5))
    assert filled.misfit_mm[:COUNT] == pytest.approx(one.misfit_mm[:COUNT])


def test_shapes_that_do_not_fit_are_refused() -> None:
    blank = FrameEvidence.nothing(5, 2)
    with pytest.raises(ShapeError, match=r"views: expected shape \(V\) with V = 5"):
        FrameEvidence(**{**blank.arrays(), "views": np.zeros(4, np.float32)})


def test_lifted_without_views_is_no_evidence() -> None:
    lifted = Lifted(
        motion=np.zeros((COUNT, 3)),
        information=np.zeros(COUNT),
        views=np.zeros(COUNT, np.int64),
        residual_px=np.full(COUNT, np.nan),
    )
    solved = (np.ones(COUNT), np.zeros((COUNT, 3)))
    told = frame_evidence(_samples(), COUNT + 1, {}, NAMES, lifted, solved)
    assert np.isnan(told.motion_mm).all()
    assert not told.agreement.any()
    assert told.mean_correlation() == 0.0
