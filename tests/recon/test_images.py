"""Grey images at full depth, and the noise in them."""

import numpy as np
import pytest

from capture.errors import ShapeError
from recon.images import clipped, mono, noise_sigma


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


def test_a_solid_highlight_is_masked_with_its_rim_and_specks_are_not():
    image = np.full((40, 50), 90, np.uint8)
    assert clipped(image) is None
    image[3, 4] = image[30:34, 5:9] = 255  # a hot pixel and a speck
    assert clipped(image) is None
    image[10:25, 20:36] = 255
    expected = np.zeros((40, 50), bool)
    expected[9:26, 19:37] = True
    mask = clipped(image)
    assert mask is not None
    assert not mask[~expected].any()
    assert (expected & ~mask).sum() <= 4 * 12  # the corners, which no disc fills
    assert mask[9, 27]
    assert mask[17, 36]
    colour = np.dstack([image // 3, image, image // 2, np.full_like(image, 255)])
    np.testing.assert_array_equal(clipped(colour), mask)  # any channel, but not alpha


def test_white_is_that_of_the_bits_in_use():
    image = np.full((30, 30), 1000, np.uint16)
    image[5:20, 5:20] = 4095  # 12 bits in 16
    assert clipped(image) is not None
    assert clipped(image << 4) is not None  # the same, shifted up: 65520
    image[5:20, 5:20] = 3000
    assert clipped(image) is None
    assert clipped(np.where(image == 3000, 1.0, 0.4).astype(np.float32)) is not None
    assert clipped(np.zeros((30, 30), np.uint8)) is None
    everything = clipped(np.full((30, 30), 255, np.uint8))
    assert everything is not None
    assert everything.all()
