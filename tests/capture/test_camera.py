"""Laws of the camera model, over seeds and over the whole image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from capture.errors import CameraError, ShapeError
from capture.pose import Pose

# k1 k2 p1 p2 k3 of mild, barrel, pincushion, tangential and fisheye-like lenses
LENSES = {
    "ideal": ([0, 0, 0, 0, 0], 1.0),
    "photogrammetry": ([-0.13, 0.16, -1.5e-4, -3e-4, 0], 2.2),
    "barrel": ([-0.35, 0.12, 1e-3, -2e-3, -0.02], 1.1),
    "fish-like": ([-0.35, 0, 0, 0, 0], 1.15),
    "pincushion": ([0.4, 0.25, 2e-3, 1e-3, 0.1], 0.9),
    "tangential": ([-0.1, 0.02, 0.02, -0.03, 0], 1.3),
}


def camera(lens: str, seed: int = 0, width: int = 640, height: int = 480) -> Camera:
    rng = np.random.default_rng(seed)
    distortion, focal = LENSES[lens]
    return Camera(
        name="cam00",
        width=width,
        height=height,
        fx=focal * width,
        fy=focal * width * 1.01,
        cx=(width - 1) / 2 + rng.normal(0, 4),
        cy=(height - 1) / 2 + rng.normal(0, 4),
        distortion=np.array(distortion, dtype=np.float64),
        camera_from_world=Pose.from_rotation_vector(rng.normal(0, 1, 3), rng.normal(0, 200, 3)),
    )


def image_grid(of: Camera, step: float = 13.0) -> Floats:
    x = np.append(np.arange(-0.5, of.width - 0.5, step), of.width - 0.5)
    y = np.append(np.arange(-0.5, of.height - 0.5, step), of.height - 0.5)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("lens", LENSES)
def test_unproject_then_project_returns_the_pixel_within_1e_6_px(lens: str, seed: int) -> None:
    cam = camera(lens, seed)
    pixels = image_grid(cam)
    depth = np.random.default_rng(seed).uniform(50, 2000, len(pixels))
    points = cam.unproject(pixels, depth)
    assert np.abs(cam.project(points) - pixels).max() < 1e-6
    assert np.abs(cam.depths(points) - depth).max() < 1e-9


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("lens", LENSES)
def test_project_then_unproject_returns_the_point(lens: str, seed: int) -> None:
    cam = camera(lens, seed)
    rng = np.random.default_rng(100 + seed)
    local = np.concatenate([rng.uniform(-0.35, 0.35, (500, 2)), np.ones((500, 1))], axis=1)
    points = cam.camera_from_world.inverse().apply(local * rng.uniform(100, 900, (500, 1)))
    back = cam.unproject(cam.project(points), cam.depths(points))
    assert np.abs(back - points).max() < 1e-6  # mm


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("lens", LENSES)
def test_project_agrees_with_opencv_within_1e_9_px(lens: str, seed: int) -> None:
    cam = camera(lens, seed)
    rng = np.random.default_rng(200 + seed)
    local = np.concatenate([rng.uniform(-0.6, 0.6, (500, 2)), np.ones((500, 1))], axis=1)
    points = cam.camera_from_world.inverse().apply(local * rng.uniform(100, 900, (500, 1)))
    pose = cam.camera_from_world
    expected, _ = cv2.projectPoints(
        points, pose.rotation_vector(), pose.translation, cam.matrix, cam.distortion
    )
    # OpenCV is given an axis and an angle; that detour alone costs about 1e-10 px.
    assert np.abs(cam.project(points) - expected.reshape(-1, 2)).max() < 1e-9


@pytest.mark.parametrize("lens", LENSES)
def test_jacobian_agrees_with_finite_differences(lens: str) -> None:
    cam = camera(lens, 5)
    rng = np.random.default_rng(5)
    local = np.concatenate([rng.uniform(-0.4, 0.4, (50, 2)), np.ones((50, 1))], axis=1)
    points = cam.camera_from_world.inverse().apply(local * 400.0)
    jacobian = cam.project_jacobian(points)
    h = 1e-3
    for axis in range(3):
        shift = np.eye(3)[axis] * h
        slope = (cam.project(points + shift) - cam.project(points - shift)) / (2 * h)
        assert np.abs(jacobian[:, :, axis] - slope).max() < 1e-6  # px per mm


@pytest.mark.parametrize("lens", LENSES)
def test_distort_jacobian_agrees_with_finite_differences(lens: str) -> None:
    cam = camera(lens)
    flat = np.random.default_rng(1).uniform(-0.5, 0.5, (100, 2))
    jacobian = cam.distort_jacobian(flat)
    for axis in range(2):
        shift = np.eye(2)[axis] * 1e-6
        slope = (cam.distort(flat + shift) - cam.distort(flat - shift)) / 2e-6
        assert np.abs(jacobian[:, :, axis] - slope).max() < 1e-8


def test_undistort_beyond_the_fold_is_nan_and_not_a_wrong_point() -> None:
    cam = camera("fish-like")
    far = np.array([[cam.cx + 0.9 * cam.fx, cam.cy], [np.nan, 3.0], [cam.cx, cam.cy]])
    flat = cam.undistort(far)
    assert np.isnan(flat[:2]).all()
    assert np.abs(flat[2]).max() < 1e-12


@pytest.mark.parametrize("seed", range(3))
def test_undistort_stays_on_the_near_side_of_the_fold(seed: int) -> None:
    """A barrel lens bends two ideal points to one pixel; the one nearer the axis is the image."""
    cam = camera("fish-like", seed)
    radius = np.hypot(*cam.undistort(image_grid(cam)).T)
    assert radius.max() < np.sqrt(1 / (3 * 0.35))


def test_points_behind_the_camera_project_to_nan() -> None:
    cam = camera("ideal").posed(Pose.identity())
    pixels = cam.project(np.array([[0.0, 0.0, -5.0], [0.0, 0.0, 0.0], [0.0, 0.0, 5.0]]))
    assert np.isnan(pixels[:2]).all()
    assert np.allclose(pixels[2], [cam.cx, cam.cy])
    assert np.isnan(cam.project_jacobian(np.array([[0.0, 0.0, -5.0]]))).all()


@pytest.mark.parametrize("seed", range(3))
def test_projection_does_not_change_when_world_and_camera_move_together(seed: int) -> None:
    cam = camera("barrel", seed)
    rng = np.random.default_rng(seed)
    motion = Pose.from_rotation_vector(rng.normal(0, 1, 3), rng.normal(0, 300, 3))
    points = cam.unproject(image_grid(cam, 97.0), rng.uniform(200, 900, len(image_grid(cam, 97.0))))
    moved = cam.posed(cam.camera_from_world @ motion.inverse())
    assert np.abs(moved.project(motion.apply(points)) - cam.project(points)).max() < 1e-8


def test_rays_start_at_the_centre_and_pass_through_the_points() -> None:
    cam = camera("photogrammetry", 3)
    pixels = image_grid(cam, 101.0)
    directions = cam.rays(pixels)
    assert np.abs(np.linalg.norm(directions, axis=1) - 1).max() < 1e-12
    assert np.abs(cam.project(cam.centre + 700.0 * directions) - pixels).max() < 1e-6


def test_contains_has_its_border_half_a_pixel_outside_the_centres() -> None:
    cam = camera("ideal")
    pixels = np.array([[-0.5, -0.5], [639.5, 479.5], [-0.51, 3], [3, 479.51], [np.nan, 3]])
    assert cam.contains(pixels).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fx": 0.0}, "focal lengths must be above 0"),
        ({"cy": np.nan}, "expected finite intrinsics"),
        ({"width": 0}, "size must be at least 1 x 1"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_by_name(change: dict[str, float], words: str) -> None:
    good = {
        "width": 4, "height": 4, "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0,
    }  # fmt: skip
    with pytest.raises(CameraError, match=f"cam7.*{words}"):
        Camera(
            name="cam7",
            distortion=np.zeros(5),
            camera_from_world=Pose.identity(),
            **(good | change),
        )


def test_distortion_of_another_length_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"distortion: expected shape \(5\), found \(8,\)"):
        Camera(
            name="c", width=4, height=4, fx=1, fy=1, cx=0, cy=0,
            distortion=np.zeros(8), camera_from_world=Pose.identity(),
        )  # fmt: skip


def test_points_of_another_shape_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"points: expected shape \(N 3\), found \(3,\)"):
        camera("ideal").project(np.zeros(3))


def test_an_array_finds_cameras_by_name_and_refuses_double_names() -> None:
    cam = camera("ideal")
    array = CameraArray((cam,))
    assert array.by_name("cam00") is cam
    assert array.project(np.zeros((4, 3))).shape == (1, 4, 2)
    with pytest.raises(CameraError, match="no camera 'cam01' in this array; it has cam00"):
        array.by_name("cam01")
    with pytest.raises(CameraError, match="found twice: cam00"):
        CameraArray((cam, cam))
