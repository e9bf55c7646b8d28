"""Calibration: truth recovered from synthetic sightings, refusals, the report, the stage."""

from __future__ import annotations

import dataclasses
import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.arrays import Bools, Floats
from capture.camera import CameraArray
from capture.camera_file import read_cameras
from capture.errors import SettingsError, SolveError, TakeError
from capture.pose import Pose
from capture.take import Take
from recon.board.body import BoardBody
from recon.board.corner_cache import CornerCache
from recon.board.corners import CornerLimits
from recon.board.observations import BoardObservations
from recon.board.sightings import observe_board
from recon.board.view_check import check_views
from recon.calibration.chain import initial_state
from recon.calibration.report import calibration_report, summary_of
from recon.calibration.solver import ArraySolution, CalibrateSettings, solve_array
from recon.calibration.stage import calibrate, report_path
from recon.calibration.world import array_world
from recon.visiting import import_take
from tools.bench.board_scene import (
    A4_BOARD,
    BoardScene,
    make_state,
    observe,
    render_board,
    triangulation_error,
)

SMALL = BoardScene(size_px=640, focal_px=1440.0, radius_mm=620.0, devices=6, poses=14)
FULL = BoardScene(devices=8, poses=40, hidden=0.7)  # 2048 px, 4000 px; few corners: quick
BENT = dataclasses.replace(FULL, bow_mm=0.3, outliers=0.01)
CORNERS = A4_BOARD.corners_mm()


@cache
def solved(scene: BoardScene) -> tuple[CameraArray, ArraySolution]:
    truth = make_state(scene)
    solution = solve_array(observe(scene, truth), CORNERS, CalibrateSettings())
    return truth.cameras, solution


def rms_um(truth: CameraArray, found: CameraArray) -> float:
    error: Floats = triangulation_error(truth, found)
    return 1000.0 * float(np.sqrt((error**2).sum(axis=1).mean()))


@pytest.mark.parametrize(("scene", "bow_mm"), [(FULL, 0.0), (BENT, 0.3)])
def test_the_face_volume_triangulates_to_micrometres(scene: BoardScene, bow_mm: float) -> None:
    truth, solution = solved(scene)
    assert rms_um(truth, solution.state.cameras) < 5.0
    focal = [a.fx - b.fx for a, b in zip(solution.state.cameras, truth, strict=True)]
    assert np.sqrt(np.mean(np.square(focal))) < 1.5  # px of 4000
    assert abs(solution.sigma_px - 0.1) < 0.01
    report = calibration_report(solution, A4_BOARD)
    assert abs(report["board"]["bow_mm"] - bow_mm) < 0.03
    assert report["held_out"]["ratio"] < 1.15
    deviations = np.array(focal) / solution.focal_sigma[:, 0]
    assert 0.3 < np.sqrt(np.mean(deviations**2)) < 1.7  # the stated deviation is the true one


def test_outliers_are_dropped_and_nothing_else() -> None:
    _, solution = solved(BENT)
    exact = make_state(BENT).residuals(solution.observations)
    wrong: Bools = np.linalg.norm(exact, axis=1) > 3.0
    assert 0.005 < wrong.mean() < 0.015
    assert not solution.kept[wrong].any()
    assert solution.kept[~wrong].mean() > 0.995


def test_a_flat_solve_of_a_bent_board_is_worse() -> None:
    truth, released = solved(BENT)
    held = CalibrateSettings(free_board=False, halves=False, held_out=0.0)
    flat = solve_array(released.observations, CORNERS, held)
    assert rms_um(truth, flat.state.cameras) > 3.0 * rms_um(truth, released.state.cameras)


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(s, marks=pytest.mark.slow) for s in (2, 3))])
def test_small_images_converge_for_every_seed(seed: int) -> None:
    scene = dataclasses.replace(SMALL, seed=seed, devices=(6, 4, 9, 5)[seed], bow_mm=0.1)
    truth, solution = solved(scene)
    assert rms_um(truth, solution.state.cameras) < 20.0
    assert solution.converged


@pytest.mark.slow
def test_twenty_arrays_with_bent_boards_and_outliers_all_converge() -> None:
    for seed in range(20):
        scene = BoardScene(
            size_px=640, focal_px=(1440.0, 1000.0, 2600.0, 700.0)[seed % 4],
            radius_mm=(620.0, 620.0, 900.0, 400.0)[seed % 4], devices=(4, 6, 5, 8)[seed % 4],
            poses=12, bow_mm=0.4, outliers=0.03, hidden=0.3, noise_px=0.15, seed=10 + seed,
        )  # fmt: skip
        truth = make_state(scene)
        settings = CalibrateSettings(least_views=2)
        found = solve_array(observe(scene, truth), CORNERS, settings).state.cameras
        assert rms_um(truth.cameras, found) < 20.0, f"seed {seed}"


