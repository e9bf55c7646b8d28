"""Grey images at full depth, and the noise in them."""

import numpy as np
import pytest

from capture.errors import ShapeError
from recon.images import mono, noise_sigma


def test_every_code_of_sixteen_bits_stays_apart():
    codes = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    grey = mono(codes)
    assert grey.dtype == np.float32
    assert len(np.unique(grey)) == 65536
    assert (grey.min(), grey.max()) == (0.0, 1.0)


def test_colour_order_does_not_matter_and_grey_stays_grey():
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    np.testing.assert_array_equal(mono(image), mono(image[:, :, ::-1]))
    level = np.repeat(image[:, :, :1], 3, axis=2)
    np.testing.assert_allclose(mono(level), mono(level[:, :, 0]), atol=1e-7)


@pytest.mark.parametrize("bad", [np.zeros((4, 4, 2), np.uint8), np.zeros((4, 4), np.int32)])
def test_other_images_are_refused(bad):
    with pytest.raises(ShapeError, match="image: expected"):
        mono(bad)


def test_noise_is_measured_through_texture():
    y, x = np.mgrid[:200, :200] / 200.0
    smooth = 0.5 + 0.3 * np.sin(9 * x) * np.cos(7 * y)
    noisy = smooth + np.random.default_rng(1).normal(0, 0.01, smooth.shape)
    assert noise_sigma(noisy.astype(np.float32)) == pytest.approx(0.01, rel=0.05)
