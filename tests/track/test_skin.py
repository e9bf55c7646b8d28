"""Heights of the skin over the neutral: a known offset is read off, what is far is not."""

import numpy as np

from tests.track.moving_patch import patch_mesh
from track.skin import skin_heights


def test_a_known_offset_is_recovered() -> None:
    fine = patch_mesh(side=60)
    mesh = patch_mesh()
    moved = mesh.vertices - 0.4 * mesh.normals()
    height = skin_heights(
        moved, mesh.triangles, (fine.vertices.astype(np.float32), fine.triangles), 1.0
    )
    inner = np.abs(mesh.vertices[:, :2]).max(axis=1) < 35.0
    assert np.abs(height[inner] - 0.4).max() < 0.2  # mm: the nose is coarser in the mesh
    assert np.median(np.abs(height[inner] - 0.4)) < 0.05


def test_what_is_far_or_missing_has_no_height() -> None:
    mesh = patch_mesh()
    far = (mesh.vertices + [0.0, 0.0, 5.0]).astype(np.float32)
    assert (skin_heights(mesh.vertices, mesh.triangles, (far, mesh.triangles), 1.0) == 0).all()
    half = mesh.triangles[mesh.vertices[mesh.triangles].mean(axis=1)[:, 0] < 0]
    scan = (mesh.vertices + 0.3 * mesh.normals()).astype(np.float32)
    height = skin_heights(mesh.vertices, mesh.triangles, (scan, half), 1.0)
    x = mesh.vertices[:, 0]
    assert (height[x > 15] == 0).all()
    assert np.median(height[x < -10]) > 0.2
