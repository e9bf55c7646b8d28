"""`likeness drift` from rendered images: what moved is named, solved anew, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera import CameraArray
from capture.camera_file import read_cameras, write_cameras
from capture.pose import Pose
from recon.visiting import import_take
from tools.bench.bench_drift import moved_state
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state, render_board
from tools.cli import main

SCENE = BoardScene(size_px=400, focal_px=900.0, radius_mm=620.0, devices=4, poses=5)
PUSH = np.concatenate([np.radians([0.3, -0.2, 0.1]), [2.0, 1.0, -1.5]])
BOARD = """[board]
kind = "charuco"
squares_x = 12
squares_y = 9
square_mm = 20.0
marker_mm = 15.0
dictionary = "DICT_5X5_1000"
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a take in which cam01 has moved, the board file, and the old cameras."""
    folder = tmp_path_factory.mktemp("drift")
    then = make_state(SCENE)
    now = moved_state(then, {1: PUSH})
    middle = A4_BOARD.corners_mm().mean(axis=0)[None]
    for camera in now.cameras:
        (folder / "source" / camera.name).mkdir(parents=True)
        for index, pose in enumerate(now.array_from_board):
            image = np.full((SCENE.size_px, SCENE.size_px), 90, np.uint8)
            if -pose.rotation[:, 2] @ (camera.centre - pose.apply(middle)[0]) > 0:
                image = render_board(camera, pose, A4_BOARD, seed=index)
            cv2.imwrite(str(folder / "source" / camera.name / f"{index:04d}.png"), image)
    import_take(folder / "source", folder / "take")
    (folder / "board.toml").write_text(BOARD, encoding="utf-8")
    write_cameras(folder / "cameras.json", then.cameras, {"mean_reprojection_px": 0.1})
    return folder


def words(place: Path, *more: str) -> list[str]:
    return [
        "drift", str(place / "take"), "--board", str(place / "board.toml"),
        "--cameras", str(place / "cameras.json"), *more,
    ]  # fmt: skip


def test_what_moved_is_solved_anew(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (place / "cameras.json").read_bytes()
    new = place / "new.json"
    assert main(words(place, "--resolve-moved", "--out", str(new), "--json")) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["verdict"], told["moved"]) == ("moved", ["cam01"])
    assert told["after"]["resolved"] == ["cam01"]
    assert told["after"]["moved"] == []
    assert "cam01 has moved by 2." in told["words"][1]
    assert (place / "cameras.json").read_bytes() == before
    then, now = read_cameras(place / "cameras.json"), read_cameras(new)
    true = moved_state(make_state(SCENE), {1: PUSH}).cameras
    assert np.linalg.norm(now[1].centre - true[1].centre) < 0.3  # mm
    for index in (0, 2, 3):
        np.testing.assert_array_equal(
            now[index].camera_from_world.matrix(), then[index].camera_from_world.matrix()
        )
        np.testing.assert_array_equal(now[index].matrix, then[index].matrix)
    kept = json.loads(new.read_text(encoding="utf-8"))["report"]
    assert kept == {
        "mean_reprojection_px": 0.1, "resolved": ["cam01"], "resolved_from": "cameras.json"
    }  # fmt: skip
    page = (place / "new.drift.html").read_text(encoding="utf-8")
    assert "cam01 has changed, the other 3 have not" in page
    assert "Solved anew: cam01" in page
    assert '<div class="summary bad">' in page
    assert "Array:</b> cam01 has moved by 2." in page
    report = (place / "new.drift.json").read_bytes()
    assert main(words(place, "--resolve", "cam01", "--out", str(new), "--json")) == 0
    assert (place / "new.drift.json").read_bytes() == report


def test_a_plain_check_reports_in_the_take(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words(place, "--significant", "6")) == 0
    text = capsys.readouterr().err
    assert "verdict: cam01 has changed, the other 3 have not" in text
    folder = place / "take" / "products" / "drift"
    assert sorted(path.name for path in folder.iterdir()) == ["drift.html", "drift.json"]


def test_options_that_contradict_are_refused(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for more, message in (
        (["--resolve-moved"], "need --out NEW.json"),
        (["--out", str(place / "x.json")], "give --resolve NAME or --resolve-moved too"),
        (["--lens"], "--lens belongs to --resolve"),
        (["--resolve", "cam01", "--out", str(place / "cameras.json")], "never overwritten"),
        (["--resolve", "cam7", "--out", str(place / "x.json")], "did you mean 'cam0"),
    ):
        assert main(words(place, *more)) == 2
        assert message in capsys.readouterr().err
        assert not (place / "x.json").exists()


def test_a_wrong_board_size_stops_a_re_solve(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    then = moved_state(make_state(SCENE), {1: PUSH}).cameras
    shrunk = CameraArray(
        tuple(
            c.posed(Pose(c.camera_from_world.rotation, 0.95 * c.camera_from_world.translation))
            for c in then
        )
    )
    write_cameras(place / "shrunk.json", shrunk)
    command = words(place, "--resolve", "cam01", "--out", str(place / "y.json"))
    command[command.index("--cameras") + 1] = str(place / "shrunk.json")
    assert main(command) == 1
    assert "the devices agree only with a board 0.95" in capsys.readouterr().err
    assert not (place / "y.json").exists()
    assert (place / "y.drift.json").is_file()
