"""The actor's skin: baked where a view shows it, drawn again as it was seen."""

import numpy as np
import pytest

from capture.pose import Pose
from tests.track.landmark_face import face, face_cameras, face_map, noisy_skin, photograph
from track.appearance import ActorSkin, bake_appearance

MESH = face()
WHERE = face_map(MESH)
SKIN = noisy_skin(MESH, WHERE)
CAMERAS = {camera.name: camera for camera in face_cameras(3)}


@pytest.fixture(scope="module")
def images() -> dict[str, np.ndarray]:
    return {n: photograph(c, MESH, MESH.vertices, SKIN) for n, c in CAMERAS.items()}


def test_every_view_bakes_what_it_shows(images: dict[str, np.ndarray]) -> None:
    baked = bake_appearance(MESH.vertices, MESH.triangles, CAMERAS, images)
    assert baked.shape == (3, len(MESH.vertices))
    known = np.isfinite(baked)
    assert np.median(np.abs(baked - SKIN)[known]) < 0.01
    assert not known[:, MESH.vertices[:, 2] < -40.0].any()  # the back of the head
    nose = np.argmax(MESH.vertices[:, 2])
    assert known[:, nose].all()
    some = {n: image for n, image in images.items() if n != "cam07"}
    without = bake_appearance(MESH.vertices, MESH.triangles, CAMERAS, some)
    row = list(CAMERAS).index("cam07")
    assert np.isnan(without[row]).all()


def test_the_neutral_drawn_again_is_its_photograph(images: dict[str, np.ndarray]) -> None:
    skin = ActorSkin(MESH.vertices, MESH.triangles, CAMERAS, images)
    name, camera = next(iter(CAMERAS.items()))
    drawn = skin.draw(name, camera, MESH.vertices, np.eye(4))
    assert np.abs(drawn.image - images[name]).mean() < 0.005
    again = skin.draw(name, camera, MESH.vertices, np.eye(4))
    assert drawn.image.tobytes() == again.image.tobytes()


def test_moved_skin_looks_as_it_would_be_photographed(images: dict[str, np.ndarray]) -> None:
    skin = ActorSkin(MESH.vertices, MESH.triangles, CAMERAS, images)
    name, camera = list(CAMERAS.items())[1]
    head = np.eye(4)
    head[:3, 3] = [6.0, -4.0, 5.0]
    swollen = MESH.vertices * [1.03, 1.0, 1.0] + head[:3, 3]
    true = photograph(camera, MESH, swollen, SKIN)
    drawn = skin.draw(name, camera, swollen, head).image
    inside = true != np.float32(0.08)
    assert np.abs(drawn - true)[inside].mean() < 0.02
    assert np.abs(images[name] - true)[inside].mean() > 0.04  # it did move


def test_skin_that_no_view_showed_looks_like_what_lies_beside_it() -> None:
    name, camera = list(CAMERAS.items())[1]
    image = photograph(camera, MESH, MESH.vertices, SKIN)
    skin = ActorSkin(MESH.vertices, MESH.triangles, {name: camera}, {name: image})
    head = np.eye(4)
    head[:3, :3] = Pose.from_rotation_vector(np.array([0.0, 0.25, 0.0]), np.zeros(3)).rotation
    turned = MESH.vertices @ head[:3, :3].T
    true = photograph(camera, MESH, turned, SKIN)
    drawn = skin.draw(name, camera, turned, head)
    baked = np.isfinite(
        bake_appearance(MESH.vertices, MESH.triangles, {name: camera}, {name: image})
    )
    corners = MESH.triangles[np.maximum(drawn.buffers.triangle, 0)]
    new = (drawn.buffers.triangle >= 0) & ~baked[0][corners].any(axis=2)
    assert new.sum() > 500  # pixels
    assert np.abs(drawn.image - true)[new].mean() < 0.12  # a dark patch would be 0.35 off
