import numpy as np

from tests.track.face_scene import TEMPLATE, head
from track.visibility import around, count_views


def test_the_front_is_seen_and_the_back_is_not() -> None:
    mesh = head(TEMPLATE)
    seen = count_views(mesh.vertices, mesh.triangles, np.array([[0.0, 0.0, 700.0]])) > 0
    normals = mesh.normals()
    assert seen[(normals[:, 2] > 0.75) & (mesh.vertices[:, 2] > 20.0)].mean() > 0.97
    assert not seen[normals[:, 2] < 0.2].any()


def test_a_screen_hides_what_is_behind_it() -> None:
    mesh = head(TEMPLATE)
    low, high = [-200.0, -200.0, 200.0], [200.0, 200.0, 200.0]
    corners = [low, [high[0], low[1], 200.0], high, [low[0], high[1], 200.0]]
    count = len(mesh.vertices)
    vertices = np.concatenate([mesh.vertices, corners])
    screen = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32) + count
    triangles = np.concatenate([mesh.triangles, screen])
    seen = count_views(vertices, triangles, np.array([[0.0, 0.0, 700.0]]))
    assert not seen[:count].any()
    assert seen[count:].all()


def test_eyes_all_around_see_the_whole_skin_and_no_bag() -> None:
    mesh = head(TEMPLATE, 48, 40)
    bag = mesh.vertices * 0.5
    vertices = np.concatenate([mesh.vertices, bag, [[0.0, 0.0, 0.0]]])
    triangles = np.concatenate([mesh.triangles, mesh.triangles + len(bag)])
    seen = count_views(vertices, triangles, around(vertices)) > 0
    assert seen[: len(bag)].mean() > 0.98
    upper = np.flatnonzero((bag[:, 1] > 0.0) & (bag[:, 1] < 40.0))  # not seen through the neck
    assert len(upper) > 300
    assert seen[len(bag) + upper].mean() < 0.02
    assert around(vertices).shape == (26, 3)
