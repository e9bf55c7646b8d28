"""Meshes through points, closest points, rays, and scans on disk."""

import dataclasses

import numpy as np
import pytest

from capture.errors import SolveError, TakeError
from recon.fusion import Points
from recon.surface import (
    Scan,
    SurfaceQuery,
    SurfaceSettings,
    closest_points,
    poisson_scan,
    read_ply,
    write_ply,
)


def sphere(count: int = 6000, radius: float = 20.0, *, cap: bool = False) -> Points:
    """Points of a sphere; with `cap` those above a height are missing."""
    k = np.arange(count) + 0.5
    polar = np.arccos(1 - 2 * k / count)
    around = np.pi * (1 + 5**0.5) * k
    unit = np.stack(
        [np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], axis=1
    ).astype(np.float32)
    if cap:
        unit = unit[unit[:, 2] < 0.7]
    one = np.full(len(unit), 0.8, np.float32)
    return Points(unit * radius, unit, one, np.full(len(unit), 4, np.int32), 1.0, (0.1, 0.2))


def square() -> tuple[np.ndarray, np.ndarray]:
    vertices = np.array([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]], dtype=np.float64)
    return vertices, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def test_poisson_recovers_a_sphere_with_outward_normals():
    scan = poisson_scan(sphere(), SurfaceSettings())
    radius = np.linalg.norm(scan.vertices, axis=1)
    assert np.abs(radius - 20.0).max() < 0.06  # mm
    cosine = (scan.normals * scan.vertices).sum(axis=1) / radius
    assert cosine.min() > 0.98
    np.testing.assert_allclose(scan.confidence, 0.8)


def test_a_hole_stays_a_hole():
    scan = poisson_scan(sphere(cap=True), SurfaceSettings())
    assert scan.vertices[:, 2].max() < 0.7 * 20.0 + 3.0


def test_the_same_points_give_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        write_ply(tmp_path / f"{name}.ply", poisson_scan(sphere(), SurfaceSettings()))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_too_few_points_make_no_surface():
    with pytest.raises(SolveError, match="at least 100 points, found 50"):
        poisson_scan(sphere(50), SurfaceSettings())


def test_closest_points_and_rays_on_a_square():
    vertices, triangles = square()
    points, ids, gap = closest_points(vertices, triangles, np.array([[2.0, 1.0, 3.0], [-3, 0, 4]]))
    np.testing.assert_allclose(points, [[2, 1, 0], [0, 0, 0]], atol=1e-5)
    np.testing.assert_allclose(gap, [3, 5], atol=1e-5)
    assert ids[0] == 0
    query = SurfaceQuery(vertices, triangles)
    far, hit = query.cast_rays(
        np.array([[2.0, 1, 5], [20, 20, 5]]), np.array([[0.0, 0, -1], [0, 0, -1]])
    )
    np.testing.assert_allclose(far, [5, np.inf])
    assert hit.tolist() == [0, -1]


def test_occlusion_is_seen_from_behind_only():
    query = SurfaceQuery(*square())
    points = np.array([[5.0, 5.0, -2.0], [5.0, 5.0, 2.0], [5.0, 5.0, 0.0]])
    blocked = query.occluded(points, np.array([5.0, 5.0, 100.0]))
    assert blocked.tolist() == [True, False, False]


def test_a_scan_comes_back_from_disk(tmp_path):
    vertices, triangles = square()
    confidence = np.array([0.0, 0.25, 0.5, 1.0], np.float32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    write_ply(tmp_path / "s.ply", Scan(vertices.astype(np.float32), triangles, normals, confidence))
    back = read_ply(tmp_path / "s.ply")
    np.testing.assert_array_equal(back.vertices, vertices.astype(np.float32))
    np.testing.assert_array_equal(back.triangles, triangles)
    np.testing.assert_array_equal(back.confidence, confidence)
    np.testing.assert_allclose(back.normals, normals, atol=1e-6)


def test_what_is_no_mesh_is_refused_by_name(tmp_path):
    (tmp_path / "bad.ply").write_bytes(b"not a ply")
    with pytest.raises(TakeError, match=r"bad\.ply: expected a PLY file"):
        read_ply(tmp_path / "bad.ply")
    with pytest.raises(TakeError, match="no such scan"):
        read_ply(tmp_path / "none.ply")


def test_the_surface_reaches_less_far_from_points_of_one_pair():
    points = sphere(cap=True)
    lone = dataclasses.replace(points, support=np.ones(len(points), np.int32))
    settings = SurfaceSettings(lone_spacings=1.2)
    far, near = (poisson_scan(given, settings) for given in (points, lone))
    assert near.vertices[:, 2].max() < far.vertices[:, 2].max() - 1.0
    assert near.vertices[:, 2].max() < 0.7 * 20.0 + 1.2


def test_a_scan_has_no_triangle_without_area():
    scan = poisson_scan(sphere(), SurfaceSettings())
    corners = scan.vertices.astype(np.float64)[scan.triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert sides.min() > 0.0
    assert len(np.unique(scan.vertices, axis=0)) == len(scan.vertices)


def test_a_narrow_gap_is_bridged_and_a_border_does_not_hang_over():
    whole = sphere()
    slit = np.abs(whole.positions[:, 0]) > 2.0
    points = dataclasses.replace(
        whole,
        positions=whole.positions[slit], normals=whole.normals[slit],
        confidence=whole.confidence[slit], support=np.ones(slit.sum(), np.int32),
    )  # fmt: skip
    bridged = poisson_scan(points, SurfaceSettings(lone_spacings=1.2))
    cut = poisson_scan(points, SurfaceSettings(lone_spacings=1.2, bridge_spacings=0.0))
    middle = np.stack([np.zeros(8), 20 * np.cos(np.arange(8)), 20 * np.sin(np.arange(8))], axis=1)
    assert SurfaceQuery(bridged.vertices, bridged.triangles).closest_points(middle)[2].max() < 0.5
    assert SurfaceQuery(cut.vertices, cut.triangles).closest_points(middle)[2].min() > 0.5
