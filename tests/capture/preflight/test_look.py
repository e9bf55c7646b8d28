"""Exposure, flicker, focus and motion are found in pictures that have them, and only there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture.arrays import Image
from capture.calibration_link import make_reference
from capture.judgement import Colour
from capture.preflight.look import (
    Sight,
    exposure_findings,
    flicker,
    flicker_findings,
    focus_findings,
    look,
    scene_findings,
)
from tests.capture.scene_pictures import Face, Stage, shot


def level(value: float, spread: float = 0.3, seed: int = 0) -> Image:
    rng = np.random.default_rng(seed)
    light = 255 * value * (1 + spread * rng.uniform(-1, 1, (120, 160)))
    return np.clip(light, 0, 255).astype(np.uint8)


def sight(*images: Image) -> Sight:
    return Sight(images, (0.4,))


@pytest.mark.parametrize(
    ("value", "colour", "words"),
    [
        (0.4, "green", "cam00 is exposed well (mean 40%, 0.0% clipped, 0% dark)."),
        (0.05, "amber", "cam00 is too dark"),
        (0.01, "red", "cam00 sees next to nothing"),
        (0.7, "green", "cam00 is exposed well"),
        (0.78, "amber", "of the face region of cam00 is clipped"),
        (0.95, "red", "of the face region of cam00 is clipped"),
    ],
)
def test_exposure_in_words(value: float, colour: str, words: str) -> None:
    (finding,) = exposure_findings({"cam00": sight(level(value))})
    assert finding.colour == colour, finding
    assert words in finding.sentence
    assert (finding.remedy == "") == (colour == "green")


def test_light_that_went_out_since_the_session_began() -> None:
    start = {"cam00": sight(level(0.4)).mean, "cam01": sight(level(0.4)).mean}
    now = {"cam00": sight(level(0.41)), "cam01": sight(level(0.25))}
    same, darker = exposure_findings(now, start)
    assert same.colour == Colour.GREEN
    assert darker.colour == Colour.RED
    assert darker.sentence.startswith("cam01 is 37% darker than at session start")


def test_only_flicker_is_flicker() -> None:
    rng = np.random.default_rng(3)
    phase = 2 * np.pi * rng.uniform(size=20)
    steady = 0.4 * (1 + 0.001 * rng.normal(size=20))
    assert flicker(steady.tolist()) < 0.002
    assert flicker((steady * np.linspace(1, 1.1, 20)).tolist()) < 0.002  # a lamp that warms up
    assert flicker((0.4 * (1 + 0.05 * np.sin(phase))).tolist()) == pytest.approx(0.035, abs=0.01)
    assert flicker([0.4, 0.5]) == 0.0
    image = level(0.4)
    sights = {
        "cam00": Sight((image,), tuple(steady)),
        "cam01": Sight((image,), tuple(0.4 * (1 + 0.05 * np.sin(phase)))),
    }
    (finding,) = flicker_findings(sights)
    assert (finding.device, finding.colour) == ("cam01", Colour.AMBER)
    assert "flickers by" in finding.sentence


def test_focus_against_calibration_day(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    faces = {name: Face(seed, size=256) for seed, name in enumerate(("a", "b", "c"))}
    then = {name: [face.seen(rng) for _ in range(3)] for name, face in faces.items()}
    flat = [shot(np.zeros((256, 256)), rng) for _ in range(2)]
    reference = make_reference({**then, "d": flat}, tmp_path / "r.npz")
    blurs = {"a": 0.0, "b": 0.8, "c": 1.6}
    sights = {
        name: sight(*(faces[name].seen(rng, blur, gain=0.7, noise=3) for _ in range(2)))
        for name, blur in blurs.items()
    }
    found = focus_findings(sights | {"d": sight(*then["a"][:2]), "e": sight(*flat)}, reference)
    assert [finding.colour for finding in found] == ["green", "amber", "red", "amber", "amber"]
    assert "b is softer than on calibration day: 6" in found[1].sentence
    assert "Focus of d is not compared" in found[3].sentence
    (empty,) = focus_findings({"a": sight(*flat)}, reference)
    assert "nothing to see in the middle of its image" in empty.sentence


def test_a_device_that_moved_is_told_by_scene_findings(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    stage = Stage(2, size=320)
    reference = make_reference({"cam07": [shot(stage.view(), rng)]}, tmp_path / "r.npz")
    (finding,) = scene_findings({"cam07": sight(shot(stage.view(3.2, 0.0), rng))}, reference)
    assert (finding.check, finding.device, finding.colour) == ("scene", "cam07", Colour.RED)
    assert finding.sentence.startswith("cam07 moved by 3.2 px")


def test_looking_keeps_two_images_and_all_levels() -> None:
    images = iter([level(0.4, seed=place) for place in (0, 0, 1, 2, 3)])
    waits: list[float] = []
    seen = look(lambda: {"a": next(images)}, 5, 0.04, waits.append)
    assert waits == [0.04] * 4
    assert len(seen["a"].levels) == 4, "the same image twice is looked at once"
    assert np.array_equal(seen["a"].images[0], level(0.4, seed=2))
    assert np.array_equal(seen["a"].images[1], level(0.4, seed=3))
