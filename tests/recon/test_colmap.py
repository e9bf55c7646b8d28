"""The seam to COLMAP: the half pixel, models in and out, refusals, and one small adjustment."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from capture.camera import Camera, CameraArray
from capture.errors import CameraError
from capture.pose import Pose
from recon.board.shape import BoardShape
from recon.calibration.gauge import regauged
from recon.colmap import (
    AdjustOptions,
    adjust_array,
    from_colmap,
    read_model,
    to_colmap,
    write_model,
)
from tools.bench.board_scene import A4_BOARD, BoardScene, make_array, make_state, observe

SCENE = BoardScene(devices=4, size_px=640, focal_px=1440.0, radius_mm=620.0, poses=6, noise_px=0.0)


def with_k3(camera: Camera, k3: float) -> Camera:
    return Camera(
        name=camera.name, width=camera.width, height=camera.height, fx=camera.fx, fy=camera.fy,
        cx=camera.cx, cy=camera.cy, distortion=np.array([*camera.distortion[:4], k3]),
        camera_from_world=camera.camera_from_world,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("model", "k3"), [("OPENCV", 0.0), ("FULL_OPENCV", 0.0), ("FULL_OPENCV", 0.3)]
)
def test_projection_agrees_across_the_half_pixel(model: str, k3: float) -> None:
    points = np.random.default_rng(7).uniform(-80, 80, (60, 3))
    for camera in (with_k3(camera, k3) for camera in make_array(SCENE)):
        theirs = to_colmap(camera, 3, model)
        local = camera.camera_from_world.apply(points)
        pixels = np.array([theirs.img_from_cam(point) for point in local]) - 0.5
        np.testing.assert_allclose(pixels, camera.project(points), atol=1e-6)
        back = from_colmap(theirs, camera.name, camera.camera_from_world)
        np.testing.assert_array_equal(back.matrix, camera.matrix)
        np.testing.assert_array_equal(back.distortion, camera.distortion)


@pytest.mark.parametrize("text", [False, True])
def test_a_model_survives_the_round_trip(tmp_path: Path, text: bool) -> None:
    cameras = list(make_array(SCENE))
    array = CameraArray((*cameras[:3], with_k3(cameras[3], 0.2)))
    write_model(tmp_path / "sparse", array, text=text)
    again = read_model(tmp_path / "sparse")
    assert again.names == array.names
    points = np.random.default_rng(1).uniform(-80, 80, (40, 3))
    np.testing.assert_allclose(again.project(points), array.project(points), atol=1e-6)


@pytest.mark.parametrize(
    ("model", "params", "bend"),
    [
        ("SIMPLE_PINHOLE", [900, 320, 240], [0, 0, 0, 0, 0]),
        ("PINHOLE", [900, 910, 320, 240], [0, 0, 0, 0, 0]),
        ("SIMPLE_RADIAL", [900, 320, 240, -0.1], [-0.1, 0, 0, 0, 0]),
        ("RADIAL", [900, 320, 240, -0.1, 0.02], [-0.1, 0.02, 0, 0, 0]),
    ],
)
def test_the_small_models_are_read(model: str, params: list[float], bend: list[float]) -> None:
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=params)
    ours = from_colmap(theirs, "cam", Pose.identity())
    np.testing.assert_array_equal(ours.distortion, bend)
    assert (ours.cx, ours.cy, ours.fx) == (319.5, 239.5, 900.0)
    point = np.array([[40.0, -25.0, 300.0]])
    np.testing.assert_allclose(
        ours.project(point)[0] + 0.5, theirs.img_from_cam(point[0]), atol=1e-9
    )


def test_lenses_that_do_not_fit_are_refused_by_name() -> None:
    fish = pycolmap.Camera(
        model="OPENCV_FISHEYE", width=640, height=480, params=[900, 900, 320, 240, 0, 0, 0, 0]
    )
    with pytest.raises(CameraError, match="cam7: camera model OPENCV_FISHEYE is not supported"):
        from_colmap(fish, "cam7", Pose.identity())
    full = [900, 900, 320, 240, 0, 0, 0, 0, 0, 0.1, 0, 0]
    bent = pycolmap.Camera(model="FULL_OPENCV", width=640, height=480, params=full)
    with pytest.raises(CameraError, match="cam7: FULL_OPENCV with k4, k5, k6"):
        from_colmap(bent, "cam7", Pose.identity())
    with pytest.raises(CameraError, match="OPENCV holds no k3"):
        to_colmap(with_k3(make_array(SCENE)[0], 0.1), 1)


def model_with(names: list[str], folder: Path) -> Path:
    model = pycolmap.Reconstruction()
    for number, (name, camera) in enumerate(zip(names, make_array(SCENE), strict=False), start=1):
        model.add_camera_with_trivial_rig(to_colmap(camera, number))
        pose = camera.camera_from_world
        rigid = pycolmap.Rigid3d(np.column_stack([pose.rotation, pose.translation]))
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, rigid)
    folder.mkdir()
    model.write_binary(str(folder))
    return folder


def test_cameras_are_named_after_folders_or_flat_images(tmp_path: Path) -> None:
    nested = model_with(["in/left/0.png", "in/right/0.png"], tmp_path / "nested")
    assert read_model(nested).names == ("left", "right")
    flat = model_with(["b.png", "a.png"], tmp_path / "flat")
    assert read_model(flat).names == ("a", "b")


def test_a_camera_at_two_places_is_refused(tmp_path: Path) -> None:
    folder = model_with(["left/0.png", "left/1.png", "right/0.png"], tmp_path / "twice")
    with pytest.raises(CameraError, match=r"left: left/1\.png has another lens or place"):
        read_model(folder)


def test_a_folder_that_is_no_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="expected a COLMAP model"):
        read_model(tmp_path)
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}.bin").write_bytes(b"\x05\x00\x00")
    with pytest.raises(CameraError, match=r"COLMAP model|none of them with a pose"):
        read_model(tmp_path)


def test_the_truth_stays_put_and_a_disturbed_array_returns() -> None:
    truth = make_state(SCENE)
    observations = observe(SCENE, truth)
    moved = [
        camera.posed(
            Pose.from_rotation_vector(np.full(3, 0.002 * k), np.full(3, 2.0 * k))
            @ camera.camera_from_world
        )
        for k, camera in enumerate(truth.cameras)
    ]
    start = type(truth)(CameraArray(tuple(moved)), truth.array_from_board, truth.corners)
    assert np.abs(start.residuals(observations)).max() > 5.0
    found = adjust_array(start, observations, AdjustOptions(loss_px=0.0)).state
    assert np.abs(found.residuals(observations)).max() < 1e-4  # px
    released = adjust_array(start, observations, AdjustOptions(free_board=True)).state
    shape = BoardShape.flat_board(A4_BOARD.corners_mm())
    found = regauged(released, shape, np.unique(observations.corner))
    np.testing.assert_allclose(
        found.residuals(observations), released.residuals(observations), atol=1e-7
    )
    np.testing.assert_allclose(found.corners, truth.corners, atol=2e-3)  # mm
