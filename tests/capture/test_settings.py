from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from capture.errors import SettingsError
from capture.settings import check_ranges, read_settings, settings_to_toml


@dataclass(frozen=True, kw_only=True)
class Knobs:
    voxel_mm: float = 0.4
    rounds: int = 3
    mode: Literal["fast", "good"] = "good"
    range_mm: tuple[float, float] = (-10.0, 10.0)
    note: str | None = None
    dense: bool = True

    def __post_init__(self) -> None:
        check_ranges("knobs", self, voxel_mm=(0.1, 5.0), rounds=(1, float("inf")))


def write(folder: Path, text: str) -> Path:
    path = folder / "settings.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_written_settings_are_read_back(tmp_path: Path) -> None:
    knobs = Knobs(voxel_mm=0.5, rounds=7, mode="fast", range_mm=(-1.0, 2.5), note='a "b" \\ c')
    path = write(tmp_path, settings_to_toml({"knobs": knobs}))
    assert read_settings(path, {"knobs": Knobs}) == {"knobs": knobs}


def test_a_stage_without_a_table_gets_its_defaults(tmp_path: Path) -> None:
    assert read_settings(write(tmp_path, ""), {"knobs": Knobs}) == {"knobs": Knobs()}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[knobs]\nvoxel_m = 1.0\n", ["settings.toml", "knobs.voxel_m", "'voxel_mm'"]),
        ("[knob]\n", ["[knob]", "'knobs'"]),
        ("[knobs]\nrounds = 2.5\n", ["knobs.rounds", "int", "2.5"]),
        ("[knobs]\nrounds = true\n", ["knobs.rounds", "int", "True"]),
        ('[knobs]\nmode = "best"\n', ["knobs.mode", "best"]),
        ("[knobs]\nrange_mm = [1.0]\n", ["knobs.range_mm", "[1.0]"]),
        ("[knobs]\nvoxel_mm = 0\n", ["knobs.voxel_mm", "at least 0.1"]),
        ("[knobs]\nvoxel_mm = nan\n", ["knobs.voxel_mm", "at least 0.1"]),
        ("[knobs\n", ["settings.toml", "TOML"]),
    ],
)
def test_a_file_that_does_not_fit_is_refused_by_name(
    tmp_path: Path, text: str, words: list[str]
) -> None:
    with pytest.raises(SettingsError) as caught:
        read_settings(write(tmp_path, text), {"knobs": Knobs})
    for word in words:
        assert word in str(caught.value)


def test_all_problems_are_listed_at_once(tmp_path: Path) -> None:
    path = write(tmp_path, "[knobs]\nvoxel_m = 1.0\nrounds = 'x'\n[other]\n")
    with pytest.raises(SettingsError) as caught:
        read_settings(path, {"knobs": Knobs})
    assert all(word in str(caught.value) for word in ("voxel_m", "rounds", "other"))


def test_every_setting_out_of_range_is_named() -> None:
    with pytest.raises(SettingsError) as caught:
        Knobs(voxel_mm=float("nan"), rounds=0)
    assert str(caught.value) == (
        "knobs.voxel_mm = nan: must be at least 0.1 and at most 5; "
        "knobs.rounds = 0: must be at least 1"
    )
    assert Knobs(voxel_mm=0.1).voxel_mm == 0.1
    assert Knobs(voxel_mm=5.0, rounds=10**9).rounds == 10**9
