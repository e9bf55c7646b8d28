"""Session to session: worlds by a named pose, alignment despite moved devices, swaps, scale."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from capture.camera import Camera, CameraArray
from capture.errors import CameraError, SettingsError
from capture.pose import Pose
from recon.board.shape import BoardShape
from recon.calibration.alignment import Alignment, align_to_previous, alignment_problems
from recon.calibration.world import world_from_board_pose
from tools.bench.board_scene import A4_BOARD, BoardScene, looking_at, make_array

SCENE = BoardScene(devices=8, size_px=640, focal_px=1440.0, radius_mm=620.0)
SHAPE = BoardShape.flat_board(A4_BOARD.corners_mm())
ELSEWHERE = Pose.from_rotation_vector(np.array([0.4, -1.1, 0.7]), np.array([120.0, -40.0, 300.0]))


def in_space(cameras: CameraArray, other_from_world: Pose, scale: float = 1.0) -> CameraArray:
    """The same array in another space, all lengths multiplied."""
    back = other_from_world.inverse()
    out = []
    for camera in cameras:
        pose = camera.camera_from_world @ back
        out.append(camera.posed(Pose(pose.rotation, scale * pose.translation)))
    return CameraArray(tuple(out))


def pushed(cameras: CameraArray, motions: dict[int, Pose]) -> CameraArray:
    return CameraArray(
        tuple(
            c.posed(motions[i] @ c.camera_from_world) if i in motions else c
            for i, c in enumerate(cameras)
        )
    )


def renamed(cameras: CameraArray, names: dict[str, str]) -> CameraArray:
    """Cameras under other names, in the old order of names."""
    made = {names.get(c.name, c.name): c for c in cameras}
    return CameraArray(tuple(dataclasses.replace(made[n], name=n) for n in cameras.names))


def jittered(cameras: CameraArray, seed: int) -> CameraArray:
    """What another calibration of the same array finds: 20 um and 1 mdeg elsewhere."""
    random = np.random.default_rng(seed)
    motions = {
        i: Pose.from_rotation_vector(random.normal(0, 2e-5, 3), random.normal(0, 0.02, 3))
        for i in range(len(cameras))
    }
    return pushed(cameras, motions)


def off_by(alignment: Alignment, world_from_array: Pose) -> tuple[float, float]:
    """Shift in mm at the middle of the face, and turn in radians."""
    gap = alignment.world_from_array @ world_from_array.inverse()
    return float(np.linalg.norm(gap.translation)), float(np.linalg.norm(gap.rotation_vector()))


@pytest.mark.parametrize("seed", range(5))
def test_the_world_returns_although_two_devices_moved(seed: int) -> None:
    then = make_array(dataclasses.replace(SCENE, seed=seed))
    push = Pose.from_rotation_vector(np.array([0.02, -0.01, 0.03]), np.array([4.0, -3.0, 5.0]))
    moved = {seed: push, (seed + 3) % 8: Pose.from_rotation_vector(np.zeros(3), 40.0 * np.ones(3))}
    now = in_space(jittered(pushed(then, moved), seed), ELSEWHERE)
    found = align_to_previous(now, then)
    shift_mm, turn = off_by(found, ELSEWHERE.inverse())
    assert shift_mm < 0.05
    assert turn < 1e-4
    assert abs(found.scale - 1.0) < 2e-4
    for name, (mm, deg) in found.moved.items():
        motion = moved.get(then.names.index(name), Pose.identity())
        assert abs(mm - np.linalg.norm(motion.translation)) < 0.15
        assert abs(deg - np.degrees(np.linalg.norm(motion.rotation_vector()))) < 0.02
    lines = alignment_problems(found)
    assert {line.split()[0] for line in lines} == {then.names[i] for i in moved}
    assert all("has moved by" in line for line in lines)


def test_an_array_that_kept_still_has_no_problems_and_an_exact_world() -> None:
    then = make_array(SCENE)
    found = align_to_previous(in_space(then, ELSEWHERE), then)
    assert off_by(found, ELSEWHERE.inverse()) < (1e-8, 1e-10)
    assert alignment_problems(found) == []
    assert found.swapped == ()
    again = align_to_previous(in_space(then, ELSEWHERE), then)
    np.testing.assert_array_equal(again.world_from_array.matrix(), found.world_from_array.matrix())


def test_a_wrong_square_size_is_told_with_the_one_that_fits() -> None:
    then = make_array(SCENE)
    grown = in_space(jittered(then, 3), ELSEWHERE, 1.0 / 0.953)
    push = {2: Pose.from_rotation_vector(np.array([0.01, 0, 0]), np.array([3.0, 0, 0]))}
    found = align_to_previous(pushed(grown, push), then)
    assert abs(found.scale - 1.0 / 0.953) < 1e-4
    lines = alignment_problems(found, 20.0)
    assert lines[0] == (
        "all devices stand 4.9 % further apart than in the previous session: "
        "is square_mm = 20 right? 19.06 would fit"
    )
    assert [line.split()[0] for line in lines[1:]] == ["cam02"]


def test_swapped_names_are_told_from_exchanged_devices() -> None:
    then = make_array(SCENE)
    now = in_space(jittered(then, 1), ELSEWHERE)
    names = align_to_previous(renamed(now, {"cam03": "cam07", "cam07": "cam03"}), then)
    assert names.swapped == (("cam03", "cam07"),)
    assert alignment_problems(names) == [
        "cam03 stands where cam07 stood, and cam07 where cam03 stood: "
        "their cables or names are swapped"
    ]
    assert off_by(names, ELSEWHERE.inverse())[0] < 0.05
    places = {"cam03": now.by_name("cam07"), "cam07": now.by_name("cam03")}
    exchanged = CameraArray(tuple(c.posed(places.get(c.name, c).camera_from_world) for c in now))
    (line, *_) = alignment_problems(align_to_previous(exchanged, then))
    assert "the devices have changed places (each has kept its lens)" in line
    same = [dataclasses.replace(c, fx=1440.0, fy=1440.0, cx=320.0, cy=320.0,
                                distortion=np.zeros(5)) for c in then]  # fmt: skip
    alike = CameraArray(tuple(same))
    (line, *_) = alignment_problems(
        align_to_previous(renamed(alike, {"cam00": "cam01", "cam01": "cam00"}), alike)
    )
    assert "cables or names are swapped, or the devices themselves" in line


def test_a_cycle_of_three_is_told_as_one() -> None:
    then = make_array(SCENE)
    turn = {"cam01": "cam04", "cam04": "cam06", "cam06": "cam01"}
    found = align_to_previous(renamed(then, turn), then)
    assert found.swapped == (("cam01", "cam06", "cam04"),)
    (line,) = alignment_problems(found)
    assert line.startswith("cam01 stands where cam06 stood, and cam06 where cam04 stood, and cam04")


def test_only_names_in_both_count_and_three_are_needed() -> None:
    then = make_array(SCENE)
    now = CameraArray((*then.cameras[:5], dataclasses.replace(then[5], name="new")))
    found = align_to_previous(now, then)
    assert found.unknown == ("new",)
    assert found.missing == ("cam05", "cam06", "cam07")
    lines = alignment_problems(found)
    assert lines == [
        "new: not in the previous session",
        "cam05, cam06, cam07: in the previous session only",
    ]
    with pytest.raises(CameraError, match=r"2 names are in both sessions \(cam00, cam01\)"):
        align_to_previous(CameraArray(then.cameras[:2]), then)


def in_a_row(parallel: bool) -> CameraArray:
    """Five devices on one line, looking ahead or at one point."""
    cameras = []
    for index, base in enumerate(make_array(SCENE).cameras[:5]):
        centre = np.array([150.0 * index, 20.0, 800.0])
        target = centre - [0, 0, 800.0] if parallel else np.array([300.0, 0.0, 0.0])
        cameras.append(base.posed(looking_at(centre, target)))
    return CameraArray(tuple(cameras))


@pytest.mark.parametrize("parallel", [False, True])
def test_centres_on_one_line_are_aligned_by_their_axes(parallel: bool) -> None:
    then = in_a_row(parallel)
    push = {1: Pose.from_rotation_vector(np.array([0.0, 0.05, 0.0]), np.array([9.0, 0.0, 0.0]))}
    found = align_to_previous(in_space(pushed(then, push), ELSEWHERE), then)
    assert off_by(found, ELSEWHERE.inverse())[1] < 1e-9
    assert [line.split()[0] for line in alignment_problems(found)] == ["cam01"]


@pytest.mark.parametrize("how", ["upright", "lying"])
def test_a_named_board_pose_gives_the_world(how: str) -> None:
    world = world_from_board_pose(ELSEWHERE, SHAPE, how)
    world_from_board = world.world_from_array @ ELSEWHERE
    middle = SHAPE.corners.mean(axis=0)
    np.testing.assert_allclose(world_from_board.apply(middle[None])[0], 0.0, atol=1e-9)
    right, down, back = world_from_board.rotation.T  # the board's axes in the world
    np.testing.assert_allclose(right, [1, 0, 0], atol=1e-12)
    if how == "upright":
        np.testing.assert_allclose(down, [0, -1, 0], atol=1e-12)
        np.testing.assert_allclose(-back, [0, 0, 1], atol=1e-12)
    else:
        np.testing.assert_allclose(-back, [0, 1, 0], atol=1e-12)
        np.testing.assert_allclose(down, [0, 0, 1], atol=1e-12)
    assert how in world.origin
    with pytest.raises(SettingsError, match=r"'standing'.*upright, lying"):
        world_from_board_pose(ELSEWHERE, SHAPE, "standing")


def test_the_motion_is_the_same_whatever_space_the_new_session_is_in() -> None:
    then = make_array(SCENE)
    now: CameraArray = jittered(then, 5)
    one, other = align_to_previous(now, then), align_to_previous(in_space(now, ELSEWHERE), then)
    whole = other.world_from_array @ ELSEWHERE
    np.testing.assert_allclose(whole.matrix(), one.world_from_array.matrix(), atol=1e-7)
    assert isinstance(now[0], Camera)
