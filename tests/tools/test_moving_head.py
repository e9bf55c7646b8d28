from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture.camera import CameraArray
from capture.errors import TakeError
from recon.mesh import Mesh, read_obj
from recon.surface import closest_points
from tests.tools.test_scan_takes import wall
from tools.bench.moving_head import (
    carried_motion,
    expressions,
    head_motion_at,
    ict_motion,
    tracked_mesh,
    write_moving_take,
)
from tools.bench.scan_takes import load_head, studio

SHARED = Path(__file__).resolve().parents[2].parent / "shared"


def test_expressions_are_read_by_name() -> None:
    assert expressions("jawOpen:0.5,mouthSmile_L:1") == {"jawOpen": 0.5, "mouthSmile_L": 1.0}
    assert expressions("") == {}
    with pytest.raises(TakeError, match="name:amount, found 'jawOpen'"):
        expressions("jawOpen")


def test_the_head_starts_and_ends_where_it_was() -> None:
    points = np.array([[40.0, -30.0, 20.0]])
    for phase, far in ((0.0, 0.0), (0.25, 1.0), (0.5, 1.0), (1.0, 0.0)):
        away = np.linalg.norm(head_motion_at(phase, 1.0).apply(points) - points)
        assert (away < 1e-9) if far == 0.0 else (away > far)
    half, whole = (head_motion_at(0.3, strength).rotation_vector() for strength in (0.5, 1.0))
    assert np.allclose(2.0 * half, whole)


def test_the_tracked_mesh_lies_on_the_surface_and_has_no_long_edge() -> None:
    places, triangles = wall().surface()
    mesh = tracked_mesh(places, triangles)
    rng = np.random.default_rng(2)
    bent = places + rng.normal(0.0, 4.0, places.shape)
    vertices = mesh.weights @ bent
    assert closest_points(bent, triangles, vertices)[2].max() < 1e-4
    flat = mesh.weights @ places
    ends = flat[mesh.triangles] - flat[np.roll(mesh.triangles, 1, axis=1)]
    assert np.linalg.norm(ends, axis=2).max() <= 6.0
    a, b, c = flat[mesh.triangles].transpose(1, 0, 2)
    area = 0.5 * np.cross(b - a, c - a)
    assert (area[:, 2] > 0).all()  # as turned as before
    assert area[:, 2].sum() == pytest.approx(180.0**2)  # nothing is there twice, no gap
    sides = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert np.unique(sides, axis=0, return_counts=True)[1].max() == 2


def test_a_surface_follows_what_lies_on_it_and_nothing_far_away() -> None:
    places, triangles = wall(spacing_mm=5.0, count=41).surface()
    leader = wall(spacing_mm=4.0, count=11)  # 40 mm in the middle of 200
    laid = Mesh(leader.vertices + [0.0, 0.0, 0.5], leader.triangles)
    motion = carried_motion(laid, np.tile([1.0, 2.0, 3.0], (121, 1)), places, triangles)
    distance = np.abs(places).max(axis=1) - 20.0
    assert np.allclose(motion[distance < -1.0], [1.0, 2.0, 3.0], atol=0.02)
    assert np.abs(motion[distance > 45.0]).max() < 0.01
    size = np.linalg.norm(motion, axis=1)
    order = np.argsort(distance)
    edges = np.linalg.norm(np.diff(motion.reshape(41, 41, 3), axis=0), axis=2)
    assert edges.max() < 1.3  # of 3.7 mm: no jump between neighbours
    assert size[order[0]] > size[order[-1]]


def test_the_truth_is_what_is_drawn(tmp_path: Path) -> None:
    head = wall()
    places, _ = head.surface()
    motion = np.tile([0.0, 6.0, 0.0], (len(places), 1))
    cameras = CameraArray(studio(64, 3).cameras[:2])
    write_moving_take(tmp_path, head, motion, cameras, (3, 0.0), seed=3)
    with np.load(tmp_path / "truth.npz") as truth:
        vertices, faces, face = truth["vertices"], truth["faces"], truth["face_region"]
    neutral = read_obj(tmp_path / "neutral.obj")
    assert np.allclose(neutral.vertices, vertices[0], atol=1e-4)
    assert np.array_equal(neutral.triangles, faces)
    assert np.allclose(vertices[2], vertices[0])
    assert np.allclose(vertices[1] - vertices[0], [0.0, 6.0, 0.0], atol=1e-4)
    assert 0 < len(face) <= len(neutral.vertices)
    assert len(list(tmp_path.glob("cam0[01]/000[012].png"))) == 6


@pytest.mark.shared_data
def test_an_unknown_expression_is_named() -> None:
    surface = load_head(SHARED / "data" / "lee-perry-smith").surface()
    with pytest.raises(TakeError, match="no jawOpens; the ICT face has PupilDilate_L"):
        ict_motion(SHARED, {"jawOpens": 1.0}, *surface)


@pytest.mark.shared_data
def test_the_jaw_parts_the_lips_of_the_scan() -> None:
    places, triangles = load_head(SHARED / "data" / "lee-perry-smith").surface()
    motion = ict_motion(SHARED, {"jawOpen": 0.5}, places, triangles)
    mesh = tracked_mesh(places, triangles)
    assert 5000 < len(mesh.face) < 7000
    vertices, moves = mesh.weights @ places, mesh.weights @ motion
    near = np.hypot(vertices[:, 0], vertices[:, 1] + 39.0) < 8.0  # about the line between the lips
    near &= vertices[:, 2] > 40.0
    down = -moves[near, 1]
    assert np.quantile(down, 0.9) > 8.0  # the lower lip
    assert np.quantile(down, 0.1) < 3.0  # the upper one
    forehead = vertices[:, 1] > 60.0
    assert np.abs(moves[forehead]).max() < 0.5
