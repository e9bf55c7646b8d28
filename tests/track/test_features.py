"""Sparse features: thresholds, binding, matching inside regions, and a motion that flow loses."""

from collections.abc import Mapping

import numpy as np
import pytest
from scipy import ndimage

from capture.arrays import Bools, Floats, Floats32, Ints
from capture.camera import Camera
from capture.errors import SettingsError, ShapeError
from recon.mesh import Mesh
from tests.track.moving_patch import patch_array, patch_mesh, picture, slit_mesh
from track.face_reference import ReferenceWindows
from track.features import (
    FeatureReference,
    FeatureRound,
    FeatureSettings,
    detect_features,
    feature_rounds,
    match_features,
)
from track.features_bind import bind_pixels, inner_skin, surface_patches
from track.features_detect import Keypoints, find_thresholds
from track.features_follow import FeatureFollower, lost_skin
from track.features_match import Expected, MatchGates, agreeing, gathered, match_keypoints
from track.raster import Rasterizer
from track.registration import Registrar, RegistrarOptions
from track.schedule import schedule
from track.surface_model import SurfaceModel

SIZE = 400
PX_PER_MM = 2.6 * SIZE / 300.0
BIG_MM = 30.0


def _jaw(rest: Floats, radians: float) -> Floats:
    """The patch below y = 15 swung back and down, like a jaw."""
    share = np.clip((15.0 - rest[:, 1]) / 25.0, 0.0, 1.0)
    angle = radians * share * share * (3.0 - 2.0 * share)
    y, z = rest[:, 1] - 15.0, rest[:, 2] + 40.0
    out = rest.copy()
    out[:, 1] = 15.0 + np.cos(angle) * y + np.sin(angle) * z * 0.8
    out[:, 2] = -40.0 + np.cos(angle) * z + np.sin(angle) * y
    return out


Scene = tuple[Mesh, dict[str, Camera], dict[str, Floats32], Floats, dict[str, Floats32]]


@pytest.fixture(scope="module")
def scene() -> Scene:
    mesh = patch_mesh()
    cameras = {camera.name: camera for camera in patch_array(5, SIZE)}
    moved = _jaw(mesh.vertices, -0.55)
    rng = np.random.default_rng(5)

    def shots(vertices: Floats, gain: float) -> dict[str, Floats32]:
        out = {}
        for name, camera in cameras.items():
            clean = picture(camera, mesh, vertices, gain)
            out[name] = (clean + rng.normal(0, 0.004, clean.shape)).astype(np.float32)
        return out

    return mesh, cameras, shots(mesh.vertices, 1.0), moved, shots(moved, 0.9)


@pytest.fixture(scope="module")
def reference(scene: Scene) -> FeatureReference:
    mesh, cameras, images, _, _ = scene
    return FeatureReference(mesh.vertices, mesh.triangles, cameras, images)


@pytest.fixture(scope="module")
def surface(scene: Scene) -> SurfaceModel:
    mesh = scene[0]
    return SurfaceModel.of(mesh.vertices, mesh.triangles, 4.0, None)


def _random_keypoints(rng: np.random.Generator, count: int) -> Keypoints:
    descriptor = rng.random((count, 128)).astype(np.float32)
    return Keypoints(
        pixel=rng.uniform(0, 60, (count, 2)),
        size=np.exp2(rng.uniform(1, 2, count)),
        angle=rng.uniform(-3, 9, count),
        response=np.ones(count),
        descriptor=descriptor / np.linalg.norm(descriptor, axis=1, keepdims=True),
    )


