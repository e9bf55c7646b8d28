"""Matching of a rectified pair: truth recovered, and a reason for each pixel left out."""

import numpy as np
import pytest
from scipy import ndimage

from capture.errors import SettingsError
from recon.disparity import DisparitySettings, Reason, match_pair, seed_disparity
from recon.images import clipped
from recon.rectify import Rectification, rectification, resample, spline_coefficients
from tests.synthetic_stereo import draw, hit, ring


@pytest.fixture(scope="module")
def pair() -> tuple[Rectification, list[np.ndarray], np.ndarray]:
    """Geometry, both rectified views, and the true disparity of the left one."""
    cameras = ring()
    geometry = rectification(cameras[0], cameras[1], np.zeros(3), 110.0)
    views = []
    for side, camera in (("left", cameras[0]), ("right", cameras[1])):
        image = draw(camera, gain=1.0 if side == "left" else 0.8)
        view, inside = resample(spline_coefficients(image), *geometry.maps(side))
        view[~inside] = np.nan
        views.append(view)
    columns, rows = geometry.maps("left")
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    truth = geometry.project(hit(cameras[0], pixels))[:, 2].reshape(columns.shape)
    return geometry, views, truth


def test_disparity_is_recovered_below_a_tenth_of_a_pixel(pair):
    _, (left, right), truth = pair
    result = match_pair(left, right, (-30.0, 30.0), DisparitySettings())
    error = np.abs(result.disparity - truth)
    known = np.isfinite(error)
    assert np.median(error[known]) < 0.08  # px
    facing = np.isfinite(truth) & (np.abs(np.gradient(truth, axis=1)) < 0.25)
    assert known[facing].mean() > 0.9
    assert (error[known & facing] > 1).mean() < 0.02


def test_each_pixel_has_a_disparity_or_a_reason(pair):
    _, (left, right), _ = pair
    result = match_pair(left, right, (-30.0, 30.0), DisparitySettings())
    np.testing.assert_array_equal(result.reason == Reason.KEPT, np.isfinite(result.disparity))
    assert (result.reason[np.isnan(left)] == Reason.OUTSIDE).all()
    assert result.coverage == np.isfinite(result.disparity).mean()


def test_flat_ground_is_not_matched(pair):
    _, (left, right), truth = pair
    result = match_pair(left, right, (-30.0, 30.0), DisparitySettings())
    near = ndimage.binary_dilation(np.isfinite(truth), iterations=9)  # windows reach the contour
    ground = np.isfinite(left) & ~near
    assert np.isfinite(result.disparity[ground]).mean() < 0.005


def test_the_seed_stays_in_its_range_at_both_signs(pair):
    _, (left, right), truth = pair
    for low, high in ((-30.0, 30.0), (-12.0, 2.0)):
        seed = seed_disparity(left, right, (low, high), 5)
        found = seed[np.isfinite(seed)]
        assert found.min() >= low - 2
        assert found.max() <= high + 18  # counts come in sixteens
    assert np.nanmedian(np.abs(seed_disparity(left, right, (-30.0, 30.0), 5) - truth)) < 0.3


def test_settings_name_what_is_wrong():
    with pytest.raises(
        SettingsError, match=r"ncc_min = 1\.5: must be at least 0 and at most 0\.99"
    ):
        DisparitySettings(ncc_min=1.5)
    with pytest.raises(SettingsError, match="seed_block: expected an odd number, found 4"):
        DisparitySettings(seed_block=4)


def test_a_highlight_that_moves_between_views_gives_no_disparity():
    rng = np.random.default_rng(7)
    skin = ndimage.gaussian_filter(rng.normal(size=(160, 260)), 1.2)
    skin = (0.5 + 0.12 * skin / skin.std()).astype(np.float32).clip(0, 0.95)
    left, right = skin[:, 20:220].copy(), skin[:, 26:226].copy()  # truth: 6 px
    down, across = np.mgrid[:160, :200]
    for view, column in ((left, 110), (right, 101)):  # where a surface 3 px nearer would be
        view[np.hypot(across - column, down - 80) < 24] = 1.0
    settings = DisparitySettings()

    misled = match_pair(left, right, (0.0, 30.0), settings)
    assert (np.abs(misled.disparity - 6.0) > 1.0).sum() > 200

    drawn = [np.where(clipped(view), np.float32(np.inf), view) for view in (left, right)]
    result = match_pair(*drawn, (0.0, 30.0), settings)
    known = np.isfinite(result.disparity)
    assert (np.abs(result.disparity - 6.0)[known] < 0.25).all()
    assert not known[np.isinf(drawn[0])].any()
    assert (result.reason[np.isinf(drawn[0])] == Reason.HIGHLIGHT).all()
    away = (np.hypot(across - 110, down - 80) > 34) & (np.hypot(across - 107, down - 80) > 34)
    assert known[away & (across > 15)].mean() > 0.95
