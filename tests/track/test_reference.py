"""Samples, windows and the guide: what views see, on one piece of surface, and where it went."""

import numpy as np

from capture.arrays import Floats
from recon.mesh import Mesh
from tests.track.moving_patch import patch_array, patch_mesh, patch_motion, picture
from track.guide import guided_view
from track.pyramid import camera_at_level, image_pyramid, level_count
from track.raster import Rasterizer
from track.reference import ReferenceLevel, facing_normals, reference_level, visible_samples
from track.surface_samples import sample_surface, vertex_rings

HALF = 5


def _two_sheets() -> Mesh:
    """The patch, and a strip in front of its upper half that is no part of it."""
    mesh = patch_mesh()
    strip = mesh.vertices + [0.0, 40.0, 30.0]
    polygons = np.concatenate([mesh.polygons, mesh.polygons + len(strip)]).astype(np.int32)
    return Mesh(np.concatenate([mesh.vertices, strip]), polygons)


def _level(mesh: Mesh, view: int = 1) -> ReferenceLevel:
    camera = patch_array()[view]
    draw = Rasterizer(mesh.triangles, len(mesh.vertices))
    buffers = draw.render(camera, mesh.vertices)
    samples = sample_surface(mesh.vertices, mesh.triangles, 3.0)
    normals = facing_normals(mesh.vertices, mesh.triangles)
    chosen = visible_samples(samples, mesh.vertices, normals, camera, buffers, 0.35)
    pixels = camera.project(samples.points(mesh.vertices)[chosen])
    rings = vertex_rings(mesh.triangles, len(mesh.vertices), 3)
    surface = (mesh.triangles, samples.triangle[chosen], rings)
    image = picture(camera, mesh, mesh.vertices)
    return reference_level(camera, image, buffers, pixels, chosen, surface, HALF)


def test_samples_are_the_vertices_and_points_inside_wide_triangles() -> None:
    mesh = patch_mesh()
    fine = sample_surface(mesh.vertices, mesh.triangles, 2.0)
    np.testing.assert_allclose(
        fine.points(mesh.vertices)[: len(mesh.vertices)], mesh.vertices, atol=1e-12
    )
    assert len(fine) > 3 * len(mesh.vertices)
    np.testing.assert_allclose(fine.barycentric.sum(axis=1), 1.0)
    assert (fine.barycentric >= 0).all()
    assert len(sample_surface(mesh.vertices, mesh.triangles, 50.0)) == len(mesh.vertices)


def test_hidden_samples_are_not_visible() -> None:
    mesh = _two_sheets()
    level = _level(mesh)
    count = len(mesh.vertices) // 2
    samples = sample_surface(mesh.vertices, mesh.triangles, 3.0)
    points = samples.points(mesh.vertices)[level.samples]
    behind = samples.corners[level.samples].max(axis=1) < count
    # well under the strip, which begins at y = -5 and is as wide as the patch
    shadow = (points[behind][:, 1] > 12.0) & (np.abs(points[behind][:, 0]) < 30.0)
    assert behind.sum() > 100
    assert shadow.sum() == 0


def test_windows_stay_on_their_piece_of_surface() -> None:
    mesh = _two_sheets()
    level = _level(mesh)
    count = len(mesh.vertices) // 2
    part = np.where(level.triangle >= 0, mesh.triangles[level.triangle, 0] // count, -1)
    samples = sample_surface(mesh.vertices, mesh.triangles, 3.0)
    cut = 0
    for n, (x, y) in enumerate(level.centres):
        if x < HALF or y < HALF or max(x, y) >= 200 - HALF or not level.windows[n].any():
            continue
        own = samples.corners[level.samples[n], 0] // count
        around = part[y - HALF : y + HALF + 1, x - HALF : x + HALF + 1]
        assert (around[level.windows[n] == 1] == own).all()
        cut += int((around != own).any())
    assert cut > 50  # the borders were there to be crossed


def test_the_guide_is_the_rasterized_motion_field() -> None:
    mesh = patch_mesh()
    level = _level(mesh)
    moved = patch_motion(mesh.vertices, 1.0)
    image = picture(level.camera, mesh, moved)
    view = guided_view(level, mesh.triangles, moved, image)
    draw = Rasterizer(mesh.triangles, len(mesh.vertices))
    motion = draw.render(level.camera, mesh.vertices, moved).motion
    assert motion is not None
    y, x = np.nonzero(np.isfinite(view.place[..., 0]))
    expected = motion[y, x] + np.column_stack([x, y])
    np.testing.assert_allclose(view.place[y, x], expected, atol=0.01)  # px
    solid = view.solid == 1
    assert solid.mean() > 0.5
    difference = np.abs(view.image - level.image)[solid]
    assert np.median(difference) < 0.01  # the texture sticks: what is left is interpolation
    still = np.abs(image - level.image)[solid]
    assert np.median(still) > 5 * np.median(difference)


def test_what_the_mesh_hides_in_the_frame_is_not_solid() -> None:
    mesh = patch_mesh()
    level = _level(mesh)
    turned = mesh.vertices.copy()
    near = camera_at_level(level.camera, 1)
    depth = Rasterizer(mesh.triangles, len(turned)).render(near, turned).depth
    free = guided_view(level, mesh.triangles, turned, level.image, (depth, 2.0))
    assert free.solid.sum() == guided_view(level, mesh.triangles, turned, level.image).solid.sum()
    wall = (depth - 30.0).astype(np.float32)
    hidden = guided_view(level, mesh.triangles, turned, level.image, (wall, 2.0))
    assert hidden.solid.sum() < 0.05 * free.solid.sum()


def test_a_level_of_the_pyramid_has_its_own_camera() -> None:
    camera = patch_array()[0]
    points: Floats = patch_mesh().vertices
    for level in range(4):
        small = camera_at_level(camera, level)
        np.testing.assert_allclose(
            small.project(points) * 2**level, camera.project(points), atol=1e-9
        )
        image = image_pyramid(np.zeros((200, 200), np.float32), level + 1)[-1]
        assert image.shape == (small.height, small.width)
    assert [level_count(w, w) for w in (100, 160, 640, 1024, 2048)] == [1, 1, 3, 4, 5]