def _literal(reference: Keypoints, expected: Expected, frame: Keypoints, gates: MatchGates) -> Ints:
    """The matcher's definition, word by word."""
    apart = np.full((len(reference), len(frame)), np.inf)
    for m in range(len(reference)):
        for j in range(len(frame)):
            near = np.hypot(*(frame.pixel[j] - expected.pixel[m])) <= expected.radius[m]
            octaves = abs(np.log2(frame.size[j] / expected.size[m]))
            turn = abs(np.angle(np.exp(1j * (frame.angle[j] - expected.angle[m]))))
            if near and octaves <= gates.octaves and turn <= gates.turn:
                apart[m, j] = np.linalg.norm(reference.descriptor[m] - frame.descriptor[j])
    out = np.full(len(reference), -1)
    for m in range(len(reference)):
        j = int(apart[m].argmin())
        away = np.linalg.norm(frame.pixel - frame.pixel[j], axis=1)
        second = apart[m][away > 0.5 * frame.size[j]].min(initial=np.inf)
        good = apart[m, j] <= gates.distance and apart[m, j] <= gates.ratio * second
        if good and apart[:, j].argmin() == m:
            out[m] = j
    return out


@pytest.mark.parametrize("seed", range(3))
def test_matches_are_those_of_the_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    reference, noise = _random_keypoints(rng, 90), _random_keypoints(rng, 120)
    descriptor = noise.descriptor.copy()
    descriptor[:70] = reference.descriptor[:70] + rng.normal(0, 0.02, (70, 128))
    pixel = noise.pixel.copy()
    pixel[:70] = reference.pixel[:70] + rng.normal(0, 3.0, (70, 2))
    pixel[100:110] = pixel[:10]  # the same place once more, in another direction
    frame = Keypoints(
        pixel=pixel,
        size=noise.size,
        angle=noise.angle,
        response=noise.response,
        descriptor=descriptor.astype(np.float32),
    )
    place = reference.pixel.copy()
    place[5] = np.nan
    expected = Expected(
        pixel=place,
        radius=rng.uniform(5, 14, 90),
        size=reference.size,
        angle=reference.angle,
    )
    gates = MatchGates(distance=0.5, ratio=0.9, octaves=0.7, turn=2.0)
    found = match_keypoints(reference, expected, frame, gates)
    np.testing.assert_array_equal(found, _literal(reference, expected, frame, gates))
    assert (found >= 0).sum() > 15
    assert found[5] == -1


def test_wrong_matches_are_voted_down_where_two_motions_meet() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(0, 100, (400, 2))
    motion = np.where(places[:, 1:] > 50, [[20.0, 0.0]], [[0.0, 30.0]])  # two lips
    wrong = rng.random(400) < 0.3
    motion[wrong] = rng.uniform(-40, 40, (int(wrong.sum()), 2))
    kept = agreeing(places, motion, 1.5, (10, 3))
    assert kept[~wrong].mean() > 0.95
    assert kept[wrong].mean() < 0.03
    assert not agreeing(places[:3], motion[:3], 1.5, (10, 3)).any()


def test_matches_of_a_patch_become_one() -> None:
    group = np.array([4, 2, 4, 4, 2])
    motion = np.array([[1.0, 0.0], [5.0, 5.0], [1.2, 0.0], [9.0, 9.0], [5.0, 5.4]])
    patches, mean, precision = gathered(group, motion, np.array([1.0, 1.0, 3.0, 2.0, 1.0]), 1.0)
    np.testing.assert_array_equal(patches, [2, 4])
    np.testing.assert_allclose(mean, [[5.0, 5.2], [1.15, 0.0]])
    np.testing.assert_allclose(precision, [2.0, 4.0])


def test_thresholds_leave_as_many_keypoints_as_wanted(scene: Scene) -> None:
    image = next(iter(scene[2].values()))
    region = np.ones(image.shape, np.uint8)
    loose, every = find_thresholds(image, region, 100_000)
    tight, some = find_thresholds(image, region, 50)
    assert loose.peak == 0.0
    assert tight.peak > 0.0
    assert tight.edge < loose.edge
    assert 50 <= len(some) <= 60 < len(every)
    assert some.response.min() == tight.peak
    again = find_thresholds(image, region, 50)[1]
    assert some.descriptor.tobytes() == again.descriptor.tobytes()
    np.testing.assert_allclose(np.linalg.norm(some.descriptor, axis=1), 1.0, atol=1e-5)
    with pytest.raises(ShapeError, match="wanted: expected at least 1"):
        find_thresholds(image, region, 0)


