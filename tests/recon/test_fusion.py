"""Fusion of depth views: exact depth maps of a known surface, with lies mixed in."""

import numpy as np
import pytest

from capture.errors import SettingsError
from recon.consensus import consensus
from recon.fusion import REJECTIONS, DepthView, FusionSettings, _pack, fuse, lift
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


def test_the_compiled_consensus_is_the_plain_weighted_mean():
    made = views(noise_px=0.2)
    points, normals, sigma = lift(made[1], 7)
    good = np.isfinite(normals).all(axis=1)
    points, normals, sigma = points[good], normals[good], sigma[good]
    moved, _, support, *_ = consensus(points, normals, sigma, 1, _pack(made), 0.7)
    for n in range(0, len(points), 40):
        total, weight, count = 0.0, 0.0, 0
        for index, view in enumerate(made):
            column, row, expected = view.geometry.project(points[n : n + 1].astype(np.float64))[0]
            found = expected if index == 1 else _bilinear(view.disparity, column, row)
            ray = points[n].astype(np.float64) - view.geometry.left.centre
            if not abs(found - expected) <= 0.7 or normals[n] @ ray >= 0:
                continue
            reached = view.geometry.triangulate(np.array([[column, row, found]]))[0]
            offset = normals[n] @ (reached - points[n])
            depth = ray @ view.geometry.rotation[2]
            mm = (normals[n] @ ray) * depth / (view.geometry.focal_px * view.geometry.baseline_mm)
            trust = 1 / (mm**2 * (0.05**2 + 0.15**2))
            total, weight, count = total + trust * offset, weight + trust, count + 1
        assert support[n] == count
        np.testing.assert_allclose(moved[n], points[n] + total / weight * normals[n], atol=1e-3)


def _bilinear(plane: np.ndarray, column: float, row: float) -> float:
    i, j = int(np.floor(row)), int(np.floor(column))
    if i < 0 or j < 0 or i + 1 >= plane.shape[0] or j + 1 >= plane.shape[1]:
        return np.nan
    cut = plane[i : i + 2, j : j + 2].astype(np.float64)
    if not np.ptp(cut) < 2.0:
        return np.nan
    s, t = row - i, column - j
    return float(np.array([1 - s, s]) @ cut @ np.array([1 - t, t]))


def test_a_setting_out_of_range_is_named():
    with pytest.raises(SettingsError, match=r"fusion\.agree_px = .*: must be"):
        FusionSettings(agree_px=-1.0)


def test_every_lifted_point_is_fused_or_counted():
    made = views(noise_px=0.3)
    settings = FusionSettings(voxel_px=0.1)  # voxels so small that each holds one point
    rejected = fuse(made, settings).rejected
    lifted = [lift(view, settings.stride) for view in made]
    kept = len(fuse(made, settings))
    assert set(rejected) == set(REJECTIONS)
    assert rejected["ragged"] == sum(np.isnan(n[:, 0]).sum() for _, n, _ in lifted)
    missing = sum(len(points) for points, _, _ in lifted) - sum(rejected.values()) - kept
    assert 0 <= missing < 0.02 * kept  # two points in one voxel


def test_all_pixels_of_a_rim_are_taken_and_a_lattice_elsewhere():
    whole = views()[0]
    plane = whole.disparity.copy()
    plane[:, 60:] = np.nan
    sparse, dense = (
        lift(DepthView(whole.geometry, plane, whole.sigma_px), stride) for stride in (4, 1)
    )
    reached = whole.geometry.project(sparse[0].astype(np.float64))
    columns, rows = np.rint(reached[:, 0]).astype(int), np.rint(reached[:, 1]).astype(int)
    known = np.isfinite(plane)
    assert len(dense[0]) == known.sum()
    taken = np.zeros_like(known)
    taken[rows, columns] = True
    assert taken[known[:, 59], 59].all()
    inner = known.copy()
    for shift in (-2, -1, 1, 2):
        inner &= np.roll(known, shift, 0) & np.roll(known, shift, 1)
    inner[:2], inner[-2:], inner[:, :2] = False, False, False
    assert taken[inner].mean() < 0.35


def test_a_point_of_one_pair_stays_until_another_sees_through_it_or_stands_before_it():
    honest = views()
    alone = fuse(honest[:1], FusionSettings())
    assert len(alone) > 100
    assert alone.support.max() == 1
    behind = honest[0].disparity - 6.0  # farther than the surface all other pairs see
    hidden = [DepthView(honest[0].geometry, behind, honest[0].sigma_px), *honest[1:]]
    wrong = [
        (np.abs(distance(fuse(hidden, settings).positions.astype(np.float64))) > 2.0).sum()
        for settings in (FusionSettings(lone_hidden=100), FusionSettings(lone_hidden=0))
    ]
    assert wrong[0] > 200
    assert wrong[1] < 0.2 * wrong[0]
