"""Templates carried onto meshes of other topology, against shapes that are known there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.arrays import Floats
from capture.errors import InputError, SettingsError
from recon.mesh import Mesh
from rig.correspondence import Correspondence, correspond
from rig.retopology import (
    RetopologySettings,
    carry_template,
    check_face,
    retopologise,
    retopology_report,
    sample_template,
)
from rig.template import Template
from rig.transfer import virtual_triangles
from tests.rig.test_correspondence import MISPLACED, QUICK, marks, moved, together
from tests.rig.toy_face import NAMES, ToyFace, toy_face

ICT = Path("../shared/data/ict/ict_light.npz")
STEPS = RetopologySettings(steps=6)


@pytest.fixture(scope="module")
def faces() -> tuple[ToyFace, ToyFace]:
    return toy_face(4.5), toy_face(5.5, slant=1)


@pytest.fixture(scope="module")
def found(faces: tuple[ToyFace, ToyFace]) -> Correspondence:
    template, mesh = faces
    return correspond(template.mesh, moved(mesh), QUICK, landmarks=marks(template, mesh))


def shape_errors(deltas: Floats, truth: Floats) -> Floats:
    """(B,) rms error of each shape over the shape's own rms."""
    return np.sqrt(((deltas - truth) ** 2).sum(axis=(1, 2)) / (truth**2).sum(axis=(1, 2)))


@pytest.mark.parametrize("method", ["gradient", "rbf"])
def test_shapes_come_out_as_they_are_on_the_other_topology(
    method: str, faces: tuple[ToyFace, ToyFace], found: Correspondence
) -> None:
    template, mesh = faces
    settings = RetopologySettings(transfer=method)  # type: ignore[arg-type]
    carried = carry_template(template.template(), moved(mesh), found, settings)
    truth = MISPLACED.scale * mesh.deltas @ MISPLACED.rotation.T
    assert shape_errors(carried.deltas, truth).max() < 0.05
    assert carried.names == NAMES
    assert carried.neutral.tobytes() == moved(mesh).vertices.tobytes()
    still = np.abs(mesh.deltas[0]).max(axis=1) == 0.0
    apart = np.abs(carried.deltas[0][still & (mesh.lips == 1)])
    assert apart.max() < 0.02  # the upper lip does not follow the jaw
    assert (carried.deltas[0][mesh.flat[:, 1] > 40.0] == 0.0).all()
    top = mesh.flat[:, 1] > 82.0
    assert np.isin(np.flatnonzero(top), carried.rigid_vertices).all()
    assert not np.isin(np.flatnonzero(mesh.flat[:, 1] < 70.0), carried.rigid_vertices).any()


def test_pairs_are_those_of_the_meshs_own_eyes_and_mouth(
    faces: tuple[ToyFace, ToyFace], found: Correspondence
) -> None:
    template, mesh = faces
    bare = sample_template(template.template(), moved(mesh), found)
    lids, lips = bare.lid_pairs, bare.lip_pairs
    assert (mesh.side[lips[:, 0]] == 1).all()
    assert (mesh.side[lips[:, 1]] == -1).all()
    own = sample_template(template.template(), template.mesh, _itself(template))
    annotated = replace(template.template(), lid_pairs=own.lid_pairs, lip_pairs=own.lip_pairs)
    carried = sample_template(annotated, moved(mesh), found)
    assert set(map(tuple, carried.lid_pairs.tolist())) == set(map(tuple, lids.tolist()))
    assert set(map(tuple, carried.lip_pairs.tolist())) == set(map(tuple, lips.tolist()))
    assert len(virtual_triangles(carried)) >= len(lids) - 2


def _itself(face: ToyFace) -> Correspondence:
    return correspond(face.mesh, face.mesh, QUICK, landmarks=marks(face, face))


def test_pairs_are_walked_along_a_mouth_that_is_no_hole() -> None:
    template, mesh = toy_face(5.0), toy_face(4.0, bag=True)
    own = sample_template(template.template(), template.mesh, _itself(template))
    annotated = replace(template.template(), lip_pairs=own.lip_pairs)
    found = correspond(template.mesh, mesh.mesh, QUICK, landmarks=marks(template, mesh))
    lips = sample_template(annotated, mesh.mesh, found).lip_pairs
    assert len(lips) >= 7
    assert (mesh.lips[lips[:, 0]] == 1).all()
    assert (mesh.lips[lips[:, 1]] == -1).all()