def test_the_first_guess_alone_comes_close() -> None:
    truth = make_state(SMALL)
    observations = observe(SMALL, truth)
    guess = initial_state(observations, CORNERS)
    assert np.nanmedian(np.abs(guess.residuals(observations))) < 2.0  # px
    told = initial_state(observations, CORNERS, focal_guess=2.25)
    assert np.nanmedian(np.abs(told.residuals(observations))) < 6.0


def test_devices_of_unequal_size_are_solved_together() -> None:
    truth = make_state(SMALL)
    doubled = [
        dataclasses.replace(
            c, width=2 * c.width, height=2 * c.height, fx=2 * c.fx, fy=2 * c.fy,
            cx=2 * c.cx + 0.5, cy=2 * c.cy + 0.5,
        ) if index % 2 else c
        for index, c in enumerate(truth.cameras)
    ]  # fmt: skip
    seen = observe(SMALL, truth)
    odd = seen.device % 2 == 1
    mixed = BoardObservations(
        device_names=seen.device_names, sizes=tuple((c.width, c.height) for c in doubled),
        frames=seen.frames, device=seen.device, pose=seen.pose, corner=seen.corner,
        pixels=np.where(odd[:, None], 2 * seen.pixels + 0.5, seen.pixels),
    )  # fmt: skip
    found = solve_array(mixed, CORNERS, CalibrateSettings()).state.cameras
    assert rms_um(CameraArray(tuple(doubled)), found) < 20.0


def test_a_rigid_move_of_the_truth_changes_nothing() -> None:
    """The world comes from the array itself, not from where the truth stood."""
    _, solution = solved(SMALL)
    state = solution.state
    turned = state.moved(
        Pose.from_rotation_vector(np.array([0.4, -1.0, 2.0]), np.array([9.0, 5, 1]))
    )
    middle = CORNERS.mean(axis=0)[None]
    places = np.concatenate([pose.apply(middle) for pose in turned.array_from_board])
    again = turned.moved(array_world(turned.cameras, places).world_from_array)
    for one, other in zip(state.cameras, again.cameras, strict=True):
        np.testing.assert_allclose(one.centre, other.centre, atol=1e-6)


def test_the_world_stands_upright_before_the_face() -> None:
    truth, solution = solved(SMALL)
    cameras = solution.state.cameras
    apart = [c.centre - t.centre for c, t in zip(cameras, truth, strict=True)]
    assert np.linalg.norm(apart, axis=1).max() < 90.0  # mm: the axes meet near the true origin
    directions = np.stack([camera.centre for camera in cameras])
    mean = directions.mean(axis=0)
    np.testing.assert_allclose(mean[:2] / mean[2], 0.0, atol=1e-9)
    assert all(camera.camera_from_world.rotation[1, 1] < -0.8 for camera in cameras)


def test_the_same_sightings_give_the_same_bytes() -> None:
    _, first = solved(SMALL)
    second = solve_array(first.observations, CORNERS, CalibrateSettings())
    one, two = (json.dumps(calibration_report(s, A4_BOARD)) for s in (first, second))
    assert one == two
    for a, b in zip(first.state.cameras, second.state.cameras, strict=True):
        assert a.camera_from_world.matrix().tobytes() == b.camera_from_world.matrix().tobytes()


def test_the_report_holds_what_a_page_draws() -> None:
    _, solution = solved(SMALL)
    tally = {name: {"used": 14, "blurred": 1} for name in solution.observations.device_names}
    report = calibration_report(solution, A4_BOARD, tally)
    json.dumps(report, allow_nan=False)
    assert report["residual_definition"] == "mean reprojection error, vector norm (COLMAP)"
    assert report["rms_per_coordinate_px"] == pytest.approx(0.1, abs=0.01)
    assert report["mean_reprojection_px"] == pytest.approx(0.125, abs=0.012)
    device = report["devices"][0]
    assert device["frames"]["blurred"] == 1
    assert sum(map(sum, device["coverage"])) == device["corners_used"]
    assert all(0 < len(v) <= 200 for v in report["residual_vectors"].values())
    assert "residual_vectors" not in summary_of(report)


def without(observations: BoardObservations, keep: Bools) -> BoardObservations:
    return observations.select(keep)


def test_devices_that_saw_too_little_are_named_together() -> None:
    seen = solved(SMALL)[1].observations
    poor = (seen.device == 1) & (seen.pose > seen.pose[seen.device == 1][0])
    poor |= seen.device == 3
    tally = {"cam03": {"no board": 9, "blurred": 5}}
    with pytest.raises(TakeError) as caught:
        check_views(without(seen, ~poor), 5, 4, tally)
    text = str(caught.value)
    assert "2 problems" in text
    assert "cam01: used the board in 1 frames" in text
    assert "cam03: used the board in 0 frames with 0 corners (9 no board, 5 blurred)" in text


