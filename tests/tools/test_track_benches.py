from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.archive import read_archive
from capture.camera import CameraArray
from capture.camera_file import read_cameras
from recon.mesh import read_obj
from tests.tools.test_scan_takes import wall
from tools.bench.bench_track import OPPONENT, frame_p95, run, settings_cases
from tools.bench.moving_head import write_moving_take
from tools.bench.scan_takes import Head, studio
from tools.bench.track_faults import TakeFault, flagging, take_faults, write_faulty
from tools.bench.track_opponent import follow_take
from track.performance import Performance

CAMERAS, FRAMES = 6, 5


@pytest.fixture(scope="module")
def visit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wall with a texture that moves by 3 mm up and 2 to the side, before six cameras."""
    folder = tmp_path_factory.mktemp("visit")
    rng = np.random.default_rng(5)
    fine = cv2.GaussianBlur(rng.uniform(0.0, 1.0, (256, 256)), (0, 0), 1.5)
    texture = (0.35 + 1.5 * (fine - fine.mean())).clip(0.05, 0.9).astype(np.float32)
    flat = wall()
    head = Head(flat.vertices, flat.normals, flat.uv, flat.triangles, texture, flat.slopes)
    motion = np.tile([2.0, 3.0, 0.0], (len(head.vertices), 1))
    cameras = CameraArray(studio(160, 3).cameras[5:11])
    write_moving_take(folder, head, motion, cameras, (FRAMES, 0.3), seed=3)
    return folder


def read(folder: Path, name: str, frame: int) -> np.ndarray:
    return cv2.imread(str(folder / name / f"{frame:04d}.png"), cv2.IMREAD_UNCHANGED)


def faulty(visit: Path, out: Path, words: str) -> tuple[TakeFault, Path]:
    names = read_cameras(visit / "cameras.json").names
    (fault,) = [one for one in take_faults(names, FRAMES) if words in one.words]
    write_faulty(visit, out, fault)
    return fault, out


def test_missing_views_are_not_in_the_take(visit: Path, tmp_path: Path) -> None:
    for words, count in (("two views", 2), ("four views", 4)):
        fault, out = faulty(visit, tmp_path / words, words)
        assert len(set(fault.gone)) == count
        left = read_cameras(out / "cameras.json").names
        assert len(left) == CAMERAS - count
        assert not set(left) & set(fault.gone)
        assert sorted(path.name for path in out.iterdir() if path.is_dir()) == sorted(left)


def test_every_other_frame_doubles_the_motion(visit: Path, tmp_path: Path) -> None:
    _, out = faulty(visit, tmp_path / "fast", "doubled")
    truth = read_archive(visit / "truth.npz", ["vertices"])["vertices"]
    assert np.array_equal(read_archive(out / "truth.npz", ["vertices"])["vertices"], truth[::2])
    name = read_cameras(out / "cameras.json").names[0]
    for place, frame in enumerate(range(0, FRAMES, 2)):
        assert np.array_equal(read(out, name, place), read(visit, name, frame))


def test_blur_light_and_delay_touch_what_they_should(visit: Path, tmp_path: Path) -> None:
    names = read_cameras(visit / "cameras.json").names
    for words in ("blurred", "flicker", "late"):
        _, out = faulty(visit, tmp_path / words, words)
        touched = {
            (name, frame)
            for name in names
            for frame in range(FRAMES)
            if not np.array_equal(read(out, name, frame), read(visit, name, frame))
        }
        assert not any(frame == 0 for _, frame in touched)
        frames, devices = {frame for _, frame in touched}, {name for name, _ in touched}
        if words == "late":
            (late,) = devices
            assert np.array_equal(read(out, late, 3), read(visit, late, 2))
        else:
            assert devices == set(names)
            assert len(frames) == (1 if words == "blurred" else FRAMES - 1)
        if words == "flicker":
            ratio = [
                read(out, names[0], f).mean() / read(visit, names[0], f).mean() for f in frames
            ]
            assert np.ptp(ratio) > 0.05
            assert np.abs(np.array(ratio) - 1.0).max() < 0.125
        if words == "blurred":
            sharp, soft = (read(folder, names[0], *frames).astype(float) for folder in (visit, out))
            assert np.abs(np.diff(soft)).mean() < 0.9 * np.abs(np.diff(sharp)).mean()


def test_a_neutral_off_the_skin_keeps_its_height(visit: Path, tmp_path: Path) -> None:
    _, out = faulty(visit, tmp_path / "off", "off the skin")
    before, after = (
        read_archive(folder / "truth.npz", ["vertices"])["vertices"] for folder in (visit, out)
    )
    neutral = read_obj(out / "neutral.obj")
    assert np.allclose(neutral.vertices, after[0], atol=1e-4)
    height = (after - before)[:, :, 2]  # the wall moves in its plane, but for the head's turn
    assert np.sqrt((height[0] ** 2).mean()) == pytest.approx(0.2, abs=0.05)
    assert np.abs(height - height[0]).max() < 0.01
    assert np.array_equal(read(out, "cam05", 2), read(visit, "cam05", 2))


def test_flags_are_counted_by_frame() -> None:
    row = flagging([True, True, False, False, True], [True, False, True, False, True])
    assert (row["bad"], row["flagged"], row["frames"]) == (3, 3, 5)
    assert row["recall"] == row["precision"] == pytest.approx(2 / 3, abs=1e-3)
    assert flagging([False], [False]) == {
        "frames": 1, "bad": 0, "flagged": 0, "recall": 1.0, "precision": 1.0
    }  # fmt: skip


def test_the_opponent_follows_a_texture(visit: Path) -> None:
    row, flags = run(visit, follow_take, None)
    assert row["median_mm"] < 0.15  # a pixel is 0.45 mm here
    assert row["round_trip_drift_mm"] < 0.1
    assert not flags.bad  # its report flags nothing
    assert max(row["p95_by_frame"]) < 1.0


def test_the_error_of_a_frame_is_over_what_two_cameras_see(visit: Path) -> None:
    truth = read_archive(visit / "truth.npz", ["vertices"])["vertices"]
    neutral = read_obj(visit / "neutral.obj")
    moved = truth + np.array([0.0, 0.0, 0.5]) * np.arange(FRAMES)[:, None, None]
    count = truth.shape[1]
    performance = Performance(
        vertices=moved.astype(np.float32),
        confidence=np.ones((FRAMES, count), np.float32),
        polygons=neutral.polygons,
        frames=np.arange(FRAMES),
        head_from_neutral=np.tile(np.eye(4), (FRAMES, 1, 1)),
        reference=np.full(FRAMES, -1),
    )
    found = frame_p95(visit, performance, neutral)
    assert np.allclose(found, 0.5 * np.arange(FRAMES), atol=1e-4)


def test_each_case_changes_something_and_switches_are_among_them() -> None:
    cases = settings_cases()
    default = cases.pop("default")
    assert all(case != default for case in cases.values())
    assert replace(default, use_scan=False) == cases["without scan"]
    assert OPPONENT not in cases
