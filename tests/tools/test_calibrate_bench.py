"""The benches of the calibration: scenes, renderer, opponents, scores, faults, kept rows."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from capture.camera import CameraArray
from capture.errors import SettingsError, SolveError
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.corners import CornerDetector
from recon.board.observations import BoardObservations
from tools.bench.bench_rows import Row, RowFile
from tools.bench.board_arrays import LAYOUTS, device_directions
from tools.bench.board_images import BoardCamera, Optics
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state, observe
from tools.bench.board_video import (
    delay_device,
    drop_rows,
    earlier_session,
    make_video,
    mirror_device,
    pick_poses,
    swap_devices,
)
from tools.bench.calibrate_faults import named_right
from tools.bench.calibrate_opponents import (
    full_board_multiview,
    opencv_chain,
    plain_adjustment,
)
from tools.bench.calibrate_protocol import opponent_line, protocol_table
from tools.bench.calibrate_scores import camera_scores, sigma_ratios
from tools.bench.faulty_takes import BAR_MM, FAULTS, FaultyTake, see_bar, spoiled

TINY = BoardScene(size_px=640, focal_px=1000.0, radius_mm=620.0, devices=4, poses=12, hidden=0.0)
VIDEO = dataclasses.replace(TINY, devices=5, layout="pairs", poses=40, hidden=0.6)
CORNERS = A4_BOARD.corners_mm()


@cache
def video() -> tuple[ArrayState, BoardObservations]:
    truth = make_video(VIDEO)
    return truth, observe(VIDEO, truth)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_sees_the_board_from_different_places(layout: str) -> None:
    scene = dataclasses.replace(TINY, layout=layout, devices=6, poses=24)
    truth = make_video(dataclasses.replace(scene, poses=50), pace=4.0)
    centres = np.stack([camera.centre for camera in truth.cameras])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)[np.triu_indices(6, 1)]
    assert apart.min() > 50.0  # mm
    np.testing.assert_allclose(np.linalg.norm(centres, axis=1), scene.radius_mm)
    for state, frames in ((make_state(scene), 24), (truth, 50)):
        views = (observe(scene, state).view_counts() > 0).sum(axis=1)
        assert views.min() >= 0.1 * frames


def test_an_unknown_layout_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"layout: one of arc, .* found 'heap'"):
        device_directions("heap", 4, 60.0)


def test_turned_devices_are_turned() -> None:
    cameras = make_state(dataclasses.replace(TINY, layout="turned")).cameras
    ups = [-camera.camera_from_world.rotation[1] @ [0.0, 1.0, 0.0] for camera in cameras]
    assert ups[0] > 0.8
    assert np.abs(ups[1:]).max() < 0.3


def test_a_video_moves_smoothly() -> None:
    truth, _ = video()
    ends = np.stack([pose.apply(truth.corners[[0, -1]]) for pose in truth.array_from_board])
    step = np.linalg.norm(np.diff(ends, axis=0), axis=2)
    jerk = np.linalg.norm(np.diff(ends, n=2, axis=0), axis=2)
    assert 1.0 < np.median(step) < 15.0  # mm a frame
    assert jerk.max() < 0.35 * step.max()


def test_a_delayed_device_shows_what_it_saw_before() -> None:
    _, seen = video()
    late = delay_device(seen, 2, 7)
    for device, shift in ((2, 7), (1, 0)):
        before = seen.pixels[(seen.device == device) & (seen.pose == 20 - shift)]
        after = late.pixels[(late.device == device) & (late.pose == 20)]
        np.testing.assert_array_equal(before, after)
    assert len(late) < len(seen)


def test_faults_undo_themselves_and_touch_no_other_device() -> None:
    _, seen = video()
    swapped = swap_devices(seen, 1, 3, from_pose=20)
    assert (swapped.view_counts()[:, :20] == seen.view_counts()[:, :20]).all()
    assert (swapped.view_counts()[1, 20:] == seen.view_counts()[3, 20:]).all()
    np.testing.assert_array_equal(swap_devices(swapped, 1, 3, from_pose=20).pixels, seen.pixels)
    mirrored = mirror_device(seen, 1)
    np.testing.assert_allclose(mirror_device(mirrored, 1).pixels, seen.pixels)
    other = seen.device != 1
    np.testing.assert_array_equal(mirrored.pixels[other], seen.pixels[other])
    np.testing.assert_array_equal(mirrored.pixels[~other][:, 1], seen.pixels[~other][:, 1])
    few = (drop_rows(seen, 0, 3).view_counts() > 0).sum(axis=1)
    assert few[0] == 3
    assert (few[1:] == (seen.view_counts()[1:] > 0).sum(axis=1)).all()


def test_picked_poses_keep_their_frames() -> None:
    _, seen = video()
    picked = pick_poses(seen, 9)
    assert len(picked.frames) == 9
    assert (picked.frames[0], picked.frames[-1]) == (0, 39)
    for place, frame in enumerate(picked.frames):
        np.testing.assert_array_equal(
            picked.pixels[picked.pose == place], seen.pixels[seen.pose == frame]
        )


def test_the_scale_bar_has_its_length() -> None:
    truth, _ = video()
    bar = see_bar(dataclasses.replace(VIDEO, noise_px=0.0), truth)
    frame = int(np.bincount(bar.frame).argmax())
    ends = []
    for end in (0, 1):
        rows = (bar.frame == frame) & (bar.end == end)
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for device, pixel in zip(bar.device[rows].tolist(), bar.pixels[rows], strict=True):
            ray = truth.cameras[device].rays(pixel[None])[0]
            across = np.eye(3) - np.outer(ray, ray)
            normal += across
            right += across @ truth.cameras[device].centre
        ends.append(np.linalg.solve(normal, right))
    assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(BAR_MM, abs=1e-3)


def test_the_right_names_and_no_others_count() -> None:
    truth, seen = video()
    fault = next(fault for fault in FAULTS if fault.devices == 2 and fault.known)
    take: FaultyTake = spoiled(fault, VIDEO, truth, seen, 4)
    one, other = take.guilty
    assert take.previous is not None
    assert named_right(take, [f"{one} and {other} are exchanged"])
    assert not named_right(take, [f"{one} is odd"])
    assert not named_right(take, [f"{one} and {other}", "cam99 too"])
    assert not named_right(take, [])
    bar = next(fault for fault in FAULTS if fault.with_bar)
    filed = spoiled(bar, VIDEO, truth, seen, 4)
    assert filed.board.square_mm == pytest.approx(20.4)
    assert named_right(filed, ["the scale bar measures 204 mm"])
    assert not named_right(filed, ["too little of the board"])


def rms_um(found: CameraArray, scene: BoardScene) -> float:
    return camera_scores(make_state(scene).cameras, found)["triangulation_um"]


def test_opponents_solve_a_take_that_suits_them() -> None:
    seen = observe(TINY, make_state(TINY))
    found = {
        solve.__name__: rms_um(solve(seen, CORNERS), TINY)
        for solve in (plain_adjustment, opencv_chain, full_board_multiview)
    }
    assert found["plain_adjustment"] < 10.0
    assert found["opencv_chain"] < 200.0
    assert found["full_board_multiview"] < 200.0


def test_opponents_say_what_they_cannot_do() -> None:
    scene = dataclasses.replace(TINY, hidden=0.1)
    seen = observe(scene, make_state(scene))
    with pytest.raises(SolveError, match="fewer than 3 usable views: cam00"):
        full_board_multiview(seen, CORNERS)
    alone = drop_rows(seen, 1, 2)
    with pytest.raises(SolveError, match="cam01: 2 views; calibrateCamera wants 3"):
        opencv_chain(alone, CORNERS)


def test_scores_of_the_truth_are_nothing_and_a_rigid_move_changes_none() -> None:
    truth = make_state(TINY).cameras
    away = Pose.from_rotation_vector(np.array([0.3, -0.2, 1.0]), np.array([5.0, 6.0, 7.0]))
    moved = CameraArray(tuple(camera.posed(camera.camera_from_world @ away) for camera in truth))
    for score in camera_scores(truth, moved).values():
        assert score == pytest.approx(0.0, abs=1e-5)
    knocked = camera_scores(truth, earlier_session(truth, 3))
    assert 10.0 < knocked["centre_rms_um"] < 600.0
    assert knocked["focal_rms_px"] == 0.0


def test_ratios_are_of_root_mean_squares() -> None:
    names = ("focal", "principal point", "camera centres", "triangulated points")
    rows = [dict.fromkeys(names, pair) for pair in ([1.0, 4.0], [3.0, 0.0])]
    assert sigma_ratios(rows) == dict.fromkeys(names, 1.0)


def test_tables_tell_failures_as_failures() -> None:
    good: Row = {
        "failed": "", "converged": True, "triangulation_um": 2.0, "focal_rms_px": 0.5,
        "focal_max_px": 0.9, "principal_rms_px": 0.4, "centre_rms_um": 80.0,
        "held_out_ratio": 1.01, "split_half_p95_px": 0.03, "seconds": 20.0, "cpu_s": 18.0,
        "sigmas": None,
    }  # fmt: skip
    bad: Row = {"failed": "no answer", "seconds": 1.0}
    table = {line[0]: line[2] for line in protocol_table([good, bad])}
    assert table["seeds that converge"] == "1 of 2"
    assert table["triangulation rmse, um"] == "worst 2.00, median 2.00"
    assert "1 of 2 failed: no answer" in opponent_line("one", [good, bad])
    assert "2 of 2 failed: no answer" in opponent_line("one", [bad, bad])


def test_rows_are_made_once_and_a_torn_line_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    made: list[str] = []

    def make(name: str) -> Row:
        made.append(name)
        return {"name": name}

    rows = RowFile(path)
    assert [rows.row(key, lambda key=key: make(key))["name"] for key in "aba"] == ["a", "b", "a"]  # type: ignore[misc]
    with path.open("a", encoding="utf-8") as out:
        out.write('{"key": "c", "ro')
    again = RowFile(path)
    assert [again.row(key, lambda key=key: make(key))["name"] for key in "abc"] == ["a", "b", "c"]  # type: ignore[misc]
    assert made == ["a", "b", "c"]
    assert len(RowFile(path)._rows) == 3


def test_a_rendered_bent_board_is_where_the_truth_says() -> None:
    scene = dataclasses.replace(TINY, focal_px=1440.0, bow_mm=1.5, poses=5)
    truth = make_state(scene)
    pose, camera = truth.array_from_board[1], truth.cameras[1]
    quiet = Optics(blur_px=0.6, defocus_px=0.3, noise_dn=0.5)
    image = BoardCamera(camera, A4_BOARD, scene.bow_mm, quiet).image(pose, 1)
    assert image.shape == (640, 640)
    assert (image == BoardCamera(camera, A4_BOARD, scene.bow_mm, quiet).image(pose, 1)).all()
    view = CornerDetector(A4_BOARD).detect(image)
    assert len(view.ids) > 60
    bent = view.pixels - camera.project(pose.apply(truth.corners))[view.ids]
    flat = view.pixels - camera.project(pose.apply(CORNERS))[view.ids]
    assert np.median(np.linalg.norm(bent, axis=1)) < 0.06  # px
    assert np.median(np.linalg.norm(flat, axis=1)) > 0.3
    assert np.abs(np.median(bent, axis=0)).max() < 0.02
