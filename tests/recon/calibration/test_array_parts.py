"""Parts of the array solve: bodies of several boards, covariance, halves, scale bar, world."""

from __future__ import annotations

import dataclasses
import re
from functools import cache

import numpy as np
import pytest

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from capture.errors import SolveError, TakeError
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.board.sightings import BarSightings
from recon.calibration.chosen_world import choose_world
from recon.calibration.covariance import ArrayCovariance, array_covariance
from recon.calibration.gate import judge_calibration
from recon.calibration.gauge import board_scale, flat_places, regauged
from recon.calibration.geometry import ball_points, rigid_fit, triangulate
from recon.calibration.report import calibration_report
from recon.calibration.scale_bar import measure_bar
from recon.calibration.solver import ArraySolution, CalibrateSettings, solve_array
from recon.calibration.split_half import projection_difference, split_half
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state, observe, triangulation_error

SMALL = BoardScene(size_px=640, focal_px=1440.0, radius_mm=620.0, devices=5, poses=12)
QUICK = CalibrateSettings(halves=False, held_out=0.0)
FLAT = BoardShape.flat_board(A4_BOARD.corners_mm())
TILT = Pose.from_rotation_vector(np.array([0.0, 0.7, 0.0]), np.array([236.0, 3.0, 6.0]))


@cache
def solved() -> tuple[ArrayState, ArraySolution]:
    truth = make_state(SMALL)
    return truth, solve_array(observe(SMALL, truth), FLAT, QUICK)


def two_boards(placed: bool) -> tuple[BoardShape, Floats]:
    """Two A4 boards that meet at an angle: nominal, and where the corners truly are, body mm."""
    own = A4_BOARD.corners_mm()
    true = np.concatenate([own, TILT.apply(own)])
    nominal = true if placed else np.concatenate([own, own])
    shape = BoardShape(
        corners=nominal, face=np.repeat([0, 1], len(own)), flat=np.tile(own[:, :2], (2, 1)),
        placed=np.array([True, placed]),
    )  # fmt: skip
    return shape, true


@pytest.mark.parametrize("placed", [True, False])
def test_two_boards_on_one_body_are_solved_together(placed: bool) -> None:
    shape, true = two_boards(placed)
    scene = dataclasses.replace(SMALL, devices=6, poses=14, noise_px=0.05, hidden=0.6)
    flat = make_state(scene)
    middle = true.mean(axis=0) - A4_BOARD.corners_mm().mean(axis=0)
    poses = tuple(pose @ Pose(np.eye(3), -middle) for pose in flat.array_from_board)
    truth = ArrayState(flat.cameras, poses, true)
    found = solve_array(observe(scene, truth), shape, QUICK)
    error = triangulation_error(truth.cameras, found.state.cameras)
    assert 1000.0 * np.sqrt((error**2).sum(axis=1).mean()) < 15.0  # um
    place = flat_places(found.state, shape)
    found_tilt = place[0].inverse() @ place[1]
    np.testing.assert_allclose(found_tilt.translation, TILT.translation, atol=0.05)  # mm
    np.testing.assert_allclose(found_tilt.rotation, TILT.rotation, atol=3e-4)


def test_boards_never_seen_together_are_told() -> None:
    shape, true = two_boards(False)
    scene = dataclasses.replace(SMALL, devices=6, poses=14)
    flat = make_state(scene)
    seen = observe(scene, ArrayState(flat.cameras, flat.array_from_board, true))
    apart = (shape.face[seen.corner] == 0) == (seen.pose % 2 == 0)
    settings = dataclasses.replace(QUICK, least_views=2)
    with pytest.raises(SolveError, match="never seen together with the others"):
        solve_array(seen.select(apart), shape, settings)


