"""The drift check: motions recovered within their deviations, no false alarm, words, re-solve."""

from __future__ import annotations

import dataclasses
import json
from functools import cache

import numpy as np
import pytest

from capture.arrays import Floats
from capture.camera import CameraArray
from capture.errors import CameraError, SettingsError, TakeError
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.calibration.drift import DriftSettings, check_drift, resolve_devices
from recon.calibration.drift_report import DriftReport
from recon.calibration.solver import CalibrateSettings, solve_array
from tools.bench.bench_drift import moved_state
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state, observe

BOARD = dataclasses.replace(A4_BOARD, squares_x=8, squares_y=6, square_mm=28.0, marker_mm=20.0)
SCENE = BoardScene(devices=6, size_px=640, focal_px=1440.0, radius_mm=620.0, poses=5, hidden=0.1)
SHAPE = BoardShape.flat_board(BOARD.corners_mm())
PUSH = np.concatenate([np.radians([0.02, 0.03, 0.01]), [0.1, 0.2, -0.2]])  # rad, mm


@cache
def truth_of(scene: BoardScene) -> ArrayState:
    return make_state(scene, BOARD)


@cache
def seen_still(scene: BoardScene) -> BoardObservations:
    return observe(scene, truth_of(scene))


def checked(scene: BoardScene, motions: dict[int, Floats], **changes: float) -> DriftReport:
    truth = truth_of(scene)
    seen = observe(scene, moved_state(truth, motions)) if motions else seen_still(scene)
    return check_drift(truth.cameras, seen, SHAPE, DriftSettings(**changes))  # type: ignore[arg-type]


def error_of(report: DriftReport, device: int, motion: Floats) -> tuple[float, float]:
    """How far the told shift (um) and turn (mdeg) lie from the true ones."""
    found = report.devices[device].motion
    shift = np.linalg.norm(found.translation - motion[3:])
    true = Pose.from_rotation_vector(motion[:3], motion[3:])
    turn = np.linalg.norm((found @ true.inverse()).rotation_vector())
    return 1e3 * float(shift), 1e3 * float(np.degrees(turn))


@cache
def check_of_a_still_array(seed: int) -> DriftReport:
    return checked(dataclasses.replace(SCENE, seed=seed, outliers=0.01), {})


@pytest.mark.parametrize("seed", range(6))
def test_an_array_that_kept_still_raises_no_alarm(seed: int) -> None:
    report = check_of_a_still_array(seed)
    assert report.verdict == "still"
    assert report.moved == ()
    assert len(report.words()) == 1 + len(report.unchecked)
    assert report.headline().startswith("nothing has moved: largest change ")


@pytest.mark.parametrize("seed", range(4))
def test_motions_are_recovered_within_their_deviations(seed: int) -> None:
    random = np.random.default_rng(seed)
    scene = dataclasses.replace(SCENE, seed=seed, devices=7, outliers=0.01)
    chosen = random.permutation(scene.devices)[: 1 + seed % 2].tolist()
    if seed >= 2 and 0 not in chosen:
        chosen[0] = 0  # the first device is no reference
    motions = {
        device: np.concatenate([np.radians(random.normal(0, 0.05, 3)), random.normal(0, 0.3, 3)])
        for device in chosen
    }
    report = checked(scene, motions)
    assert report.verdict == "moved"
    assert set(report.moved) == {f"cam{device:02d}" for device in chosen}
    for device, motion in motions.items():
        shift, turn = error_of(report, device, motion)
        told = report.devices[device]
        assert shift < 4.0 * told.shift_sigma_um
        assert turn < 4.0 * told.turn_sigma_mdeg + 1.0
        assert told.after_px < 1.2 * told.sigma_px < told.before_px
        assert f"{told.name} has moved by" in "\n".join(report.words())


def chi_square(seeds: range) -> float:
    """Mean over devices of the squared motion in its own deviations, over 6: 1 when honest."""
    reports = [check_of_a_still_array(seed) for seed in seeds]
    return float(
        np.mean(
            [
                (d.significance * report.inflation) ** 2 / 6.0
                for report in reports
                for d in report.devices
                if d.verdict != "unchecked"
            ]
        )
    )


def test_told_deviations_are_the_true_ones() -> None:
    assert abs(chi_square(range(6)) - 1.0) < 0.4


@pytest.mark.slow
def test_twenty_more_still_arrays_raise_no_alarm() -> None:
    for seed in range(6, 26):
        report = check_of_a_still_array(seed)
        assert (report.verdict, report.moved) == ("still", ()), f"seed {seed}"
    assert abs(chi_square(range(6, 26)) - 1.0) < 0.2


