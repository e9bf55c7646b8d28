import numpy as np
import pytest

from capture.errors import SettingsError
from tests.track.face_scene import TEMPLATE, head
from tests.track.flaps import GAP_MM, closed, eye, lid_down, lips
from track.separation import Separation


def test_crossed_surfaces_are_parted_until_they_touch() -> None:
    vertices, triangles, upper = lips(GAP_MM)
    separation = Separation(vertices, triangles)
    crossed, sure = closed(1.3), np.ones(len(vertices))
    parted = separation.parted(crossed, sure, rounds=4)
    left = separation.surfaces.crossings(parted)
    assert left.depth_mm.max(initial=0.0) < 0.03
    gap = parted[upper, 1].min() - parted[~upper, 1].max()
    assert -0.05 < gap < 0.15  # touching: no farther apart than need be
    moved = np.linalg.norm(parted - crossed, axis=1)
    assert 0.3 < moved.max() < 0.8  # each side half of the millimetre
    assert np.array_equal(parted, separation.parted(crossed, sure, rounds=4))


def test_the_surer_surface_stays() -> None:
    vertices, triangles, upper = lips(GAP_MM)
    crossed = closed(1.3)
    parted = Separation(vertices, triangles).parted(crossed, np.where(upper, 1.0, 0.0))
    moved = np.linalg.norm(parted - crossed, axis=1)
    assert moved[upper].max() < 0.1
    assert moved[~upper].max() > 0.8


def test_what_does_not_cross_does_not_move() -> None:
    vertices, triangles, _ = lips(GAP_MM)
    separation, sure = Separation(vertices, triangles), np.ones(len(vertices))
    assert separation.parted(vertices, sure) is vertices
    near = closed(GAP_MM - 0.02)
    assert separation.parted(near, sure) is near
    crossed = closed(1.3)
    moved = np.linalg.norm(separation.parted(crossed, sure) - crossed, axis=1)
    assert moved[np.abs(vertices[:, 1]) > 5.0].max() < 0.05
    with pytest.raises(SettingsError, match="rounds: expected >= 1, found 0"):
        separation.parted(vertices, sure, rounds=0)


def test_lids_are_parted_too() -> None:
    vertices, triangles = eye(8.0)
    separation = Separation(vertices, triangles)
    crossed = lid_down(vertices, 9.5)
    before = separation.surfaces.crossings(crossed).depth_mm.max()
    parted = separation.parted(crossed, np.ones(len(vertices)), rounds=4)
    assert separation.surfaces.crossings(parted).depth_mm.max(initial=0.0) < 0.2 * before


def test_a_mesh_without_lips_or_lids_is_left_alone() -> None:
    mesh = head(TEMPLATE)
    separation = Separation(mesh.vertices, mesh.triangles)
    assert len(separation.surfaces.vertices) == 0
    crumpled = mesh.vertices + np.random.default_rng(1).normal(0.0, 3.0, mesh.vertices.shape)
    assert separation.parted(crumpled, np.ones(len(crumpled))) is crumpled
