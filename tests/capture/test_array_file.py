"""The array file: strict, and everything that is wrong with one is told at once."""

from __future__ import annotations

from pathlib import Path

import pytest

from capture.array_file import read_array_file
from capture.devices.protocol import TriggerKind
from capture.errors import SettingsError

GOOD = """
[array]
name = "stage"
trigger = "action"
calibration = "cameras.json"

[action]
group_key = 7
broadcast = ["10.0.0.255"]
ahead_ms = 25

[record]
rate_hz = 50.0
exposure_us = 2000

[[device]]
name = "cam01"
backend = "aravis"
serial = "40012345"
address = "10.0.0.11"
preset = "stage.preset.toml"
width = 2048
height = 1536
pixel_format = "Mono8"

[[device]]
name = "cam02"
backend = "v4l2"
address = "/dev/video0"
"""


def write(folder: Path, text: str) -> Path:
    (folder / "cameras.json").write_text("{}", encoding="utf-8")
    (folder / "stage.preset.toml").write_text("", encoding="utf-8")
    path = folder / "array.toml"
    path.write_text(text, encoding="utf-8")
    return path


def refused(folder: Path, text: str) -> str:
    with pytest.raises(SettingsError) as caught:
        read_array_file(write(folder, text))
    return str(caught.value)


def test_an_array_file_is_read(tmp_path: Path) -> None:
    array = read_array_file(write(tmp_path, GOOD))
    assert (array.name, array.trigger, array.source) == ("stage", TriggerKind.ACTION, "")
    assert (array.action.keys.group_key, array.action.keys.device_key) == (7, 1)
    assert array.action.broadcast == ("10.0.0.255",)
    assert (array.scheduled, array.action.ahead_ms) == (True, 25.0)
    assert (array.record.rate_hz, array.record.exposure_us) == (50, 2000)
    assert array.calibration == tmp_path / "cameras.json"
    first, second = array.devices
    assert (first.name, first.known_as, first.preset) == (
        "cam01", "40012345", tmp_path / "stage.preset.toml",
    )  # fmt: skip
    assert (first.width, first.height, first.pixel_format) == (2048, 1536, "Mono8")
    assert (second.known_as, second.preset, second.width) == ("/dev/video0", None, None)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("pixel_format", "pixelformat", ["device 1 (cam01).pixelformat", "'pixel_format'"]),
        ("[record]", "[recrod]", ["'recrod'", "'record'"]),
        ("rate_hz = 50.0", "rate_hz = 0", ["rate_hz", "at least 1"]),
        ("rate_hz = 50.0", "rate = 50", ["record.rate", "'rate_hz'"]),
        ("exposure_us = 2000", "exposure_us = 20000", ["period of 20000 us"]),
        ('"action"', '"akshun"', ["array.trigger", "akshun"]),
        ("group_key = 7", "group_key = -1", ["group_key", "32 bits"]),
        ('["10.0.0.255"]', "[7]", ["array.toml: action.broadcast: expected str, found 7"]),
        ("group_key = 7", "timeout_ms = 0", ["timeout_ms", "above 0"]),
        ('name = "stage"\n', "", ["array: missing key 'name'"]),
        ('name = "cam02"\n', "", ["device 2: missing key 'name'"]),
        ('"cam02"', '"cam01"', ["'cam01' is there 2 times"]),
        ('"cam02"', '"../x"', ["device 2 (../x)", "'../x'"]),
        ('address = "/dev/video0"', "", ["device 2 (cam02)", "neither serial nor address"]),
        ('backend = "v4l2"\naddress = "/dev/video0"', 'backend = "aravis"\nserial = "40012345"',
         ["serial '40012345' is that of cam01 and of cam02"]),
        ('"stage.preset.toml"', '"../x.toml"', ["preset", "leads out of"]),
        ('"stage.preset.toml"', '"/etc/hostname"', ["preset", "leads out of"]),
        ('"stage.preset.toml"', '"nine.toml"', ["preset", "'nine.toml'", "no such file"]),
        ('"cameras.json"', '"c.json"', ["array.calibration", "no such file"]),
        ("width = 2048", "width = 0", ["width must be at least 1"]),
        ("width = 2048", 'width = "wide"', ["device 1 (cam01).width", "int"]),
        ("[array]", "[array", ["array.toml", "TOML"]),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_by_name(
    tmp_path: Path, old: str, new: str, words: list[str]
) -> None:
    assert old in GOOD
    message = refused(tmp_path, GOOD.replace(old, new, 1))
    assert all(word in message for word in words), message


def test_all_problems_are_told_in_one_error(tmp_path: Path) -> None:
    text = GOOD.replace("rate_hz", "rate").replace("group_key", "grop_key")
    text = text.replace('"cameras.json"', '"c.json"').replace("width", "with")
    message = refused(tmp_path, text)
    assert "4 problems" in message
    assert all(word in message for word in ("record.rate", "grop_key", "c.json", ".with"))


def test_an_array_has_devices(tmp_path: Path) -> None:
    assert "missing key 'device'" in refused(tmp_path, '[array]\nname = "a"\n')
    assert "expected [[device]] tables" in refused(tmp_path, 'device = 3\n[array]\nname = "a"\n')


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no such array file"):
        read_array_file(tmp_path / "none.toml")
