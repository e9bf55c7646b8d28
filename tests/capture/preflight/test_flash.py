"""The flash check finds the device whose frames are filed under another trigger."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture.arrays import Floats, Image
from capture.camera import Camera
from capture.devices.simulated import simulated_array
from capture.judgement import Colour
from capture.preflight import flash_findings, flash_levels
from capture.preflight.flash import flash_of
from capture.recorder import RecordSettings
from capture.session import Session, Shot, record_take
from tests.capture.recording import cameras


def levels(at: int, seed: int, share: float = 1.0, frames: int = 60, pulse: bool = True) -> Floats:
    """Levels of a device that saw a flash at a frame, the first with a share of its light."""
    rng = np.random.default_rng(seed)
    gain = rng.uniform(0.3, 1.2)
    light = np.full(frames, 0.3)
    light[at] += 0.2 * share
    if share < 1:
        light[at + 1] += 0.2 * (1 - share if pulse else 1)
    elif not pulse:
        light[at:] += 0.2
    return gain * light * (1 + 0.003 * rng.normal(size=frames))


@pytest.mark.parametrize("pulse", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_the_same_frame_everywhere_is_green(seed: int, pulse: bool) -> None:
    rng = np.random.default_rng(seed)
    at = int(rng.integers(3, 55))
    series = {f"cam{c:02d}": levels(at, seed * 100 + c, pulse=pulse) for c in range(16)}
    (finding,) = flash_findings(series)
    assert finding.colour == Colour.GREEN, finding
    assert finding.sentence == f"All 16 devices saw the flash in frame {at}."


@pytest.mark.parametrize(("late", "words"), [(1, "one frame late"), (-2, "2 frames early")])
def test_the_odd_device_is_named(late: int, words: str) -> None:
    series = {f"cam{c:02d}": levels(30 + (late if c == 5 else 0), c) for c in range(8)}
    (finding,) = flash_findings(series)
    assert (finding.device, finding.colour) == ("cam05", Colour.RED)
    assert finding.sentence == (
        f"cam05 saw the flash in frame {30 + late}, the others in frame 30: its frames are filed "
        f"{words}."
    )


def test_a_flash_within_an_exposure_proves_nothing_when_devices_disagree() -> None:
    series = {f"cam{c:02d}": levels(30, c, share=0.3 if c % 2 else 0.2) for c in range(8)}
    (finding,) = flash_findings(series)
    assert finding.colour == Colour.AMBER
    assert "this flash proves nothing" in finding.sentence
    agreed = {f"cam{c:02d}": levels(30, c, share=0.6) for c in range(8)}
    assert flash_findings(agreed)[0].colour == Colour.GREEN


def test_a_device_that_saw_nothing_and_a_take_without_a_flash() -> None:
    rng = np.random.default_rng(0)
    dark = 0.3 * (1 + 0.003 * rng.normal(size=60))
    series = {f"cam{c:02d}": levels(30, c) for c in range(3)} | {"cam03": dark}
    (finding,) = flash_findings(series)
    assert finding.sentence == "cam03 did not see the flash that the others saw in frame 30."
    (finding,) = flash_findings({"a": dark, "b": dark[::-1]})
    assert finding.sentence == "0 of 2 devices saw a flash: nothing to compare."
    assert flash_of([0.1, 0.2]).index == -1


def test_lost_frames_shift_nothing() -> None:
    series = levels(30, 1)
    series[[5, 12, 29]] = np.nan
    assert flash_of(series).index == 30


class FlashScene:
    """Dark, but for one flash of 2 ms."""

    def __init__(self, t_ns: int) -> None:
        self.t_ns = t_ns

    def render(self, camera: Camera, t_ns: int) -> Image:
        lit = t_ns <= self.t_ns < t_ns + 3_000_000
        return np.full((camera.height, camera.width), 200 if lit else 40, np.uint8)


def test_a_recorded_take_shows_its_flash(tmp_path: Path) -> None:
    settings = RecordSettings()
    start = 5 * 10**9
    array = simulated_array(cameras(3), FlashScene(start + 7 * settings.period_ns + 500_000))
    shot = Shot(slate="flash", kind="board", frames=20, start_ns=start)
    take = record_take(Session.create(tmp_path / "s"), shot, array, settings)
    (finding,) = flash_findings(flash_levels(take))
    assert finding.sentence == "All 3 devices saw the flash in frame 7."
