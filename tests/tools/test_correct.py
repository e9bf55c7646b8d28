"""`likeness correct`: what is typed, what is stored, what is told, and how it exits."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture.take import Take
from recon.mesh import read_obj, write_obj
from recon.visiting import import_take
from tests.synthetic import small_array, write_visit
from tests.track.moving_patch import patch_mesh
from tools.cli import main
from track.corrections.replay import read_corrections
from track.performance import Performance, write_performance

MESH = patch_mesh()
CAMERAS = {camera.name: camera for camera in small_array()}


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A take of four frames and three views, with a neutral and a performance that stands still."""
    folder = tmp_path_factory.mktemp("correct")
    import_take(write_visit(folder / "visit", small_array()), folder / "take")
    write_obj(folder / "take" / "neutral.obj", MESH)
    performance = Performance(
        vertices=np.tile(MESH.vertices.astype(np.float32), (4, 1, 1)),
        confidence=np.full((4, len(MESH.vertices)), 0.5, np.float32),
        polygons=MESH.polygons,
        frames=np.arange(4),
        head_from_neutral=np.tile(np.eye(4), (4, 1, 1)),
        reference=np.full(4, -1),
    )
    write_performance(folder / "take" / "products" / "track" / "performance.npz", performance)
    return folder / "take"


@pytest.fixture
def take(tracked: Path, tmp_path: Path) -> Path:
    shutil.copytree(tracked, tmp_path / "take")
    return tmp_path / "take"


