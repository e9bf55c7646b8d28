"""Scene centre and pair selection."""

import numpy as np
import pytest

from capture.camera import CameraArray
from capture.errors import CameraError, SettingsError
from capture.pose import Pose
from recon.pairs import PairSettings, scene_centre, select_pairs
from tests.synthetic_stereo import ring


def moved(cameras: CameraArray, world_from_world: Pose) -> CameraArray:
    back = world_from_world.inverse()
    return CameraArray(tuple(c.posed(c.camera_from_world @ back) for c in cameras))


def test_the_centre_is_where_the_axes_meet_and_moves_with_the_world():
    cameras = ring((-30.0, -10.0, 10.0, 30.0), (-10.0, 10.0))
    np.testing.assert_allclose(scene_centre(cameras), 0.0, atol=1e-6)
    motion = Pose.from_rotation_vector(np.array([0.4, -1.2, 2.0]), np.array([30.0, -500.0, 80.0]))
    np.testing.assert_allclose(scene_centre(moved(cameras, motion)), motion.translation, atol=1e-6)


def test_pairs_have_the_angles_asked_for_in_both_orientations():
    cameras = ring((-30.0, -10.0, 10.0, 30.0), (-10.0, 10.0))
    pairs = select_pairs(cameras, np.zeros(3))
    assert all(9.0 <= pair.angle_deg <= 27.0 for pair in pairs)
    assert {(pair.left, pair.right) for pair in pairs} >= {(0, 1), (1, 2), (2, 3)}
    vertical = [p for p in pairs if {p.left, p.right} in ({0, 4}, {1, 5}, {2, 6}, {3, 7})]
    assert len(vertical) == 4


def test_pairs_do_not_depend_on_the_place_of_the_world():
    cameras = ring((-30.0, -10.0, 10.0, 30.0), (-10.0, 10.0))
    motion = Pose.from_rotation_vector(np.array([0.4, -1.2, 2.0]), np.array([30.0, -500.0, 80.0]))
    before = select_pairs(cameras, np.zeros(3))
    after = select_pairs(moved(cameras, motion), motion.translation)
    assert [(p.left, p.right) for p in before] == [(p.left, p.right) for p in after]


def test_a_sparse_array_still_pairs_every_camera():
    pairs = select_pairs(ring((-60.0, -20.0, 20.0, 60.0)), np.zeros(3))
    assert {index for pair in pairs for index in (pair.left, pair.right)} == {0, 1, 2, 3}


def test_parallel_axes_ask_for_the_centre():
    one = ring((0.0,))[0]
    other = one.posed(Pose(np.eye(3), np.array([50.0, 0, 0])) @ one.camera_from_world)
    twin = type(one)(**{**vars(other), "name": "twin"})
    with pytest.raises(CameraError, match=r"parallel .* set centre_mm"):
        scene_centre(CameraArray((one, twin)))
    with pytest.raises(CameraError, match="at least 2 cameras, found 1"):
        scene_centre(CameraArray((one,)))


def test_angles_out_of_order_are_refused():
    with pytest.raises(SettingsError, match="angle_min_deg < angle_best_deg"):
        PairSettings(angle_min_deg=30.0)
