"""An error across the rows is measured on known surfaces, whatever the gain."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.fusion import DepthView
from recon.prior import prior_disparity
from recon.rectify import rectification
from recon.row_offset import row_offset
from tests.recon.test_prior import sphere
from tests.synthetic_stereo import draw, ring

LEFT, RIGHT = ring((-9.0, 9.0))


def measured(shift_px: float, gain: float = 1.0, share: float = 1.0) -> float:
    """What is found when the right camera is told its principal row wrong by `shift_px`."""
    true = rectification(LEFT, RIGHT, np.zeros(3), 110.0)
    disparity = prior_disparity(true, *sphere(120))
    disparity[:, int(share * disparity.shape[1]) :] = np.nan
    wrong = replace(true, right=replace(RIGHT, cy=RIGHT.cy + shift_px))
    images = [
        cv2.GaussianBlur(draw(camera, gain=g), (0, 0), 0.8).astype(np.float32)
        for camera, g in ((LEFT, 1.0), (RIGHT, gain))
    ]
    return row_offset(DepthView(wrong, disparity, np.ones_like(disparity)), *images)


def test_a_good_pair_lies_on_its_rows():
    assert abs(measured(0.0)) < 0.02  # px


@pytest.mark.parametrize("shift_px", [-0.5, 0.1, 0.3, 0.6])
def test_a_shift_across_the_rows_is_found_in_size_and_sign(shift_px: float):
    # The views are looked up `shift_px` too low in the right image: the match lies higher.
    assert measured(shift_px) == pytest.approx(-shift_px, abs=0.05 + 0.15 * abs(shift_px))


def test_gain_does_not_matter():
    assert measured(0.3, gain=0.6) == pytest.approx(measured(0.3), abs=0.03)


def test_too_little_surface_tells_nothing():
    assert np.isnan(measured(0.3, share=0.05))
