"""Cameras in every format: round trips, recognition, and refusals that name all that is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture.camera import CameraArray
from capture.errors import CameraError, InputError
from recon.camera_parts import scaled
from recon.exchange.cameras import (
    FORMATS,
    kind_of_suffix,
    largest_difference_px,
    read_any,
    recognise,
    write_any,
)
from tests.recon.exchange.camera_cases import (
    CLOUD,
    KALIBR,
    METASHAPE,
    OPENCV,
    OPENCV_ONE,
    assert_projects_alike,
    assert_same,
    changed,
    random_array,
)
from tests.synthetic import small_array

FILES = {
    "likeness": "a.json", "colmap": "model", "colmap-text": "model", "opencv": "a.yml",
    "metashape": "a.xml", "kalibr": "a.yaml",
}  # fmt: skip


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("seed", range(4))
def test_every_format_gives_back_what_it_was_given(tmp_path: Path, kind: str, seed: int) -> None:
    array = random_array(seed, count=1 + 2 * seed, k3=kind != "kalibr")
    path = tmp_path / FILES[kind]
    write_any(path, array, kind)
    again = read_any(path)
    if not kind.startswith("colmap"):  # COLMAP's images stand in the order of their names
        assert again.names == array.names
    assert_same(again, array)
    assert_projects_alike(again, array, CLOUD)


@pytest.mark.parametrize("kind", FILES)
def test_the_same_array_gives_the_same_bytes(tmp_path: Path, kind: str) -> None:
    array = random_array(5, k3=kind != "kalibr")
    contents = []
    for folder in ("one", "two"):
        write_any(tmp_path / folder / FILES[kind], array, kind)
        files = sorted(p for p in (tmp_path / folder).rglob("*") if p.is_file())
        contents.append([(p.name, p.read_bytes()) for p in files])
    assert contents[0] == contents[1]


@pytest.mark.parametrize("name", ["a.yml", "a.yaml", "a.xml"])
def test_opencv_keeps_every_bit(tmp_path: Path, name: str) -> None:
    array = random_array(8)
    write_any(tmp_path / name, array, "opencv")
    assert recognise(tmp_path / name) == "opencv"
    for one, other in zip(array, read_any(tmp_path / name), strict=True):
        np.testing.assert_array_equal(one.matrix, other.matrix)
        np.testing.assert_array_equal(one.distortion, other.distortion)
        np.testing.assert_array_equal(
            one.camera_from_world.matrix(), other.camera_from_world.matrix()
        )


@pytest.mark.parametrize("kind", [kind for kind in FILES if kind != "likeness"])
def test_units_scale_places_alone(tmp_path: Path, kind: str) -> None:
    array = random_array(3, k3=False)
    path = tmp_path / FILES[kind]
    write_any(path, array, kind, unit_mm=25.4)
    assert_same(read_any(path, unit_mm=25.4), array)
    assert_same(read_any(path, unit_mm=50.8), scaled(array, 2.0))
    with pytest.raises(
        CameraError, match="unit_mm: expected a number between 1e-6 and 1e9, found 0"
    ):
        read_any(path, unit_mm=0.0)


def test_our_own_file_is_in_millimetres(tmp_path: Path) -> None:
    write_any(tmp_path / "a.json", small_array())
    with pytest.raises(CameraError, match="always in millimetres, found unit_mm = 1000"):
        read_any(tmp_path / "a.json", unit_mm=1000.0)


@pytest.mark.parametrize(
    ("name", "text", "kind"),
    [
        ("a.xml", METASHAPE, "metashape"),
        ("a.xml", OPENCV_ONE, "opencv"),
        ("a.yaml", OPENCV, "opencv"),
        ("a.yaml", KALIBR, "kalibr"),
        ("a.yaml", "%YAML:1.0\n" + KALIBR, "kalibr"),
        ("strange", KALIBR, "kalibr"),
    ],
)
def test_content_tells_the_format(tmp_path: Path, name: str, text: str, kind: str) -> None:
    (tmp_path / name).write_text(text)
    assert recognise(tmp_path / name) == kind
    assert len(read_any(tmp_path / name)) >= 1


def test_a_suffix_tells_the_format_only_when_one_has_it() -> None:
    assert kind_of_suffix(Path("cameras.json")) == "likeness"
    assert kind_of_suffix(Path("sparse")) == "colmap"
    with pytest.raises(CameraError, match=r"\.xml may be opencv or metashape; name the format"):
        kind_of_suffix(Path("a.xml"))
    with pytest.raises(CameraError, match=r"\.yaml may be opencv or kalibr"):
        kind_of_suffix(Path("a.yaml"))
    with pytest.raises(CameraError, match=r"\.csv is none of likeness's"):
        kind_of_suffix(Path("a.csv"))


def test_distortion_that_a_format_lacks_is_refused_for_all_cameras_at_once(tmp_path: Path) -> None:
    array = random_array(2, count=3)
    with pytest.raises(CameraError, match=r"3 problems") as caught:
        write_any(tmp_path / "a.yaml", array, "kalibr")
    for camera in array:
        assert f"{camera.name}: k3 = {camera.distortion[4]:g} has no place" in str(caught.value)
    assert "solve with k3 = 0, or choose another format" in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", FILES)
def test_names_that_are_no_plain_names_are_refused(tmp_path: Path, kind: str) -> None:
    cameras = list(random_array(1, count=3, k3=False))
    array = CameraArray(
        (changed(cameras[0], name="../up"), cameras[1], changed(cameras[2], name="a,b"))
    )
    with pytest.raises(CameraError, match=r"2 problems\n.*'\.\./up'.*\n.*'a,b'"):
        write_any(tmp_path / FILES[kind], array, kind)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "kind", "words"),
    [
        ("a.json", "kalibr", "kalibr is written to .yaml or .yml"),
        ("a.json", "nothing", "no format 'nothing' of cameras; known: likeness, colmap"),
        ("a.json", "kalib", "did you mean 'kalibr'"),
    ],
)
def test_a_wrong_kind_is_named(tmp_path: Path, name: str, kind: str, words: str) -> None:
    with pytest.raises(CameraError, match=words):
        write_any(tmp_path / name, small_array(), kind)


def test_folders_and_files_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(CameraError, match="colmap is written to a folder, and this is a file"):
        write_any(tmp_path / "file", small_array(), "colmap")
    (tmp_path / "a.yml").mkdir()
    with pytest.raises(CameraError, match="opencv is written to a file, and this is a folder"):
        write_any(tmp_path / "a.yml", small_array(), "opencv")
    write_any(tmp_path / "sparse", small_array())
    with pytest.raises(CameraError, match="one file of a COLMAP model; give its folder"):
        read_any(tmp_path / "sparse" / "cameras.bin")


def test_the_difference_of_arrays_is_seen_in_pixels() -> None:
    array = random_array(4)
    assert largest_difference_px(array, array) == 0.0
    shifted = CameraArray(tuple(changed(camera, cx=camera.cx + 0.25) for camera in array))
    assert largest_difference_px(array, shifted) == pytest.approx(0.25)
    with pytest.raises(CameraError, match="5 and 4 cameras"):
        largest_difference_px(array, CameraArray(array.cameras[1:]))


BOMB = "a: &a [x, x, x, x]\n" + "".join(
    f"{b}: &{b} [*{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}]\n"
    for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
ENTITY = '<!DOCTYPE d [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
HOSTILE = {
    "empty": "",
    "binary": "\x00\x01\x02",
    "junk": "hello",
    "aliases": "cam0: {camera_model: *a}\n",
    "alias bomb": BOMB + "cam0: *i\n",
    "merge keys": "x: &x {a: 1}\ncam0:\n  <<: *x\n",
    "python object": "cam0: !!python/object/apply:os.system ['true']\n",
    "brackets": "cam0: " + "[" * 50_000,
    "dates": "cam0: 2001-99-99\n",
    "odd tags": "cam0: !!bool perhaps\n",
    "digits": "cam0: {camera_model: " + "9" * 6000 + "}\n",
    "cut kalibr": KALIBR[:200],
    "doctype": '<?xml version="1.0"?>' + ENTITY + "<document>&b;</document>",
    "doctype of opencv": '<?xml version="1.0"?>' + ENTITY + "<opencv_storage/>",
    "outside entity": '<!DOCTYPE d SYSTEM "file:///etc/hostname"><document/>',
    "deep xml": "<document>" + "<a>" * 200_000,
    "deep opencv xml": "<opencv_storage>" + "<a>" * 200_000,
    "odd encoding": '<?xml version="1.0" encoding="no-such"?><document/>',
    "cut xml": METASHAPE[:1500],
    "wrong root": "<html></html>",
    "no chunk": "<document></document>",
    "deep yaml": "%YAML:1.0\n---\nKs: " + "[" * 300_000,
    "deep dashes": "%YAML:1.0\n---\nKs:\n   " + "- " * 300_000 + "1\n",
    "deep indents": "%YAML:1.0\n---\n" + "".join(" " * n + "a:\n" for n in range(500)),
    "list of opencv": "%YAML:1.0\n---\n- 1\n- 2\n",
    "cut opencv": OPENCV[:400],
    "huge claim": "%YAML:1.0\n---\nKs: !!opencv-matrix\n   rows: 1000000\n   cols: 1000000\n"
    "   dt: d\n   data: [ 1. ]\n",
    "wrong json": '{"units": "mm"}',
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
@pytest.mark.parametrize("kind", [None, "opencv", "metashape", "kalibr"])
def test_hostile_files_give_one_short_error(tmp_path: Path, case: str, kind: str | None) -> None:
    path = tmp_path / "file.txt"
    path.write_text(HOSTILE[case])
    with pytest.raises(InputError) as caught:
        read_any(path, kind)
    assert str(caught.value).startswith(str(path))
    assert len(str(caught.value)) < 700 + len(str(path))


@pytest.mark.parametrize("kind", ["opencv", "metashape", "kalibr"])
def test_files_of_a_wrong_size_or_place_are_refused(tmp_path: Path, kind: str) -> None:
    big = tmp_path / "big"
    with big.open("wb") as handle:
        handle.truncate((1 << 25) + 1)
    with pytest.raises(CameraError, match="larger than"):
        read_any(big, kind)
    with pytest.raises(CameraError, match="no such file"):
        read_any(tmp_path / "nowhere", kind)
    with pytest.raises(CameraError, match="not readable"):
        read_any(tmp_path, kind)
    (tmp_path / "latin").write_bytes(KALIBR.replace("left", "é").encode("latin-1"))
    with pytest.raises(CameraError):
        read_any(tmp_path / "latin", kind)


def test_every_format_is_tested() -> None:
    assert set(FILES) == set(FORMATS)