def test_dark_images_have_the_same_keypoints(scene: Scene) -> None:
    image = next(iter(scene[2].values()))
    region = np.ones(image.shape, np.uint8)
    bright, dark = (find_thresholds(image * gain, region, 200)[1] for gain in (1.0, 0.05))
    away = np.linalg.norm(bright.pixel[:, None] - dark.pixel[None], axis=2).min(axis=1)
    assert (away < 0.3).mean() > 0.9


def test_keypoints_lie_on_the_surface_that_their_pixels_show(scene: Scene) -> None:
    mesh, cameras, _, _, _ = scene
    camera = cameras["cam01"]
    buffers = Rasterizer(mesh.triangles, len(mesh.vertices)).render(camera, mesh.vertices)
    shape = (mesh.vertices, mesh.triangles)
    skin = inner_skin(camera, buffers, shape, 0.3, 4)
    rows, columns = np.nonzero(skin)
    rng = np.random.default_rng(1)
    pixels = np.column_stack([columns, rows])[::17] + rng.uniform(-0.5, 0.5, (len(rows[::17]), 2))
    bound = bind_pixels(pixels, camera, buffers, shape)
    assert (bound.triangle >= 0).all()
    np.testing.assert_allclose(camera.project(bound.points(mesh.vertices)), pixels, atol=1e-7)
    depth = ndimage.distance_transform_cdt(buffers.triangle >= 0, metric="chessboard")
    assert depth[rows, columns].min() > 4  # px: the margin
    outside = bind_pixels(np.array([[1.0, 1.0]]), camera, buffers, shape)
    assert outside.triangle[0] == -1


def test_patches_cover_the_surface_and_never_join_two_lips() -> None:
    mesh, below = slit_mesh(18, 7)
    centres, patch = surface_patches(mesh.vertices, mesh.triangles, 8.0)
    assert (patch >= 0).all()
    np.testing.assert_array_equal(patch[centres], np.arange(len(centres)))
    away = np.linalg.norm(mesh.vertices - mesh.vertices[centres[patch]], axis=1)
    assert away.max() < 1.5 * 8.0 + 1.0
    lower = np.arange(19 * 19, len(mesh.vertices))[3:-3]
    upper = 9 * 19 + np.arange(3, 16)[3:-3]
    np.testing.assert_allclose(mesh.vertices[lower], mesh.vertices[upper])
    assert not set(patch[lower]) & set(patch[upper])
    assert below[lower].all()


def test_sightings_are_where_the_skin_went(reference: FeatureReference, scene: Scene) -> None:
    mesh, _, _, moved, images = scene
    first = feature_rounds(0, BIG_MM)[0]
    frame = detect_features(reference, images, mesh.vertices, first)
    seen = match_features(reference, frame, mesh.vertices, first)
    points = seen.surface.points(moved)
    truth = np.stack(
        [
            reference.cameras[seen.cameras[v]].project(points[p : p + 1])[0]
            for p, v in zip(seen.point, seen.view, strict=True)
        ]
    )
    miss = np.linalg.norm(seen.pixel - truth, axis=1)
    assert len(seen.surface) > 60
    assert np.median(miss) < 2.0  # px: a patch is 20 px wide
    assert (miss < 8.0).mean() > 0.9
    far = np.linalg.norm(points - seen.surface.points(mesh.vertices), axis=1) > 12.0
    assert far.sum() > 8


def _follower(surface: SurfaceModel, reference: FeatureReference) -> FeatureFollower:
    return FeatureFollower(surface, reference, feature_rounds(0, BIG_MM, 3))


def _inner() -> Ints:
    return np.arange(19 * 19).reshape(19, 19)[2:-2, 2:-2].ravel()


