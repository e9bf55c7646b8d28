import numpy as np

from tests.track.flaps import eye
from track.vertex_marks import Mark, inner_vertices, vertex_marks


def test_what_is_folded_behind_a_margin_is_inner_and_skin_is_not() -> None:
    vertices, triangles = eye(1.0)  # all but closed
    eyes = np.array([[x, y, 500.0] for x in (-200.0, 0.0, 200.0) for y in (-100.0, 100.0)])
    inner = inner_vertices(vertices, triangles, eyes).reshape(-1, 48)
    middle = np.r_[6:18, 30:42]  # of the lids, away from the corners
    assert inner[:4, middle].all()
    assert not inner[6:].any()


def test_views_decide_between_seen_and_carried() -> None:
    inner = np.array([False, False, False, True, True])
    marks = vertex_marks(np.array([0.0, 1.4, 2.0, 0.0, 3.0]), inner)
    wanted = [Mark.CARRIED, Mark.CARRIED, Mark.SEEN, Mark.INNER, Mark.SEEN]
    assert marks.tolist() == [int(mark) for mark in wanted]
    assert marks.dtype == np.int8
