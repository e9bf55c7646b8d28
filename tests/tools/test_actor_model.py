"""The actor's geometry: topology, lids, lips, mirrored shapes, landmarks."""

from __future__ import annotations

import numpy as np
import pytest

from capture.errors import SettingsError, ShapeError
from capture.pose import Pose
from tools.actor.lattice import make_lattice
from tools.actor.model import ActorModel, build_actor, named_weights
from tools.actor.sculpt import mirror_ids

SEEDS = (None, 1, 5)


@pytest.fixture(scope="module", params=SEEDS)
def actor(request: pytest.FixtureRequest) -> ActorModel:
    return build_actor(request.param)


def gap_mm(actor: ActorModel, pairs: np.ndarray, amplitudes: dict[str, float]) -> np.ndarray:
    weights = named_weights(actor.names, amplitudes)
    skin = actor.pose(weights, Pose.identity()).skin
    return np.linalg.norm(skin[pairs[:, 0]] - skin[pairs[:, 1]], axis=1)


def test_size_and_names(actor: ActorModel) -> None:
    count = len(actor.neutral.vertices)
    assert 5_000 <= count <= 12_000
    assert actor.deltas.shape == (len(actor.names), count, 3)
    assert actor.deltas.dtype == np.float64
    assert len(set(actor.names)) == len(actor.names) >= 40
    assert (actor.neutral.polygons >= 0).all()  # quads only
    assert actor.neutral.uv is not None
    height = np.ptp(actor.neutral.vertices[actor.landmarks68, 1])
    assert 100 < height < 160  # brows to chin of a human head, mm


def test_every_vertex_is_used_and_every_edge_is_manifold(actor: ActorModel) -> None:
    polygons = actor.neutral.polygons
    assert np.array_equal(np.unique(polygons), np.arange(len(actor.neutral.vertices)))
    edges = np.concatenate([polygons[:, [k, (k + 1) % 4]] for k in range(4)])
    assert len(np.unique(edges, axis=0)) == len(
        edges
    )  # each directed edge once: oriented, manifold


def test_no_quad_of_the_outer_skin_is_inverted_or_degenerate(actor: ActorModel) -> None:
    lattice = make_lattice()
    points, normals = actor.neutral.vertices, actor.rest_normals
    polygons = actor.neutral.polygons
    outer = (lattice.ring[polygons] == 0).all(axis=1)
    corner = points[polygons[outer]]
    mean = normals[polygons[outer]].mean(axis=1)
    area = np.zeros((outer.sum(), 4))
    for k in range(4):
        one, two = corner[:, (k + 1) % 4] - corner[:, k], corner[:, (k + 3) % 4] - corner[:, k]
        area[:, k] = (np.cross(one, two) * mean).sum(axis=1)
    assert area.sum(axis=1).min() > 0.05  # mm^2
    assert (area < 0.0).any(axis=1).mean() < 0.004


def test_uv_of_the_skin_do_not_overlap(actor: ActorModel) -> None:
    uv = actor.neutral.uv
    assert uv is not None
    assert uv.min() >= 0.0
    assert uv.max() <= 1.0
    one, two = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    assert (area > 0).all()
    centres = np.round(uv.mean(axis=1), 5)
    assert len(np.unique(centres, axis=0)) == len(centres)


def test_lids_meet_in_a_blink_and_stand_open_at_rest(actor: ActorModel) -> None:
    assert gap_mm(actor, actor.lid_pairs, {"eyeBlink": 1.0}).max() <= 0.1
    open_mm = gap_mm(actor, actor.lid_pairs, {})
    assert 7.0 < open_mm.max() < 13.0


def test_a_shut_lid_lies_outside_the_ball(actor: ActorModel) -> None:
    balls = [part for part in actor.parts if part.kind == "eye"]
    for amount in (0.0, 0.5, 1.0):
        skin = actor.pose(named_weights(actor.names, {"eyeBlink": amount}), Pose.identity()).skin
        for part, slit in zip(balls, make_lattice().eyes, strict=True):
            edges = skin[np.concatenate([slit.upper, slit.lower])]
            radius = np.linalg.norm(edges - part.centre, axis=1)
            assert radius.min() > 12.7, amount


