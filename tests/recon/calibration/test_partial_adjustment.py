"""Adjusting some devices while the others are held: against a plain least-squares solver."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.optimize

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from capture.errors import CameraError, SolveError
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations
from recon.colmap import AdjustOptions, adjust_array
from tools.bench.board_scene import BoardScene, make_state, observe

SCENE = BoardScene(devices=3, size_px=640, focal_px=1440.0, radius_mm=620.0, poses=4, hidden=0.6)


def bumped(state: ArrayState, indices: tuple[int, ...]) -> ArrayState:
    """The same state with some devices turned by half a degree and shifted by some millimetres."""
    push = Pose.from_rotation_vector(np.array([0.004, -0.006, 0.005]), np.array([0.8, -0.5, 1.2]))
    cameras = [
        c.posed(push @ c.camera_from_world) if index in indices else c
        for index, c in enumerate(state.cameras)
    ]
    return ArrayState(CameraArray(tuple(cameras)), state.array_from_board, state.corners)


def unpacked(x: Floats, start: ArrayState, moving: int) -> ArrayState:
    """The state that 14 numbers of one device and 6 of each pose describe."""
    old = start.cameras[moving]
    lens = np.array([old.fx, old.fy, old.cx, old.cy, *old.distortion[:4]]) + x[6:14] * np.array(
        [100.0, 100.0, 100.0, 100.0, 0.1, 0.1, 0.01, 0.01]
    )
    place = Pose.from_rotation_vector(x[:3], 100.0 * x[3:6]) @ old.camera_from_world
    new = Camera(
        name=old.name, width=old.width, height=old.height, fx=lens[0], fy=lens[1], cx=lens[2],
        cy=lens[3], distortion=np.array([*lens[4:], 0.0]), camera_from_world=place,
    )  # fmt: skip
    cameras = tuple(new if index == moving else c for index, c in enumerate(start.cameras))
    poses = tuple(
        Pose.from_rotation_vector(part[:3], 100.0 * part[3:]) @ pose
        for part, pose in zip(x[14:].reshape(-1, 6), start.array_from_board, strict=True)
    )
    return ArrayState(CameraArray(cameras), poses, start.corners)


def plain_solution(start: ArrayState, seen: BoardObservations, moving: int) -> ArrayState:
    def misses(x: Floats) -> Floats:
        return unpacked(x, start, moving).residuals(seen).ravel()

    size = 14 + 6 * len(start.array_from_board)
    found = scipy.optimize.least_squares(misses, np.zeros(size), xtol=1e-14, ftol=1e-14)
    return unpacked(found.x, start, moving)


@pytest.mark.parametrize("moving", [0, 1])
def test_one_moving_device_agrees_with_a_plain_solver(moving: int) -> None:
    truth = make_state(SCENE)
    seen = observe(SCENE, truth)
    seen = seen.select(np.bincount(seen.corner)[seen.corner] > 1)  # COLMAP leaves the others out
    start = bumped(truth, (moving,))
    options = AdjustOptions(loss_px=0.0, moving=(moving,))
    found = adjust_array(start, seen, options).state
    plain = plain_solution(start, seen, moving)
    least = float((plain.residuals(seen) ** 2).sum())
    assert float((found.residuals(seen) ** 2).sum()) < least * (1 + 1e-6)
    new, other = found.cameras[moving], plain.cameras[moving]
    assert np.linalg.norm(new.centre - other.centre) < 0.02  # mm
    assert abs(new.fx - other.fx) < 0.05  # px
    for index, camera in enumerate(start.cameras):
        assert (found.cameras[index] is camera) == (index != moving)


def test_a_held_lens_stays_while_its_device_moves() -> None:
    truth = make_state(dataclasses.replace(SCENE, noise_px=0.0))
    seen = observe(dataclasses.replace(SCENE, noise_px=0.0), truth)
    options = AdjustOptions(free_lenses=False, moving=(0, 2))
    found = adjust_array(bumped(truth, (0, 2)), seen, options).state
    for new, true in zip(found.cameras, truth.cameras, strict=True):
        np.testing.assert_array_equal(new.matrix, true.matrix)
        assert np.linalg.norm(new.centre - true.centre) < 1e-3  # mm
    for new_pose, true_pose in zip(found.array_from_board, truth.array_from_board, strict=True):
        np.testing.assert_allclose(new_pose.translation, true_pose.translation, atol=1e-3)


def test_a_lens_with_k3_is_held_and_never_solved_for() -> None:
    truth = make_state(SCENE)
    bent = dataclasses.replace(
        truth.cameras[1], distortion=np.array([*truth.cameras[1].distortion[:4], 0.05])
    )
    cameras = CameraArray((truth.cameras[0], bent, truth.cameras[2]))
    state = ArrayState(cameras, truth.array_from_board, truth.corners)
    seen = observe(SCENE, state)
    found = adjust_array(bumped(state, (0,)), seen, AdjustOptions(moving=(0,))).state
    assert found.cameras[1] is bent
    assert np.sqrt((found.residuals(seen) ** 2).mean()) < 0.12  # px
    with pytest.raises(CameraError, match=r"cam01: a lens with k3 = 0\.05 is not solved for"):
        adjust_array(state, seen, AdjustOptions(moving=(1,)))


@pytest.mark.parametrize("moving", [(0, 1, 2), (3,), (-1,)])
def test_moving_must_leave_a_device_to_hold(moving: tuple[int, ...]) -> None:
    truth = make_state(SCENE)
    with pytest.raises(SolveError, match=r"expected some of the devices 0\.\.2 and not all"):
        adjust_array(truth, observe(SCENE, truth), AdjustOptions(moving=moving))