def literal_covariance(state: ArrayState, seen: BoardObservations, sigma_px: float) -> Floats:
    """Lens deviations (C, 8) from a numerical Jacobian of all parameters and a pseudo-inverse."""
    cameras, poses, corners = list(state.cameras), list(state.array_from_board), state.corners

    def residuals(x: Floats) -> Floats:
        moved = []
        for index, camera in enumerate(cameras):
            p = x[14 * index : 14 * (index + 1)]
            place = camera.camera_from_world @ Pose.from_rotation_vector(1e-3 * p[8:11], p[11:14])
            bend = camera.distortion + 1e-2 * np.array([*p[4:8], 0.0])
            moved.append(
                Camera(
                    name=camera.name, width=camera.width, height=camera.height, fx=camera.fx + p[0],
                    fy=camera.fy + p[1], cx=camera.cx + p[2], cy=camera.cy + p[3],
                    distortion=bend, camera_from_world=place,
                )
            )  # fmt: skip
        at = 14 * len(cameras)
        held = []
        for pose in poses:
            p = x[at : at + 6]
            held.append(Pose.from_rotation_vector(1e-3 * p[:3], p[3:]) @ pose)
            at += 6
        shape = corners + x[at:].reshape(-1, 3)
        return ArrayState(CameraArray(tuple(moved)), tuple(held), shape).residuals(seen).ravel()

    size = 14 * len(cameras) + 6 * len(poses) + corners.size
    step = 1e-4
    jacobian = np.stack(
        [(residuals(step * e) - residuals(-step * e)) / (2 * step) for e in np.eye(size)], axis=1
    )
    inverse = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-11, hermitian=True)
    units = np.array([1.0, 1.0, 1.0, 1.0, 1e-2, 1e-2, 1e-2, 1e-2])
    spread = np.sqrt(np.diag(inverse))[: 14 * len(cameras)].reshape(-1, 14)[:, :8]
    found: Floats = sigma_px * spread * units
    return found


@pytest.mark.parametrize("devices", [3, 1])
def test_the_covariance_is_that_of_the_whole_problem(devices: int) -> None:
    scene = dataclasses.replace(SMALL, devices=devices, poses=6, hidden=0.0, span_deg=25.0)
    board = dataclasses.replace(A4_BOARD, squares_x=5, squares_y=4, square_mm=45.0, marker_mm=30.0)
    truth = make_state(scene, board)
    seen = observe(scene, truth)
    assert len(np.unique(seen.corner)) == board.corner_count
    shape = BoardShape.flat_board(board.corners_mm())
    found = array_covariance(truth, seen, shape, 0.1)
    assert found is not None
    np.testing.assert_allclose(found.lens_sigma, literal_covariance(truth, seen, 0.1), rtol=2e-3)


def test_a_pose_of_one_corner_tells_the_covariance_nothing() -> None:
    _, solution = solved()
    used = solution.observations.select(solution.kept)
    rows = np.flatnonzero(used.pose == 4)
    without = used.select(used.pose != 4)
    for few in (1, 2):
        other = used.select((used.pose != 4) | np.isin(np.arange(len(used)), rows[:few]))
        one, two = (array_covariance(solution.state, o, FLAT, 0.1) for o in (without, other))
        assert one is not None
        assert two is not None
        np.testing.assert_allclose(one.lens_sigma, two.lens_sigma, rtol=1e-5)


@pytest.mark.parametrize("devices", [1, 2])
def test_few_devices_with_few_poses_are_solved_and_their_deviations_are_honest(
    devices: int,
) -> None:
    scene = dataclasses.replace(SMALL, devices=devices, poses=8, hidden=0.3, span_deg=25.0)
    truth = make_state(scene)
    found = solve_array(observe(scene, truth), FLAT, CalibrateSettings(halves=False))
    assert found.covariance is not None
    off = [a.fx - b.fx for a, b in zip(found.state.cameras, truth.cameras, strict=True)]
    assert (np.abs(off) < 4.0 * found.covariance.lens_sigma[:, 0]).all()
    assert 1.0 < found.held_out.ratio < 3.0  # one corner in one view places the board all the same


def test_the_covariance_does_not_depend_on_where_the_world_is() -> None:
    _, solution = solved()
    moved = solution.state.moved(
        Pose.from_rotation_vector(np.array([0.3, -1.1, 0.5]), np.array([90.0, -40.0, 15.0]))
    )
    used = solution.observations.select(solution.kept)
    one, other = (
        array_covariance(state, used, FLAT, solution.sigma_px) for state in (solution.state, moved)
    )
    assert isinstance(one, ArrayCovariance)
    assert isinstance(other, ArrayCovariance)
    np.testing.assert_allclose(one.lens_sigma, other.lens_sigma, rtol=1e-5)
    sizes = [np.linalg.norm(c.place_sigma_mm, axis=1) for c in (one, other)]
    np.testing.assert_allclose(sizes[0], sizes[1], rtol=1e-5)
    points = ball_points(np.zeros(3), 60.0, 4)
    motion = rigid_fit(
        np.stack([c.centre for c in solution.state.cameras]),
        np.stack([c.centre for c in moved.cameras]),
    )
    traces = [
        np.einsum("nii->n", c.triangulation_sigma(p))
        for c, p in ((one, points), (other, motion.apply(points)))
    ]
    np.testing.assert_allclose(traces[0], traces[1], rtol=1e-5)


