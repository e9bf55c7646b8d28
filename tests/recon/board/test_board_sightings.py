"""Board takes: rests, devices out of step, soft devices, the choice of poses, the scale bar."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from capture.arrays import Image
from capture.errors import TakeError
from capture.pose import Pose
from recon.board.body import BoardBody, ScaleBar
from recon.board.corners import BLURRED, LOST, SPARE, STILL, USED, CornerLimits
from recon.board.mirrored import mirrored_devices
from recon.board.observations import BoardObservations
from recon.board.pose_choice import MARK_COUNT, choose_poses, view_marks
from recon.board.shape import BoardShape
from recon.board.sightings import observe_board
from tests.board_prints import MemoryTake, markers_print, render, small_camera, turned
from tools.bench.board_scene import A4_BOARD

CORNERS = A4_BOARD.corners_mm()
MIDDLE = CORNERS.mean(axis=0)
PLACES = {"A": (10.0, 12.0, 5.0), "B": (-20.0, 5.0, -10.0), "C": (0.0, -30.0, 20.0)}
CAMERA = small_camera()
LIMITS = CornerLimits()


@cache
def picture(place: str, seed: int = 0, shift_px: int = 0) -> Image:
    if seed or shift_px:
        noise = np.random.default_rng(seed).normal(0.0, 2.0, (400, 400))
        image = np.clip(np.roll(picture(place), shift_px, axis=1) + noise, 0, 255).astype(np.uint8)
    else:
        image = render(CAMERA, turned(*PLACES[place], MIDDLE), A4_BOARD)
    image.flags.writeable = False
    return image


def take_of(*rows: str) -> MemoryTake:
    """One row a device: the place of the board in each frame, "-" for a lost frame."""
    return MemoryTake(
        {
            f"cam{device}": [
                None if place == "-" else picture(place, seed, device)
                for seed, place in enumerate(row)
            ]
            for device, row in enumerate(rows)
        }
    )


def test_a_board_that_rests_is_one_pose() -> None:
    found = observe_board(take_of("AAABB", "AAABB", "A-ABB"), A4_BOARD, LIMITS)
    assert len(found.observations.frames) == 2
    assert found.every.frames == tuple(range(5))
    assert found.tally["cam0"] == {USED: 2, STILL: 3}
    assert found.tally["cam2"][LOST] == 1


def test_a_device_out_of_step_makes_no_poses() -> None:
    found = observe_board(take_of("ABBB", "ABBB", "AABB"), A4_BOARD, LIMITS)
    assert len(found.observations.frames) == 2
    two = observe_board(take_of("ABBB", "AABB"), A4_BOARD, LIMITS)
    assert len(two.observations.frames) == 3  # of two devices none can be told to be right


def test_a_board_whose_edge_alone_moves_has_moved() -> None:
    """It turns about its left edge: half of the corners move by less than the limit."""
    pose = turned(0, 0, 0, MIDDLE)
    left = np.array([0.0, MIDDLE[1], 0.0])
    turn = Pose.from_rotation_vector(np.array([0, 0, 0.0024]), np.zeros(3))
    about = Pose(np.eye(3), left) @ turn @ Pose(np.eye(3), -left)
    moved = np.linalg.norm(
        CAMERA.project(pose.apply(CORNERS)) - CAMERA.project((pose @ about).apply(CORNERS)), axis=1
    )
    assert np.median(moved) < LIMITS.still_px < moved.max()
    images: list[Image | None] = [
        render(CAMERA, place, A4_BOARD, seed=1) for place in (pose, pose @ about)
    ]
    found = observe_board(MemoryTake({"cam": images}), A4_BOARD, LIMITS)
    assert len(found.observations.frames) == 2


def test_of_a_rest_the_frame_that_shows_most_is_used() -> None:
    hidden = picture("A", 0).copy()
    hidden[:, :190] = 90
    shown: list[Image | None] = [hidden, picture("A", 1), hidden]
    found = observe_board(MemoryTake({"cam": shown}), A4_BOARD, LIMITS)
    assert found.observations.frames == (1,)
    assert found.tally["cam"] == {USED: 1, STILL: 2}
    assert len(found.observations) > 75  # of 88; half of them are hidden in the others


def test_a_soft_device_is_told_by_its_tally_and_its_blur() -> None:
    take = take_of("ABC", "ABC")
    take.shown["cam1"] = [
        cv2.GaussianBlur(i, (0, 0), 0.8) for i in take.shown["cam0"] if i is not None
    ]
    found = observe_board(take, A4_BOARD, CornerLimits(max_blur_px=1.15))
    assert found.tally["cam1"] == {BLURRED: 3}
    assert found.tally["cam0"] == {USED: 3}
    assert found.blur_px["cam1"] > 1.15 > found.blur_px["cam0"]


def test_the_order_of_threads_does_not_show() -> None:
    take = take_of("ABC", "BCA", "CAB")
    one, two = (observe_board(take, A4_BOARD, CornerLimits(max_poses=2)) for _ in range(2))
    for key in ("device", "pose", "corner", "pixels"):
        for which in ("observations", "every"):
            first, second = (getattr(getattr(f, which), key) for f in (one, two))
            assert first.tobytes() == second.tobytes()
    assert one.tally == two.tally
    assert one.observations.frames == two.observations.frames
    assert sum(counts[SPARE] for counts in one.tally.values()) == 3


def test_a_damaged_image_stops_the_search() -> None:
    class Broken(MemoryTake):
        def image(self, device: str, frame: int) -> Image:
            if frame == 1:
                raise TakeError("cam0.mcap: frame 1: damaged")
            return super().image(device, frame)

    with pytest.raises(TakeError, match="frame 1: damaged"):
        observe_board(Broken(take_of("ABC").shown), A4_BOARD, LIMITS)


def test_the_scale_bar_is_followed_through_the_take() -> None:
    bar = ScaleBar(dictionary="DICT_4X4_50", markers=(3, 8), marker_mm=30.0, length_mm=120.0)
    sheet = markers_print(bar.dictionary, {3: (20.0, 20.0), 8: (140.0, 20.0)}, 30.0, (190.0, 70.0))
    centres = np.array([[35.0, 35.0, 0.0], [155.0, 35.0, 0.0]])
    pose = turned(10, 10, 5, centres.mean(axis=0))
    image = render(CAMERA, pose, sheet, seed=1)
    take = MemoryTake({"cam0": [picture("A"), image], "cam1": [image, None]})
    seen = observe_board(take, BoardBody.of(A4_BOARD, bar), LIMITS).bar
    assert seen.frame.tolist() == [0, 0, 1, 1]
    assert seen.device.tolist() == [1, 1, 0, 0]
    assert seen.end.tolist() == [0, 1, 0, 1]
    np.testing.assert_allclose(seen.pixels[:2], CAMERA.project(pose.apply(centres)), atol=0.15)


def test_poses_are_chosen_for_the_devices_that_see_least() -> None:
    marks = [[(0, np.array([0, 1, 17]))] for _ in range(20)]
    for place in (4, 11, 17):  # the second device sees the board three times
        marks[place].append((1, np.array([0, 5 + place % 3, 18])))
    chosen = choose_poses(marks, 2, 6)
    assert len(chosen) == 6
    assert {4, 11, 17} <= set(chosen)
    assert chosen == sorted(chosen)
    assert choose_poses(marks[:5], 2, 6) == [0, 1, 2, 3, 4]


def test_poses_are_chosen_for_new_places_and_tilts() -> None:
    size = (400, 400)
    flat = CORNERS[:, :2]
    views = [
        view_marks(flat, CAMERA.project(turned(yaw, 0, 0, MIDDLE).apply(CORNERS)), size)
        for yaw in [0] * 10 + [35] + [0] * 10 + [-35] + [0] * 4
    ]
    assert {10, 21} < set(choose_poses([[(0, marks)] for marks in views], 1, 3))
    tilts = []
    for yaw, pitch in ((0, 0), (30, 0), (-30, 0), (0, 30), (0, -30)):
        pixels = CAMERA.project(turned(yaw, pitch, 0, MIDDLE).apply(CORNERS))
        marks = view_marks(flat, pixels, size)
        assert marks[0] == 0
        assert marks.max() < MARK_COUNT
        tilts.append(int(marks[-1]) - (MARK_COUNT - 5))
        spun = np.stack([pixels[:, 1], 399 - pixels[:, 0]], axis=1)  # the camera a quarter turned
        quarter = int(view_marks(flat, spun, size)[-1]) - (MARK_COUNT - 5)
        assert quarter == (0 if tilts[-1] == 0 else 1 + (tilts[-1] - 1 + 3) % 4)
    assert tilts[0] == 0
    assert sorted(tilts) == [0, 1, 2, 3, 4]


def test_mirrored_sightings_are_named() -> None:
    rows = []
    for device, flip in enumerate((False, True, False)):
        for pose, place in enumerate(PLACES.values()):
            pixels = CAMERA.project(turned(*place, MIDDLE).apply(CORNERS))
            if flip or (device == 2 and pose == 0):  # one odd view makes no mirror
                pixels[:, 0] = 399 - pixels[:, 0]
            rows += [(device, pose, n, *p) for n, p in enumerate(pixels.tolist())]
    table = np.array(rows)
    seen = BoardObservations(
        device_names=("cam0", "cam1", "cam2"), sizes=((400, 400),) * 3, frames=(0, 1, 2),
        device=table[:, 0], pose=table[:, 1], corner=table[:, 2], pixels=table[:, 3:],
    )  # fmt: skip
    shape = BoardShape.flat_board(CORNERS)
    assert mirrored_devices(seen, shape) == ["cam1"]
    assert mirrored_devices(seen.select(seen.device == 0), shape) == []
    mixed = BoardShape.flat_board(CORNERS[np.random.default_rng(1).permutation(len(CORNERS))])
    assert mirrored_devices(seen, mixed) == []  # another board than the file's
    line = seen.select(seen.corner < 11)  # one row of corners tells nothing
    assert mirrored_devices(line, shape) == []
