"""The rasterizer against a literal loop over pixels and triangles, and against the camera."""

import numpy as np
import pytest

from capture.arrays import Floats, Ints32
from capture.camera import Camera
from capture.errors import ShapeError
from capture.pose import Pose
from track.raster import Rasterizer


def _camera(width: int = 61, height: int = 47, distortion: float = -0.15) -> Camera:
    return Camera(
        name="cam", width=width, height=height, fx=70.0, fy=72.0, cx=29.3, cy=24.1,
        distortion=np.array([distortion, 0.1, 1e-3, -5e-4, 0.0]),
        camera_from_world=Pose.from_rotation_vector(
            np.array([0.1, -0.2, 0.05]), np.array([2.0, -3.0, 300.0])
        ),
    )  # fmt: skip


def _bumpy(side: int = 12, seed: int = 0) -> tuple[Floats, Ints32]:
    """A grid of (side + 1)^2 vertices over 200 x 180 mm with bumps, and a sheet behind it."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : side + 1, 0 : side + 1] / side
    front = np.stack([200 * (x - 0.5), 180 * (y - 0.5), 25 * np.sin(5 * x) * np.cos(4 * y)], -1)
    front = front.reshape(-1, 3) + rng.normal(0, 1.5, ((side + 1) ** 2, 3))
    back = front + [8.0, 5.0, 40.0]
    corner = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    tri = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    return np.concatenate([front, back]), np.concatenate([tri, tri + len(front)]).astype(np.int32)


def _literal(camera: Camera, vertices: Floats, triangles: Ints32) -> tuple[Ints32, Floats, Floats]:
    """Nearest triangle by a loop, its depth, and how far (px) the pixel is from a decision."""
    pixels, depth = camera.project(vertices), camera.depths(vertices)
    best = np.full((camera.height, camera.width), np.inf)
    ids = np.full(best.shape, -1, np.int32)
    margin = np.full(best.shape, np.inf)
    y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
    for index, corner in enumerate(triangles):
        p, z = pixels[corner], depth[corner]
        area = np.linalg.det(np.stack([p[1] - p[0], p[2] - p[0]]))
        flat = []
        for k in range(3):
            i, j = p[(k + 1) % 3], p[(k + 2) % 3]
            signed = ((j[0] - i[0]) * (y - i[1]) - (j[1] - i[1]) * (x - i[0])) * np.sign(area)
            flat.append(signed / abs(area))
            along = ((x - i[0]) * (j[0] - i[0]) + (y - i[1]) * (j[1] - i[1])) / ((j - i) ** 2).sum()
            near = np.hypot(x - i[0] - np.clip(along, 0, 1) * (j[0] - i[0]),
                            y - i[1] - np.clip(along, 0, 1) * (j[1] - i[1]))  # fmt: skip
            margin = np.minimum(margin, near)
        weights = np.stack(flat) / z[:, None, None]
        surface = 1.0 / weights.sum(axis=0)
        inside = (np.stack(flat) >= 0).all(axis=0)
        nearer = inside & (surface < best)
        best[nearer], ids[nearer] = surface[nearer], index
    return ids, np.where(ids >= 0, best, np.nan), margin


def test_ids_and_depth_equal_a_literal_rasterizer() -> None:
    camera = _camera()
    vertices, triangles = _bumpy()
    buffers = Rasterizer(triangles, len(vertices)).render(camera, vertices)
    ids, depth, margin = _literal(camera, vertices, triangles)
    clear = margin > 0.02  # px from any edge: there rounding may choose either side
    assert clear.mean() > 0.9
    assert (ids >= 0).sum() > 1000
    np.testing.assert_array_equal(buffers.triangle[clear], ids[clear])
    np.testing.assert_allclose(buffers.depth[clear], depth[clear], atol=2e-3)  # mm


@pytest.mark.parametrize("distortion", [0.0, -0.15, 0.15])
def test_barycentrics_project_back_to_the_pixel_centre(distortion: float) -> None:
    camera = _camera(distortion=distortion)
    vertices, triangles = _bumpy(side=36)
    buffers = Rasterizer(triangles, len(vertices)).render(camera, vertices)
    y, x = np.nonzero(buffers.triangle >= 0)
    weights = buffers.barycentric[y, x].astype(np.float64)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
    inside = (weights > 0).all(axis=1)
    points = np.einsum("nk,nkx->nx", weights, vertices[triangles[buffers.triangle[y, x]]])
    error = np.linalg.norm(camera.project(points) - np.column_stack([x, y]), axis=1)
    assert error[inside].max() < 0.01  # px
    assert np.abs(camera.depths(points) - buffers.depth[y, x])[inside].max() < 0.02  # mm


def test_motion_is_the_moved_image_minus_the_image() -> None:
    camera = _camera()
    vertices, triangles = _bumpy(side=36)
    moved = vertices @ Pose.from_rotation_vector(np.array([0.05, 0.1, 0.0]), np.zeros(3)).rotation.T
    moved += [3.0, -2.0, 5.0]
    buffers = Rasterizer(triangles, len(vertices)).render(camera, vertices, moved)
    assert buffers.motion is not None
    assert buffers.moved_depth is not None
    y, x = np.nonzero((buffers.barycentric > 0).all(axis=2))
    corners = triangles[buffers.triangle[y, x]]
    weights = buffers.barycentric[y, x].astype(np.float64)
    after = np.einsum("nk,nkx->nx", weights, moved[corners])
    expected = camera.project(after) - np.column_stack([x, y])
    np.testing.assert_allclose(buffers.motion[y, x], expected, atol=0.02)  # px
    np.testing.assert_allclose(buffers.moved_depth[y, x], camera.depths(after), atol=0.02)  # mm
    assert np.isnan(buffers.motion[buffers.triangle < 0]).all()


def test_what_lies_behind_or_outside_is_left_out() -> None:
    camera = _camera()
    vertices, triangles = _bumpy()
    draw = Rasterizer(triangles, len(vertices))
    centre = camera.centre
    behind = draw.render(camera, 2 * centre - vertices)
    assert (behind.triangle == -1).all()
    assert np.isnan(behind.depth).all()
    assert (behind.barycentric == 0).all()
    half = vertices.copy()
    half[0] = 2 * centre - vertices[0]  # one vertex behind: its triangles go, the others stay
    left = draw.render(camera, half).triangle
    assert not np.isin(left, np.flatnonzero((triangles == 0).any(axis=1))).any()
    assert (left >= 0).any()


def test_a_point_beyond_the_fold_of_a_barrel_lens_does_not_appear() -> None:
    camera = _camera(distortion=-0.6)
    aside = camera.camera_from_world.inverse().apply(
        np.array([[500.0, 0.0, 200.0], [520.0, 0.0, 200.0], [500.0, 20.0, 200.0]])
    )
    buffers = Rasterizer(np.array([[0, 1, 2]], np.int32), 3).render(camera, aside)
    assert (buffers.triangle == -1).all()


def test_same_bytes_twice_and_from_another_rasterizer() -> None:
    camera = _camera()
    vertices, triangles = _bumpy()
    draw = Rasterizer(triangles, len(vertices))
    first, second = (
        draw.render(camera, vertices, vertices + 1),
        draw.render(camera, vertices, vertices + 1),
    )
    third = Rasterizer(triangles, len(vertices)).render(camera, vertices, vertices + 1)
    for other in (second, third):
        for name in ("triangle", "barycentric", "depth", "motion", "moved_depth"):
            assert getattr(first, name).tobytes() == getattr(other, name).tobytes()


def test_an_index_without_a_vertex_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"must lie in 0\.\.3, found 0\.\.4"):
        Rasterizer(np.array([[0, 1, 4]], np.int32), 4)
    draw = Rasterizer(np.array([[0, 1, 2]], np.int32), 4)
    with pytest.raises(ShapeError, match="vertices: expected shape"):
        draw.render(_camera(), np.zeros((5, 3)))
