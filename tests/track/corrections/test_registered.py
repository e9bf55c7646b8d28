"""Pins and curves in a registration: obeyed where they speak, silent where they do not."""

from __future__ import annotations

import numpy as np
import pytest

from capture.arrays import Floats
from tests.track.corrections.patch_subject import MESH, SUBJECT
from tests.track.moving_patch import patch_motion, picture
from track.corrections.entries import Correction, Curve, Pin
from track.corrections.replay import Corrections
from track.face_reference import ReferenceWindows
from track.registration import FrameAids, Registrar, RegistrarOptions
from track.schedule import schedule
from track.surface_model import SurfaceModel

CAMERAS = {camera.name: camera for camera in SUBJECT.cameras}
TRUTH = patch_motion(MESH.vertices, 1.0)
ROW = tuple(range(9 * 19 + 3, 9 * 19 + 16))  # across the patch's nose
INNER = np.array(ROW[1:-1])


@pytest.fixture(scope="module")
def registrar() -> Registrar:
    return Registrar(
        SurfaceModel.of(MESH.vertices, MESH.triangles, 6.0, None),
        CAMERAS,
        {name: picture(camera, MESH, MESH.vertices) for name, camera in CAMERAS.items()},
        RegistrarOptions(
            steps=schedule(1, 12.0, 2, (4.0, 2.0)),
            windows=ReferenceWindows(levels=1, half=6, half_coarse=4, min_cosine=0.35),
            min_correlation=0.6,
            search_stride=3,
            rotation_iterations=2,
            threads=1,
        ),
    )


@pytest.fixture(scope="module")
def images() -> dict[str, np.ndarray]:
    return {name: picture(camera, MESH, TRUTH) for name, camera in CAMERAS.items()}


def solved(registrar: Registrar, images: dict[str, np.ndarray], *told: Correction) -> Floats:
    sightings = Corrections(SUBJECT, told).for_frame(1).sightings
    start = patch_motion(MESH.vertices, 0.6)
    start[:, 0] += 1.5  # along the row: a curve cannot know
    return registrar.register(start, images, FrameAids(sightings=sightings)).vertices


def pin(vertex: int, away_px: float, *cameras: str) -> Pin:
    pixels = {name: CAMERAS[name].project(TRUTH[[vertex]])[0] + away_px for name in cameras}
    return Pin(
        frame=1,
        corners=(vertex,),
        barycentric=(1.0,),
        pixels={name: (float(x), float(y)) for name, (x, y) in pixels.items()},
    )


def curve(camera: str, away_px: float) -> Curve:
    line = CAMERAS[camera].project(TRUTH[list(ROW)]) + [0.0, away_px]
    return Curve(
        frame=1,
        camera=camera,
        chain="row",
        vertices=tuple(INNER.tolist()),
        pixels=tuple((float(x), float(y)) for x, y in line),
    )


def test_a_curve_leaves_its_vertices_free_along_it(
    registrar: Registrar, images: dict[str, np.ndarray]
) -> None:
    alone = np.linalg.norm(solved(registrar, images) - TRUTH, axis=1)[INNER]
    drawn = np.linalg.norm(solved(registrar, images, curve("cam01", 0.0)) - TRUTH, axis=1)[INNER]
    assert np.median(alone) < 0.05  # mm
    assert np.median(drawn) < 0.05  # mm; held where they began, they would be off by 1.5
    assert drawn.max() < 0.1


def test_a_curve_beside_the_skin_is_followed(
    registrar: Registrar, images: dict[str, np.ndarray]
) -> None:
    found = solved(registrar, images, curve("cam01", 3.0))
    seen = CAMERAS["cam01"].project(found[INNER]) - CAMERAS["cam01"].project(TRUTH[INNER])
    assert np.abs(seen[:, 1] - 3.0).max() < 0.6  # px


def test_a_pin_in_one_view_leaves_depth_to_the_flow(
    registrar: Registrar, images: dict[str, np.ndarray]
) -> None:
    found = solved(registrar, images, pin(180, 0.0, "cam01"))
    assert np.linalg.norm(found[180] - TRUTH[180]) < 0.05  # mm


def test_a_pin_is_obeyed_against_the_flow(
    registrar: Registrar, images: dict[str, np.ndarray]
) -> None:
    found = solved(registrar, images, pin(180, 4.0, "cam01", "cam03"))
    for name in ("cam01", "cam03"):
        away = CAMERAS[name].project(found[[180]]) - CAMERAS[name].project(TRUTH[[180]])
        assert np.linalg.norm(away[0] - 4.0) < 1.0  # px: the two pins do not meet in one point
    far = np.linalg.norm(MESH.vertices - MESH.vertices[180], axis=1) > 20.0
    inside = np.abs(MESH.vertices[:, :2]).max(axis=1) < 35.0
    assert np.linalg.norm(found - TRUTH, axis=1)[far & inside].max() < 0.15  # mm