def test_a_bent_board_is_no_motion() -> None:
    report = checked(dataclasses.replace(SCENE, bow_mm=0.5), {})
    assert report.verdict == "still"
    assert max(d.effect_px for d in report.devices) < 0.08
    middle = report.corners - report.corners.mean(axis=0)
    flat = np.column_stack([middle[:, :2], np.ones(len(middle))])
    bow = np.linalg.lstsq(flat, middle[:, 2], rcond=None)[1]
    assert np.sqrt(bow[0] / len(middle)) > 0.08  # mm: the bend was found


def test_far_motions_are_told_and_solved_anew_while_others_keep_every_bit() -> None:
    far = np.concatenate([np.radians([2.0, -6.0, 4.0]), [50.0, -20.0, 30.0]])
    scene = dataclasses.replace(SCENE, devices=7, poses=6, hidden=0.1)
    truth = truth_of(scene)
    now = moved_state(truth, {0: far, 3: PUSH})
    seen = observe(scene, now)
    report = check_drift(truth.cameras, seen, SHAPE)
    assert report.moved == ("cam00", "cam03")
    new = resolve_devices(truth.cameras, ["cam00", "cam03"], seen, SHAPE)
    for index, (solved, old, true) in enumerate(zip(new, truth.cameras, now.cameras, strict=True)):
        if index not in (0, 3):
            assert solved is old
            continue
        np.testing.assert_array_equal(solved.matrix, old.matrix)
        sigma_um = report.devices[index].shift_sigma_um
        assert 1e3 * np.linalg.norm(solved.centre - true.centre) < 4.0 * sigma_um
    assert check_drift(new, seen, SHAPE).verdict == "still"


def test_a_lens_is_solved_anew_from_enough_views_only() -> None:
    scene = dataclasses.replace(SCENE, poses=9, devices=5)
    truth = truth_of(scene)
    cameras = list(truth.cameras)
    cameras[2] = dataclasses.replace(cameras[2], fx=1.01 * cameras[2].fx, fy=1.01 * cameras[2].fy)
    array = CameraArray(tuple(cameras))
    seen = observe(scene, ArrayState(array, truth.array_from_board, truth.corners))
    new = resolve_devices(truth.cameras, ["cam02"], seen, SHAPE, lens=True)
    assert abs(new[2].fx / cameras[2].fx - 1.0) < 2e-3
    report = check_drift(truth.cameras, seen, SHAPE)
    assert report.moved == ("cam02",)
    told = report.devices[2]
    assert told.verdict == "lens" or "focus may have been touched" in told.remark
    with pytest.raises(TakeError, match=r"cam02: saw the board at 5 poses .* 8 are needed"):
        resolve_devices(truth.cameras, ["cam02"], seen.select(seen.pose < 5), SHAPE, lens=True)


def test_when_most_devices_disagree_none_is_called_the_moved_one() -> None:
    random = np.random.default_rng(2)
    motions = {
        device: np.concatenate([np.radians(random.normal(0, 0.2, 3)), random.normal(0, 1.0, 3)])
        for device in range(5)
    }
    report = checked(SCENE, motions)
    assert report.verdict == "anew"
    assert "half of them or more: calibrate anew" in report.headline()
    assert not any("re-solve" in line for line in report.words())
    truth = truth_of(SCENE)
    seen = observe(SCENE, moved_state(truth, motions))
    with pytest.raises(TakeError, match="other devices that saw the board agree with each other"):
        resolve_devices(truth.cameras, ["cam05"], seen, SHAPE)


def renamed(cameras: CameraArray, names: list[str]) -> CameraArray:
    pairs = zip(cameras, names, strict=True)
    return CameraArray(tuple(dataclasses.replace(camera, name=name) for camera, name in pairs))


