"""Faults of single devices, each named in one message; and none named where there is none."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from capture.camera import CameraArray
from capture.errors import TakeError
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.calibration.chain import Links
from recon.calibration.exchanged import find_exchange
from recon.calibration.faults import DeviceViews, explain_odd, odd_devices
from recon.calibration.solver import CalibrateSettings, solve_array
from tools.bench.board_scene import A4_BOARD, BoardScene, make_array, observe
from tools.bench.board_video import (
    delay_device,
    make_video,
    mirror_device,
    pick_poses,
    swap_devices,
)

SCENE = BoardScene(
    devices=6, span_deg=40.0, size_px=640, focal_px=1300.0, radius_mm=640.0, poses=90, hidden=0.7,
    seed=3,
)  # fmt: skip
QUICK = CalibrateSettings(halves=False, held_out=0.0)


@cache
def video() -> tuple[ArrayState, BoardObservations]:
    truth = make_video(SCENE)
    return truth, observe(SCENE, truth)


def solve(every: BoardObservations) -> None:
    solve_array(pick_poses(every, 24), A4_BOARD.corners_mm(), QUICK, every=every)


def test_a_healthy_take_is_not_refused() -> None:
    solve(video()[1])


@pytest.mark.parametrize(
    ("frames", "told"),
    [
        (20, "20 frames late"),
        pytest.param(-7, "7 frames early", marks=pytest.mark.slow),
    ],
)
def test_a_device_out_of_step_is_named_with_its_frames(frames: int, told: str) -> None:
    with pytest.raises(TakeError) as caught:
        solve(delay_device(video()[1], 4, frames))
    text = str(caught.value)
    assert f"cam04: its pictures are {told}" in text
    assert "cam03" not in text


def test_devices_exchanged_midway_are_named_together() -> None:
    with pytest.raises(TakeError, match=r"cam02 and cam04: their pictures are exchanged from fr"):
        solve(swap_devices(video()[1], 2, 4, from_pose=45))


def test_an_exchange_in_a_ring_is_laid_at_the_right_doors() -> None:
    """Only neighbours share the board, so that no array solved without the two would tell."""
    scene = BoardScene(
        devices=8, layout="ring", span_deg=180.0, size_px=640, focal_px=1300.0, radius_mm=640.0,
        poses=200, hidden=0.7, seed=5,
    )  # fmt: skip
    every = pick_poses(observe(scene, make_video(scene)), 100)
    lenses = list(make_array(scene))
    shape = BoardShape.flat_board(A4_BOARD.corners_mm())
    assert find_exchange(lenses, every, shape) is None
    poses = np.unique(every.pose[every.device == 5]).tolist()
    middle = poses[len(poses) // 2]
    found = find_exchange(lenses, swap_devices(every, 5, 6, from_pose=middle), shape)
    assert found is not None
    assert {found.one, found.other} == {5, 6}
    assert abs(found.frame - every.frames[middle]) <= 4
    late = delay_device(every, 3, 10)
    assert find_exchange(lenses, late, shape) is None  # another fault


def test_a_mirrored_device_is_named() -> None:
    with pytest.raises(TakeError, match="cam03: its images are mirrored"):
        solve(mirror_device(video()[1], 3))


def views_of(device: int, cameras: CameraArray) -> tuple[DeviceViews, dict[int, Pose]]:
    """Exact views of one device, frame by frame, its place that of `cameras`, and the motion."""
    truth, _ = video()
    frames, board, pixels = [], [], []
    corners = truth.corners[::9]
    for frame, pose in enumerate(truth.array_from_board):
        camera = cameras[device]
        seen = camera.project(pose.apply(corners))
        good = camera.contains(np.nan_to_num(seen, nan=-1e9))
        frames.append(np.full(int(good.sum()), frame))
        board.append(corners[good])
        pixels.append(seen[good])
    views = DeviceViews(
        lens=cameras[device], frame=np.concatenate(frames), board=np.concatenate(board),
        pixels=np.concatenate(pixels),
    )  # fmt: skip
    return views, dict(enumerate(truth.array_from_board))


def test_a_device_that_was_knocked_is_told_from_one_in_step() -> None:
    truth, _ = video()
    others = CameraArray(tuple(truth.cameras)[2:])
    steady, motion = views_of(0, truth.cameras)
    assert explain_odd({"cam00": steady}, others, motion, 0.1) == {}
    jolt = Pose.from_rotation_vector(np.array([0.0, 0.02, 0.0]), np.array([0.0, 8.0, 0.0]))
    moved = CameraArray(
        (
            truth.cameras[0].posed(jolt @ truth.cameras[0].camera_from_world),
            *list(truth.cameras)[1:],
        )
    )
    later, _ = views_of(0, moved)
    late = later.frame >= 50
    knocked = DeviceViews(
        lens=steady.lens,
        frame=np.concatenate([steady.frame[steady.frame < 50], later.frame[late]]),
        board=np.concatenate([steady.board[steady.frame < 50], later.board[late]]),
        pixels=np.concatenate([steady.pixels[steady.frame < 50], later.pixels[late]]),
    )
    said = explain_odd({"cam00": knocked}, others, motion, 0.1)
    assert "cam00: it was moved at frame 50" in said["cam00"]


def test_single_frames_that_are_off_are_no_move() -> None:
    truth, _ = video()
    others = CameraArray(tuple(truth.cameras)[1:])
    steady, motion = views_of(0, truth.cameras)
    off = np.random.default_rng(2).choice(90, 7, replace=False)
    shift = np.where(np.isin(steady.frame, off)[:, None], [9.0, 4.0], 0.0)
    views = dataclasses.replace(steady, pixels=steady.pixels + shift)
    assert explain_odd({"cam00": views}, others, motion, 0.1) == {}
    few = steady.frame < 3
    rare = DeviceViews(
        lens=steady.lens, frame=steady.frame[few], board=steady.board[few],
        pixels=steady.pixels[few] + 40.0 * (steady.frame[few] == 1)[:, None],
    )  # fmt: skip
    assert explain_odd({"cam00": rare}, others, motion, 0.1) == {}, "too few frames to tell"


def test_a_noisy_device_is_in_step() -> None:
    truth, _ = video()
    views, motion = views_of(1, truth.cameras)
    noise = np.random.default_rng(2).normal(0.0, 1.5, views.pixels.shape)  # px
    noisy = dataclasses.replace(views, pixels=views.pixels + noise)
    assert explain_odd({"cam01": noisy}, truth.cameras, motion, 0.1) == {}


def test_pictures_that_fit_nothing_are_told() -> None:
    truth, _ = video()
    views, motion = views_of(1, truth.cameras)
    random = np.random.default_rng(1)
    shuffled = random.permutation(90)
    wrong = dataclasses.replace(views, frame=shuffled[views.frame])
    said = explain_odd({"cam01": wrong}, truth.cameras, motion, 0.1)
    assert "fit those of no other device" in said["cam01"]


def links_of(agreeing: list[list[int]]) -> Links:
    table = np.array(agreeing)
    return Links({}, np.where(np.eye(len(table), dtype=bool), 0, 10), table, table.astype(float))


def test_the_odd_one_is_the_one_outside_the_majority() -> None:
    good, bad = 9, 1
    table = np.full((5, 5), good)
    table[3, :] = table[:, 3] = bad
    assert odd_devices(links_of(table.tolist())) == [3]
    assert odd_devices(links_of(np.full((5, 5), good).tolist())) == []
    assert odd_devices(links_of([[0, bad], [bad, 0]])) == []  # two against each other: nobody
