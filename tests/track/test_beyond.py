"""Search beyond the edge of a piece of surface, on a patch with a slit that parts like a mouth."""

import numpy as np
import pytest

from capture.arrays import Floats, Floats32
from capture.camera import Camera
from recon.mesh import Mesh
from tests.track.moving_patch import patch_array, picture, slit_mesh
from track.beyond import own_slope, search_beyond
from track.flow import search_flow
from track.guide import GuidedView, guided_view
from track.raster import Rasterizer
from track.reference import ReferenceLevel, facing_normals, reference_level, visible_samples
from track.surface_samples import sample_surface, vertex_rings

REACH_PX = 9
Slit = tuple[Camera, Mesh, ReferenceLevel, Floats, Floats]


@pytest.fixture(scope="module")
def slit() -> Slit:
    """A camera, the closed mesh, its reference, all samples' points, and how far each falls."""
    mesh, below = slit_mesh()
    camera = patch_array()[1]
    samples = sample_surface(mesh.vertices, mesh.triangles, 6.0)
    drawn = Rasterizer(mesh.triangles, len(mesh.vertices)).render(camera, mesh.vertices)
    normals = facing_normals(mesh.vertices, mesh.triangles)
    chosen = visible_samples(samples, mesh.vertices, normals, camera, drawn, 0.35)
    points = samples.points(mesh.vertices)
    rings = vertex_rings(mesh.triangles, len(mesh.vertices), 3)
    surface = (mesh.triangles, samples.triangle[chosen], rings)
    image = picture(camera, mesh, mesh.vertices)
    pixels = camera.project(points[chosen])
    level = reference_level(camera, image, drawn, pixels, chosen, surface, 6)
    return camera, mesh, level, points[chosen], below


def _open(mesh: Mesh, below: Floats, amount_mm: float) -> Floats:
    """The lower piece moved down as a whole."""
    return mesh.vertices - amount_mm * below[:, None] * np.array([0.0, 1.0, 0.0])


def _view(slit: Slit, guess_mm: float, truth_mm: float) -> tuple[GuidedView, Floats32]:
    camera, mesh, level, _, below = slit
    image = picture(camera, mesh, _open(mesh, below, truth_mm))
    return guided_view(level, mesh.triangles, _open(mesh, below, guess_mm), image), image


def _lower_lip(slit: Slit) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Samples within 6 mm under the line, inside the cut."""
    _, _, _, points, _ = slit
    x, y = points[:, 0], points[:, 1]
    return np.asarray((np.abs(x) < 12.0) & (y < -1.0) & (y > -6.0))


def test_a_lip_that_comes_up_is_found_in_the_gap(slit: Slit) -> None:
    _, _, level, _, _ = slit
    view, image = _view(slit, guess_mm=14.0, truth_mm=9.5)  # 4.5 mm: 7.8 px up
    lip = _lower_lip(slit)
    every = np.ones(len(level.samples), bool)
    inside = search_flow(level, view, every, REACH_PX)
    found = search_beyond(level, view, image, every, (REACH_PX, 3))
    best, over = inside.displacement[lip], found.displacement[lip]
    assert lip.sum() >= 5
    assert (np.abs(best[:, 1] + 7.8) < 1.0).mean() < 0.5  # the guided view does not show it
    assert (np.abs(over[:, 1] + 7.8) < 0.6).all()
    assert (found.correlation[lip] > 0.9).all()


def test_where_the_guide_is_right_nothing_moves(slit: Slit) -> None:
    _, _, level, _, _ = slit
    view, image = _view(slit, guess_mm=9.0, truth_mm=9.0)
    lip = _lower_lip(slit)
    found = search_beyond(level, view, image, lip, (REACH_PX, 3))
    assert np.abs(found.displacement[lip]).max() < 0.1  # px
    assert np.isnan(found.displacement[~lip]).all()
    assert (found.correlation[~lip] == -1.0).all()


def test_a_slope_does_not_look_across_the_edge(slit: Slit) -> None:
    """Both pieces move without stretch: every derivative is near the identity."""
    _, _, level, _, _ = slit
    view, _ = _view(slit, guess_mm=12.0, truth_mm=12.0)
    edge = np.flatnonzero(_lower_lip(slit))
    slopes = np.array([own_slope(view.place, level.windows[n], *level.centres[n]) for n in edge])
    assert np.abs(slopes - [1.0, 0.0, 0.0, 1.0]).max() < 0.3
