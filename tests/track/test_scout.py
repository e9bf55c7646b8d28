"""The scout: the head of a frame as one rigid piece, and whether the face is at rest in it."""

from pathlib import Path

import numpy as np

from capture.pose import Pose
from recon.visiting import import_take
from tests.track.moving_patch import patch_mesh, patch_motion, write_visit
from track.anchors import REST_MM
from track.face_tracker import FaceTracker
from track.track_settings import TrackSettings


def test_a_head_that_only_turned_is_at_rest_and_found(tmp_path: Path) -> None:
    mesh = patch_mesh()
    turn = Pose.from_rotation_vector(np.array([0.03, -0.05, 0.02]), np.array([1.0, 2.0, -1.5]))
    frames = [mesh.vertices, turn.apply(mesh.vertices), patch_motion(mesh.vertices, 1.0)]
    write_visit(tmp_path / "visit", mesh, np.stack(frames), 0, None)
    take = import_take(tmp_path / "visit", tmp_path / "take")
    tracker = FaceTracker(take, mesh, TrackSettings(), {})
    placed, unrest = tracker.scout(1, mesh.vertices)
    assert np.abs(placed - frames[1]).max() < 0.1  # mm
    assert unrest < 0.5 * REST_MM
    _, unrest = tracker.scout(2, mesh.vertices)
    assert unrest > REST_MM  # a bump has grown by 3 mm


def test_a_frame_without_views_is_not_known(tmp_path: Path) -> None:
    mesh = patch_mesh()
    write_visit(tmp_path / "visit", mesh, np.stack([mesh.vertices] * 2), 0, None)
    take = import_take(tmp_path / "visit", tmp_path / "take")
    tracker = FaceTracker(take, mesh, TrackSettings(), {})
    blank = {name: np.full_like(image, 0.2) for name, image in tracker.images(1).items()}
    placed, unrest = tracker.registrar().scout(mesh.vertices, blank)
    assert np.isinf(unrest)
    np.testing.assert_array_equal(placed, mesh.vertices)
