"""Chains drawn as lines: pulled across them, in order, and not beyond their ends."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from capture.arrays import Floats
from tests.track.corrections.patch_subject import MESH, SUBJECT
from track.corrections.curves import CurveSightings, feet
from track.corrections.entries import Curve
from track.corrections.replay import Corrections

ROW = tuple(range(9 * 19 + 3, 9 * 19 + 16))  # across the patch's nose


def arc(count: int, start: float = 0.1, stop: float = 3.0, radius: float = 60.0) -> Floats:
    """A smile of pixels."""
    angle = np.linspace(start, stop, count)
    return np.stack([100 + radius * np.cos(angle), 100 + 0.6 * radius * np.sin(angle)], axis=1)


def distance(points: Floats, line: Floats) -> Floats:
    """From points (L, 2) to the nearest of a densely cut line."""
    return np.linalg.norm(points[:, None] - line[None], axis=2).min(axis=1)


def test_feet_lie_on_the_line_across_from_the_points() -> None:
    line, chain = arc(200), arc(30, 0.3, 2.8) + [0.0, 4.0]
    pixel, information = feet(chain, line, 0.5)
    assert distance(pixel, arc(20000)).max() < 0.15  # px
    matrix = np.stack([information[:, :2], information[:, 1:]], axis=1)
    strength, direction = np.linalg.eigh(matrix)
    np.testing.assert_allclose(strength[:, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(strength[:, 1], 4.0)
    moved = pixel - chain
    across = np.einsum("lx,lx->l", moved, direction[:, :, 1]) ** 2
    np.testing.assert_allclose(across, (moved**2).sum(axis=1), rtol=1e-9, atol=1e-12)


def test_points_on_the_line_stay_wherever_they_are_along_it() -> None:
    line = arc(400)
    for start, stop in ((0.2, 1.0), (1.0, 2.9), (0.5, 0.6)):
        chain = arc(25, start, stop)
        pixel, information = feet(chain, line, 0.5)
        assert np.abs(pixel - chain).max() < 0.05  # px
        assert (information[:, 0] + information[:, 2] > 3.9).all()


def test_the_direction_of_drawing_says_nothing() -> None:
    line, chain = arc(150), arc(20, 0.4, 2.5) * 1.03
    forth, back = feet(chain, line, 0.5), feet(chain, line[::-1], 0.5)
    np.testing.assert_allclose(forth[0], back[0], atol=1e-6)
    np.testing.assert_allclose(forth[1], back[1], atol=1e-6)


def test_what_reaches_past_the_ends_is_left_alone() -> None:
    line, chain = arc(100, 1.0, 2.0), arc(31, 0.3, 2.7) + [0.0, 1.0]
    pixel, information = feet(chain, line, 0.5)
    angle = np.linspace(0.3, 2.7, 31)
    seen = information.any(axis=1)
    assert seen[(angle > 1.1) & (angle < 1.9)].all()
    assert not seen[(angle < 0.9) | (angle > 2.1)].any()
    np.testing.assert_array_equal(pixel[~seen], chain[~seen])


def test_a_hairpin_is_followed_in_order() -> None:
    """Lips nearly closed, drawn as one line: what is nearest is the other lip's."""
    upper, lower = arc(60, 0.05, 3.09, 60.0), arc(60, 0.05, 3.09, 62.0)
    line = np.concatenate([upper, lower[::-1]])
    chain = np.concatenate([upper[5::6] + [0.0, 1.6], lower[::-1][5::6] + [0.0, 1.6]])
    pixel, _ = feet(chain, line, 0.5)
    half = len(chain) // 2
    dense = arc(20000, 0.05, 3.09, 60.0), arc(20000, 0.05, 3.09, 62.0)
    middle = slice(2, half - 2)  # within a few pixels of its ends the pin turns
    assert distance(pixel[:half][middle], dense[0]).max() < 0.3
    assert distance(pixel[half:][middle], dense[1]).max() < 0.3


@pytest.mark.parametrize("start", [0, 13, 50])
def test_a_closed_line_has_no_ends(start: int) -> None:
    ring = arc(81, 0.0, 2 * np.pi)[:-1]
    line = np.roll(ring, start, axis=0)
    line = np.concatenate([line, line[:1]])
    chain = (arc(40, 0.2, 2 * np.pi + 0.1) - 100) * 0.95 + 100
    pixel, information = feet(chain, line, 0.5)
    assert (information[:, 0] + information[:, 2] > 3.9).all()
    assert distance(pixel, arc(20000, 0.0, 2 * np.pi)).max() < 0.3


def test_points_behind_the_camera_are_not_seen() -> None:
    chain = arc(10)
    chain[3] = np.nan
    _, information = feet(chain, arc(50), 0.5)
    assert not information[3].any()
    assert information[[2, 4]].any(axis=1).all()
    none = feet(np.full((4, 2), np.nan), arc(50), 0.5)
    assert not none[1].any()


def drawn(camera: str, truth: Floats) -> CurveSightings:
    seen = SUBJECT.cameras.by_name(camera).project(truth[list(ROW)])
    line = tuple((float(x), float(y)) for x, y in seen[::2])
    curve = Curve(frame=1, camera=camera, chain="row", vertices=ROW[1:-1], pixels=line)
    (sightings,) = Corrections(SUBJECT, [curve]).for_frame(1).sightings
    assert isinstance(sightings, CurveSightings)
    return sightings


def test_a_chain_is_lifted_across_its_line_and_not_along() -> None:
    cameras = {camera.name: camera for camera in SUBJECT.cameras}
    rng = np.random.default_rng(2)
    truth = MESH.vertices + rng.normal(0, 0.02, MESH.vertices.shape)
    start = truth + [0.9, -2.5, 0.0]
    sightings = drawn("cam01", truth)
    lifted = sightings.lifted(start, cameras)
    chain = sightings.surface.points(start) + lifted.motion
    line = cameras["cam01"].project(truth[list(ROW)])
    dense = np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(line)])
    assert distance(cameras["cam01"].project(chain), dense).max() < 0.4  # px: chords of two edges
    assert (lifted.views == 1).all()
    assert np.abs(lifted.motion[:, 0]).max() < 0.5  # mm along; 0.9 mm was asked for by nothing
    assert (lifted.motion[:, 1] > 1.5).all()
    assert not sightings.lifted(start, {}).views.any()
    again = sightings.lifted(MESH.vertices + [0, 300.0, 0], cameras)  # from anywhere
    assert np.isfinite(again.motion).all()