def test_stated_deviations_are_true_ones() -> None:
    stated, made, um = [], [], []
    for seed in range(3):
        scene = dataclasses.replace(SMALL, seed=seed, hidden=0.5)
        truth = make_state(scene)
        found = solve_array(observe(scene, truth), FLAT, QUICK)
        assert found.covariance is not None
        made += [a.fx - b.fx for a, b in zip(found.state.cameras, truth.cameras, strict=True)]
        stated += found.covariance.lens_sigma[:, 0].tolist()
        error = triangulation_error(truth.cameras, found.state.cameras)
        points = ball_points(np.zeros(3), 80.0)
        variance = np.einsum("nii->n", found.covariance.triangulation_sigma(points)).mean()
        um.append((error**2).sum(axis=1).mean() / variance)
    ratio = np.sqrt(np.mean(np.square(stated)) / np.mean(np.square(made)))
    assert 0.6 < ratio < 1.7  # fifteen focal lengths
    assert 0.3 < np.mean(um) < 2.0


def test_a_twisted_gauge_is_put_right() -> None:
    _, solution = solved()
    twisted = ArrayState(
        solution.state.scaled(1.07).cameras,
        tuple(
            pose @ Pose.from_rotation_vector(np.array([0.0, 0.1, 0.2]), np.array([4.0, 5.0, 6.0]))
            for pose in solution.state.scaled(1.07).array_from_board
        ),
        Pose.from_rotation_vector(np.array([0.0, 0.1, 0.2]), np.array([4.0, 5.0, 6.0]))
        .inverse()
        .apply(solution.state.scaled(1.07).corners),
    )
    seen = np.unique(solution.observations.corner)
    again = regauged(twisted, FLAT, seen)
    np.testing.assert_allclose(again.corners, solution.state.corners, atol=1e-6)
    assert board_scale(again.corners, FLAT, seen) == pytest.approx(1.0, abs=1e-12)


def test_the_same_array_elsewhere_projects_alike_and_a_wrong_one_does_not() -> None:
    truth, _ = solved()
    volume = ball_points(np.zeros(3), 60.0, 5)
    away = Pose.from_rotation_vector(np.array([0.2, 0.4, -0.3]), np.array([30.0, -8.0, 12.0]))
    moved = truth.moved(away).cameras
    assert projection_difference(truth.cameras, moved, volume).p95_px < 1e-6
    turn = Pose.from_rotation_vector(np.array([0.0, 2e-3, 0.0]), np.zeros(3))
    wrong = CameraArray(
        tuple(
            c.posed(turn @ c.camera_from_world) if index == 2 else c
            for index, c in enumerate(moved)
        )
    )
    found = projection_difference(truth.cameras, wrong, volume)
    assert max(found.by_device, key=lambda name: found.by_device[name]) == "cam02"
    assert found.by_device["cam02"] > 1.0


def test_halves_that_do_not_hang_together_are_not_compared() -> None:
    _, solution = solved()
    seen = solution.observations
    apart = (seen.device < 2) != (seen.pose % 4 < 2)  # in either half two groups never meet
    halves = split_half(
        solution.state, seen.select(apart), lambda start, half: start, np.zeros((4, 3)), 1
    )
    assert halves.remark == "half of the poses do not tie all devices together"


def test_a_board_that_is_not_that_of_its_file_is_asked_about() -> None:
    truth, _ = solved()
    nominal = A4_BOARD.corners_mm()
    other = nominal.copy()
    other[:, 0] += np.where((np.arange(len(other)) % 11) % 2, 0.5, -0.5)  # uneven columns, mm
    seen = observe(SMALL, ArrayState(truth.cameras, truth.array_from_board, other))
    report = calibration_report(solve_array(seen, FLAT, QUICK), A4_BOARD)
    assert report["board"]["faces"][0]["in_plane_rms_mm"] == pytest.approx(0.5, abs=0.02)
    words = " ".join(reason["words"] for reason in report["gate"]["reasons"])
    assert "is it the file of this board?" in words
    straight = calibration_report(solved()[1], A4_BOARD)
    assert straight["board"]["faces"][0]["in_plane_rms_mm"] < 0.02


def test_corners_a_little_off_are_no_fault_of_the_trigger() -> None:
    report = calibration_report(solved()[1], A4_BOARD)
    device, views = report["devices"][1], report["rejected"]["devices"]["cam01"]
    device["corners_rejected"] = device["corners_used"] // 8
    views.update(whole_views=2, median_px=0.8)
    slight = judge_calibration(report)["reasons"]
    assert any("off by 0.8 px" in r["words"] and "at a slant" in r["words"] for r in slight)
    views["median_px"] = 30.0
    grave = judge_calibration(report)["reasons"]
    assert any("was it triggered with the others" in r["words"] for r in grave)


