import numpy as np
import pytest

from capture.errors import ShapeError
from tests.track.flaps import eye, lips
from track.openings import find_openings, split_rim


def test_an_almond_has_two_corners_and_two_rims() -> None:
    vertices, triangles = eye(10.0)
    (opening,) = find_openings(vertices, triangles)
    assert np.allclose(np.sort(vertices[opening.corners, 0]), [-12.0, 12.0])
    upper, lower = sorted(
        (opening.first, opening.second), key=lambda rim: -float(vertices[rim, 1].mean())
    )
    assert (vertices[upper, 1] > 0).all()
    assert (vertices[lower, 1] < 0).all()
    assert len(upper) == len(lower) == 23
    assert sorted(opening.rim.tolist()) == list(range(48))
    step = np.linalg.norm(np.diff(vertices[opening.rim], axis=0), axis=1)
    assert step.max() < 2.0  # neighbours follow each other


def test_the_edges_of_pieces_are_no_openings() -> None:
    assert find_openings(*lips(0.2)[:2]) == []
    vertices, triangles = eye(10.0)
    assert find_openings(vertices * 20.0, triangles) == []  # 300 mm and more: a neck
    assert find_openings(vertices, triangles[:0]) == []


def test_a_rim_of_few_vertices_is_refused() -> None:
    vertices, _ = eye(10.0)
    with pytest.raises(ShapeError, match="rim: expected 8 vertices or more, found 5"):
        split_rim(vertices, np.arange(5))
