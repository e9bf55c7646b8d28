"""A device that moved or lost focus is found by so much; one that did not raises no alarm."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from capture.archive import write_archive
from capture.calibration_link import (
    calibration_standing,
    check_static_scene,
    link_calibration,
    linked_cameras,
    linked_reference,
    make_reference,
    measure_motion,
    read_link,
    read_reference,
    sharpness,
    small_picture,
)
from capture.camera_file import write_cameras
from capture.errors import CameraError, ShapeError, TakeError
from capture.judgement import Colour
from tests.capture.recording import cameras
from tests.capture.scene_pictures import Face, Stage, shot, with_actor

NOON = datetime(2026, 11, 20, 12, tzinfo=UTC)


@pytest.mark.parametrize("seed", range(2))
def test_shifts_are_found_within_a_tenth_of_a_pixel(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    stage = Stage(seed, size=352)
    then = {"cam07": [with_actor(shot(stage.view(), rng), rng)]}
    reference = make_reference(then, tmp_path / "reference.npz")
    for size in (0.0, 0.4, 3.2, 20.0):
        angle = rng.uniform(0, 2 * np.pi)
        x, y = size * np.cos(angle), size * np.sin(angle)
        image = shot(stage.view(x, y), rng, gain=rng.uniform(0.6, 1.3), noise=rng.uniform(1, 5))
        now = {"cam07": with_actor(image, rng, aside=rng.uniform(-0.06, 0.06))}
        (found,) = check_static_scene(reference, now)
        motion = found.motion
        assert motion is not None
        assert np.hypot(motion.shift_px[0] - x, motion.shift_px[1] - y) < 0.1
        assert motion.sigma_px < 0.1
        expected = "green" if size == 0 else "amber" if size < 1 else "red"
        assert found.colour == expected, (size, found.sentence)
        if size == 3.2:
            assert found.sentence.startswith("cam07 moved by 3.2 px: its surroundings lie ")
            assert "likeness drift" in found.remedy


def test_a_larger_image_is_measured_in_its_own_pixels() -> None:
    rng = np.random.default_rng(5)
    stage = Stage(5, size=640)
    then, now = (shot(stage.view(*by), rng) for by in ((0.0, 0.0), (2.5, -1.25)))
    motion = measure_motion(small_picture(then), small_picture(now), factor=2)
    np.testing.assert_allclose(motion.shift_px, [2.5, -1.25], atol=0.1)


def test_a_turn_is_told_though_the_middle_stays() -> None:
    turn_deg = -0.3
    rng = np.random.default_rng(8)
    picture = small_picture(shot(Stage(8, size=256).view(), rng, noise=0.5))
    turned = _turned(picture, np.radians(turn_deg), 1.0)
    motion = measure_motion(picture, turned)
    assert motion.turn_mdeg == pytest.approx(1000 * turn_deg, abs=15)
    assert motion.size_px < 0.05
    grown = measure_motion(picture, _turned(picture, 0.0, 1.002))
    assert grown.growth_ppm == pytest.approx(2000, abs=300)


def test_no_false_alarm_over_seeds() -> None:
    stage = Stage(3, size=320)
    rng = np.random.default_rng(17)
    still = stage.view()
    picture = small_picture(with_actor(shot(still, rng), rng))
    for _ in range(5):
        image = shot(still, rng, gain=rng.uniform(0.5, 1.4), noise=rng.uniform(0.5, 6))
        motion = measure_motion(
            picture, small_picture(with_actor(image, rng, rng.uniform(-0.1, 0.1)))
        )
        assert motion.size_px < 0.1
        assert motion.size_px < 5 * motion.sigma_px


def test_other_surroundings_and_empty_ones_are_not_compared() -> None:
    rng = np.random.default_rng(1)
    one, other = (small_picture(shot(Stage(seed, size=300).view(), rng)) for seed in (1, 2))
    assert not measure_motion(one, other).known
    dark = np.zeros((300, 300))
    assert not measure_motion(dark, dark).known
    with pytest.raises(ShapeError, match="fresh"):
        measure_motion(one, dark[:200])


def test_findings_say_what_could_not_be_compared(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    image = shot(Stage(2, size=256).view(), rng)
    reference = make_reference({"a": [image], "b": [image]}, tmp_path / "r.npz")
    flat = np.full((256, 256), 90, np.uint8)
    found = check_static_scene(reference, {"a": flat, "c": image})
    assert [(f.device, f.colour) for f in found] == [
        ("a", Colour.AMBER), ("b", Colour.AMBER), ("c", Colour.AMBER)
    ]  # fmt: skip
    assert "whether it moved is not known" in found[0].sentence
    assert found[1].sentence == "b gave no image: not compared."
    assert found[2].sentence == "c has no picture of calibration day: not compared."
    (found_size,) = check_static_scene({"a": reference["a"]}, {"a": image[:200]})
    assert found_size.colour == Colour.RED
    assert "sends 256 x 200 px; it was calibrated with 256 x 256 px" in found_size.sentence


def test_sharpness_follows_focus_and_nothing_else() -> None:
    rng = np.random.default_rng(4)
    for seed in (0, 1):
        face = Face(seed, size=256)
        base = sharpness([face.seen(rng), face.seen(rng)])
        for gain, noise in ((0.5, 0.5), (1.0, 4.0), (1.3, 1.5)):
            pair = [face.seen(rng, 0.0, gain, noise) for _ in range(2)]
            assert sharpness(pair) == pytest.approx(base, rel=0.05)
            assert sharpness(pair[:1]) == pytest.approx(base, rel=0.08)
            soft = [face.seen(rng, 1.0, gain, noise) for _ in range(2)]
            assert 0.4 < sharpness(soft) / base < 0.6


def test_sharpness_of_nothing_is_not_a_number() -> None:
    rng = np.random.default_rng(0)
    flat, other = (shot(np.zeros((256, 256)), rng) for _ in range(2))
    assert np.isnan(sharpness([flat, other]))
    assert np.isnan(sharpness([flat, flat.copy()]))
    assert np.isnan(sharpness([np.zeros((8, 32), np.uint8)]))
    with pytest.raises(ShapeError, match="images of one size, at least one"):
        sharpness([flat, flat[:100]])
    with pytest.raises(ShapeError, match="uint8 or uint16 is expected, found float64"):
        sharpness([flat / 255.0])


def test_a_reference_reads_back_as_it_was_made(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    wide = shot(Stage(6, size=640).view(), rng)[:480]
    deep = (wide[:200, :300].astype(np.uint16) * 257)[..., None].repeat(3, axis=2)
    path = tmp_path / "reference.npz"
    made = make_reference({"a": [wide, wide], "b": [deep]}, path, lenses={"b": "L-77"})
    first = path.read_bytes()
    make_reference({"a": [wide, wide], "b": [deep]}, path, lenses={"b": "L-77"})
    assert path.read_bytes() == first
    back = read_reference(path)
    assert list(back) == ["a", "b"]
    for name, one in back.items():
        np.testing.assert_allclose(one.picture, made[name].picture, atol=1e-5)
        assert one.brightness == made[name].brightness
    assert (back["a"].size_px, back["a"].factor, back["b"].lens) == ((640, 480), 2, "L-77")
    np.testing.assert_allclose(back["b"].picture, wide[:200, :300] / 255.0, atol=1e-4)


def test_a_damaged_reference_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "reference.npz"
    path.write_bytes(b"PK no")
    with pytest.raises(ShapeError, match=r"expected an \.npz archive"):
        read_reference(path)
    write_archive(path, {"device_names": np.array(["a"])})
    with pytest.raises(ShapeError, match="missing lens_names"):
        read_reference(path)
    with pytest.raises(ShapeError, match="reference: b: no image"):
        make_reference({"b": []}, path)


def calibration(folder: Path, days_old: float) -> Path:
    """A cameras.json of four devices that was made so many days before NOON."""
    folder.mkdir(exist_ok=True)
    path = folder / "cameras.json"
    write_cameras(path, cameras(4))
    made = (NOON - timedelta(days=days_old)).timestamp()
    os.utime(path, (made, made))
    return path


def test_a_session_names_its_calibration_and_its_age(tmp_path: Path) -> None:
    session = tmp_path / "session"
    session.mkdir()
    names = cameras(4).names
    none = calibration_standing(session, names, now=NOON)
    assert (none.colour, read_link(session)) == (Colour.AMBER, None)
    assert "names no calibration" in none.sentence
    path = calibration(tmp_path / "made", 3)
    stage = Stage(1, size=256).view()
    make_reference(
        {"cam00": [shot(stage, np.random.default_rng(0))]}, path.with_name("reference.npz")
    )
    link = link_calibration(session, path, now=NOON)
    assert read_link(session) == link
    assert link.has_reference
    assert list(read_reference(linked_reference(session))) == ["cam00"]
    assert link.age_days(NOON) == pytest.approx(3, abs=0.01)
    good = calibration_standing(session, names, now=NOON)
    assert (good.colour, good.sentence) == (Colour.GREEN, f"Calibration {link.id} is 3 days old.")
    old = calibration_standing(session, names, old_days=2, now=NOON)
    assert old.colour == Colour.AMBER
    assert "older than 2 days" in old.sentence
    assert "likeness drift" in old.remedy
    odd = calibration_standing(session, [*names, "cam99"], now=NOON)
    assert (odd.colour, odd.sentence) == (
        Colour.RED, f"Calibration {link.id} has no camera for cam99."
    )  # fmt: skip
    path.write_text("changed elsewhere", encoding="utf-8")  # the session has its own copy
    assert calibration_standing(session, names, now=NOON).colour == Colour.GREEN
    linked_cameras(session).write_text("{}", encoding="utf-8")
    changed = calibration_standing(session, names, now=NOON)
    assert changed.colour == Colour.RED
    assert "is not the calibration" in changed.sentence


def test_links_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    session = tmp_path / "session"
    with pytest.raises(TakeError, match="no such session folder"):
        link_calibration(session, tmp_path / "cameras.json")
    session.mkdir()
    with pytest.raises(CameraError, match="no such file"):
        link_calibration(session, tmp_path / "cameras.json")
    link_calibration(session, calibration(tmp_path / "made", 1), now=NOON)
    file = session / "calibration.json"
    document = json.loads(file.read_text(encoding="utf-8"))
    for change, words in (
        ({"made": "tuesday"}, "made: expected a time with its zone, found 'tuesday'"),
        ({"devices": "cam00"}, "devices: expected a list of names, found 'cam00'"),
        ({"version": 9}, "reads up to 1; update likeness"),
        ({"extra": 1}, "unknown key 'extra'"),
        ({"id": 5}, "id: expected text, found 5"),
    ):
        file.write_text(json.dumps(document | change), encoding="utf-8")
        with pytest.raises(TakeError, match=words):
            read_link(session)
        standing = calibration_standing(session, ["cam00"], now=NOON)
        assert standing.colour == Colour.RED
        assert words in standing.sentence


def _turned(picture: np.ndarray, angle: float, scale: float) -> np.ndarray:
    """The picture turned about its middle, by cubic sampling of a fine upsampling."""
    fine = 5
    height, width = picture.shape
    spectrum = np.fft.fftshift(np.fft.fft2(picture))
    padded = np.pad(spectrum, ((height * (fine - 1) // 2,) * 2, (width * (fine - 1) // 2,) * 2))
    large = np.fft.ifft2(np.fft.ifftshift(padded)).real * fine * fine
    y, x = np.mgrid[:height, :width]
    cx, cy = (width - 1) / 2, (height - 1) / 2
    u = ((x - cx) * np.cos(angle) + (y - cy) * np.sin(angle)) / scale + cx
    v = ((y - cy) * np.cos(angle) - (x - cx) * np.sin(angle)) / scale + cy
    a, b = np.clip(v * fine, 0, large.shape[0] - 1), np.clip(u * fine, 0, large.shape[1] - 1)
    out: np.ndarray = large[np.round(a).astype(int), np.round(b).astype(int)]
    return out
