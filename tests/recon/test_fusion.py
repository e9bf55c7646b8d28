"""Fusion of depth views: exact depth maps of a known surface, with lies mixed in."""

import numpy as np
import pytest

from capture.errors import SettingsError
from recon.fusion import DepthView, FusionSettings, fuse, lift
from recon.rectify import rectification
from tests.synthetic_stereo import RADII_MM, distance, hit, ring

ARRAY = ring((-20.0, -7.0, 7.0, 20.0), (-8.0, 8.0), size=120)
PAIRS = ((0, 1), (1, 2), (2, 3), (4, 5), (5, 6), (6, 7))


def views(noise_px: float = 0.0) -> list[DepthView]:
    """True disparities of some pairs, with noise."""
    made = []
    for index, (first, second) in enumerate(PAIRS):
        geometry = rectification(ARRAY[first], ARRAY[second], np.zeros(3), 100.0)
        columns, rows = geometry.maps("left")
        points = hit(ARRAY[first], np.stack([columns.ravel(), rows.ravel()], 1).astype(np.float64))
        disparity = geometry.project(points)[:, 2]
        disparity += np.random.default_rng(index).normal(0, noise_px, disparity.shape)
        plane = disparity.reshape(columns.shape).astype(np.float32)
        made.append(DepthView(geometry, plane, np.full_like(plane, 0.05)))
    return made


def test_lifted_points_lie_on_the_surface_with_its_normals():
    points, normals, _ = lift(views()[0])
    np.testing.assert_allclose(distance(points.astype(np.float64)), 0.0, atol=2e-3)
    outward = points / RADII_MM**2
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    cosine = (normals * outward).sum(axis=1)
    assert np.nanmedian(cosine) > 0.9995
    facing = (outward * (ARRAY[0].centre - points)).sum(axis=1) > 0
    assert (cosine[facing & np.isfinite(cosine)] > 0).all()


def test_averaging_over_pairs_beats_the_noise_of_one():
    noisy = views(noise_px=0.2)
    raw = distance(lift(noisy[1])[0].astype(np.float64))
    fused = fuse(noisy, FusionSettings())
    assert np.std(distance(fused.positions.astype(np.float64))) < 0.5 * np.std(raw)
    assert fused.agreement_mm[0] == pytest.approx(np.std(raw), rel=0.6)


def test_what_only_one_pair_claims_where_others_see_through_is_dropped():
    honest = views()
    lying = honest[1].disparity.copy()
    lying[40:60, 40:60] += 6.0  # nearer by several mm
    with_lie = [*honest]
    with_lie[1] = DepthView(honest[1].geometry, lying, honest[1].sigma_px)
    assert np.abs(distance(lift(with_lie[1])[0].astype(np.float64))).max() > 5.0
    fused = fuse(with_lie, FusionSettings())
    assert np.abs(distance(fused.positions.astype(np.float64))).max() < 0.3


def test_support_counts_pairs_and_raises_confidence():
    fused = fuse(views(), FusionSettings())
    assert fused.support.max() <= len(PAIRS)
    low, high = fused.support <= 2, fused.support >= 5
    assert fused.confidence[high].mean() > fused.confidence[low].mean()
    np.testing.assert_allclose(np.linalg.norm(fused.normals, axis=1), 1.0, atol=1e-5)


def test_threads_do_not_change_a_byte():
    made = views(noise_px=0.1)
    one, four = (fuse(made, FusionSettings(), workers=n) for n in (1, 4))
    assert one.positions.tobytes() == four.positions.tobytes()
    assert one.confidence.tobytes() == four.confidence.tobytes()


def test_a_setting_out_of_range_is_named():
    with pytest.raises(SettingsError, match="agree_px: expected"):
        FusionSettings(agree_px=-1.0)
