"""Texture stability: a mesh that follows the skin leaves no flow, one that slides is found out."""

from __future__ import annotations

import numpy as np
import pytest

from capture.arrays import Floats
from capture.camera import Camera
from tests.track.moving_patch import patch_array, patch_mesh, patch_motion, picture
from track.quality_texture import TextureWatch

MESH = patch_mesh()


@pytest.fixture(scope="module")
def camera() -> Camera:
    return patch_array(3, 360)[1]


@pytest.fixture(scope="module")
def watch(camera: Camera) -> TextureWatch:
    image = picture(camera, MESH, MESH.vertices)
    return TextureWatch(MESH, {camera.name: camera}, {camera.name: image})


def _moved(amount: float) -> Floats:
    return patch_motion(MESH.vertices, amount)


def test_the_reference_itself_is_still(watch: TextureWatch, camera: Camera) -> None:
    image = picture(camera, MESH, MESH.vertices)
    found = watch.residual(MESH.vertices, {camera.name: image})[camera.name]
    assert found.p95_px < 0.02
    assert found.flow_px.shape == (360, 360, 2)
    assert np.isnan(found.flow_px[0, 0]).all()


def test_skin_that_is_followed_is_still_in_other_light(watch: TextureWatch, camera: Camera) -> None:
    image = picture(camera, MESH, _moved(1.0), gain=0.85)
    found = watch.residual(_moved(1.0), {camera.name: image})[camera.name]
    assert found.median_px < 0.06


@pytest.mark.parametrize("slide_mm", [0.1, 0.3])
def test_a_mesh_that_slides_is_found_out(
    watch: TextureWatch, camera: Camera, slide_mm: float
) -> None:
    image = picture(camera, MESH, _moved(1.0))
    slid = _moved(1.0) + np.array([slide_mm, 0.0, 0.0])
    found = watch.residual(slid, {camera.name: image})[camera.name]
    expected = slide_mm * camera.fx / float(np.median(camera.depths(slid)))
    assert found.median_px == pytest.approx(expected, rel=0.2, abs=0.03)


def test_views_without_the_frame_or_the_skin_tell_nothing(
    watch: TextureWatch, camera: Camera
) -> None:
    assert watch.residual(MESH.vertices, {}) == {}
    image = picture(camera, MESH, MESH.vertices)
    away = MESH.vertices + np.array([500.0, 0.0, 0.0])
    found = watch.residual(away, {camera.name: image})[camera.name]
    assert np.isnan(found.median_px)
    noise = np.random.default_rng(2).normal(0.5, 0.02, image.shape).astype(np.float32)
    found = watch.residual(MESH.vertices, {camera.name: noise})[camera.name]
    assert np.isnan(found.median_px)
    assert np.isnan(found.flow_px).all()
