"""OpenCV's files: three layouts, read as cv2.projectPoints understands them, and refusals."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.errors import CameraError
from recon.exchange.opencv import read_opencv, write_opencv
from tests.capture.refusals import refusal
from tests.recon.exchange.camera_cases import CLOUD, OPENCV, OPENCV_ONE, random_array

STEREO = """%YAML:1.0
---
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320., 0., 500., 240., 0., 0., 1. ]
D1: !!opencv-matrix
   rows: 1
   cols: 14
   dt: d
   data: [ 0.1, -0.05, 0., 0., 0.01, 0., 0., 0., 0., 0., 0., 0., 0., 0. ]
M2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 510., 0., 321., 0., 511., 241., 0., 0., 1. ]
D2: !!opencv-matrix
   rows: 1
   cols: 4
   dt: d
   data: [ 0., 0., 0., 0. ]
"""
PLACE = """R: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]
T: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ -60., 0., 0. ]
"""
SIZE = "image_width: 640\nimage_height: 480\n"


def written(tmp_path: Path, text: str, name: str = "a.yml") -> Path:
    (tmp_path / name).write_text(text)
    return tmp_path / name


def test_the_multi_view_layout_is_read(tmp_path: Path) -> None:
    array = read_opencv(written(tmp_path, OPENCV), unit_mm=1000.0)
    assert array.names == ("front", "side")
    points_m = np.random.default_rng(2).uniform(-0.2, 0.2, (30, 3)) + [0.9, 0.0, 1.5]
    bend = [np.array([-0.1, 0.02, 0.001, -0.002, 0.005]), np.zeros(5)]
    turn = [np.zeros(3), np.array([0.0, np.pi / 2, 0.0])]
    move = [np.zeros(3), np.array([-0.5, 0.25, 1.0])]
    k = [
        np.array([[800, 0, 319.5], [0, 810, 239.5], [0, 0, 1]]),
        np.array([[700, 0, 300.0], [0, 701, 200], [0, 0, 1]]),
    ]
    points_m[:, 0] -= 1.6  # before both cameras
    for at, camera in enumerate(array):
        expected = cv2.projectPoints(points_m, turn[at], move[at], k[at], bend[at])[0]
        np.testing.assert_allclose(
            camera.project(1000.0 * points_m), expected.reshape(-1, 2), rtol=0, atol=1e-8
        )


def test_what_is_written_is_what_the_sample_loads(tmp_path: Path) -> None:
    array = random_array(9, count=4)
    write_opencv(tmp_path / "a.yaml", array)
    storage = cv2.FileStorage(str(tmp_path / "a.yaml"), cv2.FILE_STORAGE_READ)
    loaded = {key: storage.getNode(key).mat() for key in ("Rs", "Ts", "Ks", "distortions")}
    assert storage.getNode("cam_ids").string().split(",") == list(array.names)
    for at, camera in enumerate(array):
        turn = cv2.Rodrigues(loaded["Rs"][at])[0]
        expected = cv2.projectPoints(
            CLOUD, turn, loaded["Ts"][at], loaded["Ks"][at], loaded["distortions"][at]
        )[0]
        np.testing.assert_allclose(
            expected.reshape(-1, 2), camera.project(CLOUD), rtol=0, atol=1e-6
        )
    sizes = storage.getNode("image_sizes").mat()
    np.testing.assert_array_equal(sizes, [[c.width, c.height] for c in array])


def test_a_single_camera_is_the_world(tmp_path: Path) -> None:
    array = read_opencv(written(tmp_path, OPENCV_ONE, "lens_7.xml"))
    assert array.names == ("lens_7",)
    np.testing.assert_array_equal(array[0].camera_from_world.matrix(), np.eye(4))
    np.testing.assert_array_equal(array[0].distortion, [0.1, -0.2, 0.003, 0.004, 0.05])
    assert (array[0].width, array[0].fy, array[0].cx) == (640, 610.0, 320.0)


def test_the_stereo_layout_is_read_from_one_file_or_two(tmp_path: Path) -> None:
    array = read_opencv(written(tmp_path, STEREO + PLACE + SIZE))
    assert array.names == ("left", "right")
    point = np.array([[10.0, 20.0, 400.0]])
    np.testing.assert_allclose(
        array[1].project(point), [[510 * -50 / 400 + 321, 511 * 20 / 400 + 241]]
    )
    written(tmp_path, "%YAML:1.0\n---\n" + PLACE, "extrinsics.yml")
    apart = read_opencv(written(tmp_path, STEREO + SIZE, "intrinsics.yml"))
    np.testing.assert_array_equal(apart.project(point), array.project(point))
    with pytest.raises(CameraError, match="stores no image size; add image_width and image_height"):
        read_opencv(written(tmp_path, STEREO + PLACE))
    (tmp_path / "extrinsics.yml").unlink()
    with pytest.raises(CameraError, match=r"no R and T, here or in extrinsics\.yml beside it"):
        read_opencv(written(tmp_path, STEREO + SIZE))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("data: [ 0, 0 ]", "data: [ 0, 1 ]", "side: a fisheye lens"),
        ("[ 800., 0., 319.5", "[ 800., 2., 319.5", "front: the lens has skew = 2; likeness holds"),
        ("0., 0., 1., 700.", "0., 0., 2., 700.", "front: K must be [[fx,0,cx]"),
        ("5.0e-03, 0.,", "5.0e-03, .Inf,", "side: distortion must be finite"),
        ("-2.0e-03, 5.0e-03, 0.,", "5.0e-03, 0.,", "holds 9 numbers, which 2 cameras cannot"),
        ("front,side", "front", "cam_ids names 1 cameras, Ks holds 2"),
        ("front,side", "fr/ont,side", "'fr/ont': a camera's name must be"),
        ("front,side", "side,side", "unique, found twice: side"),
        ("640, 480, 600", "0, 480, 600", "front: image width must be a whole number of px"),
        ("640, 480, 600, 400", "640, 480, 600", "image_sizes must be a list of 4 numbers"),
        ("Ts:", "Tz:", "missing Ts; expected Ks, distortions, Rs, Ts"),
        ("[ 800., 0., 319.5,", "[ 800.,", "Ks must hold 3 x 3 numbers a camera"),
        ("[ 800., 0., 319.5", "[ hello, 0., 319.5", "Ks must hold numbers"),
        ("Ks:", "Kz:", "expected Ks, distortions, Rs, Ts, image_sizes (multi-view sample)"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in OPENCV
    with pytest.raises(CameraError) as caught:
        read_opencv(written(tmp_path, OPENCV.replace(old, new, 1)))
    assert words in str(caught.value)


@pytest.mark.parametrize("place", range(5, 14))
def test_coefficients_beyond_k3_are_refused_by_name_unless_zero(tmp_path: Path, place: int) -> None:
    term = ["k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y"][place - 5]
    row = ["0.1"] * 5 + ["0."] * 9
    row[place] = "0.25"
    text = STEREO.replace("0.1, -0.05, 0., 0., 0.01" + ", 0." * 9, ", ".join(row))
    with pytest.raises(CameraError, match=f"left: the lens has {term} = 0.25"):
        read_opencv(written(tmp_path, text + PLACE + SIZE))


@settings(max_examples=150, deadline=None)
@given(
    at=st.integers(0, len(OPENCV) - 1),
    length=st.integers(0, 40),
    put=st.text(alphabet="[]{}:- \n!&*'\"019e.,%", max_size=10),
)
def test_damage_is_read_or_refused_but_never_crashes(
    tmp_path_factory: pytest.TempPathFactory, at: int, length: int, put: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.yml"
    path.write_text(OPENCV[:at] + put + OPENCV[at + length :])
    said = refusal(lambda: read_opencv(path))
    assert not said or said.startswith(str(path))
