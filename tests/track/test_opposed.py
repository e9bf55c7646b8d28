import numpy as np
import pytest

from tests.track.flaps import GAP_MM, closed, eye, lid_down, lips
from track.openings import split_rim
from track.opposed import OpposedSurfaces
from track.rigid import nearest_rotations


def test_lips_that_touch_without_an_opening_have_two_sides() -> None:
    vertices, triangles, upper = lips(GAP_MM)
    surfaces = OpposedSurfaces(vertices, triangles)
    found = surfaces.vertices
    assert 50 < upper[found].sum() < len(found) - 50
    assert len(found) < 0.8 * len(vertices)  # next to the contact alone
    assert np.abs(vertices[found, 1]).max() < np.abs(vertices[:, 1]).max() - 0.5
    assert len(surfaces.crossings(vertices).vertex) == 0


@pytest.mark.parametrize("by_mm", [0.8, 1.5])
def test_depth_is_how_far_lips_are_through_each_other(by_mm: float) -> None:
    vertices, triangles, upper = lips(GAP_MM)
    found = OpposedSurfaces(vertices, triangles).crossings(closed(by_mm))
    assert found.depth_mm.max() == pytest.approx(by_mm - GAP_MM, abs=0.06)
    sides = upper[found.vertex]
    assert sides.any()
    assert not sides.all()
    assert (found.direction[sides, 1] > 0.5).all()  # the upper lip is to be pushed up
    assert (upper[found.corners].all(axis=1) != sides).all()


def test_crossings_do_not_depend_on_where_the_head_is() -> None:
    vertices, triangles, _ = lips(GAP_MM)
    rng = np.random.default_rng(3)
    turn = nearest_rotations(rng.normal(size=(1, 3, 3)))[0]
    surfaces = OpposedSurfaces(vertices, triangles)
    here, there = surfaces.crossings(closed(1.0)), surfaces.crossings(closed(1.0) @ turn.T + 40.0)
    assert np.array_equal(here.vertex, there.vertex)
    assert np.allclose(here.depth_mm, there.depth_mm, atol=1e-3)  # ties go either way


def test_lids_that_cross_are_found_and_an_open_eye_is_not() -> None:
    vertices, triangles = eye(8.0)
    surfaces = OpposedSurfaces(vertices, triangles)
    assert len(surfaces.crossings(lid_down(vertices, 6.0)).vertex) == 0
    assert len(surfaces.crossings(lid_down(vertices, 9.5)).vertex) > 3


def test_a_lone_vertex_far_behind_is_not_believed() -> None:
    vertices, triangles, upper = lips(GAP_MM)
    spiked = vertices.copy()
    spiked[np.argmin(np.where(upper, vertices[:, 1], np.inf)), 1] -= 2.5
    assert len(OpposedSurfaces(vertices, triangles).crossings(spiked).vertex) == 0


def test_lids_before_a_socket_are_known_by_their_margin() -> None:
    vertices, triangles = eye(8.0)
    socket = np.array([[0.0, 0.0, -20.0]])
    ring = np.arange(48)
    bag = np.stack([np.full(48, len(vertices)), ring, (ring + 1) % 48], axis=1)
    whole = np.concatenate([triangles, bag]).astype(np.int32)
    place = np.concatenate([vertices, socket])
    assert len(OpposedSurfaces(place, whole).vertices) == 0
    surfaces = OpposedSurfaces(place, whole, [split_rim(place, 48 * 5 + ring)])
    closed_lid = np.concatenate([lid_down(vertices, 9.5), socket])
    assert len(surfaces.crossings(closed_lid).vertex) > 3