def test_lips_touch_at_rest_and_part_with_the_jaw(actor: ActorModel) -> None:
    assert gap_mm(actor, actor.lip_pairs, {}).max() <= 1e-9
    assert gap_mm(actor, actor.lip_pairs, {"jawOpen": 1.0}).max() > 14.0
    assert gap_mm(actor, actor.lip_pairs, {"jawOpen": 1.0, "mouthClose": 1.0}).max() <= 1e-6


def test_left_and_right_shapes_mirror_on_the_generic_head() -> None:
    actor = build_actor(None)
    mirror = mirror_ids(make_lattice())
    flipped = [-1.0, 1.0, 1.0]
    assert np.abs(actor.neutral.vertices[mirror] * flipped - actor.neutral.vertices).max() < 1e-9
    for index, name in enumerate(actor.names):
        other = name.replace("Left", "#").replace("Right", "Left").replace("#", "Right")
        partner = actor.deltas[actor.names.index(other)]
        assert np.abs(actor.deltas[index][mirror] * flipped - partner).max() < 1e-6, name


def test_shapes_move_what_they_name(actor: ActorModel) -> None:
    lips, chin, left_brow = actor.landmarks68[51], actor.landmarks68[8], actor.landmarks68[24]
    delta = dict(zip(actor.names, actor.deltas, strict=True))
    assert delta["jawOpen"][chin, 1] < -10.0
    assert abs(delta["jawOpen"][lips, 1]) < 2.5
    assert delta["browOuterUpLeft"][left_brow, 1] > 2.0
    assert np.abs(delta["browOuterUpRight"][left_brow]).max() < 0.5
    assert delta["mouthSmileLeft"][actor.landmarks68[54], 1] > 3.0
    assert delta["mouthSmileLeft"][actor.landmarks68[48], 1] < 0.5


def test_rigid_vertices_hardly_move(actor: ActorModel) -> None:
    assert len(actor.rigid_vertices) > 100
    moved = np.linalg.norm(actor.deltas[:, actor.rigid_vertices], axis=2)
    assert moved.max() < 0.5
    points = actor.neutral.vertices[actor.rigid_vertices]
    assert (points[:, 2] > 60).sum() > 30  # some of them face the cameras


def test_an_actor_makes_shapes_in_its_own_way() -> None:
    generic, actor = build_actor(None), build_actor(1)
    ratio = np.linalg.norm(actor.deltas, axis=(1, 2)) / np.linalg.norm(generic.deltas, axis=(1, 2))
    assert ratio.std() > 0.05
    assert np.abs(actor.neutral.vertices - build_actor(5).neutral.vertices).max() > 1.0


def test_landmarks_are_in_order() -> None:
    points = build_actor(None).neutral.vertices[build_actor(None).landmarks68]
    assert (np.diff(points[:17, 0]) > 0).all()
    assert (np.diff(points[17:27, 0]) > 0).all()
    assert (np.diff(points[27:31, 1]) < 0).all()
    for start in (36, 42):
        eye = points[start : start + 6]
        assert eye[0, 0] < eye[1, 0] < eye[2, 0] < eye[3, 0]
        assert eye[[1, 2], 1].min() > eye[[4, 5], 1].max()
    assert points[51, 1] > points[62, 1] >= points[66, 1] > points[57, 1]


def test_same_seed_same_bytes() -> None:
    first = build_actor(3)
    build_actor.cache_clear()
    again = build_actor(3)
    assert first is not again
    assert first.neutral.vertices.tobytes() == again.neutral.vertices.tobytes()
    assert first.deltas.tobytes() == again.deltas.tobytes()
    assert first.paint.albedo.tobytes() == again.paint.albedo.tobytes()


def test_pose_carries_the_head_rigidly() -> None:
    actor = build_actor(None)
    head = Pose.from_rotation_vector(np.array([0.1, -0.2, 0.05]), np.array([3.0, -2.0, 1.0]))
    weights = named_weights(actor.names, {"jawOpen": 0.5})
    still, moved = actor.pose(weights, Pose.identity()), actor.pose(weights, head)
    assert np.abs(head.apply(still.surface) - moved.surface).max() < 1e-9


def test_wrong_weights_are_refused() -> None:
    actor = build_actor(None)
    with pytest.raises(ShapeError, match="weights"):
        actor.pose(np.zeros(3), Pose.identity())
    with pytest.raises(SettingsError, match="no shape 'jawOpne'"):
        named_weights(actor.names, {"jawOpne": 1.0})
