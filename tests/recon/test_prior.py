"""The prior's disparity map: exact on planes, like its slow form, on the pyramid's pixels."""

import time

import numpy as np
import pytest

from capture.errors import SettingsError, ShapeError
from recon.disparity import pyramid
from recon.prior import PriorMesh, PriorMeshes, prior_disparity
from recon.rectify import Rectification, rectification
from tests.synthetic_stereo import RADII_MM, hit, ring

ARRAY = ring((-9.0, 9.0), (-8.0, 8.0))


def pair(first: int = 0, second: int = 1) -> Rectification:
    return rectification(ARRAY[first], ARRAY[second], np.zeros(3), 110.0)


def sphere(rings: int = 24, radii: np.ndarray = RADII_MM) -> tuple[np.ndarray, np.ndarray]:
    """An ellipsoid of quads split in two, counter-clockwise from outside."""
    columns = 2 * rings
    polar = np.linspace(0, np.pi, rings + 1)
    round_ = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    p, r = (grid.ravel() for grid in np.meshgrid(polar, round_, indexing="ij"))
    vertices = np.stack([np.sin(p) * np.sin(r), np.cos(p), np.sin(p) * np.cos(r)], 1) * radii
    i, j = (g.ravel() for g in np.meshgrid(np.arange(rings), np.arange(columns), indexing="ij"))
    a, b = i * columns + j, i * columns + (j + 1) % columns
    quads = np.stack([a, a + columns, b + columns, b], axis=1)
    return vertices, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]).astype(np.int32)


def square(normal: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two large triangles that face along `normal`, and a far corner that tells their inside."""
    x = np.cross([0.0, 1.0, 0.0], normal)
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    corners = [centre + 300 * (s * x + t * y) for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    back = centre - 200 * normal
    faces = [[0, 1, 2], [0, 2, 3], [1, 0, 4], [2, 1, 4], [3, 2, 4], [0, 3, 4]]
    return np.array([*corners, back]), np.array(faces, np.int32)


def slow(geometry: Rectification, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Every pixel's ray against every triangle, by solving for the crossing in world space."""
    out = np.full((geometry.height, geometry.width), np.nan)
    a = vertices[triangles[:, 0]] - geometry.left.centre
    edges = (
        np.stack([vertices[triangles[:, 1]], vertices[triangles[:, 2]]], axis=2)
        - vertices[triangles[:, 0]][:, :, None]
    )
    outward = np.cross(edges[:, :, 0], edges[:, :, 1])
    for i in range(geometry.height):
        for j in range(geometry.width):
            local = [j - geometry.left_column, i - geometry.row, geometry.focal_px]
            ray = np.array(local) @ geometry.rotation
            front = outward @ ray < -1e-9
            system = np.concatenate(
                [np.broadcast_to(ray[None, :, None], (front.sum(), 3, 1)), -edges[front]], axis=2
            )
            t, u, v = np.linalg.solve(system, a[front][:, :, None])[:, :, 0].T
            inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
            if inside.any():
                depth = t[inside].min() * geometry.focal_px
                out[i, j] = geometry.disparity(np.array(depth))
    return out


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("pair_of", [(0, 1), (0, 2)])
def test_a_slanted_plane_is_exact(level: int, pair_of: tuple[int, int]):
    geometry = pair(*pair_of)
    normal = np.array([0.3, -0.4, 1.0]) / np.linalg.norm([0.3, -0.4, 1.0])
    centre = np.array([3.0, -5.0, 20.0])
    found = prior_disparity(geometry, *square(normal, centre), level)
    assert found.shape == (geometry.height >> level, geometry.width >> level)
    factor = 2**level
    columns = factor * (np.arange(found.shape[1]) + 0.5) - 0.5
    rows = factor * (np.arange(found.shape[0]) + 0.5) - 0.5
    u, v = np.meshgrid(columns - geometry.left_column, rows - geometry.row)
    rays = np.stack([u, v, np.full_like(u, geometry.focal_px)], axis=-1) @ geometry.rotation
    t = ((centre - geometry.left.centre) @ normal) / (rays @ normal)
    truth = geometry.disparity(t * geometry.focal_px) / factor
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, truth, atol=2e-5)


def test_a_curved_mesh_is_as_ray_casting_says():
    geometry = pair().cropped(60, 55, 70, 64)
    vertices, triangles = sphere(10)
    expected = slow(geometry, vertices, triangles)
    found = prior_disparity(geometry, vertices, triangles)
    edge = np.isfinite(found) != np.isfinite(expected)
    assert edge.sum() <= 2  # silhouettes pass through pixel centres nowhere but by chance
    both = np.isfinite(found) & np.isfinite(expected)
    assert both.sum() > 500
    np.testing.assert_allclose(found[both], expected[both], atol=2e-5)


def test_the_nearest_of_two_surfaces_is_seen_whatever_the_order():
    geometry = pair()
    vertices, triangles = sphere()
    small = 0.3 * vertices + [0.0, 0.0, 120.0]
    both = np.concatenate([vertices, small])
    faces = np.concatenate([triangles, triangles + len(vertices)])
    one = prior_disparity(geometry, both, faces)
    other = prior_disparity(geometry, both, np.ascontiguousarray(faces[::-1]))
    assert one.tobytes() == other.tobytes()
    alone = prior_disparity(geometry, small, triangles)
    seen = np.isfinite(alone)
    assert seen.sum() > 200
    np.testing.assert_array_equal(one[seen], alone[seen])


