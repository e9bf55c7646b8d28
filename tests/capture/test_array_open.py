"""Opening the devices of an array file: presets read back, all problems in one error."""

from __future__ import annotations

from pathlib import Path

import pytest

from capture.array_file import ArrayFile, read_array_file, simulated_array_file
from capture.array_open import open_array
from capture.devices.backend import load_backend
from capture.devices.lines import HostLine, SoftwareLine
from capture.devices.protocol import TriggerKind
from capture.errors import DeviceError, LikenessError, SettingsError

PRESET = """
[[feature]]
name = "TriggerMode"
value = "Off"
[[feature]]
name = "Gain"
value = 6.0
"""
ARRAY = """
[array]
name = "stage"
[record]
rate_hz = 25.0
[[device]]
name = "left"
backend = "sim"
address = "64x48?seed=1"
preset = "stage.preset.toml"
width = 64
height = 48
pixel_format = "Mono8"
[[device]]
name = "right"
backend = "sim"
serial = "SIM-0002"
"""


def array_file(folder: Path, array: str = ARRAY, preset: str = PRESET) -> ArrayFile:
    (folder / "stage.preset.toml").write_text(preset, encoding="utf-8")
    path = folder / "array.toml"
    path.write_text(array, encoding="utf-8")
    return read_array_file(path)


def test_devices_are_opened_in_order_with_their_presets(tmp_path: Path) -> None:
    told: list[str] = []
    array = open_array(array_file(tmp_path), told=told.append)
    try:
        assert array.names == ("left", "right")
        assert told == []
        left = array.devices[0]
        assert left.read_feature("Gain") == 6.0  # type: ignore[attr-defined]
        assert array.line is load_backend("sim").line()  # type: ignore[attr-defined]
    finally:
        array.close()


def test_every_setting_that_does_not_read_back_is_told(tmp_path: Path) -> None:
    preset = PRESET.replace("6.0", "6.27") + '[[feature]]\nname = "Gane"\nvalue = 1\n'
    told: list[str] = []
    open_array(array_file(tmp_path, preset=preset), told=told.append).close()
    assert len(told) == 2
    assert told[0].startswith("left: stage.preset.toml: Gain: asked for 6.27, reads 6.3")
    assert "Gane: asked for 1, reads nothing (no feature 'Gane'; did you mean 'Gain'?)" in told[1]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("width = 64", "width = 2048", ["left: asked for width = 2048, has 64", "preset"]),
        ('"Mono8"', '"Mono12"', ["left: asked for pixel_format Mono12, has Mono8", "PixelFormat"]),
        ('name = "stage"', 'name = "stage"\ntrigger = "action"',
         ["2 of 2 devices", "asked for trigger action", "offers hardware", 'trigger = "hardware"']),
        ("64x48?seed=1", "64x48?sead=1", ["left", "'seed'"]),
    ],
)  # fmt: skip
def test_a_device_that_is_not_as_the_file_says_is_refused(
    tmp_path: Path, old: str, new: str, words: list[str]
) -> None:
    with pytest.raises(LikenessError) as caught:
        open_array(array_file(tmp_path, ARRAY.replace(old, new, 1)))
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_all_devices_are_tried_and_those_that_opened_are_closed(tmp_path: Path) -> None:
    text = ARRAY.replace("seed=1", "sead=1") + (
        '[[device]]\nname = "top"\nbackend = "sim"\naddress = "1x1"\n'
    )
    with pytest.raises(DeviceError) as caught:
        open_array(array_file(tmp_path, text))
    assert "2 of 3 devices" in str(caught.value)
    assert all(f"- {name}: " in str(caught.value) for name in ("left", "top"))
    open_array(array_file(tmp_path)).close()  # the wire is as free as before


def test_an_unknown_backend_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no backend 'simm'; did you mean 'sim'"):
        open_array(array_file(tmp_path, ARRAY.replace('"sim"', '"simm"', 1)))


@pytest.mark.parametrize(
    ("trigger", "line", "fires"),
    [(TriggerKind.SOFTWARE, SoftwareLine, True), (TriggerKind.FREE_RUN, HostLine, False)],
)
def test_the_line_is_that_of_the_trigger(
    tmp_path: Path, trigger: TriggerKind, line: type, fires: bool
) -> None:
    text = ARRAY.replace('name = "stage"', f'name = "stage"\ntrigger = "{trigger}"', 1)
    array = open_array(array_file(tmp_path, text))
    array.close()
    assert (array.trigger, type(array.line), array.line.fires) == (trigger, line, fires)


def test_a_simulated_array_needs_no_file() -> None:
    array = open_array(simulated_array_file(16))
    array.close()
    assert array.names[::15] == ("cam01", "cam16")
    assert len({device.info.serial for device in array.devices}) == 16
    with pytest.raises(SettingsError, match="asked for 0, offers 1 to 64"):
        simulated_array_file(0)