def bar_sightings(cameras: CameraArray, length_mm: float, noise_px: float) -> BarSightings:
    random = np.random.default_rng(5)
    rows = []
    for frame in range(8):
        direction = random.normal(size=3)
        half = 0.5 * length_mm * direction / np.linalg.norm(direction)
        middle = random.normal(0.0, 15.0, 3)
        for device, camera in enumerate(cameras):
            for end, sign in enumerate((-1.0, 1.0)):
                pixel = camera.project((middle + sign * half)[None])[0]
                wrong = 60.0 if (frame, device, end) == (3, 1, 0) else 0.0
                rows.append((device, frame, end, *(pixel + random.normal(0, noise_px, 2) + wrong)))
    table = np.array(rows)
    return BarSightings(
        device_names=cameras.names, device=table[:, 0].astype(np.int64),
        frame=table[:, 1].astype(np.int64), end=table[:, 2].astype(np.int64), pixels=table[:, 3:],
    )  # fmt: skip


def test_a_scale_bar_is_measured_and_a_misread_end_does_not_spoil_it() -> None:
    truth, _ = solved()
    bar = measure_bar(truth.cameras, bar_sightings(truth.cameras, 150.0, 0.1), 150.0)
    assert bar.frames == 8
    assert abs(bar.measured_mm - 150.0) < 0.05
    assert 0.0 < bar.sigma_mm < 0.05
    larger = measure_bar(truth.cameras, bar_sightings(truth.cameras, 153.0, 0.1), 150.0)
    assert larger.ratio == pytest.approx(1.02, abs=5e-4)
    none = measure_bar(
        truth.cameras,
        dataclasses.replace(
            bar_sightings(truth.cameras, 150.0, 0.1), end=np.zeros(80, dtype=np.int64)
        ),
        150.0,
    )
    assert none.frames == 0


def test_triangulation_returns_the_points() -> None:
    truth, _ = solved()
    points = ball_points(np.zeros(3), 50.0, 4)
    pixels = [camera.project(points) for camera in truth.cameras]
    seen = [np.ones(len(points), dtype=np.bool_)] * len(pixels)
    np.testing.assert_allclose(triangulate(truth.cameras, pixels, seen), points, atol=1e-7)


def test_the_world_is_that_of_a_named_frame_or_of_the_previous_session() -> None:
    truth, solution = solved()
    every = solution.observations
    assert choose_world(solution, every, QUICK, None, 20.0) is None
    named = dataclasses.replace(QUICK, world_frame=every.frames[4])
    chosen = choose_world(solution, every, named, None, 20.0)
    assert chosen is not None
    pose = chosen.world.world_from_array @ solution.state.array_from_board[4]
    middle = FLAT.corners.mean(axis=0)
    np.testing.assert_allclose(pose.apply(middle[None])[0], 0.0, atol=0.05)  # mm
    np.testing.assert_allclose(pose.rotation, np.diag([1.0, -1.0, -1.0]), atol=1e-3)
    with pytest.raises(TakeError, match="world_frame = 99: no device has a usable view"):
        choose_world(solution, every, dataclasses.replace(QUICK, world_frame=99), None, 20.0)
    before = truth.cameras
    kept = choose_world(solution, every, QUICK, before, 20.0)
    assert kept is not None
    same = solution.state.moved(kept.world.world_from_array).cameras
    for one, other in zip(same, before, strict=True):
        np.testing.assert_allclose(one.centre, other.centre, atol=1.5)  # mm, along the axis
    names = list(before.names)
    names[0], names[3] = names[3], names[0]
    swapped = CameraArray(
        tuple(dataclasses.replace(c, name=n) for c, n in zip(before, names, strict=True))
    )
    with pytest.raises(TakeError, match=r"cam00 stands where cam03 stood"):
        choose_world(solution, every, QUICK, swapped, 20.0)
    a_little = ArrayState(before, truth.array_from_board, truth.corners).scaled(0.997).cameras
    told = choose_world(solution, every, QUICK, a_little, 20.0)
    assert told is not None
    assert any(re.search(r"stand 0\.2\d* % further apart", line) for line in told.changes)
    larger = ArrayState(before, truth.array_from_board, truth.corners).scaled(1 / 1.05).cameras
    with pytest.raises(TakeError, match=r"is square_mm = 20 right\? 19\.0"):
        choose_world(solution, every, QUICK, larger, 20.0)
