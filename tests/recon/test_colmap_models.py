"""COLMAP models with rigs: one rig written, several frames read, broken files refused in time."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from capture.camera import CameraArray
from capture.errors import CameraError
from capture.pose import Pose
from recon.colmap import read_model, to_colmap, write_model
from recon.colmap_files import name_images
from tests.capture.refusals import refusal
from tests.recon.exchange.camera_cases import (
    CLOUD,
    assert_projects_alike,
    assert_same,
    random_array,
)

Model = pycolmap.Reconstruction


def rigid(pose: Pose) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(np.column_stack([pose.rotation, pose.translation]))


def rig_model(cameras: CameraArray, moves: list[Pose], name: str = "{camera}/{frame}.png") -> Model:
    """A model of one rig whose frame f stands at `moves[f]`: array_from_world of the frame."""
    model, rig = Model(), pycolmap.Rig(rig_id=1)
    origin = cameras[0].camera_from_world
    for number, camera in enumerate(cameras, start=1):
        lens = to_colmap(camera, number, "FULL_OPENCV")
        model.add_camera(lens)
        place = rigid(camera.camera_from_world @ origin.inverse())
        if number == 1:
            rig.add_ref_sensor(lens.sensor_id)
        else:
            rig.add_sensor(lens.sensor_id, place)
    model.add_rig(rig)
    images = []
    for at, move in enumerate(moves):
        frame = pycolmap.Frame(frame_id=at + 1, rig_id=1)
        frame.rig_from_world = rigid(origin @ move)
        for number, camera in enumerate(cameras, start=1):
            image_id = len(images) + 1
            sensor = model.camera(number).sensor_id
            frame.add_data_id(pycolmap.data_t(sensor, image_id))
            path = name.format(camera=camera.name, frame=f"{at:04d}")
            image = pycolmap.Image(name=path, camera_id=number, image_id=image_id)
            image.frame_id = at + 1
            images.append(image)
        model.add_frame(frame)
    for image in images:
        model.add_image(image)
    return model


def saved(model: Model, folder: Path, text: bool = False) -> Path:
    folder.mkdir()
    (model.write_text if text else model.write_binary)(str(folder))
    return folder


MOVES = [
    Pose.from_rotation_vector(np.array([0.1 * f, -0.2, 0.05]), np.array([30.0 * f, 5.0, -20.0 * f]))
    for f in range(3)
]


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("count", [1, 6])
def test_one_rig_of_all_cameras_and_one_frame_are_written(
    tmp_path: Path, text: bool, count: int
) -> None:
    array = random_array(31, count=count)
    write_model(tmp_path / "m", array, text=text, unit_mm=1000.0)
    suffix = ".txt" if text else ".bin"
    assert sorted(p.name for p in (tmp_path / "m").iterdir()) == sorted(
        name + suffix for name in ("cameras", "images", "points3D", "rigs", "frames")
    )
    model = Model(str(tmp_path / "m"))
    assert (model.num_rigs(), model.num_frames()) == (1, 1)
    assert model.rig(1).num_sensors() == model.num_images() == count
    image = next(i for i in model.images.values() if i.name == f"{array.names[-1]}/0000.png")
    np.testing.assert_allclose(
        image.cam_from_world().translation,
        array[count - 1].camera_from_world.translation / 1000.0,
        atol=1e-12,
    )
    again = read_model(tmp_path / "m", unit_mm=1000.0)
    assert_same(again, array)
    assert_projects_alike(again, array, CLOUD)


@pytest.mark.parametrize("text", [False, True])
def test_several_frames_of_one_rig_are_one_array_in_the_space_of_the_rig(
    tmp_path: Path, text: bool
) -> None:
    array = random_array(32, count=4)
    again = read_model(saved(rig_model(array, MOVES), tmp_path / "m", text))
    origin = array[0].camera_from_world.inverse()
    wanted = CameraArray(tuple(c.posed(c.camera_from_world @ origin) for c in array))
    assert_same(again, wanted)


def test_frames_that_stand_still_keep_the_world(tmp_path: Path) -> None:
    array = random_array(33, count=3)
    again = read_model(saved(rig_model(array, [Pose.identity()] * 3), tmp_path / "m"))
    assert_same(again, array)


@pytest.mark.parametrize(
    ("pattern", "numbered"),
    [
        ("in/{camera}/{frame}.png", False),
        ("{frame}/{camera}.png", False),
        ("all/{camera}_{frame}.png", True),
    ],
)
def test_sensors_are_named_after_folders_or_images_or_numbers(
    tmp_path: Path, pattern: str, numbered: bool
) -> None:
    array = random_array(34, count=3)
    again = read_model(saved(rig_model(array, MOVES, pattern), tmp_path / "m"))
    expected = {"camera1", "camera2", "camera3"} if numbered else set(array.names)
    assert set(again.names) == expected


def test_names_of_images_of_one_frame() -> None:
    assert name_images([("a.png", 1), ("b.png", 2)], "m", one_rig=True) == ["a", "b"]
    assert name_images([("x/a.png", 1), ("y/a.png", 1)], "m") == ["x", "y"]
    with pytest.raises(CameraError, match=r"m: 'a b', the folder of a camera's images, must be"):
        name_images([("a b/0.png", 1)], "m")


def test_a_rig_without_known_places_is_refused(tmp_path: Path) -> None:
    folder = saved(rig_model(random_array(35, count=3), MOVES), tmp_path / "m", text=True)
    rigs = (folder / "rigs.txt").read_text()
    number = r"[-+.0-9e]+"
    unplaced = re.sub(rf"CAMERA (2|3) 1( {number}){{7}}", r"CAMERA \1 0", rigs)
    assert unplaced.count(" 0") >= 2
    (folder / "rigs.txt").write_text(unplaced)
    with pytest.raises(CameraError, match=r"2 problems\n.*sensor 2 of the rig has no known sensor"):
        read_model(folder)


def test_a_model_of_old_has_no_rigs(tmp_path: Path) -> None:
    array = random_array(36, count=4)
    write_model(tmp_path / "m", array)
    for name in ("rigs.bin", "frames.bin"):
        (tmp_path / "m" / name).unlink()
    assert_same(read_model(tmp_path / "m"), array)


def test_a_folder_that_holds_more_than_a_model_is_not_replaced(tmp_path: Path) -> None:
    array, folder = random_array(41, count=2), tmp_path / "m"
    write_model(folder, array, text=True)
    write_model(folder, array)
    (folder / "thesis.txt").write_text("years")
    with pytest.raises(CameraError, match=r"m: holds thesis\.txt, which a model"):
        write_model(folder, array)
    assert (folder / "thesis.txt").read_text() == "years"


def test_image_names_with_spaces_are_refused_never_cut(tmp_path: Path) -> None:
    array, folder = random_array(42, count=2), tmp_path / "m"
    write_model(folder, array, text=True)
    path = folder / "images.txt"
    path.write_text(path.read_text().replace("/0000.png", "/00 00.png", 1))
    with pytest.raises(CameraError, match=r"images\.txt: .*name '.*/00 00\.png' has spaces"):
        read_model(folder)


@pytest.mark.parametrize("name", ["cameras", "images", "rigs", "frames", "points3D"])
@pytest.mark.parametrize("count", [2**60, 2**32, 200])
def test_counts_beyond_the_file_are_refused_at_once(tmp_path: Path, name: str, count: int) -> None:
    write_model(tmp_path / "m", random_array(37, count=3))
    path = tmp_path / "m" / f"{name}.bin"
    path.write_bytes(struct.pack("<Q", count) + path.read_bytes()[8:])
    with pytest.raises(CameraError, match=rf"{name}\.bin: not readable as a COLMAP model"):
        read_model(tmp_path / "m")


def test_every_cut_of_a_binary_model_is_refused(tmp_path: Path) -> None:
    model = rig_model(random_array(38, count=2), MOVES[:2])
    folder = saved(model, tmp_path / "m")
    for path in sorted(folder.iterdir()):
        whole = path.read_bytes()
        for size in range(0, len(whole), 5):
            path.write_bytes(whole[:size])
            assert refusal(lambda: read_model(folder)), f"{path.name} cut to {size} bytes"
        path.write_bytes(whole)
    assert len(read_model(folder)) == 2


def test_damage_of_a_binary_model_is_read_or_refused(tmp_path: Path) -> None:
    folder = saved(rig_model(random_array(39, count=2), MOVES[:2]), tmp_path / "m")
    rng = np.random.default_rng(0)
    for path in sorted(folder.iterdir()):
        whole = path.read_bytes()
        for _ in range(40):
            bytes_ = np.frombuffer(whole, dtype=np.uint8).copy()
            at = rng.integers(0, len(bytes_), 2)
            bytes_[at] = rng.integers(0, 256, 2)
            path.write_bytes(bytes_.tobytes())
            said = refusal(lambda: read_model(folder))
            assert not said or said.startswith(str(folder))
        path.write_bytes(whole)
