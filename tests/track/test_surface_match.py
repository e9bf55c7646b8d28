import numpy as np
import pytest

from capture.errors import ShapeError
from recon.mesh import vertex_normals
from recon.surface import closest_points
from tests.track.face_scene import TEMPLATE, head
from track.surface_match import MatchSurface, border_vertices, near_border


def test_near_the_surface_matches_are_the_closest_points() -> None:
    mesh = head(TEMPLATE)
    normals = vertex_normals(mesh.vertices, mesh.triangles)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(mesh.vertices), 500, replace=False)
    asked = mesh.vertices[chosen] + 0.3 * rng.normal(size=(500, 3))
    surface = MatchSurface(mesh.vertices, mesh.triangles, normal_mm=0.001)
    found = surface.match(asked, normals[chosen])
    _, _, distance = closest_points(mesh.vertices, mesh.triangles, asked)
    assert np.abs(found.distance_mm - distance).max() < 1e-4  # float32 on the other side
    rebuilt = np.einsum("nk,nkx->nx", found.barycentric, mesh.vertices[found.corners])
    assert np.abs(rebuilt - found.points).max() < 1e-12
    assert np.abs(found.barycentric.sum(axis=1) - 1.0).max() < 1e-12
    assert found.barycentric.min() >= -1e-12


def test_triangles_without_area_are_met_at_their_nearest_place() -> None:
    """A line and a point beside a true triangle, in every order of their corners."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0], [1, 0, 0]], dtype=np.float64)
    asked = np.array([[0.5, -0.2, 0.3], [1.4, -0.3, 0.1], [-0.3, -0.3, 0.2], [0.2, 0.9, 0.0]])
    for line in ([0, 1, 4], [1, 4, 0], [4, 0, 1], [0, 3, 1], [1, 0, 3], [1, 4, 1]):
        triangles = np.array([[0, 1, 2], line], dtype=np.int32)
        surface = MatchSurface(vertices, triangles, normal_mm=0.001)
        found = surface.match(asked, np.tile([0.0, 0.0, 1.0], (4, 1)))
        _, _, distance = closest_points(vertices, triangles[:1], asked)
        assert np.isfinite(found.points).all()
        assert (found.distance_mm >= distance - 1e-6).all()
        assert found.distance_mm[:3] == pytest.approx(distance[:3], abs=0.35)


def test_normals_tell_two_sheets_apart() -> None:
    """Two sheets 1 mm apart that face away from each other: the further one looks our way."""
    x, y = np.meshgrid(np.arange(10.0), np.arange(10.0))
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(100)], axis=1)
    index = np.arange(100).reshape(10, 10)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    up = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    down = up[:, ::-1] + 100
    vertices = np.concatenate([flat, flat + [0.0, 0.0, 1.0]])
    triangles = np.concatenate([up, down]).astype(np.int32)
    asked = np.array([[4.3, 4.6, 0.9]])
    outward = np.array([[0.0, 0.0, 1.0]])
    blind = MatchSurface(vertices, triangles, normal_mm=0.01).match(asked, outward)
    aware = MatchSurface(vertices, triangles, normal_mm=5.0).match(asked, outward)
    assert blind.points[0, 2] == pytest.approx(1.0)
    assert blind.cosine[0] == pytest.approx(-1.0)
    assert aware.points[0] == pytest.approx([4.3, 4.6, 0.0])
    assert aware.cosine[0] == pytest.approx(1.0)


def test_unusable_vertices_make_their_triangles_unusable() -> None:
    mesh = head(TEMPLATE, 24, 20)
    usable = mesh.vertices[:, 2] > 0.0
    normals = vertex_normals(mesh.vertices, mesh.triangles)
    surface = MatchSurface(mesh.vertices, mesh.triangles, normal_mm=1.0, usable=usable)
    found = surface.match(mesh.vertices, normals)
    assert np.array_equal(found.usable, usable[found.corners].all(axis=1))
    assert 0 < found.usable.sum() < len(usable)


def test_border_is_the_rim_of_the_neck_and_of_the_crown() -> None:
    mesh = head(TEMPLATE, 24, 20)
    border = border_vertices(mesh.triangles, len(mesh.vertices))
    assert np.array_equal(np.flatnonzero(border), np.r_[:24, 24 * 19 : 24 * 20])
    near = near_border(mesh.vertices, mesh.triangles, 25.0)
    assert near[border].all()
    assert border.sum() < near.sum() < len(near)
    assert not near_border(mesh.vertices, np.zeros((0, 3), np.int32), 5.0).any()


def test_thinned_tree_still_gives_points_of_the_surface() -> None:
    mesh = head(TEMPLATE)
    normals = vertex_normals(mesh.vertices, mesh.triangles)
    surface = MatchSurface(mesh.vertices, mesh.triangles, normal_mm=10.0, tree_size=500)
    found = surface.match(mesh.vertices, normals)
    assert np.median(found.distance_mm) < 5.0
    with pytest.raises(ShapeError, match="normals: expected shape"):
        surface.match(mesh.vertices, normals[:-1])
