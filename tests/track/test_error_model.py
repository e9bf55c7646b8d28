"""The error model: what grows likely errors, distances along the skin, percentiles of mixtures."""

from __future__ import annotations

import numpy as np
import pytest

from capture.errors import SettingsError
from recon.mesh import Mesh
from track.error_model import (
    FITTED,
    TERMS,
    ErrorModel,
    SkinGraph,
    combined,
    error_terms,
    frame_error,
    likely_errors,
)
from track.evidence import FrameEvidence

SIDE, STEP_MM, MM_PER_PX = 15, 4.0, 0.3


def _sheet() -> Mesh:
    """A flat sheet of 15 x 15 vertices, 4 mm apart."""
    column, row = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    vertices = STEP_MM * np.stack([column, row, 0 * row], axis=-1).reshape(-1, 3).astype(float)
    index = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)
    return Mesh(vertices, quads.reshape(-1, 4).astype(np.int32))


def _told(**changes: float) -> FrameEvidence:
    """Evidence of a sheet that six of six views found well."""
    usual = {
        "residual_px": 0.05, "reprojection_px": 0.06, "correlation": 0.96, "views": 6.0,
        "views_open": 6.0, "information": 2500.0, "agreement": 0.9, "motion_mm": 0.02,
        "misfit_mm": 0.01,
    } | changes  # fmt: skip
    count = SIDE * SIDE
    blank = FrameEvidence.nothing(count, 6).arrays()
    full = {key: np.full(count, value, np.float32) for key, value in usual.items()}
    return FrameEvidence(**{**blank, **full})


def _likely(told: FrameEvidence, deformed_mm: float = 3.0) -> np.ndarray:
    mesh = _sheet()
    still = np.stack([mesh.vertices, mesh.vertices + [0.0, 0.0, deformed_mm]]).astype(np.float32)
    blank = FrameEvidence.nothing(len(mesh.vertices), 6)
    return likely_errors(mesh, still, [blank, told], MM_PER_PX)[1]


def test_good_evidence_is_a_tenth_of_a_pixel() -> None:
    assert 0.005 < float(np.median(_likely(_told()))) < 0.06


@pytest.mark.parametrize(
    ("worse", "times"),
    [
        ({"motion_mm": 1.0}, 10.0),
        ({"misfit_mm": 1.0, "reprojection_px": 2.0}, 10.0),
        ({"views": 2.0}, 1.1),
        ({"views": 0.0, "information": 0.0, "motion_mm": np.nan, "misfit_mm": np.nan}, 30.0),
    ],
)
def test_worse_evidence_makes_larger_errors_likely(worse: dict[str, float], times: float) -> None:
    usual = float(np.median(_likely(_told())))
    assert float(np.median(_likely(_told(**worse)))) > times * usual


def test_skin_that_was_not_found_is_worse_the_farther_and_the_more_deformed() -> None:
    told = _told()
    views = told.views.copy().reshape(SIDE, SIDE)
    views[:, 5:] = 0.0
    patched = FrameEvidence(**{**told.arrays(), "views": views.ravel()})
    near, far = (_likely(patched, mm).reshape(SIDE, SIDE)[7] for mm in (1.0, 5.0))
    assert (np.diff(far[5:12]) > 0.0).all()
    assert (far[6:] > near[6:]).all()
    assert far[2] < 0.2 * far[12]


def test_the_first_frame_is_the_neutral_itself() -> None:
    mesh = _sheet()
    blank = FrameEvidence.nothing(len(mesh.vertices), 6)
    still = np.stack([mesh.vertices, mesh.vertices]).astype(np.float32)
    assert not likely_errors(mesh, still, [blank, blank], MM_PER_PX)[0].any()


def test_terms_are_never_negative_or_undefined() -> None:
    mesh = _sheet()
    graph = SkinGraph(mesh.vertices, mesh.triangles)
    blank = FrameEvidence.nothing(len(mesh.vertices), 6)
    for told in (blank, _told(), _told(correlation=np.nan, motion_mm=np.nan)):
        terms = error_terms(graph, told, np.ones(len(mesh.vertices)), MM_PER_PX)
        assert terms.mm.shape == (len(TERMS), len(mesh.vertices))
        assert np.isfinite(terms.mm).all()
        assert (terms.mm >= 0.0).all()
        assert (combined(terms, FITTED) >= 0.0).all()


def test_reach_is_the_distance_along_edges() -> None:
    mesh = _sheet()
    graph = SkinGraph(mesh.vertices, mesh.triangles)
    found = np.zeros(len(mesh.vertices), np.bool_)
    found[:SIDE] = True  # the first row
    expected = np.minimum(STEP_MM * np.arange(SIDE), 40.0)
    assert graph.reach(found).reshape(SIDE, SIDE)[:, 7] == pytest.approx(expected)
    assert graph.reach(~found | True).max() == 0.0
    assert graph.reach(found & False).min() == 40.0


def test_means_around_pass_over_gaps() -> None:
    mesh = _sheet()
    graph = SkinGraph(mesh.vertices, mesh.triangles)
    values = np.full(len(mesh.vertices), 2.0)
    values[::3] = np.nan
    assert graph.around(values, 2) == pytest.approx(2.0)
    assert np.isnan(graph.around(np.full(len(values), np.nan), 2)).all()


def test_frame_error_is_the_percentile_of_the_mixture() -> None:
    rng = np.random.default_rng(3)
    model = ErrorModel(shares=FITTED.shares, haste=0.0, spread=0.6)
    likely = np.where(rng.random(4000) < 0.9, 0.03, 0.8)
    drawn = likely[:, None] * np.exp(0.6 * rng.normal(size=(4000, 200)))
    assert frame_error(likely, model) == pytest.approx(np.percentile(drawn, 95), rel=0.02)
    assert frame_error(5.0 * likely, model) == pytest.approx(5.0 * frame_error(likely, model))
    assert np.isnan(frame_error(np.zeros(0)))


def test_a_model_has_a_share_for_each_term() -> None:
    with pytest.raises(SettingsError, match="one of each of triangulation, reprojection"):
        ErrorModel(shares=(1.0, 2.0), haste=0.0, spread=0.5)
