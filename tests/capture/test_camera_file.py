"""cameras.json: the round trip is exact, and whatever does not fit is refused by name."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.camera_file import cameras_from_document, read_cameras, write_cameras
from capture.errors import CameraError
from tests.capture.refusals import refusal
from tests.synthetic import small_array


def document(tmp_path: Path) -> Any:
    write_cameras(tmp_path / "c.json", small_array(2))
    return json.loads((tmp_path / "c.json").read_text())


def test_the_round_trip_is_exact(tmp_path: Path) -> None:
    array = small_array(3)
    write_cameras(tmp_path / "cameras.json", array, report={"mean_error_px": 0.04})
    again = read_cameras(tmp_path / "cameras.json")
    assert again.names == array.names
    for a, b in zip(array, again, strict=True):
        assert (a.width, a.height) == (b.width, b.height)
        assert np.array_equal(a.matrix, b.matrix)
        assert np.array_equal(a.distortion, b.distortion)
        assert np.array_equal(a.camera_from_world.matrix(), b.camera_from_world.matrix())
    first = (tmp_path / "cameras.json").read_bytes()
    write_cameras(tmp_path / "cameras.json", again, report={"mean_error_px": 0.04})
    assert (tmp_path / "cameras.json").read_bytes() == first


def put(*path: Any) -> Callable[[Any], None]:
    *keys, value = path

    def change(tree: Any) -> None:
        for key in keys[:-1]:
            tree = tree[key]
        tree[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put("cameras", 1, "K", 0, 0, float("nan")), "cam01: K holds NaN or infinity"),
        (put("cameras", 0, "t", [0, 0, float("inf")]), "cam00: t holds NaN or infinity"),
        (put("cameras", 0, "R", [[1, 0, 0], [0, 1, 0], [0, 0, 2]]), "cam00: R, t: .*orthonormal"),
        (
            put("cameras", 0, "dist", [0, 0, 0, 0]),
            r"cam00: dist must have shape \(5,\), found \(4,\)",
        ),
        (put("cameras", 0, "K", 0, 1, 0.5), "cam00: K must be"),
        (put("cameras", 0, "width", 64.0), "cam00: width must be a whole number of px, found 64.0"),
        (put("cameras", 0, "height", True), "cam00: height must be a whole number"),
        (put("cameras", 0, "name", "../evil"), "name must be letters"),
        (put("cameras", 1, "name", "cam00"), "unique, found twice: cam00"),
        (put("cameras", 0, "focal", 3), "unknown key 'focal'"),
        (put("cameras", 0, "Dist", [0] * 5), "unknown key 'Dist'; did you mean 'dist'"),
        (put("units", "m"), "units must be \"mm\", found 'm'"),
        (put("cameras", []), "at least one camera"),
        (put("cameras", {"cam00": 1}), "must be a list"),
        (put("camera", 1), "unknown key 'camera'; did you mean 'cameras'"),
    ],
)
def test_whatever_does_not_fit_is_named(
    tmp_path: Path, change: Callable[[Any], None], words: str
) -> None:
    tree = copy.deepcopy(document(tmp_path))
    change(tree)
    with pytest.raises(CameraError, match=words):
        cameras_from_document(tree, "cameras.json")


def test_several_misfits_come_in_one_message(tmp_path: Path) -> None:
    tree = document(tmp_path)
    del tree["cameras"][0]["K"]
    tree["cameras"][1]["dist"] = "none"
    with pytest.raises(CameraError) as caught:
        cameras_from_document(tree, "cameras.json")
    assert "2 problems" in str(caught.value)
    assert "missing key 'K'" in str(caught.value)
    assert "cam01: dist must hold numbers" in str(caught.value)


def test_a_missing_file_says_what_writes_one(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"nowhere.json: no such file; `likeness calibrate`"):
        read_cameras(tmp_path / "nowhere.json")
    (tmp_path / "broken.json").write_text('{"units": "mm", ')
    with pytest.raises(CameraError, match=r"broken.json: not readable as JSON"):
        read_cameras(tmp_path / "broken.json")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4)
    ),
    max_leaves=12,
)


@settings(max_examples=150, deadline=None)
@given(
    tree=JSON, place=st.sampled_from(["", "cameras", "entry", "K", "R", "dist", "name", "width"])
)
def test_any_json_is_read_or_refused_but_never_crashes(tree: Any, place: str) -> None:
    entry: dict[str, Any] = {
        "name": "a", "width": 4, "height": 4, "K": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "dist": [0] * 5, "R": np.eye(3).tolist(), "t": [0, 0, 0],
    }  # fmt: skip
    whole: Any = {"units": "mm", "cameras": [entry]}
    if place == "":
        whole = tree
    elif place == "cameras":
        whole["cameras"] = tree
    elif place == "entry":
        whole["cameras"] = [tree]
    else:
        entry[place] = tree
    said = refusal(lambda: cameras_from_document(whole, "x"))
    assert not said or said.startswith("x")


@pytest.mark.parametrize("wrong", [10**400, "400", None, True])
def test_what_is_no_number_is_refused_by_camera_and_key(tmp_path: Path, wrong: object) -> None:
    write_cameras(tmp_path / "cameras.json", small_array(2))
    document = json.loads((tmp_path / "cameras.json").read_text())
    document["cameras"][1]["K"] = [[wrong, 0, 1], [0, wrong, 1], [0, 0, 1]]
    if wrong is True:
        document["cameras"][1]["K"] = [[True] * 3] * 3
    (tmp_path / "cameras.json").write_text(json.dumps(document))
    with pytest.raises(CameraError, match="cam01: K must hold numbers") as refused:
        read_cameras(tmp_path / "cameras.json")
    assert len(str(refused.value)) < 500
