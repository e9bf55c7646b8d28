"""Base points and heights: identity, the normal law, rigid invariance."""

import numpy as np

from capture.arrays import Floats, Ints32
from capture.pose import Pose
from recon.mesh import vertex_normals
from track.displacement import Displacements, bind_points


def _bowl(side: int = 10) -> tuple[Floats, Ints32]:
    y, x = np.mgrid[0 : side + 1, 0 : side + 1] * (60.0 / side) - 30.0
    z = 0.008 * (x**2 - 0.5 * y**2) + 2.0 * np.sin(x / 9.0)
    corner = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return np.stack([x, y, z], -1).reshape(-1, 3), triangles.astype(np.int32)


def _near(vertices: Floats, triangles: Ints32, seed: int) -> tuple[Floats, Floats]:
    """Points above inner triangles at known heights, built from the definition."""
    rng = np.random.default_rng(seed)
    centre = vertices[triangles].mean(axis=1)
    inner = np.flatnonzero(np.abs(centre[:, :2]).max(axis=1) < 22.0)
    chosen = triangles[rng.choice(inner, 80)]
    weights = rng.dirichlet([1.0, 1.0, 1.0], 80)
    height = rng.uniform(-1.5, 1.5, 80)
    normals = vertex_normals(vertices, triangles)
    n = np.einsum("nk,nkx->nx", weights, normals[chosen])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return np.einsum("nk,nkx->nx", weights, vertices[chosen]) + height[:, None] * n, height


def _placed(bound: Displacements, vertices: Floats, triangles: Ints32) -> tuple[Floats, Floats]:
    """Base points b and bound points b + h n (N, 3) on a mesh."""
    base = np.einsum("nk,nkx->nx", bound.barycentric, vertices[bound.corners])
    return base, base + bound.height_mm[:, None] * bound.normals(vertices, triangles)


def test_base_point_and_height_reproduce_the_point() -> None:
    vertices, triangles = _bowl()
    points, height = _near(vertices, triangles, 1)
    bound = bind_points(points, vertices, triangles)
    assert (bound.triangle >= 0).all()
    base, placed = _placed(bound, vertices, triangles)
    np.testing.assert_allclose(placed, points, atol=1e-9)  # mm
    assert (np.abs(bound.height_mm) <= np.abs(height) + 1e-9).all()
    np.testing.assert_allclose(bound.height_mm, height, atol=1e-8)  # mm
    across = np.cross(points - base, bound.normals(vertices, triangles))
    assert np.abs(across).max() < 1e-9  # (u - b) x n = 0


def test_a_point_on_the_surface_has_no_height() -> None:
    vertices, triangles = _bowl()
    corner = triangles[57]
    bound = bind_points(vertices[corner].mean(axis=0)[None], vertices, triangles)
    np.testing.assert_allclose(bound.height_mm, 0.0, atol=1e-12)
    np.testing.assert_allclose(bound.barycentric, 1.0 / 3.0, atol=1e-12)
    assert bound.triangle[0] == 57


def test_a_rigid_motion_of_the_mesh_carries_the_points() -> None:
    vertices, triangles = _bowl()
    points, _ = _near(vertices, triangles, 2)
    bound = bind_points(points, vertices, triangles)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        motion = Pose.from_rotation_vector(rng.normal(0, 1, 3), rng.normal(0, 50, 3))
        moved = motion.apply(vertices)
        _, placed = _placed(bound, moved, triangles)
        np.testing.assert_allclose(placed, motion.apply(points), atol=1e-8)  # mm


def test_a_point_beyond_the_border_is_left_unbound() -> None:
    vertices, triangles = _bowl()
    bound = bind_points(np.array([[80.0, 0.0, 0.0]]), vertices, triangles)
    assert bound.triangle[0] == -1
    assert np.isnan(bound.height_mm[0])
    assert np.isnan(bound.barycentric).all()