@pytest.mark.parametrize("by", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_cameras_of_other_devices_end_in_words(by: int) -> None:
    cameras = truth_of(SCENE).cameras
    turned = renamed(cameras, [*cameras.names[by:], *cameras.names[:by]])
    report = check_drift(turned, seen_still(SCENE), SHAPE)
    assert report.verdict == "anew"
    json.dumps(report.document(), allow_nan=False)


def test_two_exchanged_devices_are_told_as_such() -> None:
    scene = dataclasses.replace(SCENE, devices=7)
    truth = truth_of(scene)
    names = list(truth.cameras.names)
    names[1], names[4] = names[4], names[1]
    report = check_drift(renamed(truth.cameras, names), seen_still(scene), SHAPE)
    assert set(report.moved) == {"cam01", "cam04"}
    text = "\n".join(report.words())
    assert "it stands where cam01 was calibrated to stand: are the names or cables" in text
    assert "it stands where cam04 was calibrated to stand" in text


def test_a_wrong_square_size_is_told_as_such() -> None:
    larger = BoardShape.flat_board(1.049 * SHAPE.corners)
    report = check_drift(truth_of(SCENE).cameras, seen_still(SCENE), larger)
    assert report.verdict == "still"
    assert abs(report.board_factor - 1 / 1.049) < 3e-4
    assert "agree only with a board 0.95" in report.words()[1]


def test_the_array_growing_as_a_whole_is_told_as_growth() -> None:
    scene = dataclasses.replace(SCENE, devices=8, hidden=0.0)
    truth = truth_of(scene)
    cameras = tuple(
        c.posed(Pose(c.camera_from_world.rotation, 1.0004 * c.camera_from_world.translation))
        for c in truth.cameras
    )
    state = ArrayState(CameraArray(cameras), truth.array_from_board, truth.corners)
    report = check_drift(truth.cameras, observe(scene, state), SHAPE)
    assert report.verdict == "still"
    assert abs(report.growth - 4e-4) < 4.0 * report.growth_sigma
    assert report.growth_sigma < 1e-4


def test_a_calibrated_array_is_not_called_moved() -> None:
    board = dataclasses.replace(SCENE, poses=18, hidden=0.5, seed=4)
    found = solve_array(
        observe(board, truth_of(board)), SHAPE.corners, CalibrateSettings(held_out=0.0)
    )
    again = dataclasses.replace(SCENE, seed=4, hidden=0.5)
    truth = truth_of(again)
    assert check_drift(found.state.cameras, seen_still(again), SHAPE).verdict == "still"
    push = moved_state(truth, {2: 3.0 * PUSH})
    report = check_drift(found.state.cameras, observe(again, push), SHAPE)
    assert report.moved == ("cam02",)


def test_devices_are_named_that_saw_too_little_or_are_not_known() -> None:
    seen = seen_still(SCENE)
    blind = (seen.device == 2) | ((seen.device == 4) & (seen.pose != 1))
    names = ("extra", *seen.device_names[1:])
    other = dataclasses.replace(seen.select(~blind), device_names=names)
    report = check_drift(truth_of(SCENE).cameras, other, SHAPE)
    assert report.unchecked == ("cam00", "cam02", "cam04")
    text = "\n".join(report.words())
    assert "cam02 could not be checked: it saw the board at 0 poses" in text
    assert "extra: in the take, but not among the calibrated cameras" in text


def test_devices_keep_their_names_in_any_order() -> None:
    truth = truth_of(SCENE)
    seen = observe(SCENE, moved_state(truth, {1: 3.0 * PUSH}))
    turned = CameraArray(truth.cameras.cameras[::-1])
    one = check_drift(truth.cameras, seen, SHAPE)
    other = check_drift(turned, seen, SHAPE)
    assert one.moved == other.moved == ("cam01",)
    assert abs(one.devices[1].shift_um - other.devices[4].shift_um) < 1.0


def test_the_same_take_gives_the_same_document() -> None:
    documents = [checked(SCENE, {}).document() for _ in range(2)]
    assert json.dumps(documents[0], allow_nan=False) == json.dumps(documents[1])


def test_too_little_is_refused_in_words() -> None:
    cameras, seen = truth_of(SCENE).cameras, seen_still(SCENE)
    with pytest.raises(TakeError, match=r"saw the board at 2 poses; at least 3 are needed"):
        check_drift(cameras, seen.select(seen.pose < 2), SHAPE)
    with pytest.raises(TakeError, match=r"2 devices saw the board together .* cam01 \d, cam02 0"):
        check_drift(cameras, seen.select(seen.device < 2), SHAPE)
    with pytest.raises(CameraError, match=r"cam9.*did you mean 'cam0"):
        resolve_devices(cameras, ["cam9"], seen, SHAPE)
    strange = renamed(cameras, [f"left{index}" for index in range(len(cameras))])
    with pytest.raises(TakeError, match=r"0 of its devices \(cam00, .*calibrated ones \(left0, "):
        check_drift(strange, seen, SHAPE)
    sizes = ((800, 640), *seen.sizes[1:])
    with pytest.raises(TakeError, match="cam00: images are 800 x 640 px, calibrated were 640"):
        check_drift(cameras, dataclasses.replace(seen, sizes=sizes), SHAPE)
    with pytest.raises(SettingsError, match=r"drift\.significant = 1\.0"):
        DriftSettings(significant=1.0)
