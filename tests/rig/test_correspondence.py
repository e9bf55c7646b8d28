"""Correspondence between topologies: the truth is the same surface, meshed otherwise."""

import numpy as np
import pytest

from capture.arrays import Floats, Ints
from capture.errors import SettingsError, SolveError
from capture.pose import Pose
from recon.mesh import Mesh
from rig.correspondence import Correspondence, correspond
from rig.correspondence_fit import FitSettings
from rig.slits import annotate_pairs, find_slits, match_slits, pair_loops
from rig.torn_edges import Bindings, TornEdges
from tests.rig.toy_face import ToyFace, toy_face
from track.rigid import Similarity

_MOTION = Pose.from_rotation_vector(
    np.radians(10.0) * np.array([0.6, 0.64, 0.48]), np.array([12.0, -10.0, 12.0])
).matrix()
MISPLACED = Similarity(rotation=_MOTION[:3, :3], translation=_MOTION[:3, 3], scale=1.05)
QUICK = FitSettings(steps=6)


def moved(face: ToyFace) -> Mesh:
    return face.mesh.with_vertices(MISPLACED.apply(face.mesh.vertices))


def marks(first: ToyFace, second: ToyFace) -> Ints:
    """The corners of eyes and mouth, forehead and chin."""
    places = np.array([(25, -35), (-25, -35), (46, 35), (-46, 35), (0, 90), (0, -95)])
    ids = [
        [int((((face.flat - at) ** 2).sum(axis=1) + face.depth).argmin()) for at in places]
        for face in (first, second)
    ]
    return np.array(ids).T


def place_error_mm(found: Correspondence, template: ToyFace, mesh: ToyFace) -> Floats:
    """How far each bound vertex's place is from the true one, on the flat surface."""
    own, true = (np.column_stack([face.flat, face.depth]) for face in (template, mesh))
    places = np.einsum("uk,ukx->ux", found.barycentric, own[found.corners])
    return np.linalg.norm(places - true, axis=1)[found.bound]


def mixed_lips(found: Correspondence, template: ToyFace, mesh: ToyFace) -> int:
    """Vertices of one lip that are bound to the other; where sheets are joined is neither."""
    limit = 0.9 * mesh.depth.max() * (1.0 - (mesh.flat[:, 0] / 25.0) ** 2)
    ask = found.bound & ((mesh.depth < limit) | (mesh.depth == 0.0))
    used = found.barycentric > 1e-6
    crossed = (template.lips[found.corners] * mesh.lips[:, None] < 0) & used
    return int(crossed[ask].any(axis=1).sum())


def test_a_misplaced_mesh_of_other_topology_finds_its_places() -> None:
    template, mesh = toy_face(4.5), toy_face(5.5, slant=1)
    found = correspond(template.mesh, moved(mesh))
    error = place_error_mm(found, template, mesh)
    assert found.bound.mean() > 0.99
    assert np.median(error) < 0.05
    assert np.quantile(error, 0.95) < 0.3
    assert mixed_lips(found, template, mesh) == 0
    assert (mesh.lips != 0).sum() > 50
    assert found.torn == 0
    assert found.mesh_from_template.scale == pytest.approx(1.05, abs=2e-3)
    assert np.nanmax(found.distance_mm) < 1.0
    assert found.rows().sum(axis=1) == pytest.approx(found.bound.astype(float))


def test_lips_that_touch_before_a_bag_are_not_mixed() -> None:
    template, mesh = toy_face(5.0, bag=True), toy_face(4.0, slant=1, bag=True)
    found = correspond(template.mesh, moved(mesh), QUICK, landmarks=marks(template, mesh))
    assert mixed_lips(found, template, mesh) == 0
    assert found.bound.mean() > 0.99


def test_the_same_input_gives_the_same_bytes() -> None:
    template, mesh = toy_face(7.0), toy_face(8.0)
    one, two = (
        correspond(template.mesh, moved(mesh), QUICK, landmarks=marks(template, mesh))
        for _ in range(2)
    )
    assert one.barycentric.tobytes() == two.barycentric.tobytes()
    assert one.corners.tobytes() == two.corners.tobytes()


def _ball(centre: Floats, radius: float) -> Mesh:
    turn, height = np.meshgrid(np.linspace(0, 2 * np.pi, 13)[:-1], np.linspace(-1.2, 1.2, 7))
    flat = np.cos(height) * radius
    points = np.stack(
        [np.cos(turn) * flat, np.sin(height) * radius, -np.sin(turn) * flat], axis=-1
    ).reshape(-1, 3)
    quads = [
        [r * 12 + c, r * 12 + (c + 1) % 12, (r + 1) * 12 + (c + 1) % 12, (r + 1) * 12 + c]
        for r in range(6)
        for c in range(12)
    ]
    return Mesh(points + centre, np.array(quads, dtype=np.int32))


def together(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    polygons = [
        np.where(mesh.polygons < 0, -1, mesh.polygons + start)
        for mesh, start in zip(meshes, starts[:-1], strict=True)
    ]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(polygons).astype(np.int32),
    )


