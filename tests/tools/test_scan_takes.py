from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera import Camera, CameraArray
from capture.camera_file import read_cameras
from recon.mesh import vertex_normals
from recon.surface import closest_points
from tools.bench.scan_takes import Head, face_region, load_head, photographs, studio, write_take

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
FLAT = np.zeros((4, 4, 2), np.float32)
SPOT = (0.82, 0.25)  # uv of the dark spot on the wall


def wall(spacing_mm: float = 30.0, count: int = 7) -> Head:
    """A wall in the plane z = 0 with one dark spot on it."""
    place = np.linspace(0.0, 1.0, count)
    u, v = (axis.ravel() for axis in np.meshgrid(place, place))
    side = spacing_mm * (count - 1)
    vertices = np.stack([(u - 0.5) * side, (v - 0.5) * side, 0.0 * u], axis=1)
    corner = np.arange(count * count).reshape(count, count)
    a, b, c, d = (
        part.ravel()
        for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1])
    )
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    rows, columns = np.mgrid[0:256, 0:256]
    x, y = SPOT[0] * 256 - 0.5, (1 - SPOT[1]) * 256 - 0.5
    texture = 0.35 - 0.3 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 4.0**2))
    normals = vertex_normals(vertices, triangles)
    return Head(vertices, normals, np.stack([u, v], 1), triangles, texture.astype(np.float32), FLAT)


@pytest.mark.parametrize("radial", [0.0, -0.9])
def test_a_spot_of_the_texture_lands_where_the_lens_puts_it(radial: float) -> None:
    straight = studio(192, 3)[7]
    camera = Camera(
        name="bent", width=192, height=192, fx=straight.fx, fy=straight.fy, cx=straight.cx,
        cy=straight.cy, distortion=np.array([radial, 0.0, 0.0, 0.0, 0.0]),
        camera_from_world=straight.camera_from_world,
    )  # fmt: skip
    ((name, picture),) = photographs(wall(), CameraArray((camera,)), seed=3)
    assert name == "bent"
    true = camera.project(np.array([[(SPOT[0] - 0.5) * 180.0, (SPOT[1] - 0.5) * 180.0, 0.0]]))
    left, top = np.rint(true[0]).astype(int) - 7
    window = picture[top : top + 15, left : left + 15].astype(float)
    dark = np.maximum(np.median(window) - 12.0 - window, 0.0)
    rows, columns = np.mgrid[top : top + 15, left : left + 15]
    found = np.array([(dark * columns).sum(), (dark * rows).sum()]) / dark.sum()
    assert np.abs(found - true[0]).max() < 0.12  # px: half a sample off would be 0.25


def test_relief_brightens_what_it_turns_to_the_light() -> None:
    head, cameras = wall(), CameraArray((studio(96, 3)[7],))
    along_u, along_v = head.tangents()
    assert np.allclose(along_u, [1.0, 0.0, 0.0])
    assert np.allclose(along_v, [0.0, 1.0, 0.0])
    light = []
    for slope in (-0.4, 0.4):  # the strongest light comes from above
        turned = Head(
            head.vertices, head.normals, head.uv, head.triangles, head.texture,
            FLAT + np.array([0.0, slope], np.float32),
        )  # fmt: skip
        light.append(dict(photographs(turned, cameras, seed=3))["cam07"].mean())
    assert light[1] > light[0] + 3.0


def test_halving_keeps_the_surface() -> None:
    head = wall(count=3)
    bumpy = head.vertices + np.array([0, 0, 1]) * np.arange(9)[:, None] ** 2
    head = Head(bumpy, head.normals, head.uv, head.triangles, head.texture, FLAT)
    fine = head.halved()
    assert len(fine.triangles) == 4 * len(head.triangles)
    centres = fine.vertices[fine.triangles].mean(axis=1)
    assert closest_points(head.vertices, head.triangles, centres)[2].max() < 1e-4


def test_seams_are_welded_and_slivers_dropped() -> None:
    head = wall(count=3)
    doubled = np.concatenate([head.vertices, head.vertices[[4]]])
    triangles = head.triangles.copy()
    triangles[0][triangles[0] == 4] = 9
    triangles = np.concatenate([triangles, [[4, 9, 0]]]).astype(np.int32)
    seamed = Head(doubled, doubled, doubled[:, :2], triangles, head.texture, FLAT)
    places, faces = seamed.surface()
    assert len(places) == 9
    assert len(faces) == len(head.triangles)


def test_the_same_seed_gives_the_same_take_and_another_another(tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        cameras = CameraArray(studio(64, seed).cameras[:2])
        write_take(tmp_path / name, wall(), cameras, seed)
    for file in ("cameras.json", "cam00/0000.png", "cam01/0000.png", "truth.npz"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
        if file != "truth.npz":
            assert (tmp_path / "a" / file).read_bytes() != (tmp_path / "c" / file).read_bytes()
    cameras = read_cameras(tmp_path / "a" / "cameras.json")
    assert cameras.names == ("cam00", "cam01")
    assert np.array_equal(cameras[1].distortion, studio(64, 3)[1].distortion)
    picture = cv2.imread(str(tmp_path / "a" / "cam00" / "0000.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (64, 64)


def test_the_studio_looks_at_the_face_from_the_front() -> None:
    cameras = studio(512, 8)
    assert len(cameras) == 16
    middle = cameras.project(np.zeros((1, 3)))[:, 0]
    assert np.abs(middle - 255.5).max() < 60.0
    assert all(camera.centre[2] > 200.0 for camera in cameras)
    up = np.array([camera.camera_from_world.rotation[1, 1] for camera in cameras])
    assert (up < -0.85).all()  # rows run down


@pytest.mark.shared_data
def test_the_scanned_head_is_as_large_as_a_head() -> None:
    head = load_head(SHARED / "data" / "lee-perry-smith")
    vertices, triangles = head.surface()
    assert len(triangles) > 17000
    face = vertices[face_region(vertices)]
    assert 3000 < len(face) < 5000
    size = np.ptp(face, axis=0)
    assert 120.0 < size[0] < 170.0  # mm across the cheeks
    assert 180.0 < size[1] < 210.0  # mm chin to hairline
    crown = vertices[:, 1].max() - face[:, 1].min()
    assert 225.0 < crown < 255.0
    outwards = (head.normals * (head.vertices + [0.0, 0.0, 60.0])).sum(axis=1)
    near = head.vertices[:, 2] > 40.0
    assert (outwards[near] > 0).mean() > 0.8
