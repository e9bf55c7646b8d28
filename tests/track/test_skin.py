"""Heights of the skin over the neutral: a known offset is read off, what is far is not."""

import numpy as np

from capture.arrays import Ints32
from recon.mesh import Mesh
from recon.surface import Scan
from tests.track.moving_patch import patch_mesh
from track.skin import skin_heights


def _scan(mesh: Mesh, offset_mm: float = 0.0, triangles: Ints32 | None = None) -> Scan:
    normals = mesh.normals()
    return Scan(
        (mesh.vertices + offset_mm * normals).astype(np.float32),
        mesh.triangles if triangles is None else triangles,
        normals.astype(np.float32),
        np.ones(len(mesh.vertices), np.float32),
    )


def test_a_known_offset_is_recovered() -> None:
    mesh = patch_mesh()
    moved = mesh.vertices - 0.4 * mesh.normals()
    height = skin_heights(moved, mesh.triangles, _scan(patch_mesh(side=60)), 1.0)
    inner = np.abs(mesh.vertices[:, :2]).max(axis=1) < 35.0
    assert np.abs(height[inner] - 0.4).max() < 0.25  # mm: what the mesh cuts off its nose
    assert np.median(np.abs(height[inner] - 0.4)) < 0.05


def test_what_is_far_or_missing_has_no_height() -> None:
    mesh = patch_mesh()
    assert (skin_heights(mesh.vertices, mesh.triangles, _scan(mesh, 5.0), 1.0) == 0).all()
    fine = patch_mesh(side=60)
    left = Mesh(fine.vertices[fine.vertices[:, 0] < 0], np.empty((0, 3), np.int32))
    scan = Scan(
        (left.vertices + [0.0, 0.0, 0.3]).astype(np.float32),
        left.polygons,
        np.tile(np.array([0, 0, 1], np.float32), (len(left.vertices), 1)),
        np.ones(len(left.vertices), np.float32),
    )
    height = skin_heights(mesh.vertices, mesh.triangles, scan, 1.0)
    x = mesh.vertices[:, 0]
    assert (height[x > 15] == 0).all()
    assert np.median(height[x < -10]) > 0.2


def test_skin_that_looks_the_other_way_has_no_height() -> None:
    mesh = patch_mesh()
    front = _scan(mesh, 0.3)
    back = Scan(front.vertices, front.triangles[:, ::-1], -front.normals, front.confidence)
    assert (skin_heights(mesh.vertices, mesh.triangles, back, 1.0) == 0).all()