def test_eyes_meet_eyes_and_what_the_other_lacks_is_left_alone() -> None:
    template, mesh = toy_face(6.0), toy_face(7.0)
    eyes = [_ball(np.array([x, 35.0, 62.0]), 12.0) for x in (32.0, -32.0)]
    tooth = _ball(np.array([0.0, -50.0, 40.0]), 6.0)
    whole = together(template.mesh, *eyes)
    other = together(mesh.mesh, eyes[0], tooth)
    found = correspond(whole, other, QUICK, landmarks=marks(template, mesh))
    skin, balls = len(template.mesh.vertices), len(mesh.mesh.vertices)
    assert (found.corners[:balls][found.bound[:balls]] < skin).all()
    left = slice(balls, balls + len(eyes[0].vertices))
    assert found.bound[left].all()
    assert (found.corners[left] >= skin).all()
    assert (found.corners[left] < skin + len(eyes[0].vertices)).all()
    assert not found.bound[left.stop :].any()
    assert found.missing.sum() == len(eyes[1].vertices)


def test_a_mesh_that_cannot_be_placed_asks_for_landmarks() -> None:
    pebble = toy_face(9.0).mesh
    tiny = pebble.with_vertices(0.05 * pebble.vertices)
    with pytest.raises(SolveError, match=r"template: .*landmarks"):
        correspond(toy_face(9.0).mesh, tiny, QUICK)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"template\.steps = 1"):
        FitSettings(steps=1)


def _sheets(count: int) -> tuple[Floats, np.ndarray]:
    """Two sheets one on the other, joined along one side: a folded strip."""
    u = np.concatenate([np.arange(count), np.arange(count)[:-1][::-1]]) * 2.0
    points = np.array([[x, 0.0 if n < count else 1e-3, z] for n, x in enumerate(u) for z in (0, 2)])
    quads = [[2 * n, 2 * n + 1, 2 * n + 3, 2 * n + 2] for n in range(len(u) - 1)]
    return points, Mesh(points, np.array(quads, dtype=np.int32)).triangles


def test_torn_edges_are_counted_and_mended() -> None:
    points, triangles = _sheets(15)
    used, first = np.unique(triangles.ravel(), return_index=True)
    corners = triangles[first // 3].astype(np.int64)
    barycentric = np.eye(3)[first % 3]
    true = Bindings(
        corners=corners, barycentric=barycentric, bound=np.ones(len(points), dtype=np.bool_)
    )
    edges = TornEdges((points, triangles), (points, triangles))
    assert not edges.find(true).any()
    wrong = np.arange(len(points))
    patch = np.arange(4, 10)  # bound to what lies over it, far along the fold
    wrong[patch] = [
        int(np.flatnonzero((points[:, [0, 2]] == points[v][[0, 2]]).all(axis=1))[-1]) for v in patch
    ]
    assert (wrong[patch] != patch).all()
    torn = Bindings(corners=corners[wrong], barycentric=barycentric[wrong], bound=true.bound)
    assert edges.find(torn).sum() >= 4
    mended = edges.repaired(torn, 5.0)
    assert not edges.find(mended).any()
    places = np.einsum("nk,nkx->nx", mended.barycentric, points[mended.corners])
    assert np.linalg.norm(places - points, axis=1).max() < 1e-9
    assert len(used) == len(points)


def test_slits_are_found_with_their_sides() -> None:
    face = toy_face(5.0)
    slits = find_slits(face.mesh.vertices, face.mesh.triangles)
    assert len(slits) == 3
    mouth = slits[int(np.argmin([slit.centre[1] for slit in slits]))]
    upright = mouth if mouth.across[1] > 0.0 else mouth.turned()
    told = upright.side[face.lips != 0] != 0
    assert told.mean() > 0.9
    assert (upright.side * face.lips >= 0).all()
    bag = toy_face(5.0, bag=True)
    touching = [s for s in find_slits(bag.mesh.vertices, bag.mesh.triangles) if s.opening is None]
    assert len(touching) == 1
    sides = touching[0].side * bag.lips * (bag.depth < 8.0)
    assert (sides >= 0).all() or (sides <= 0).all()


def test_slits_of_two_meshes_are_matched_side_by_side() -> None:
    one, two = (find_slits(f.mesh.vertices, f.mesh.triangles) for f in (toy_face(5), toy_face(7)))
    pairs = match_slits(one, [slit.turned() for slit in two])
    assert len(pairs) == 3
    assert all(float(a.across @ b.across) > 0.0 for a, b in pairs)
    assert match_slits(one, []) == []


def test_loops_are_paired_by_arc_length_without_a_gap() -> None:
    rng = np.random.default_rng(0)
    for above, below in ((9, 5), (4, 11), (1, 3)):
        x = [np.sort(rng.uniform(0, 50, n)) for n in (above, below)]
        points = np.array([[v, 1.0, 0.0] for v in x[0]] + [[v, 0.0, 0.0] for v in x[1]])
        pairs = pair_loops(np.arange(above), above + np.arange(below), points)
        assert set(pairs[:, 0]) == set(range(above))
        assert set(pairs[:, 1]) == set(range(above, above + below))
        steps = np.diff(pairs, axis=0)
        assert ((steps == 0) | (steps == 1)).all()
        assert (steps.sum(axis=1) > 0).all()


def test_eyes_and_mouth_are_annotated_upper_first() -> None:
    face = toy_face(4.5)
    lids, lips = annotate_pairs(face.mesh.vertices, face.mesh.triangles)
    y = face.mesh.vertices[:, 1]
    assert (y[lids[:, 0]] > y[lids[:, 1]]).all()
    assert (face.side[lips[:, 0]] == 1).all()
    assert (face.side[lips[:, 1]] == -1).all()
    assert set(np.sign(face.flat[lids[:, 0], 0])) == {-1.0, 1.0}
    sheet, triangles = _sheets(4)
    assert [len(p) for p in annotate_pairs(sheet, triangles)] == [0, 0]
