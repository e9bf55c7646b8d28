"""The photometric stage from images on disk: board, flat field, dark frames, refusals, the page."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera import CameraArray
from capture.camera_file import write_cameras
from capture.errors import InputError, SettingsError, TakeError
from capture.pose import Pose
from capture.product import record_path
from capture.take import Take
from recon.board.body import BoardBody
from recon.photometry.flat_samples import dark_levels, sample_flats
from recon.photometry.model import PhotometricModel, read_photometry
from recon.photometry.sources import LightSources, PhotometricSettings
from recon.photometry.stage import calibrate_photometry
from recon.visiting import import_take
from tests.synthetic_light import BIG_BOARD, TrueLight, true_light
from tools.bench.board_scene import BoardScene, make_state, render_board
from tools.cli import main

SCENE = BoardScene(size_px=400, focal_px=1000.0, radius_mm=620.0, devices=3, span_deg=30.0, poses=7)
STATE = make_state(SCENE, BIG_BOARD)
SIZES = tuple((camera.width, camera.height) for camera in STATE.cameras)
TRUTH = true_light(SIZES, 2)
TOP = 65535.0
BOARD_FILE = f"""[board]
kind = "charuco"
squares_x = {BIG_BOARD.squares_x}
squares_y = {BIG_BOARD.squares_y}
square_mm = {BIG_BOARD.square_mm}
marker_mm = {BIG_BOARD.marker_mm}
dictionary = "{BIG_BOARD.dictionary}"
"""


def save(folder: Path, name: str, frame: int, image: np.ndarray) -> None:
    (folder / name).mkdir(parents=True, exist_ok=True)
    deep = np.clip(np.round(image), 0, TOP).astype(np.uint16)
    cv2.imwrite(str(folder / name / f"{frame:04d}.png"), deep)


def taken(folder: Path) -> Take:
    return import_take(folder, folder.with_name(folder.name + "-take"))


def make_board_take(folder: Path) -> Take:
    for device, camera in enumerate(STATE.cameras):
        for frame, pose in enumerate(STATE.array_from_board):
            # the light changes from frame to frame, the paper's colour with the place on it
            radiance = render_board(camera, pose, BIG_BOARD, seed=frame) / 255.0
            radiance *= 0.5 + 0.04 * (frame % 5)
            shown = TRUTH.shown(device, radiance, TOP, 30.0, frame)
            save(folder, camera.name, frame, shown)
    return taken(folder)


def make_flat_take(folder: Path, truth: TrueLight, names: tuple[str, ...], level: float) -> Take:
    for device, name in enumerate(names):
        for frame in range(2):
            width, height = truth.sizes[device]
            radiance = np.full((height, width), level * (1.0 + 0.1 * frame))
            save(folder, name, frame, truth.shown(device, radiance, TOP, 300.0, frame))
    return taken(folder)


def make_dark_take(folder: Path, truth: TrueLight, names: tuple[str, ...]) -> Take:
    return make_flat_take(folder, truth, names, 0.0)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("light")
    names = STATE.cameras.names
    make_board_take(folder / "board")
    make_flat_take(folder / "flat", TRUTH, names, 0.4)
    make_dark_take(folder / "dark", TRUTH, names)
    (folder / "board.toml").write_text(BOARD_FILE, encoding="utf-8")
    write_cameras(folder / "cameras.json", STATE.cameras)
    return folder


def sources(home: Path, *, board: bool, flat: bool, dark: bool = True) -> LightSources:
    return LightSources(
        board_take=Take.open(home / "board-take") if board else None,
        board=BoardBody.of(BIG_BOARD) if board else None,
        cameras=STATE.cameras if board else None,
        flat=Take.open(home / "flat-take") if flat else None,
        dark=Take.open(home / "dark-take") if dark else None,
    )


def worst(model: PhotometricModel, radius: float) -> tuple[float, float]:
    """Largest relative error of V within that radius, half diagonals, and of a gain."""
    falls = []
    for index, device in enumerate(model):
        x, y = np.meshgrid(np.arange(0, device.width, 20), np.arange(0, device.height, 20))
        pixels = np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)
        away = np.linalg.norm(pixels - TRUTH.centres[index], axis=1)
        pixels = pixels[away < radius * 0.5 * np.hypot(*SIZES[index])]
        falls.append(np.abs(device.falloff(pixels) / TRUTH.falloff(index, pixels) - 1).max())
    gains = np.array([device.gain for device in model]) / np.exp(TRUTH.log_gains)
    return float(max(falls)), float(np.abs(gains - 1.0).max())


def test_rendered_boards_tell_gain_and_falloff(home: Path) -> None:
    out = home / "out" / "photometric.json"
    model = calibrate_photometry(sources(home, board=True, flat=False), PhotometricSettings(), out)
    fall, gain = worst(model, 0.75)
    assert fall < 0.005
    assert gain < 0.005
    for index, device in enumerate(model):
        assert device.black_dn == pytest.approx(TOP * TRUTH.black[index], abs=2.0)
        assert device.samples == device.coverage.sum()
    report = json.loads(out.read_text(encoding="utf-8"))["report"]
    assert 0.08 < report["devices"][0]["ink_ratio"] < 0.11
    assert record_path(out).is_file()
    before = out.read_bytes(), out.stat().st_mtime_ns
    steps: list[str] = []
    again = calibrate_photometry(
        sources(home, board=True, flat=False), PhotometricSettings(), out,
        progress=lambda done, total, what: steps.append(what),
    )  # fmt: skip
    assert steps == []  # current: skipped
    assert (out.read_bytes(), out.stat().st_mtime_ns) == before
    other = home / "out" / "again.json"
    calibrate_photometry(sources(home, board=True, flat=False), PhotometricSettings(), other)
    assert other.read_bytes() == before[0]
    assert again.names == STATE.cameras.names


def test_corrected_images_of_one_light_agree(home: Path) -> None:
    both = sources(home, board=True, flat=True)
    model = calibrate_photometry(both, PhotometricSettings(), home / "out" / "both.json")
    fall, gain = worst(model, 1.0)
    assert fall < 0.005
    assert gain < 0.005
    flat = Take.open(home / "flat-take")
    for name in model.names:
        light = model.corrected(name, flat.image(name, 0))
        blocks = light.reshape(10, 40, 10, 40).mean(axis=(1, 3))
        assert np.abs(blocks / 0.4 - 1.0).max() < 0.006


def test_a_flat_field_alone_has_no_gains_unless_told(home: Path) -> None:
    flat = sources(home, board=False, flat=True)
    model = calibrate_photometry(flat, PhotometricSettings(), home / "out" / "flat.json")
    assert worst(model, 1.0)[0] < 0.005
    assert all(device.gain == 1.0 and np.isnan(device.gain_sigma) for device in model)
    told = PhotometricSettings(same_light=True)
    model = calibrate_photometry(flat, told, home / "out" / "same.json")
    assert worst(model, 1.0)[1] < 0.005


def test_the_verb_writes_the_file_and_a_page(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = home / "verb" / "photometric.json"
    words = ["--board-take", "board-take", "--board", "board.toml", "--cameras", "cameras.json"]
    words = [str(home / w) if not w.startswith("--") else w for w in words]
    status = main(["photometric", *words, "--out", str(out), "--black-dn", "60000", "--json"])
    assert status == 2  # no light is left above such a black
    assert "cam00: 0 readings of light" in capsys.readouterr().err
    status = main(["photometric", *words, "--out", str(out), "--black-dn", "20000"])
    assert status == 2
    assert "likeness photometric: light t" in capsys.readouterr().err
    assert not out.exists()
    dark = ["--dark", str(home / "dark-take")]
    assert main(["photometric", *words, *dark, "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["gains_known"]
    assert read_photometry(out).names == STATE.cameras.names
    page = Path(told["page"]).read_text(encoding="utf-8")
    assert all(name in page for name in STATE.cameras.names)
    assert "falloff of cam01" in page


def test_sources_that_do_not_fit_are_refused(home: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs a flat field take"):
        LightSources()
    with pytest.raises(InputError, match=r"--board BOARD.toml --cameras CAMERAS\.json"):
        LightSources(board_take=Take.open(home / "board-take"))
    names = ("cam00", "cam01")
    small = true_light(((200, 200), (400, 400)), 1)
    other = make_dark_take(tmp_path / "dark", small, names)
    wrong = dataclasses.replace(sources(home, board=False, flat=True), dark=other)
    out = tmp_path / "photometric.json"
    with pytest.raises(InputError, match=r"2 problems(.|\n)*cam00(.|\n)*no device cam02"):
        calibrate_photometry(wrong, PhotometricSettings(), out)
    free = PhotometricSettings(centre="free", flat_slope=True)
    with pytest.raises(SettingsError, match="cannot tell a slope of the light from a falloff"):
        calibrate_photometry(sources(home, board=False, flat=True), free, out)
    with pytest.raises(SettingsError, match="terms"):
        PhotometricSettings(terms=4)
    lit = dataclasses.replace(
        sources(home, board=False, flat=True), dark=Take.open(home / "flat-take")
    )
    with pytest.raises(TakeError, match=r"cam00: dark frames show .* cap the lens"):
        calibrate_photometry(lit, PhotometricSettings(), out)
    assert not out.exists()


def test_cameras_of_another_array_are_noticed(home: Path, tmp_path: Path) -> None:
    turned = list(STATE.cameras)
    turned[1] = turned[1].posed(turned[2].camera_from_world)
    wrong = dataclasses.replace(
        sources(home, board=True, flat=False), cameras=CameraArray(tuple(turned))
    )
    with pytest.raises(TakeError, match=r"cam01: the board is .* px from where its camera"):
        calibrate_photometry(wrong, PhotometricSettings(), tmp_path / "photometric.json")


def test_another_board_is_told_by_what_the_images_show(home: Path, tmp_path: Path) -> None:
    other = dataclasses.replace(BIG_BOARD, dictionary="DICT_4X4_100")
    wrong = dataclasses.replace(sources(home, board=True, flat=False), board=BoardBody.of(other))
    with pytest.raises(TakeError, match=r"no device sees this board.*all 3 devices.*DICT_5X5"):
        calibrate_photometry(wrong, PhotometricSettings(), tmp_path / "photometric.json")


def test_a_device_that_moved_within_the_take_is_told(home: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    shutil.copytree(home / "board", moved)
    jolt = Pose.from_rotation_vector(np.radians([0.8, -0.8, 0.0]), np.zeros(3))
    camera = STATE.cameras[1].posed(jolt @ STATE.cameras[1].camera_from_world)
    for frame, pose in enumerate(STATE.array_from_board[:3]):
        radiance = 0.6 * render_board(camera, pose, BIG_BOARD, seed=frame) / 255.0
        save(moved, camera.name, frame, TRUTH.shown(1, radiance, TOP, 30.0, frame))
    given = dataclasses.replace(
        sources(home, board=True, flat=True, dark=False), board_take=taken(moved)
    )
    out = tmp_path / "photometric.json"
    calibrate_photometry(given, PhotometricSettings(black_dn=600.0), out)
    warnings = json.loads(out.read_text(encoding="utf-8"))["report"]["warnings"]
    told = [line for line in warnings if "has it moved since it was calibrated?" in line]
    assert len(told) == 1
    assert told[0].startswith("cam01: in 3 of 7 views the board is more than 2 px from where")


def test_dark_frames_and_clipped_fields(home: Path, tmp_path: Path) -> None:
    hidden = dataclasses.replace(TRUTH, black=np.zeros(3))
    names = STATE.cameras.names
    levels = dark_levels(make_dark_take(tmp_path / "dark", hidden, names), names)
    assert all(level.held_back for level in levels.values())
    bright = make_flat_take(tmp_path / "flat", TRUTH, names, 1.15)
    found = sample_flats(bright, names, black=TRUTH.black)
    assert (found.clipped > 0.1).all()
    for device in range(3):  # what is left is not biased by what is clipped
        mine = found.samples.device == device
        mine &= found.samples.light < 3
        pixels = found.samples.pixels[mine]
        level = 1.15 * np.exp(TRUTH.log_gains[device]) * TRUTH.falloff(device, pixels)
        assert np.abs(found.samples.value[mine] / level - 1.0).max() < 0.004
