"""Rectification laws: rows, triangulation, cropping, and exactness through the lens."""

import numpy as np
import pytest
from scipy import ndimage

from capture.camera import Camera
from capture.errors import CameraError
from recon.rectify import rectification, rectified, resample, spline_coefficients
from tests.synthetic_stereo import ring


def cloud(count: int = 200) -> np.ndarray:
    return np.random.default_rng(3).uniform(-60, 60, (count, 3))


@pytest.mark.parametrize(("first", "second"), [(0, 1), (0, 2), (1, 2), (3, 0)])
def test_corresponding_points_share_a_row(first: int, second: int):
    cameras = ring((-9.0, 9.0), (-10.0, 10.0))
    geometry = rectification(cameras[first], cameras[second], np.zeros(3), 120.0)
    points = cloud()
    column, row, disparity = geometry.project(points).T
    local = (points - geometry.right.centre) @ geometry.rotation.T
    right_column = geometry.focal_px * local[:, 0] / local[:, 2] + geometry.right_column
    right_row = geometry.focal_px * local[:, 1] / local[:, 2] + geometry.row
    np.testing.assert_allclose(right_row, row, atol=1e-9)
    np.testing.assert_allclose(right_column, column - disparity, atol=1e-9)
    back = geometry.disparity(geometry.depth(np.array([0.0, 5.0])))
    np.testing.assert_allclose(back, [0.0, 5.0], atol=1e-9)


def test_triangulation_undoes_projection():
    cameras = ring()
    geometry = rectification(cameras[0], cameras[1], np.zeros(3), 120.0)
    points = cloud()
    np.testing.assert_allclose(geometry.triangulate(geometry.project(points)), points, atol=1e-9)


@pytest.mark.parametrize("side", ["left", "right"])
def test_maps_go_through_the_lens_exactly(side: str):
    cameras = ring()
    geometry = rectification(cameras[0], cameras[1], np.zeros(3), 120.0)
    camera: Camera = getattr(geometry, side)
    columns, rows = geometry.maps(side)
    for v, u in ((10, 20), (geometry.height // 2, 30), (geometry.height - 9, geometry.width - 4)):
        start = geometry.left_column if side == "left" else geometry.right_column
        ray = np.array([u - start, v - geometry.row, geometry.focal_px]) @ geometry.rotation
        pixel = camera.project((camera.centre + 0.7 * ray)[None])[0]
        assert abs(columns[v, u] - pixel[0]) < 2e-5  # float32 maps
        assert abs(rows[v, u] - pixel[1]) < 2e-5


def test_a_crop_sees_the_same_world():
    cameras = ring()
    whole = rectification(cameras[0], cameras[1], np.zeros(3), 120.0)
    crop = whole.cropped(17, 9, 50, 40)
    points = cloud()
    np.testing.assert_allclose(crop.project(points) + [17, 9, 0], whole.project(points), atol=1e-9)
    for side in ("left", "right"):
        for part, full in zip(crop.maps(side), whole.maps(side), strict=True):
            np.testing.assert_allclose(part, full[9:49, 17:67], atol=2e-5)


def test_spline_resampling_agrees_with_scipy():
    image = np.random.default_rng(4).uniform(0, 1, (30, 40)).astype(np.float32)
    coefficients = spline_coefficients(image)
    columns = np.random.default_rng(5).uniform(0, 39, (7, 6)).astype(np.float32)
    rows = np.random.default_rng(6).uniform(0, 29, (7, 6)).astype(np.float32)
    columns[0, 0] = -0.01
    values, inside = resample(coefficients, columns, rows)
    slow = ndimage.map_coordinates(
        coefficients.astype(np.float64), [rows, columns], order=3, prefilter=False, mode="mirror"
    )
    assert not inside[0, 0]
    assert values[0, 0] == 0.0
    np.testing.assert_allclose(values[inside], slow[inside], atol=2e-6)


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_fast_rectification_is_the_literal_one(side: str):
    cameras = ring()
    geometry = rectification(cameras[0], cameras[1], np.zeros(3), 120.0)
    geometry = geometry.cropped(5, 3, geometry.width - 5, geometry.height - 3)
    camera: Camera = getattr(geometry, side)
    image = np.random.default_rng(4).uniform(0, 1, (camera.height, camera.width))
    coefficients = spline_coefficients(ndimage.gaussian_filter(image, 1.0).astype(np.float32))
    fast = rectified(geometry, side, coefficients)
    slow, inside = resample(coefficients, *geometry.maps(side))
    assert (np.isfinite(fast) != inside).mean() < 1e-3  # the very border, to rounding
    both = np.isfinite(fast) & inside
    assert both.sum() > 1000
    np.testing.assert_allclose(fast[both], slow[both], atol=1e-5)


def test_two_cameras_at_one_place_have_no_baseline():
    camera = ring()[0]
    with pytest.raises(CameraError, match="no baseline"):
        rectification(camera, camera, np.zeros(3), 100.0)


def test_a_view_is_infinite_exactly_where_the_recorded_pixel_is_clipped():
    cameras = ring()
    geometry = rectification(cameras[0], cameras[1], np.zeros(3), 120.0)
    rng = np.random.default_rng(8)
    image = rng.uniform(0, 1, (cameras[0].height, cameras[0].width)).astype(np.float32)
    mask = ndimage.binary_dilation(image > 0.999, iterations=3)
    coefficients = spline_coefficients(image)
    plain = rectified(geometry, "left", coefficients)
    view = rectified(geometry, "left", coefficients, mask)
    columns, rows = geometry.maps("left")
    known = np.isfinite(plain)
    literal = np.zeros_like(known)
    literal[known] = mask[np.rint(rows[known]).astype(int), np.rint(columns[known]).astype(int)]
    assert literal.sum() > 100
    assert (np.isposinf(view) != literal).mean() < 1e-4  # to rounding
    rest = ~np.isposinf(view)
    np.testing.assert_array_equal(view[rest], plain[rest])