def test_devices_that_never_share_the_board_are_told_apart() -> None:
    seen = solved(SMALL)[1].observations
    apart = (seen.device < 3) == (seen.pose % 2 == 0)
    with pytest.raises(SolveError, match="never saw the board together with"):
        solve_array(without(seen, apart), CORNERS, CalibrateSettings(least_views=2))


def test_a_device_out_of_step_is_warned_of() -> None:
    seen = solved(SMALL)[1].observations
    shift = np.where((seen.pose == 5)[:, None] & (seen.device == 2)[:, None], 0.6, 0.0)
    late = dataclasses.replace(seen, pixels=seen.pixels + shift)
    report = calibration_report(solve_array(late, CORNERS, CalibrateSettings()), A4_BOARD)
    assert report["poses"][5]["corners_rejected"] > 20


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("least_views", 1),
        ("loss_px", 0.0),
        ("focal_guess", 0.0),
        ("image_up", "up"),
        ("held_out", 0.9),
        ("max_poses", 4),
    ],
)
def test_settings_out_of_range_are_refused(key: str, value: object) -> None:
    with pytest.raises(SettingsError, match=key):
        CalibrateSettings(**{key: value})  # type: ignore[arg-type]


def board_take(folder: Path, scene: BoardScene) -> Take:
    """A take of rendered boards; devices that see the back of the board see grey."""
    truth = make_state(scene)
    middle = CORNERS.mean(axis=0)[None]
    for camera in truth.cameras:
        (folder / "source" / camera.name).mkdir(parents=True)
        for index, pose in enumerate(truth.array_from_board):
            towards = camera.centre - pose.apply(middle)[0]
            image = np.full((scene.size_px, scene.size_px), 90, np.uint8)
            if -pose.rotation[:, 2] @ towards > 0:
                image = render_board(camera, pose, A4_BOARD, seed=index)
            cv2.imwrite(str(folder / "source" / camera.name / f"{index:04d}.png"), image)
    return import_take(folder / "source", folder / "take")


def test_the_stage_writes_cameras_report_and_record_once(tmp_path: Path) -> None:
    scene = BoardScene(size_px=400, focal_px=900.0, radius_mm=620.0, devices=4, poses=7)
    take = board_take(tmp_path, scene)
    out = tmp_path / "out" / "cameras.json"
    settings = CalibrateSettings(least_views=2)
    cameras = calibrate(take, A4_BOARD, settings, out)
    assert rms_um(make_state(scene).cameras, cameras) < 100.0
    report = json.loads(report_path(out).read_text(encoding="utf-8"))
    assert report["mean_reprojection_px"] < 0.1
    assert read_cameras(out).names == take.device_names
    known = CornerCache(take, BoardBody.of(A4_BOARD))
    thinned = observe_board(take, A4_BOARD, CornerLimits(max_poses=3), cache=known)
    assert len(thinned.observations.frames) == 3
    assert len(thinned.every.frames) == 7
    spare = sum(counts.get("more poses than needed", 0) for counts in thinned.tally.values())
    assert spare > 0
    take.set_cameras(cameras)
    before = out.read_bytes(), out.stat().st_mtime_ns
    steps: list[str] = []
    calibrate(take, A4_BOARD, settings, out, progress=lambda done, total, what: steps.append(what))
    assert steps == []  # current: skipped
    assert (out.read_bytes(), out.stat().st_mtime_ns) == before
    report_path(out).write_text("{}", encoding="utf-8")  # as of another calibration
    calibrate(take, A4_BOARD, settings, out)
    assert json.loads(report_path(out).read_text(encoding="utf-8")) == report
    every = dataclasses.replace(settings, leave_out=take.device_names)
    with pytest.raises(SettingsError, match="leave_out: names every device"):
        calibrate(take, A4_BOARD, every, out)
    framed = dataclasses.replace(settings, world_frame=1)
    with pytest.raises(SettingsError, match="world_frame = 1 and a previous session"):
        calibrate(take, A4_BOARD, framed, out, previous=cameras)
    with pytest.raises(SettingsError, match="that name is taken"):
        calibrate(take, A4_BOARD, settings, report_path(out))
    with pytest.raises(
        TakeError, match=r"cam00: used the board in 4 frames .* \(4 used, 3 no board\)"
    ):
        calibrate(
            take,
            A4_BOARD,
            dataclasses.replace(settings, least_views=7),
            tmp_path / "no.json",
        )
    assert not (tmp_path / "no.json").exists()
