"""Each fault of a device is named, by its number and in words; a good array is left in peace."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera import CameraArray
from capture.camera_file import read_cameras
from recon.fusion import Points, fuse
from recon.scan import ReconSettings
from recon.scan_quality import CameraQuality, camera_qualities
from recon.scan_warnings import camera_warnings, missing_warnings, scan_warnings
from recon.stereo import PairDepth, match_views
from tests.synthetic_stereo import draw, ring

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
ARRAY = ring((-18.0, 0.0, 18.0), (-9.0, 9.0))
SETTINGS = ReconSettings(depth_mm=90.0, extent_mm=110.0)
BAD = "cam04"


@pytest.fixture(scope="module")
def images() -> dict[str, np.ndarray]:
    return {c.name: np.rint(65535 * draw(c)).astype(np.uint16) for c in ARRAY}


def seen(cameras: CameraArray, images: dict[str, np.ndarray]) -> tuple[list[PairDepth], Points]:
    pairs = match_views(cameras, images, SETTINGS.stereo(), workers=2)
    return pairs, fuse([pair.view for pair in pairs if pair.view], SETTINGS.fusion(), workers=2)


@pytest.fixture(scope="module")
def clean(images) -> tuple[list[PairDepth], Points]:
    return seen(ARRAY, images)


def judged(cameras, images, found=None) -> dict[str, CameraQuality]:
    pairs, points = found or seen(cameras, images)
    return {one.name: one for one in camera_qualities(cameras, images, pairs, points)}


def told(qualities: dict[str, CameraQuality]) -> dict[str, list[str]]:
    return camera_warnings(list(qualities.values()))


def test_a_good_array_is_left_in_peace(images, clean):
    found = judged(ARRAY, images, clean)
    assert told(found) == {}
    for one in found.values():
        assert one.deviation_px < 0.05
        assert 0.85 < one.sharpness < 1.15
        assert 0.97 < one.gain < 1.03
        assert one.clipped_share < 0.01
        assert one.pairs >= 2
        assert one.unconfirmed_share < 0.1
        assert one.covered_share > 0.8
    assert judged(ARRAY, images, clean) == found


def test_a_device_out_of_focus_is_named(images):
    faulty = {**images, BAD: cv2.GaussianBlur(images[BAD], (0, 0), 1.8)}
    found = judged(ARRAY, faulty)
    assert found[BAD].sharpness < 0.8
    (names, sentences), *others = told(found).items()
    assert (names, others) == (BAD, [])
    assert any("out of focus" in words for words in sentences)


@pytest.mark.parametrize("white", [65535, 30000])
def test_clipped_highlights_are_named(images, clean, white: int):
    skin = images[BAD][images[BAD] > 10000]
    limit = np.percentile(skin, 90)
    clipped = np.minimum(images[BAD], limit) * (white / limit)
    faulty = {**images, BAD: np.rint(clipped).astype(np.uint16)}
    found = judged(ARRAY, faulty, clean)
    assert 0.06 < found[BAD].clipped_share < 0.14
    assert all(one.clipped_share < 0.01 for one in found.values() if one.name != BAD)
    assert any("at white" in words for words in told(found)[BAD])


@pytest.mark.parametrize("gain", [0.7, 1.3])
def test_a_gain_that_is_off_is_named(images, clean, gain: float):
    faulty = {**images, BAD: np.rint(images[BAD] * gain).astype(np.uint16)}
    found = judged(ARRAY, faulty, clean)
    assert found[BAD].gain == pytest.approx(gain, abs=0.03)
    assert list(told(found)) == [BAD]
    word = "darker" if gain < 1 else "brighter"
    assert any(word in words for words in told(found)[BAD])


@pytest.mark.parametrize("shift", [(0.4, 0.0), (0.0, 0.4)])
def test_a_device_that_moved_is_named(images, shift: tuple[float, float]):
    moved = CameraArray(
        tuple(
            replace(c, cx=c.cx + shift[0], cy=c.cy + shift[1]) if c.name == BAD else c
            for c in ARRAY
        )
    )
    found = judged(moved, images)
    assert 0.2 < found[BAD].deviation_px < 0.6
    others = [one.deviation_px for one in found.values() if one.name != BAD]
    assert max(others) < found[BAD].deviation_px
    assert list(told(found)) == [BAD]
    assert any("moved since the calibration" in words for words in told(found)[BAD])


def test_a_device_that_sees_something_else_is_named(images):
    noise = np.random.default_rng(8).integers(0, 65535, (200, 200))
    faulty = {**images, BAD: noise.astype(np.uint16)}
    found = judged(ARRAY, faulty)
    assert any("nothing matched" in w or "look at its image" in w for w in told(found)[BAD])


@pytest.mark.slow
@pytest.mark.shared_data
def test_four_faults_on_a_face_are_told_apart():
    source = SHARED / "takes" / "dev-smile"
    cameras = read_cameras(source / "cameras.json")
    images = {
        c.name: cv2.imread(str(source / c.name / "0000.png"), cv2.IMREAD_GRAYSCALE) for c in cameras
    }
    blurred, dark, clipped, moved = (cameras.names[k] for k in (1, 5, 9, 13))
    images[blurred] = cv2.GaussianBlur(images[blurred], (0, 0), 1.6)
    images[dark] = np.rint(0.7 * images[dark]).astype(np.uint8)
    bright = images[clipped] > 0.3 * images[clipped].max()
    level = np.percentile(images[clipped][bright], 85)
    images[clipped] = np.minimum(images[clipped], level).astype(np.uint8)
    shifted = CameraArray(
        tuple(replace(c, cx=c.cx + 0.3, cy=c.cy - 0.2) if c.name == moved else c for c in cameras)
    )
    settings = ReconSettings()
    pairs = match_views(shifted, images, settings.stereo(), workers=2)
    points = fuse([p.view for p in pairs if p.view], settings.fusion(), workers=2)
    found = camera_warnings(camera_qualities(shifted, images, pairs, points))
    assert set(found) == {blurred, dark, clipped, moved}
    for name, word in (
        (blurred, "out of focus"),
        (dark, "darker"),
        (clipped, "at white"),
        (moved, "moved since the calibration"),
    ):
        assert any(word in sentence for sentence in found[name])


GOOD = CameraQuality(
    name="a", pairs=4, matched_share=0.5, neighbours_share=0.5, unconfirmed_share=0.1,
    covered_share=0.9, deviation_px=0.01,
    deviation_mm=0.01, sharpness=1.0, clipped_share=0.0, gain=1.0,
)  # fmt: skip


def four(**changes: float) -> list[CameraQuality]:
    return [replace(GOOD, name=name, **changes) for name in "abcd"]


def warned(qualities: list[CameraQuality], **numbers: float) -> list[str]:
    plain = {"matched_share": 0.5, "agreement_p95_mm": 0.1, "footprint_mm": 0.5}
    return scan_warnings(qualities, **{**plain, **numbers})


def test_what_all_cameras_share_is_said_once():
    assert warned(four()) == []
    (words,) = warned(four(deviation_px=0.3))
    assert "4 of 4 cameras" in words
    assert "calibrate again" in words
    (words,) = warned(four(clipped_share=0.2))
    assert "20 % of the skin is at white" in words
    (words,) = warned(four(), agreement_p95_mm=0.4)
    assert "pairs agree to 0.40 mm (95 %) where a pixel covers 0.50 mm" in words
    (words,) = warned(four(), matched_share=0.05)
    assert "5 % of the textured pixels were matched" in words


def test_what_one_camera_shows_names_it():
    mixed = [*four()[:3], replace(GOOD, name="d", deviation_px=0.3, gain=0.6)]
    assert [words.partition(":")[0] for words in warned(mixed)] == ["d", "d"]
    unmatched = replace(GOOD, name="d", deviation_px=float("nan"), gain=float("nan"))
    (words,) = warned([*four()[:3], unmatched])
    assert words.startswith("d: nothing matched with any of its 4 partners")
    (words,) = warned([*four()[:3], replace(unmatched, pairs=0)])
    assert words.startswith("d: stands too far")
    assert missing_warnings([]) == []
    (words,) = missing_warnings(["x", "y"])
    assert words.startswith("x, y: no image of this frame")