def test_what_has_no_place_follows_near_by_and_is_still_far_away(
    faces: tuple[ToyFace, ToyFace], found: Correspondence
) -> None:
    template, mesh = faces
    known = found.bound & (mesh.flat[:, 1] > -60.0) & (np.abs(mesh.flat[:, 0]) < 70.0)
    part = replace(found, bound=known)
    carried = carry_template(template.template(), moved(mesh), part)
    jaw = np.linalg.norm(carried.deltas[0], axis=1)
    below = (np.abs(mesh.flat[:, 0]) < 10.0) & (mesh.flat[:, 1] < -60.0)
    assert 0.5 < jaw[below & (mesh.flat[:, 1] > -68.0)].max() < 9.5
    whole = carry_template(template.template(), moved(mesh), found)
    assert jaw.max() < 1.1 * np.linalg.norm(whole.deltas[0], axis=1).max()
    assert (carried.deltas[0][mesh.flat[:, 1] < -93.0] == 0.0).all()


def test_parts_without_a_partner_have_no_motion_and_are_told() -> None:
    template, mesh = toy_face(6.0), toy_face(7.0)
    loose = Mesh(
        np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0.0], [9, 9, 4]]) + [20.0, -70.0, 20.0],
        np.array([[0, 1, 3, 2]], dtype=np.int32),
    )
    whole = template.template()
    tongue = Template(
        neutral=np.concatenate([whole.neutral, loose.vertices + [0.0, 300.0, -300.0]]),
        deltas=np.concatenate(
            [
                np.concatenate([whole.deltas, np.zeros((6, 4, 3))], axis=1),
                np.concatenate([np.zeros((1, len(whole.neutral), 3)), np.ones((1, 4, 3))], axis=1),
            ]
        ),
        names=(*whole.names, "tongueOut"),
        polygons=together(whole.mesh, loose).polygons,
    )
    target = together(mesh.mesh, loose)
    found = correspond(tongue.mesh, target, QUICK, landmarks=marks(template, mesh))
    carried = carry_template(tongue, target, found)
    told = retopology_report(tongue, target, found, carried)
    assert (carried.deltas[:, -4:] == 0.0).all()
    assert told["mesh_components_without_motion"] == 1
    assert told["template_components_skipped"] == 1
    assert told["shapes_skipped"] == ["tongueOut"]
    assert told["unbound"] >= 4


def test_a_mesh_in_other_units_or_without_polygons_is_refused() -> None:
    mesh = toy_face(9.0).mesh
    with pytest.raises(InputError, match=r"metres: multiply its vertices by 1000"):
        check_face(mesh.with_vertices(0.001 * mesh.vertices))
    with pytest.raises(InputError, match="no polygons"):
        retopologise(toy_face(9.0).template(), Mesh(mesh.vertices, mesh.polygons[:0]))
    with pytest.raises(SettingsError, match="expected gradient or rbf"):
        RetopologySettings(transfer="magic")  # type: ignore[arg-type]


@pytest.mark.shared_data
def test_the_ict_face_keeps_its_shapes_on_another_topology() -> None:
    from tools.make_template import ict_template

    whole = ict_template(ICT, 6706)
    kept = [whole.names.index(name) for name in ("jawOpen", "eyeBlink_L", "mouthSmile_L")]
    template = replace(whole, deltas=whole.deltas[kept], names=tuple(np.array(whole.names)[kept]))
    corners, shares, triangles = _remeshed(template.mesh)
    surface = np.einsum("uk,ukx->ux", shares, template.neutral[corners])
    mesh = Mesh(MISPLACED.apply(surface), triangles)
    known = np.flatnonzero(shares[:, 0] == 1.0)[:: len(shares) // 20]
    pairs = np.stack([corners[known, 0], known], axis=1)
    carried = retopologise(template, mesh, STEPS, landmarks=pairs)
    truth = np.einsum("uk,bukx->bux", shares, template.deltas[:, corners])
    truth = MISPLACED.scale * truth @ MISPLACED.rotation.T
    assert shape_errors(carried.deltas, truth).max() < 0.05


def _remeshed(mesh: Mesh) -> tuple[np.ndarray, Floats, np.ndarray]:
    """Half the triangles split at a random point, vertices in another order."""
    rng = np.random.default_rng(5)
    count = len(mesh.vertices)
    split = rng.random(len(mesh.triangles)) < 0.5
    a, b, c = mesh.triangles[split].T
    new = count + np.arange(len(a))
    corners = np.concatenate([np.repeat(np.arange(count)[:, None], 3, axis=1), np.c_[a, b, c]])
    shares = np.concatenate([np.tile([1.0, 0, 0], (count, 1)), rng.dirichlet([3, 3, 3], len(a))])
    triangles = np.concatenate(
        [mesh.triangles[~split], np.c_[a, b, new], np.c_[b, c, new], np.c_[c, a, new]]
    )
    order = rng.permutation(len(corners))
    return corners[order], shares[order], np.argsort(order)[triangles].astype(np.int32)
