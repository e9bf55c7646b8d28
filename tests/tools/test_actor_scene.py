"""The actor's scene: what plays when, its truth, its errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture.archive import read_archive
from capture.camera_file import read_cameras
from capture.errors import SettingsError
from tools.actor.array import make_array
from tools.actor.scene import DEMO_BOARD, ActorScene, SceneSettings, act_times, open_scene
from tools.actor.script import Act, Plan, Script, board_pose, make_script
from tools.actor.truth import write_truth

PERIOD_NS = 100_000_000


@pytest.fixture(scope="module")
def scene() -> ActorScene:
    plans = [
        Plan(slate="board", kind="board", frames=5),
        Plan(slate="smile", kind="face", frames=7, weights={"mouthSmile": 0.8, "jawOpen": 0.3}),
    ]
    return ActorScene(SceneSettings(script=make_script(plans, period_ns=PERIOD_NS), actor=2))


def test_an_expression_leaves_neutral_and_comes_back(scene: ActorScene) -> None:
    times = act_times(scene.settings.script.by_slate("smile"))
    assert len(times) == 7
    posed = [scene.truth(int(t)) for t in times]
    for end in (posed[0], posed[-1]):
        assert np.array_equal(end.skin, scene.model.neutral.vertices)
        assert not end.weights.any()
    peak = posed[3]
    assert peak.weights[scene.model.names.index("mouthSmileLeft")] == pytest.approx(0.8)
    assert np.abs(peak.head.rotation - np.eye(3)).max() > 0.01


def test_a_board_is_still_about_each_trigger(scene: ActorScene) -> None:
    times = act_times(scene.settings.script.by_slate("board"))
    for t_ns in times:
        early, late = scene.board_truth(int(t_ns) - 40_000), scene.board_truth(int(t_ns) + 40_000)
        assert np.array_equal(early.matrix(), late.matrix())
    assert not np.array_equal(
        scene.board_truth(int(times[0])).matrix(), scene.board_truth(int(times[1])).matrix()
    )


def test_boards_face_all_about_and_fill_the_volume() -> None:
    size = (
        DEMO_BOARD.squares_x * DEMO_BOARD.square_mm,
        DEMO_BOARD.squares_y * DEMO_BOARD.square_mm,
    )
    poses = [board_pose(index, 0, size) for index in range(60)]
    outward = np.array([-pose.rotation[:, 2] for pose in poses])
    azimuth = np.degrees(np.arctan2(outward[:, 0], outward[:, 2]))
    assert azimuth.min() < -40
    assert azimuth.max() > 40
    middle = np.array([0.5 * size[0], 0.5 * size[1], 0.0])
    centres = np.array([pose.apply(middle) for pose in poses])
    assert (np.ptp(centres, axis=0) > 70).all()


def test_images_follow_the_script(scene: ActorScene) -> None:
    camera = make_array(0, count=16, size=120)[7]
    board, smile = (scene.settings.script.by_slate(slate).start_ns for slate in ("board", "smile"))
    first, second = scene.render(camera, board), scene.render(camera, smile)
    assert first.shape == second.shape == (120, 120)
    assert first.dtype == np.uint8
    assert np.abs(first.astype(float) - second).mean() > 10
    assert scene.render(camera, board).tobytes() == first.tobytes()
    assert scene.render(camera, smile).tobytes() == second.tobytes()


def test_truth_on_disk(scene: ActorScene, tmp_path: Path) -> None:
    array = make_array(0, count=2, size=80)
    times = act_times(scene.settings.script.by_slate("smile"))
    write_truth(tmp_path / "truth", scene, array, times, depth_frames=(3,))
    truth = read_archive(
        tmp_path / "truth" / "truth.npz",
        ["vertices", "faces", "weights", "names", "R", "t", "landmarks68", "surface", "surface_tri",
         "face_region", "t_ns"],
    )  # fmt: skip
    skin = truth["vertices"].shape[1]
    assert truth["vertices"].shape == (7, len(scene.model.neutral.vertices), 3)
    assert truth["surface_tri"].max() == skin + truth["surface"].shape[1] - 1
    assert truth["weights"].shape == (7, len(truth["names"]))
    expected = scene.truth(int(times[3])).skin
    assert np.abs(truth["vertices"][3] - expected).max() < 1e-4
    posed = truth["vertices"][3] @ truth["R"][3] - truth["t"][3] @ truth["R"][3]
    shape = scene.model.neutral.vertices + np.tensordot(truth["weights"][3], scene.model.deltas, 1)
    assert np.abs(posed - shape).max() < 1e-3
    assert read_cameras(tmp_path / "truth" / "cameras.json").names == array.names
    depth = read_archive(tmp_path / "truth" / "depth_0003.npz", ["cam00", "cam01"])
    assert 400 < np.median(depth["cam00"][depth["cam00"] > 0]) < 800


def test_a_scene_opens_from_its_description() -> None:
    act = {"slate": "a", "kind": "face", "start_ns": 0, "end_ns": 100, "weights": {"jawOpen": 1.0}}
    scene = open_scene({"actor": None, "acts": [act], "seed": 3})
    assert scene.model.identity.generic
    text = '{"acts": [{"slate": "b", "kind": "board", "start_ns": 0, "end_ns": 10, "hold_ns": 5}]}'
    assert open_scene(text).settings.script.acts[0].kind == "board"


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"acts": [], "actr": 1}, "actr: unknown"),
        ({}, "acts: expected a list"),
        ({"acts": []}, "at least one act"),
        ({"acts": [{"slate": "a"}]}, "missing"),
        ('{"acts": ', "expected JSON"),
        ("no/such/file.json", "not readable"),
        (
            {"acts": [{"slate": "a", "kind": "hand", "start_ns": 0, "end_ns": 1}]},
            '"board" or "face"',
        ),
        (
            {
                "acts": [
                    {"slate": "a", "kind": "face", "start_ns": 0, "end_ns": 1, "weights": {"x": 1}}
                ]
            },
            "no shape 'x'",
        ),
    ],
)
def test_a_wrong_description_is_refused(spec: object, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        open_scene(spec)  # type: ignore[arg-type]


def test_acts_must_not_overlap() -> None:
    one = Act(slate="a", kind="face", start_ns=0, end_ns=10)
    two = Act(slate="b", kind="face", start_ns=10, end_ns=20)
    with pytest.raises(SettingsError, match="must start after 'a' ends"):
        Script((one, two))


def test_an_array_stands_before_the_face() -> None:
    array = make_array(4)
    assert len(array) == 16
    assert array.names[0] == "cam00"
    centres = np.array([camera.centre for camera in array])
    azimuth = np.degrees(np.arctan2(centres[:, 0], centres[:, 2] - 40))
    assert azimuth.min() < -58
    assert azimuth.max() > 58
    for camera in array:
        assert camera.contains(camera.project(np.array([[0.0, -12.0, 40.0]]))).all()
    same = make_array(4)
    assert all(np.array_equal(a.matrix, b.matrix) for a, b in zip(array, same, strict=True))
    with pytest.raises(SettingsError, match="count"):
        make_array(0, count=0)
