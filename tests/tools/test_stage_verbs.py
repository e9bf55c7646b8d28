"""`likeness reference` and `likeness flash`: what they write and what they tell."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from capture.arrays import Image
from capture.calibration_link import read_reference
from capture.camera import Camera
from capture.camera_file import write_cameras
from capture.devices.simulated import simulated_array
from capture.recorder import RecordSettings
from capture.session import Session, Shot, record_take
from tests.synthetic import small_array
from tools.cli import main

START_NS = 5 * 10**9
PERIOD_NS = RecordSettings().period_ns
CAMERAS = small_array(3, width=64, height=48)


class FlashScene:
    """Grey, but for one flash; one camera sees it a trigger late when asked to."""

    def __init__(self, late: str = "") -> None:
        self.late = late

    def render(self, camera: Camera, t_ns: int) -> Image:
        at = START_NS + (6 if camera.name == self.late else 5) * PERIOD_NS
        level = 200 if abs(t_ns - at) < PERIOD_NS // 2 else 60
        rng = np.random.default_rng(t_ns & 0xFFFF)
        noise = rng.integers(0, 4, (camera.height, camera.width))
        return (level + noise).astype(np.uint8)


def take_of(folder: Path, scene: FlashScene) -> Path:
    shot = Shot(slate="flash", kind="board", frames=14, start_ns=START_NS)
    array = simulated_array(CAMERAS, scene)
    return record_take(Session.create(folder), shot, array, RecordSettings()).folder


def test_a_flash_that_all_saw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    take = take_of(tmp_path / "s", FlashScene())
    assert main(["flash", str(take), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["colour"] == "green"
    assert report["same trigger everywhere"] is True
    assert set(report["frames"].values()) == {5}


def test_a_flash_that_one_saw_late(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = CAMERAS.names[1]
    take = take_of(tmp_path / "s", FlashScene(late=name))
    assert main(["flash", str(take), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["colour"] == "red"
    assert report["findings"][0].startswith(
        f"{name} saw the flash in frame 6, the others in frame 5: its frames are filed one frame "
        "late."
    )


def test_a_reference_stands_beside_its_calibration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    take = take_of(tmp_path / "s", FlashScene())
    path = tmp_path / "stage" / "cameras.json"
    path.parent.mkdir()
    write_cameras(path, CAMERAS)
    assert main(["reference", str(take), "--cameras", str(path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    made = read_reference(path.with_name("reference.npz"))
    assert list(made) == list(CAMERAS.names) == list(report["devices"])
    assert made[CAMERAS.names[0]].size_px == (64, 48)
    assert made[CAMERAS.names[0]].brightness == pytest.approx(61.5 / 255, abs=0.01)
    assert main(["reference", str(take), "--cameras", str(tmp_path / "none.json")]) == 2
