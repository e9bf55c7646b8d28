"""`likeness devices` on the simulated backend: the table, the roster, settings out and in."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools.cli import main

ARRAY = """
[array]
name = "stage"
[[device]]
name = "left"
backend = "sim"
serial = "SIM-0003"
address = "9"
[[device]]
name = "right"
backend = "sim"
serial = "SIM-0099"
"""


@pytest.fixture
def array(tmp_path: Path) -> Path:
    path = tmp_path / "array.toml"
    path.write_text(ARRAY, encoding="utf-8")
    return path


def test_the_table_names_every_device(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices", "--backend", "sim"]) == 0
    told = capsys.readouterr()
    assert told.out == ""
    assert "16 found" in told.err
    assert "SIM-0015  likeness simulated  simulated, 10000 Mbit/s" in told.err


def test_every_backend_that_is_installed_is_asked(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    asked = {device["backend"] for device in report["devices"]}
    assert "sim" in asked
    # Whatever could not look is named with what to install, and is no failure.
    assert all("install" in why for why in report["not_installed"].values())


def test_the_roster_says_what_is_missing_moved_and_extra(
    array: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["devices", "--backend", "sim", "--array", str(array)]
    assert main(words) == 0
    told = capsys.readouterr().err
    assert "array stage: 1 of 2 devices are there" in told
    assert "moved    left: expected at 9, found at 3" in told
    assert "missing  right: expected serial SIM-0099; not found; look at its power" in told
    assert main([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["complete"] is False
    assert [line["kind"] for line in report["roster"]][:3] == ["moved", "missing", "extra"]
    assert len(report["roster"]) == 2 + 15


def test_all_settings_of_a_device_are_written_with_its_own_description(
    tmp_path: Path, array: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "left.json"
    words = ["devices", "--backend", "sim", "--array", str(array), "--features", "left"]
    assert main([*words, "--out", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    document = json.loads(out.read_text(encoding="utf-8"))
    assert document["values"]["PixelFormat"] == "Mono8"
    assert document["serial"] == "SIM-0003"
    assert report["read"] == len(document["values"])
    assert Path(report["description"]).read_text(encoding="utf-8").startswith("<SimulatedDevice>")


def test_a_preset_is_written_and_what_reads_back_otherwise_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    preset = tmp_path / "gain.toml"
    preset.write_text('[[feature]]\nname = "Gain"\nvalue = 3.0\n', encoding="utf-8")
    words = ["devices", "--backend", "sim", "--preset", str(preset), "--device", "SIM-0004"]
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["written"] == 1
    preset.write_text('[[feature]]\nname = "Gain"\nvalue = 99.0\n', encoding="utf-8")
    assert main(words) == 1
    told = capsys.readouterr().err
    assert "SIM-0004: 1 setting" in told
    assert "Gain: asked for 99.0, reads 0.0 (Gain: asked for 99.0, offers 0 to 24" in told


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--features", "SIM-0001"], "--features DEVICE and --out FILE belong together"),
        (["--preset", "x.toml"], "--preset FILE and --device DEVICE belong together"),
        (["--backend", "simm"], "did you mean 'sim'"),
        (["--backend", "sim", "--features", "nine", "--out", "x.json"],
         "no device 'nine'; found: SIM-0000 at 0"),
        (["--array", "none.toml"], "none.toml: no such array file"),
    ],
)  # fmt: skip
def test_bad_usage_is_told(words: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices", *words]) == 2
    assert told in capsys.readouterr().err