def test_there_are_no_cracks_between_triangles():
    found = np.isfinite(prior_disparity(pair(), *sphere(40)))
    rows = np.flatnonzero(found.any(axis=1))
    for row in rows:
        seen = np.flatnonzero(found[row])
        assert found[row, seen[0] : seen[-1] + 1].all()


def test_the_inside_is_not_drawn_and_winding_does_not_matter():
    vertices, triangles = sphere()
    geometry = pair()
    whole = prior_disparity(geometry, vertices, triangles)
    turned = prior_disparity(geometry, vertices, np.ascontiguousarray(triangles[:, ::-1]))
    np.testing.assert_array_equal(whole, turned)
    middle = vertices[triangles].mean(axis=1)
    open_front = triangles[~((middle[:, 2] > 55) & (np.abs(middle[:, :2]) < 25).all(axis=1))]
    hollow = prior_disparity(geometry, vertices, open_front)
    gone = np.isfinite(whole) & np.isnan(hollow)
    assert gone.sum() > 100
    kept = np.isfinite(hollow)
    np.testing.assert_array_equal(hollow[kept], whole[kept])


def test_the_levels_are_those_of_the_pyramid():
    geometry = pair()
    plane = square(np.array([0.5, -0.3, 1.0]) / np.linalg.norm([0.5, -0.3, 1.0]), np.zeros(3))
    fine = prior_disparity(geometry, *plane)
    levels = pyramid(fine, fine, -(-max(fine.shape) // 4))
    assert len(levels) == 3
    coarse = prior_disparity(geometry, *plane, level=2)
    np.testing.assert_allclose(coarse, levels[-1][0] / 4.0, atol=2e-5)


def test_the_map_agrees_with_the_surface_it_was_drawn_from():
    geometry = pair()
    camera = geometry.left
    pixels = np.array([[100.0, 90.0], [80.0, 110.0], [120.0, 100.0]])
    column, row, disparity = geometry.project(hit(camera, pixels)).T
    found = prior_disparity(geometry, *sphere(120))
    for k in range(len(pixels)):
        i, j = int(np.rint(row[k])), int(np.rint(column[k]))
        assert abs(found[i, j] - disparity[k]) < 0.25  # half a pixel aside, and facets


def test_what_lies_behind_the_pair_or_is_not_known_is_left_out():
    geometry = pair()
    vertices, triangles = sphere()
    behind = vertices + [0.0, 0.0, 2000.0]
    assert not np.isfinite(prior_disparity(geometry, behind, triangles)).any()
    holed = vertices.copy()
    holed[:400] = np.nan
    assert (
        0
        < np.isfinite(prior_disparity(geometry, holed, triangles)).sum()
        < np.isfinite(prior_disparity(geometry, vertices, triangles)).sum()
    )


def test_a_head_is_drawn_in_a_blink():
    camera = ring((-9.0, 9.0), size=700)
    geometry = rectification(camera[0], camera[1], np.zeros(3), 110.0)
    mesh = sphere(75)
    assert len(mesh[1]) > 22_000
    prior_disparity(geometry, *mesh)
    spent = []
    for _ in range(5):
        start = time.process_time()
        prior_disparity(geometry, *mesh)
        spent.append(time.process_time() - start)
    assert min(spent) < 0.05  # seconds


def test_a_frame_takes_its_own_mesh_or_the_one_before():
    vertices, triangles = sphere(6)
    frames = np.array([2, 5], dtype=np.int64)
    stack = np.stack([vertices, vertices + 1.0]).astype(np.float32)
    meshes = PriorMeshes(frames, stack, triangles)
    assert meshes.at(1, 8.0) is None
    assert meshes.digest(1) == "none"
    for frame, place in ((2, 0), (4, 0), (5, 1), (90, 1)):
        mesh = meshes.at(frame, 3.0)
        assert mesh is not None
        assert mesh.reach_mm == 3.0
        np.testing.assert_array_equal(mesh.vertices, stack[place])
    assert meshes.digest(2) == meshes.digest(4) != meshes.digest(5)


def test_errors_say_what_does_not_fit():
    vertices, triangles = sphere(6)
    with pytest.raises(SettingsError, match="reach_mm"):
        PriorMesh(vertices, triangles, 0.0)
    with pytest.raises(ShapeError, match="indices must lie in"):
        PriorMesh(vertices[:9], triangles)
    with pytest.raises(ShapeError, match="at least one"):
        PriorMesh(vertices, triangles[:0])
    stack = vertices[None].astype(np.float32)
    with pytest.raises(ShapeError, match="rising frame numbers"):
        PriorMeshes(np.array([3, 3]), np.concatenate([stack, stack]), triangles)
    with pytest.raises(ShapeError, match=r"prior|vertices"):
        PriorMeshes(np.array([0]), stack[0], triangles)
