"""`likeness capture` without keys, on simulated devices in real time."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from capture.devices.array import DeviceArray
from capture.devices.faults import Fault, FaultKind
from capture.devices.lines import RealTimeLine
from capture.devices.simulated import SimulatedBackend
from capture.live import LiveArray
from capture.recorder import RecordSettings
from capture.rom.conductor import Conductor, Stand
from capture.rom.shot_list import read_shot_list
from capture.session import Session
from tools.cli import main
from tools.verbs.capture_unattended import Rehearsal, run_unattended

SHOTS = """
name = "two"
[defaults]
hold_s = 0.1
total_s = 0.2
countdown_s = 0.0
[[prompt]]
slate = "neutral"
title = "Neutral"
sentence = "Relax."
kind = "neutral"
[[prompt]]
slate = "smile"
title = "Smile"
sentence = "Smile."
kind = "expression"
"""
ARRAY = """
[array]
name = "stage"
[record]
rate_hz = 50.0
[[device]]
name = "left"
backend = "sim"
address = "64x48?seed=1"
preset = "gain.preset.toml"
[[device]]
name = "right"
backend = "sim"
address = "64x48?seed=2"
"""
ROOT = Path(__file__).resolve().parents[2]


def write_gain(folder: Path, gain: float) -> None:
    preset = f'[[feature]]\nname = "Gain"\nvalue = {gain}\n'
    (folder / "gain.preset.toml").write_text(preset, encoding="utf-8")


def kept(report: dict[str, Any]) -> set[str]:
    """Slates with a good take; on a busy machine another of them may be red, and stays on disk."""
    return {take["slate"] for take in report["list"] if take["status"] == "keep"}


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    """A folder with an array file, its preset and a shot list."""
    (tmp_path / "shots.toml").write_text(SHOTS, encoding="utf-8")
    (tmp_path / "array.toml").write_text(ARRAY, encoding="utf-8")
    write_gain(tmp_path, 6.5)
    return tmp_path


def words(stage: Path, *more: str) -> list[str]:
    shots = ["--shots", str(stage / "shots.toml")]
    quick = ["--burst", "10", "--looks", "2", "--ptp-hold-s", "0", "--retakes", "5"]
    return ["capture", str(stage / "session"), *shots, "--unattended", *quick, *more]


def test_a_session_runs_without_keys_and_reports_every_take(
    stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words(stage, "--array", str(stage / "array.toml"), "--json")) == 0
    told = capsys.readouterr()
    report = json.loads(told.out)
    assert (report["finished"], report["prompts_left"]) == (True, [])
    assert kept(report) == {"neutral", "smile"}
    assert report["remarks"] == []
    assert "session session: 2/2" in told.err
    assert len(Session.open(stage / "session").takes()) == report["takes"]
    for take in report["list"]:
        assert main(["verify", str(stage / "session" / "takes" / take["take"])]) == 0
    # All is done: again, nothing more is recorded.
    assert main(words(stage, "--array", str(stage / "array.toml"), "--json")) == 0
    assert json.loads(capsys.readouterr().out)["takes"] == report["takes"]


def test_a_setting_that_does_not_read_back_stops_the_session_unless_overruled(
    stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_gain(stage, 1.27)
    array = ["--array", str(stage / "array.toml")]
    assert main(words(stage, *array)) == 1
    told = capsys.readouterr().err
    assert "left is not set as preset gain.preset says: Gain: asked for 1.27, reads 1.3" in told
    assert "Traceback" not in told
    assert main(words(stage, *array, "--overrule", "--json")) == 0
    report = json.loads(capsys.readouterr().out)
    assert kept(report) == {"neutral", "smile"}
    assert "Gain: asked for 1.27, reads 1.3" in report["remarks"][0]


def test_a_setting_that_a_device_rounds_a_little_is_told_and_stops_nothing(
    stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_gain(stage, 6.27)
    assert main(words(stage, "--array", str(stage / "array.toml"), "--json")) == 0
    report = json.loads(capsys.readouterr().out)
    assert kept(report) == {"neutral", "smile"}
    assert report["check"][0].startswith(
        "amber: left rounds preset gain.preset: Gain: asked for 6.27, reads 6.3"
    )


def test_simulated_devices_need_no_array_file(
    stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words(stage, "--simulate", "3", "--json")) == 0
    report = json.loads(capsys.readouterr().out)
    assert kept(report) == {"neutral", "smile"}
    assert "of 3 devices are complete" in report["list"][-1]["sentence"]


def test_a_red_take_is_taken_again_and_the_red_one_is_kept(stage: Path) -> None:
    backend = SimulatedBackend(RealTimeLine())
    devices = tuple(backend.open(f"64x48?seed={n}", f"cam{n:02d}") for n in range(2))
    settings = RecordSettings(rate_hz=50.0)
    session = Session.create(stage / "session")
    stand = Stand(
        session=session, prompts=read_shot_list(stage / "shots.toml"),
        array=LiveArray(DeviceArray(devices, backend.line()), settings), settings=settings,
        frame_set_bytes=2 * 64 * 48,
    )  # fmt: skip
    spoilt: list[int] = []

    def progress(done: int, total: int, what: str) -> None:
        if not spoilt and what.startswith("session"):  # armed, the first take about to begin
            spoilt.append(done)
            devices[1].inject(Fault(FaultKind.LOSE_FRAME, triggers=15))

    with Conductor(stand) as conductor:
        view = run_unattended(conductor, Rehearsal(retakes=5), progress)
    takes = {take.name: (take.colour, take.note.status) for take in view.takes}
    assert takes["neutral_001"] == ("red", "retake")
    assert {name.partition("_")[0] for name, of in takes.items() if of == ("green", "keep")} == {
        "neutral", "smile",
    }  # fmt: skip
    assert {note.folder.name for note in session.takes()} == set(takes)


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ([], "give either --array array.toml or --simulate NUMBER"),
        (["--simulate", "0"], "asked for 0, offers 1 to 64"),
        (["--array", "none.toml"], "none.toml: no such array file"),
        (["--simulate", "2", "--shots", "none.toml"], "none.toml: no such shot list"),
    ],
)
def test_bad_usage_is_told_and_leaves_no_session(
    stage: Path, more: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words(stage, *more)) == 2
    assert told in capsys.readouterr().err
    assert not (stage / "session").exists()


def test_a_device_that_is_not_there_leaves_no_session(
    stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = ARRAY.replace("64x48?seed=2", "nowhere")
    (stage / "array.toml").write_text(text, encoding="utf-8")
    assert main(words(stage, "--array", str(stage / "array.toml"))) == 1
    told = capsys.readouterr().err
    assert "1 of 2 devices could not be opened" in told
    assert "right: simulated device 'nowhere'" in told
    assert not (stage / "session").exists()


def test_the_console_wants_a_terminal(
    stage: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    assert main(["capture", str(stage / "session"), "--simulate", "2"]) == 2
    told = capsys.readouterr().err
    assert "the console needs a terminal" in told
    assert "--unattended" in told


def test_textual_is_imported_by_the_console_alone() -> None:
    code = (
        "import sys, importlib, pkgutil, tools.verbs, tools.terminal, tools.cli\n"
        "for m in ('capture', 'devices'):\n"
        "    importlib.import_module('tools.verbs.' + m)\n"
        "sys.exit(any(m.partition('.')[0] == 'textual' for m in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False)
    assert done.returncode == 0
