import numpy as np

from tests.track.flaps import eye, lips
from track.openings import find_openings


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
