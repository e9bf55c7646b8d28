"""Expressions made of landmarks: they move what they should, and leave the rest."""

import numpy as np
import pytest

from capture.errors import TakeError
from tests.track.landmark_face import face, face_map
from track.face_landmarks import LANDMARK_NAMES
from track.landmark_actor import landmark_rest
from track.landmark_expressions import head_frame, landmark_shapes
from track.landmark_training import Jitter, made_up_acts

MESH = face()
WHERE = face_map(MESH)


def test_axes_of_a_face() -> None:
    frame = head_frame(landmark_rest(WHERE, MESH.vertices))
    assert np.abs(frame.axes.T @ frame.axes - np.eye(3)).max() < 1e-9
    assert frame.axes[:, 0] @ [1.0, 0.0, 0.0] > 0.99  # the actor's left is +X when he looks at +Z
    assert frame.axes[1, 1] > 0.9
    assert frame.axes[2, 2] > 0.9


def test_shapes_move_their_landmarks() -> None:
    shapes = landmark_shapes(MESH, WHERE)
    moved = {n: dict(zip(WHERE.names, WHERE.surface.points(d), strict=True))
             for n, d in shapes.items()}  # fmt: skip
    assert moved["jaw_open"]["lip_outer_9"][1] < -10.0  # the lower lip goes down
    assert abs(moved["jaw_open"]["lip_outer_3"][1]) < 4.0  # the upper one stays
    assert moved["jaw_open"]["jaw_8"][1] < -10.0
    assert moved["smile_left"]["lip_outer_6"][1] > 3.0
    assert abs(moved["smile_left"]["lip_outer_0"][1]) < 1.5
    assert moved["blink_right"]["lids_right_1"][1] < -5.0
    assert abs(moved["blink_right"]["lids_left_1"][1]) < 1.0
    assert moved["brow_inner"]["brow_left_0"][1] > 4.0
    for name, deltas in shapes.items():
        back = np.linalg.norm(deltas[MESH.vertices[:, 2] < -60.0], axis=1)
        assert back.max() < 1.5, name  # mm: the back of the head stays


def test_a_map_without_lips_is_refused() -> None:
    known = [name for name in LANDMARK_NAMES if not name.startswith("lip")]
    with pytest.raises(TakeError, match=r"expressions need lids_right_0.*lip_outer_6 on the mesh"):
        landmark_shapes(MESH, WHERE.select(known))


def test_moments_mix_sides_and_repeat() -> None:
    shapes = {name: np.full((len(MESH.vertices), 3), 1.0) for name in
              ("blink_left", "blink_right", "jaw_open", "mouth_left", "mouth_right")}  # fmt: skip
    jitter = Jitter(turn_deg=0.0, shift_mm=0.0)
    acts = made_up_acts(MESH, shapes, 40, jitter, seed=3)
    again = made_up_acts(MESH, shapes, 40, jitter, seed=3)
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(acts, again, strict=True))
    assert np.array_equal(acts[0].vertices, MESH.vertices)
    sizes = [float((act.vertices - MESH.vertices).mean()) for act in acts]
    assert len(np.unique(np.round(sizes, 6))) > 25
    assert np.abs(acts[5].head - np.eye(4)).max() < 1e-9
    turned = made_up_acts(MESH, shapes, 10, Jitter(turn_deg=5.0), seed=3)
    assert np.abs(turned[3].head[:3, :3] - np.eye(3)).max() > 0.01
