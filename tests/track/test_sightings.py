"""Sightings: points seen in several views are lifted to where they are."""

import numpy as np

from tests.track.moving_patch import patch_array
from track.sightings import Sightings
from track.surface_samples import SurfaceSamples

COUNT = 20


def _surface() -> tuple[SurfaceSamples, np.ndarray]:
    rng = np.random.default_rng(3)
    vertices = rng.uniform(-30, 30, (COUNT, 3))
    corners = np.tile(np.arange(COUNT, dtype=np.int32)[:, None], (1, 3))
    weights = np.tile([1.0, 0.0, 0.0], (COUNT, 1))
    surface = SurfaceSamples(
        triangle=np.zeros(COUNT, np.int32), corners=corners, barycentric=weights
    )
    return surface, vertices


def _seen(motion: np.ndarray, views: int) -> tuple[Sightings, np.ndarray, dict]:
    surface, vertices = _surface()
    cameras = {camera.name: camera for camera in patch_array(views)}
    sightings = Sightings(
        surface=surface,
        cameras=tuple(cameras),
        point=np.tile(np.arange(COUNT, dtype=np.int32), views),
        view=np.repeat(np.arange(views, dtype=np.int32), COUNT),
        pixel=np.concatenate([camera.project(vertices + motion) for camera in cameras.values()]),
        information=np.tile([1.0, 0.0, 1.0], (COUNT * views, 1)),
        scale_px=5.0,
        accuracy_px=0.0,
    )
    return sightings, vertices, cameras


def test_points_are_lifted_to_where_they_are_seen() -> None:
    motion = np.random.default_rng(4).normal(0, 0.5, (COUNT, 3))
    sightings, vertices, cameras = _seen(motion, 5)
    lifted = sightings.lifted(vertices, cameras)
    assert np.abs(lifted.motion - motion).max() < 0.03  # mm: what linear projection leaves
    assert (lifted.views == 5).all()


def test_views_that_are_missing_are_left_out() -> None:
    sightings, vertices, cameras = _seen(np.full((COUNT, 3), 0.2), 4)
    del cameras[sightings.cameras[1]]
    lifted = sightings.lifted(vertices, cameras)
    assert (lifted.views == 3).all()
    assert not sightings.lifted(vertices, {}).views.any()
