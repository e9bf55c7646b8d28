"""Depth maps through the lens: planes and spheres are exact, the rest of the view is empty."""

import numpy as np
import pytest

from capture.errors import ShapeError
from recon.depth_maps import depth_map, depth_maps, read_depth_maps, write_depth_maps
from tests.recon.test_prior import sphere, square
from tests.synthetic_stereo import RADII_MM, hit, ring

CAMERAS = ring((-18.0, 18.0), (-9.0,))


def grid(camera) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)


@pytest.mark.parametrize("index", [0, 1])
def test_a_plane_is_exact_through_the_lens(index: int):
    camera = CAMERAS[index]
    normal = np.array([0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0])
    centre = np.array([3.0, 5.0, 10.0])
    rays = camera.rays(grid(camera))
    length = ((centre - camera.centre) @ normal) / (rays @ normal)
    truth = camera.depths(camera.centre + length[:, None] * rays).reshape(200, 200)
    found = depth_map(camera, *square(normal, centre))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, truth, atol=2e-3)  # mm of 600: float32 rays


def test_an_ellipsoid_is_seen_where_it_is_and_nowhere_else():
    camera = CAMERAS[0]
    found = depth_map(camera, *sphere(160))
    points = hit(camera, grid(camera))
    truth = np.full(len(points), np.nan)
    seen = np.isfinite(points[:, 0])
    truth[seen] = camera.depths(points[seen])
    truth = truth.reshape(200, 200)
    differ = np.isfinite(found) != np.isfinite(truth)
    assert differ.sum() < 0.02 * np.isfinite(truth).sum()  # facets cut the rim
    both = np.isfinite(found) & np.isfinite(truth)
    assert np.median(np.abs(found[both] - truth[both])) < 0.02  # mm, of facets
    assert np.percentile(np.abs(found[both] - truth[both]), 99) < 0.5


def test_a_depth_gives_the_surface_back():
    camera = CAMERAS[1]
    found = depth_map(camera, *sphere(160))
    rows, columns = np.nonzero(np.isfinite(found))
    points = camera.unproject(
        np.stack([columns, rows], axis=1).astype(np.float64),
        found[rows, columns].astype(np.float64),
    )
    level = np.linalg.norm(points / RADII_MM, axis=1)
    assert np.abs(level - 1.0).max() < 1e-3


def test_what_is_out_of_view_or_behind_is_empty():
    vertices, triangles = sphere(12)
    camera = CAMERAS[0]
    for moved in (vertices + [0.0, 0.0, 3000.0], vertices + [900.0, 0.0, 0.0]):
        assert np.isnan(depth_map(camera, moved, triangles)).all()
    aside = depth_map(camera, vertices + [100.0, 0.0, 0.0], triangles)
    assert 0 < np.isfinite(aside).sum() < 200 * 200


def test_the_file_holds_a_map_a_camera(tmp_path):
    path = tmp_path / "depth.npz"
    mesh = sphere(24)
    write_depth_maps(path, CAMERAS, *mesh)
    first = path.read_bytes()
    found = read_depth_maps(path, CAMERAS)
    assert list(found) == list(depth_maps(CAMERAS, *mesh)) == list(CAMERAS.names)
    for camera in CAMERAS:
        np.testing.assert_array_equal(found[camera.name], depth_map(camera, *mesh))
    write_depth_maps(path, CAMERAS, *mesh)
    assert path.read_bytes() == first
    with pytest.raises(ShapeError, match="cam05"):
        read_depth_maps(path, ring((-20.0, -10.0, 0.0), (-9.0, 9.0)))