def test_features_find_a_motion_that_flow_loses(
    surface: SurfaceModel, reference: FeatureReference, scene: Scene
) -> None:
    mesh, cameras, first, moved, images = scene
    options = RegistrarOptions(
        steps=schedule(2, 12.0 * PX_PER_MM, 2, (4.0, 2.0)),
        windows=ReferenceWindows(levels=2, half=6, half_coarse=4, min_cosine=0.35),
        min_correlation=0.6,
        search_stride=1,
        rotation_iterations=2,
    )
    registrar = Registrar(surface, cameras, first, options)

    def miss(vertices: Floats) -> Floats:
        return np.linalg.norm(vertices - moved, axis=1)[_inner()]

    start = mesh.vertices
    assert miss(start).max() > 15.0  # mm
    alone = registrar.register(start, images)
    assert miss(alone.vertices).max() > 5.0
    found = _follower(surface, reference).follow(start, images)
    assert np.sqrt((miss(found) ** 2).mean()) < 0.8
    both = registrar.register(found, images)
    assert np.sqrt((miss(both.vertices) ** 2).mean()) < 0.12
    assert lost_skin(surface, alone.confidence, registrar.vertex_views(), 200.0).any()
    assert not lost_skin(surface, both.confidence, registrar.vertex_views(), 200.0).any()


def test_following_is_the_same_twice_and_does_without_views(
    surface: SurfaceModel, reference: FeatureReference, scene: Scene
) -> None:
    mesh, _, _, moved, images = scene
    follower = _follower(surface, reference)
    three = {name: images[name] for name in list(images)[::2]}
    one, two = (follower.follow(mesh.vertices, three) for _ in range(2))
    assert one.tobytes() == two.tobytes()
    assert np.median(np.linalg.norm(one - moved, axis=1)[_inner()]) < 1.0
    np.testing.assert_array_equal(follower.follow(mesh.vertices, {}), mesh.vertices)


def test_held_skin_stays_and_only_wanted_skin_is_looked_at(
    surface: SurfaceModel, reference: FeatureReference, scene: Scene
) -> None:
    mesh, _, _, moved, images = scene
    far: Bools = np.linalg.norm(moved - mesh.vertices, axis=1) > 0.05
    first = feature_rounds(0, 12.0)[0]
    counts: list[Mapping[str, Keypoints]] = [
        detect_features(reference, images, mesh.vertices, first, wanted)
        for wanted in (None, mesh.vertices[:, 1] < -40.0)
    ]
    every, some = (sum(len(keypoints) for keypoints in count.values()) for count in counts)
    assert 0 < some < 0.6 * every
    start = np.where(far[:, None], mesh.vertices, moved)
    found = _follower(surface, reference).follow(start, images, wanted=far, held=~far)
    inside = _inner()
    still = inside[~far[inside]]
    assert np.linalg.norm(found - moved, axis=1)[still].max() < 0.8
    assert np.median(np.linalg.norm(found - moved, axis=1)[inside[far[inside]]]) < 0.8


def test_regions_shrink_and_the_mesh_is_let_go() -> None:
    rounds = feature_rounds(1, 30.0, 3)
    assert [one.radius_mm for one in rounds] == sorted((r.radius_mm for r in rounds), reverse=True)
    assert rounds[0].radius_mm == 30.0
    assert rounds[0].gates.distance < rounds[-1].gates.distance
    assert rounds[0].bending_mm > rounds[-1].bending_mm


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(SettingsError, match="rounds: expected at least 1, found 0"):
        feature_rounds(0, rounds=0)
    gates = MatchGates(distance=0.5, ratio=0.9, octaves=1.0, turn=1.0)
    with pytest.raises(SettingsError, match="expected level >= 0"):
        FeatureRound(level=0, radius_mm=0.0, gates=gates, spacing_mm=5.0, bending_mm=4.0)
    with pytest.raises(SettingsError, match="keypoints"):
        FeatureSettings(keypoints=1)
