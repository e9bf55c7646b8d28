"""Influence masks: their formula, how they spread, and what an artist paints over them."""

from dataclasses import replace

import numpy as np
import pytest

from capture.errors import ShapeError
from rig.influence import influence_masks, neighbours
from tests.rig.grid_face import grid_template


def test_a_smooth_step_of_the_displacement() -> None:
    template = grid_template(10)
    mask = influence_masks(template, rings=0)
    assert mask.shape == (6, 100)
    for shape, delta in enumerate(template.deltas[:5]):
        length = np.linalg.norm(delta, axis=1)
        share = length / length.max()
        assert np.abs(mask[shape] - share * share * (3 - 2 * share)).max() <= 1e-12
    assert (mask[5] == 0.0).all()  # the shape that moves nothing
    assert mask[:5].max(axis=1) == pytest.approx(np.ones(5))


def test_each_ring_reaches_the_neighbours_and_no_further() -> None:
    template = grid_template(9)
    dot = np.zeros((1, 81, 3))
    dot[0, 40, 1] = 4.0
    template = replace(template, deltas=dot, names=("dot",))
    row, column = np.divmod(np.arange(81), 9)
    steps = np.abs(row - 4) + np.abs(column - 4)  # along edges: diagonals of quads are none
    for rings in range(4):
        assert (influence_masks(template, rings)[0] == (steps <= rings)).all()


def test_what_is_painted_replaces_what_is_computed() -> None:
    template = grid_template(8)
    painted = np.full((6, 64), np.nan)
    painted[0, :10], painted[5, 3] = 0.25, 1.0
    mask, plain = influence_masks(template, painted=painted), influence_masks(template)
    assert (mask[0, :10] == 0.25).all()
    assert mask[5, 3] == 1.0
    assert (mask[np.isnan(painted)] == plain[np.isnan(painted)]).all()
    painted[2, 2] = 1.5
    with pytest.raises(ShapeError, match=r"must lie in 0\.\.1"):
        influence_masks(template, painted=painted)
    with pytest.raises(ShapeError, match=r"expected shape \(B V\)"):
        influence_masks(template, painted=painted[:, :5])


def test_neighbours_of_quads_and_triangles() -> None:
    polygons = np.array([[0, 1, 2, 3], [2, 1, 4, -1]], dtype=np.int32)
    link = neighbours(polygons, 6).toarray()
    edges = {(0, 1), (1, 2), (2, 3), (0, 3), (1, 4), (2, 4)}
    expected = np.zeros((6, 6))
    for a, b in edges:
        expected[a, b] = expected[b, a] = 1.0
    assert (link == expected).all()
