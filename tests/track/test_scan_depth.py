"""Lifting by depth: points behind pixels, and skin that one view alone sees, followed by scans."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from capture.arrays import Bools, Floats
from capture.camera import CameraArray
from capture.take import Take
from recon.mesh import Mesh
from recon.surface import Scan
from recon.visiting import import_take
from tests.track.moving_patch import patch_array, patch_mesh, write_patch_scan, write_patch_visit
from track.lift import Observations
from track.scan_depth import ScanDepth, depth_observations
from track.stage import TrackSettings, track

AMOUNTS = [0.0, 0.5, 1.0]


def _as_scan(mesh: Mesh) -> Scan:
    return Scan(
        mesh.vertices.astype(np.float32),
        mesh.triangles,
        mesh.normals().astype(np.float32),
        np.ones(len(mesh.vertices), np.float32),
    )


def test_points_behind_pixels_are_those_of_the_surface() -> None:
    mesh, camera = patch_mesh(side=30), patch_array()[0]
    depth = ScanDepth(_as_scan(mesh), mesh.vertices)
    inner = np.abs(mesh.vertices[:, :2]).max(axis=1) < 35.0
    points, normals = depth.lift(camera, camera.project(mesh.vertices))
    away = np.linalg.norm(points - mesh.vertices, axis=1)[inner]
    turned = np.einsum("nx,nx->n", normals, mesh.normals())[inner]
    assert np.isfinite(away).mean() > 0.95  # the nose hides some
    assert np.nanmedian(away) < 0.05  # mm; a pixel is 0.58 mm
    assert np.nanmedian(turned) > 0.99


def test_edges_of_depth_and_empty_pixels_have_none() -> None:
    front = np.array([[-20.0, -20.0, 20.0], [0.0, -20.0, 20.0], [0.0, 20.0, 20.0]])
    back = np.array([[-40.0, -40.0, 0.0], [40.0, -40.0, 0.0], [0.0, 45.0, 0.0]])
    vertices = np.concatenate([front, back])
    scan = Scan(
        vertices.astype(np.float32),
        np.array([[0, 1, 2], [3, 4, 5]], np.int32),
        np.tile(np.array([0.0, 0.0, 1.0], np.float32), (6, 1)),
        np.ones(6, np.float32),
    )
    camera = patch_array(3)[1]
    depth = ScanDepth(scan, vertices)
    edge = camera.project(np.array([[0.0, -5.0, 20.0]]))[0]
    row = edge + np.array([[-20.0, 0.0], [0.0, 0.0], [20.0, 0.0], [900.0, 0.0], [0.0, -98.0]])
    points, normals = depth.lift(camera, row)
    assert np.isfinite(points[:, 0]).tolist() == [True, False, True, False, False]
    np.testing.assert_allclose(points[[0, 2], 2], [20.0, 0.0], atol=0.01)  # mm
    np.testing.assert_array_equal(np.isfinite(normals), np.isfinite(points))


def test_a_scan_that_is_far_or_turned_away_says_nothing() -> None:
    mesh, camera = patch_mesh(), patch_array()[1]
    chosen = np.abs(mesh.vertices[:, :2]).max(axis=1) < 30.0
    points, normals = mesh.vertices, mesh.normals()
    seen = Observations(
        sample=np.flatnonzero(chosen).astype(np.int32),
        offset=np.zeros((int(chosen.sum()), 2)),
        jacobian=camera.project_jacobian(points[chosen]),
        information=np.ones((int(chosen.sum()), 3)),
    )
    every = np.ones(len(seen.sample), np.bool_)

    def told(lift_mm: float, normals: Floats) -> Observations:
        scan = _as_scan(mesh.with_vertices(points + [0.0, 0.0, lift_mm]))
        return depth_observations(ScanDepth(scan, points), camera, seen, every, (points, normals))

    near = told(1.0, normals)
    assert len(near.sample) > 0.9 * len(every)
    gap_mm = near.offset[:, 0] / np.linalg.norm(near.jacobian[:, 0], axis=1)
    facing = near.jacobian[:, 0] / np.linalg.norm(near.jacobian[:, 0], axis=1, keepdims=True)
    np.testing.assert_allclose(np.median(gap_mm / facing[:, 2]), 1.0, atol=0.05)  # mm
    assert len(told(4.5, normals).sample) == 0
    assert len(told(1.0, -normals).sample) == 0


def _one_sided() -> CameraArray:
    """Two views; the second one's image ends in the middle of the patch."""
    whole, half = patch_array(2)
    return CameraArray((whole, dataclasses.replace(half, cx=half.cx + 90.0)))