class Runner:
    """Runs actions on one take and keeps what they say."""

    def __init__(self, take: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self._take, self._capsys = take, capsys

    def done(self, *words: str) -> dict[str, Any]:
        assert main(["correct", str(self._take), *words, "--json"]) == 0
        report: dict[str, Any] = json.loads(self._capsys.readouterr().out)
        return report

    def refused(self, *words: str) -> str:
        assert main(["correct", str(self._take), *words]) == 2
        message = self._capsys.readouterr().err
        assert "Traceback" not in message
        return " ".join(message.replace("│", " ").split())


@pytest.fixture
def correct(take: Path, capsys: pytest.CaptureFixture[str]) -> Runner:
    return Runner(take, capsys)


def seen(vertex: int, camera: str, away_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> str:
    x, y = CAMERAS[camera].project(MESH.vertices[[vertex]] + away_mm)[0]
    return f"{camera}:{x},{y}"


def test_every_action_is_stored_listed_and_replayed(correct: Runner, take: Path) -> None:
    pin = ["add-pin", "--frame", "2", "--vertex", "100", "--pixel", seen(100, "cam00")]
    assert correct.done(*pin, "--by", "Ann", "--note", "slid")["added"] == [
        "1: pin at frame 2: vertex 100 in cam00 (Ann; slid)"
    ]
    row = ["170", "171", "172", "173"]
    line = [seen(int(vertex), "cam01").split(":")[1] for vertex in row]
    curve = ["add-curve", "--frame", "2", "--camera", "cam01", "--chain", "lip", "--pixels", *line]
    correct.done(*curve, "--vertices", *row)
    correct.done("add-curve", "--frame", "3", *curve[3:])  # the chain is known by its name
    correct.done("exclude-view", "--camera", "cam02", "--frames", "1,3")
    correct.done("exclude-frame", "--frames", "1")
    correct.done("lock", "--frames", "3")
    correct.done("anchor", "--frames", "2:4")
    listed = correct.done("list")
    assert [entry["kind"] for entry in listed["entries"]] == [
        *("pin", "curve", "curve", "exclude_view", "exclude_view", "exclude_frame", "lock"),
        *("anchor", "anchor"),
    ]  # fmt: skip
    assert listed["entries"][2]["vertices"] == [170, 171, 172, 173]
    assert (listed["corrections"], listed["can_undo"], listed["can_redo"]) == (9, 7, 0)
    told = read_corrections(Take.open(take), read_obj(take / "neutral.obj"))
    assert (told.anchors, told.excluded, told.locked) == ((2, 3), (1,), (3,))
    held = told.for_frame(3).locked
    assert held is not None
    np.testing.assert_array_equal(held.vertices, MESH.vertices.astype(np.float32))
    assert (held.confidence == 0.5).all()
    assert [len(told.for_frame(frame).sightings) for frame in range(4)] == [0, 0, 2, 1]
    assert told.for_frame(1).excluded_views == {"cam02"}


def test_a_list_in_words_names_every_entry(
    correct: Runner, take: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    correct.done("exclude-view", "--camera", "cam02")
    correct.done("anchor", "--frames", "2")
    assert main(["correct", str(take), "list"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert "1: view cam02 excluded at frames 0 to 3" in lines
    assert "2: anchor at frame 2" in lines


def test_a_pin_tells_what_it_does(correct: Runner) -> None:
    away = (0.0, 1.5, 0.0)
    words = ["add-pin", "--frame", "2", "--vertex", "100", "--pixel"]
    one = correct.done(*words, seen(100, "cam00", away))
    assert "across this one view" in one["pin 1"]
    both = correct.done(*words, seen(100, "cam01", away), seen(100, "cam02", away))
    assert both["removed"] == ["1: pin at frame 2: vertex 100 in cam00"]
    assert both["pin 2"] == "moves the point by 1.50 mm; its views meet within 0.00 px"
    apart = correct.done(*words, seen(100, "cam01", (0.0, -4.0, 0.0)))
    assert float(apart["pin 3"].split()[-2]) > 1.0  # px: one view contradicts the others
    point = ["--triangle", *map(str, MESH.triangles[7]), "--barycentric", "0.2", "0.3", "0.5"]
    middle = np.array([0.2, 0.3, 0.5]) @ MESH.vertices[MESH.triangles[7]]
    x, y = CAMERAS["cam01"].project(middle[None])[0]
    inner = correct.done("add-pin", "--frame", "1", *point, "--pixel", f"cam01:{x},{y}")
    assert inner["pin 4"].startswith("moves the point by 0.00 mm")


def test_undo_redo_remove_and_unlock(correct: Runner, take: Path) -> None:
    correct.done("anchor", "--frames", "2")
    correct.done("lock", "--frames", "1:3")
    state = (take / "corrections.json").read_bytes()
    assert correct.done("unlock", "--frames", "1")["removed"] == ["2: frame 1 locked"]
    assert correct.done("undo")["added"] == ["2: frame 1 locked"]
    assert correct.done("remove", "1", "3")["removed"] == [
        "1: anchor at frame 2",
        "3: frame 2 locked",
    ]
    assert correct.done("undo")["added"] == ["1: anchor at frame 2", "3: frame 2 locked"]
    assert (
        json.loads(state)["entries"]
        == json.loads((take / "corrections.json").read_text(encoding="utf-8"))["entries"]
    )
    assert correct.done("redo")["removed"] == ["1: anchor at frame 2", "3: frame 2 locked"]
    assert correct.done("anchor", "--frames", "2")["added"] == ["4: anchor at frame 2"]
    assert correct.done("anchor", "--frames", "2")["unchanged"] == "it says so already"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("add-pin --frame 9 --vertex 3 --pixel cam00:1,2", "frame 9 is not of the take"),
        ("add-pin --frame 1 --vertex 999 --pixel cam00:1,2", "no vertex 999; the mesh has 0..360"),
        ("add-pin --frame 1 --vertex 3 --pixel cam00,2", "expected CAMERA:COLUMN,ROW"),
        ("add-pin --frame 1 --vertex 3 --pixel cam00:1", "expected COLUMN,ROW, two numbers"),
        ("add-pin --frame 1 --vertex 3 --pixel cam00:nan,1", "pixel nan, 1 lies outside"),
        ("add-pin --frame 1 --vertex 3 --pixel cam00:1,1 cam00:2,2", "cam00 is named twice"),
        ("add-pin --frame 1 --vertex 3", "pixel"),
        ("add-pin --frame 1 --pixel cam00:1,2", "either --vertex, or --triangle"),
        ("add-pin --frame 1 --triangle 1 2 3 --pixel cam00:1,2", "either --vertex, or --triangle"),
        ("add-pin --frame 1 --vertex 3 --triangle 1 2 3 --pixel cam00:1,2", "either --vertex, or"),
        ("add-pin --frame 1 --vertex 3 --pixel cam00:1,2 --weight nan", "weight must be above 0"),
        ("add-curve --frame 1 --camera cam00 --chain lip --pixels 1,2 3,4", "give its --vertices"),
        ("exclude-view --camera cam0 --frames 1", "no camera 'cam0'; did you mean 'cam0"),
        ("exclude-frame --frames 0", "it shows the neutral"),
        ("exclude-frame --frames 3:9", "no frame 4; the take has 0..3"),
        ("unlock --frames 2", "none of these frames is locked; locked: none"),
        ("remove 4", "no correction 4; there are: none"),
        ("undo", "nothing to undo"),
        ("redo", "nothing was undone"),
        ("add-pim", "add-pim"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(
    correct: Runner, take: Path, words: str, told: str
) -> None:
    assert told in correct.refused(*words.split())
    assert not (take / "corrections.json").exists()
    assert not (take / "corrections").exists()


def test_a_take_that_was_never_tracked_needs_a_mesh(correct: Runner, take: Path) -> None:
    shutil.rmtree(take / "products")
    assert "not tracked yet, so there is nothing to lock" in correct.refused(
        "lock", "--frames", "1"
    )
    shutil.move(take / "neutral.obj", take.parent / "mesh.obj")
    assert "name the neutral with --neutral MESH.obj" in correct.refused("list")
    words = ["--neutral", str(take.parent / "mesh.obj"), "anchor", "--frames", "1"]
    assert correct.done(*words)["added"] == ["1: anchor at frame 1"]


def test_corrections_of_another_mesh_are_refused(correct: Runner, take: Path) -> None:
    correct.done("anchor", "--frames", "1")
    write_obj(take.parent / "coarse.obj", patch_mesh(9))
    words = ["--neutral", str(take.parent / "coarse.obj"), "list"]
    assert "the corrections are of 361 vertices, this mesh has 100" in correct.refused(*words)
