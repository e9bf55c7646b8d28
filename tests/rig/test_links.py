"""Symmetric shapes by name and place, exclusive ones as told."""

import dataclasses

import numpy as np
import pytest

from capture.errors import InputError
from rig.links import find_links
from tests.rig.grid_face import grid_template

ALL = np.ones(6, dtype=bool)


def test_mirrored_shapes_on_their_own_halves_are_symmetric() -> None:
    links = find_links(grid_template(), ALL, ())
    assert links.symmetric.tolist() == [[1, 2]]  # mouthSmile_L and _R
    assert links.exclusive.shape == (0, 2)


def test_shapes_that_move_the_whole_face_sideways_are_not() -> None:
    template = grid_template()
    names = ("jawLeft", "mouthSmile_L", "mouthSmile_R", "jawRight", "cheekPuff", "still")
    links = find_links(dataclasses.replace(template, names=names), ALL, ("jawLeft:jawRight",))
    assert links.symmetric.tolist() == [[1, 2]]
    assert links.exclusive.tolist() == [[0, 3]]


def test_refuses_names_that_are_not_there() -> None:
    with pytest.raises(InputError, match=r"jawLeft: the template has no such shape"):
        find_links(grid_template(), ALL, ("jawLeft:jawOpen",))


def test_a_shape_that_moves_nothing_is_no_trouble() -> None:
    template = grid_template()
    still = dataclasses.replace(template, deltas=np.zeros_like(template.deltas))
    assert find_links(still, ALL, ()).symmetric.tolist() == [[1, 2]]


def test_links_count_the_shapes_that_are_solved() -> None:
    kept = np.array([False, True, True, True, True, False])
    links = find_links(grid_template(), kept, ("browInnerUp:cheekPuff", "jawOpen:cheekPuff"))
    assert links.symmetric.tolist() == [[0, 1]]
    assert links.exclusive.tolist() == [[2, 3]]