@pytest.fixture(scope="module")
def visit(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Mesh, Floats]:
    folder = tmp_path_factory.mktemp("half")
    mesh, truth = write_patch_visit(folder, AMOUNTS, cameras=_one_sided())
    return folder, mesh, truth


def _lone(mesh: Mesh) -> Bools:
    """Inner vertices that only the first view sees, on the bump that comes out."""
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    found: Bools = (x > 10.0) & (x < 32.0) & (np.abs(y + 5.0) < 27.0)
    return found


def _rms(error: Floats) -> float:
    return float(np.sqrt((error**2).sum(axis=-1).mean()))


def test_skin_of_one_view_is_followed_by_the_depth_of_scans(
    visit: tuple[Path, Mesh, Floats], tmp_path: Path
) -> None:
    folder, mesh, truth = visit
    lone = _lone(mesh)
    assert not _one_sided()[1].contains(_one_sided()[1].project(mesh.vertices[lone])).any()
    blind, take = (import_take(folder, tmp_path / name) for name in ("blind", "scanned"))
    without = track(blind, mesh, TrackSettings())
    for frame in (1, 2):
        write_patch_scan(take.folder, frame, mesh, truth[frame], seed=frame)
    scanned = track(take, mesh, TrackSettings())
    ignored = track(take, mesh, TrackSettings(use_scan=False))
    lost, found = (
        float(np.median(np.linalg.norm(p.vertices - truth, axis=2)[1:, lone]))
        for p in (without, scanned)
    )
    assert found < 0.2  # mm
    assert lost > 2.5 * found
    np.testing.assert_array_equal(ignored.vertices, without.vertices)


def test_a_new_scan_makes_its_segment_again(
    visit: tuple[Path, Mesh, Floats], tmp_path: Path
) -> None:
    folder, mesh, truth = visit
    take = import_take(folder, tmp_path / "take")
    settings = TrackSettings(passes=1)
    track(take, mesh, settings)
    frames = [take.products / "track" / "frames" / f"frame_{f:04d}.npz" for f in (1, 2)]
    product = take.products / "track" / "performance.npz"
    stamps = [path.stat().st_mtime_ns for path in (*frames, product)]
    write_patch_scan(take.folder, 2, mesh, truth[2])
    later = track(Take.open(take.folder), mesh, settings)
    again = [path.stat().st_mtime_ns for path in (*frames, product)]
    assert not any(old == new for old, new in zip(stamps, again, strict=True))
    fresh = import_take(folder, tmp_path / "fresh")
    write_patch_scan(fresh.folder, 2, mesh, truth[2])
    assert (track(fresh, mesh, settings).vertices == later.vertices).all()
    write_patch_scan(take.folder, 2, mesh, truth[2], seed=5)
    track(take, mesh, settings)
    assert product.stat().st_mtime_ns != again[2]
    inputs = json.loads(product.with_name("performance.npz.record.json").read_text())["inputs"]
    assert "scans" in inputs


def test_the_mesh_keeps_its_distance_from_the_skin(tmp_path: Path) -> None:
    mesh, truth = write_patch_visit(tmp_path / "visit", AMOUNTS)
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    height = 0.5 * np.sin(x / 18.0) * np.cos(y / 20.0)
    sunk = mesh.with_vertices(mesh.vertices - height[:, None] * mesh.normals())
    plain, take = (import_take(tmp_path / "visit", tmp_path / name) for name in ("plain", "take"))
    write_patch_scan(take.folder, 0, mesh, truth[0])
    inner = np.maximum(np.abs(x), np.abs(y)) < 36.0
    wanted = [
        rest - height[:, None] * mesh.with_vertices(rest).normals() for rest in truth[1:]
    ]  # c = u - h n
    errors = [
        _rms((track(one, sunk, TrackSettings()).vertices[1:] - wanted)[:, inner])
        for one in (plain, take)
    ]
    assert errors[1] < 0.1  # mm
    assert errors[1] < 0.8 * errors[0]
