"""Matches followed back: true ones come home, chance ones do not."""

import numpy as np

from tests.track.test_flow import SIZE, _level, _seen, _texture
from track.flow import refine_flow
from track.round_trip import return_miss

STILL = np.eye(2)


def test_true_matches_come_home() -> None:
    shift = np.array([0.4, -0.3])
    level, view = _level(_texture(STILL, np.zeros(2))), _seen(_texture(STILL, shift))
    matches = refine_flow(level, view, np.zeros((len(level.centres), 2)), 5)
    every = np.ones(len(level.centres), np.bool_)
    miss = return_miss(level, view, matches, every, 5)
    assert np.abs(matches.displacement - shift).max() < 0.05  # px
    assert miss.max() < 0.05


def test_a_larger_motion_comes_home_as_well() -> None:
    shift = np.array([2.6, 1.7])
    level, view = _level(_texture(STILL, np.zeros(2))), _seen(_texture(STILL, shift))
    near = np.tile(np.rint(shift), (len(level.centres), 1))
    matches = refine_flow(level, view, near, 5)
    miss = return_miss(level, view, matches, np.ones(len(near), np.bool_), 5)
    assert miss.max() < 0.05


def test_what_is_not_there_does_not_come_home() -> None:
    rng = np.random.default_rng(2)
    level = _level(_texture(STILL, np.zeros(2)))
    other = rng.uniform(0.2, 0.8, (SIZE, SIZE)).astype(np.float32)
    matches = refine_flow(level, _seen(other), np.zeros((len(level.centres), 2)), 5)
    wanted = np.isfinite(matches.displacement[:, 0])
    miss = return_miss(level, _seen(other), matches, wanted, 5)
    assert np.isnan(miss[~wanted]).all()
    assert np.median(miss[wanted]) > 0.5  # px
