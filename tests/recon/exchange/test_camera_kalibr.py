"""Kalibr's camera chain: metres, the chain of places, names in topics, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.errors import CameraError
from recon.exchange.kalibr import read_kalibr, write_kalibr
from tests.capture.refusals import refusal
from tests.recon.exchange.camera_cases import KALIBR, assert_same, random_array


def written(tmp_path: Path, text: str = KALIBR) -> Path:
    (tmp_path / "camchain.yaml").write_text(text)
    return tmp_path / "camchain.yaml"


def test_a_literal_chain_is_read(tmp_path: Path) -> None:
    array = read_kalibr(written(tmp_path))
    assert array.names == ("cam0", "cam1", "cam2")
    np.testing.assert_array_equal(array[0].distortion, [-0.28, 0.07, 0.0002, 1e-5, 0.0])
    np.testing.assert_array_equal(array[0].camera_from_world.matrix(), np.eye(4))
    point_mm = np.array([[30.0, -20.0, 1000.0]])  # in cam0's space
    np.testing.assert_allclose(
        array[0].camera_from_world.apply(point_mm), [[30.0, -20.0, 1000.0]], atol=1e-12
    )
    in_cam1 = [30.0 - 110.0, 1000.0 + 20.0, 20.0 + 30.0]
    np.testing.assert_allclose(array[1].camera_from_world.apply(point_mm), [in_cam1], atol=1e-9)
    expected = [455 * -80.0 / 50.0 + 376, 454 * 1020.0 / 50.0 + 240]
    np.testing.assert_allclose(array[1].project(point_mm), [expected], atol=1e-9)
    in_cam2 = [-in_cam1[1], in_cam1[0], in_cam1[2] + 500.0]
    np.testing.assert_allclose(array[2].camera_from_world.apply(point_mm), [in_cam2], atol=1e-9)
    assert (array[2].width, array[2].height) == (640, 480)


def test_what_is_written_is_a_chain_in_metres(tmp_path: Path) -> None:
    array = random_array(6, count=3, k3=False)
    write_kalibr(tmp_path / "a.yaml", array)
    chain = yaml.safe_load((tmp_path / "a.yaml").read_text())
    assert list(chain) == ["cam0", "cam1", "cam2"]
    one, two = array[1].camera_from_world, array[2].camera_from_world
    step = two.matrix() @ np.linalg.inv(one.matrix())
    step[:3, 3] /= 1000.0
    np.testing.assert_allclose(chain["cam2"]["T_cn_cnm1"], step, atol=1e-12)
    assert chain["cam1"]["distortion_model"] == "radtan"
    assert len(chain["cam1"]["distortion_coeffs"]) == 4
    assert chain["cam2"]["rostopic"] == f"/{array.names[2]}/image_raw"


def test_without_its_own_place_the_first_camera_is_the_world(tmp_path: Path) -> None:
    array = random_array(7, count=4, k3=False)
    write_kalibr(tmp_path / "a.yaml", array)
    chain = yaml.safe_load((tmp_path / "a.yaml").read_text())
    del chain["cam0"]["T_cn_cnm1"]  # as Kalibr itself writes it
    again = read_kalibr(written(tmp_path, yaml.safe_dump(chain)))
    np.testing.assert_array_equal(again[0].camera_from_world.matrix(), np.eye(4))
    first_from_world = array[0].camera_from_world
    moved = type(again)(
        tuple(camera.posed(camera.camera_from_world @ first_from_world) for camera in again)
    )
    assert_same(moved, array)


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ("/camera/left", "/left/image_raw", ("cam0", "cam1", "cam2")),  # others have none
        ("cam1:\n", "cam1:\n  rostopic: 5\n", ("cam0", "cam1", "cam2")),
    ],
)
def test_names_come_from_topics_only_when_all_have_one(
    tmp_path: Path, old: str, new: str, names: tuple[str, ...]
) -> None:
    assert read_kalibr(written(tmp_path, KALIBR.replace(old, new))).names == names


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("radtan", "equidistant", "cam0: distortion_model 'equidistant'; only radtan (and none)"),
        ("radtan", "fov", "cam0: distortion_model 'fov'"),
        ("camera_model: pinhole", "camera_model: omni", "cam0: camera_model 'omni'; only pinhole"),
        ("[-0.28, 0.07, 0.0002, 1e-5]", "[-0.28, 0.07]", "cam0: distortion_coeffs must be a list"),
        ("[752, 480]", "[752.5, 480]", "cam0: resolution must be a whole number of px"),
        ("[460.5, 459.25", "[.nan, 459.25", "cam0: intrinsics must be finite"),
        ("[460.5, 459.25", "[true, 459.25", "cam0: intrinsics must be a number, found True"),
        ("[460.5, 459.25", "[-460.5, 459.25", "cam0: focal lengths must be above 0"),
        ("- [0.0, 0.0, 0.0, 1.0]\n  camera", "- [0, 0, 0, 2]\n  camera", "cam1: T_cn_cnm1: expec"),
        ("- [1.0, 0.0, 0.0, -0.11]", "- [2.0, 0.0, 0.0, -0.11]", "cam1: T_cn_cnm1: rotation"),
        ("T_cn_cnm1", "T_cam_imu", "cam1: T_cn_cnm1 must be a 4 x 4 matrix; without it"),
        ("distortion_coeffs: []", "distortion_coeffs: [0.1, 0, 0, 0]", "cam1: distortion_model no"),
        ("cam1:", "cam4:", "3 cameras, but no cam1"),
        ("cam0:", "cam9:", "expected a Kalibr chain of cam0"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in KALIBR
    with pytest.raises(CameraError) as caught:
        read_kalibr(written(tmp_path, KALIBR.replace(old, new, 1)))
    assert words in str(caught.value)


def test_cameras_that_hang_on_a_wrong_one_are_named_too(tmp_path: Path) -> None:
    text = KALIBR.replace("- [1.0, 0.0, 0.0, -0.11]", "- [2.0, 0.0, 0.0, -0.11]")
    with pytest.raises(CameraError, match=r"2 problems\n.*cam1: T_cn.*\n.*cam2: hangs on cam1"):
        read_kalibr(written(tmp_path, text))


def test_aliases_and_objects_are_refused(tmp_path: Path) -> None:
    alias = KALIBR.replace("[752, 480]", "&size [752, 480]", 1).replace(
        "[752, 480]\ncam2", "*size\ncam2"
    )
    with pytest.raises(CameraError, match=r"an alias \(\*name\); write the values out"):
        read_kalibr(written(tmp_path, alias))
    with pytest.raises(CameraError, match="could not determine a constructor"):
        read_kalibr(written(tmp_path, "cam0: !!python/name:os.system {}\n"))


@settings(max_examples=100, deadline=None)
@given(
    at=st.integers(0, len(KALIBR) - 1),
    length=st.integers(0, 40),
    put=st.text(alphabet="[]{}:- \n!&*'\"019e.~yn", max_size=10),
)
def test_damage_is_read_or_refused_but_never_crashes(
    tmp_path_factory: pytest.TempPathFactory, at: int, length: int, put: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.yaml"
    path.write_text(KALIBR[:at] + put + KALIBR[at + length :])
    said = refusal(lambda: read_kalibr(path))
    assert not said or said.startswith(str(path))
