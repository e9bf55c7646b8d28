"""The gradient operator and deformation gradients."""

import numpy as np
import pytest

from rig.gradient import components, deformation_gradients, gradient_operator
from tests.rig.grid_face import grid_template


def test_linear_functions_have_their_own_gradient_in_the_surface() -> None:
    mesh = grid_template().mesh
    slope = np.array([0.3, -1.2, 0.7])
    operator = gradient_operator(mesh.vertices, mesh.triangles)
    found = (operator @ (mesh.vertices @ slope)).reshape(-1, 3)
    corner = mesh.vertices[mesh.triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    unit = normal / (2 * area)[:, None]
    tangential = slope - (unit @ slope)[:, None] * unit
    assert found == pytest.approx(tangential * np.sqrt(area)[:, None], abs=1e-9)


def test_its_square_is_the_cotangent_laplacian() -> None:
    mesh = grid_template().mesh
    operator = gradient_operator(mesh.vertices, mesh.triangles)
    laplacian = (operator.T @ operator).toarray()
    expected = np.zeros_like(laplacian)
    for triangle in mesh.triangles:
        for k in range(3):
            i, j, o = triangle[k], triangle[(k + 1) % 3], triangle[(k + 2) % 3]
            a, b = mesh.vertices[i] - mesh.vertices[o], mesh.vertices[j] - mesh.vertices[o]
            half = 0.5 * (a @ b) / np.linalg.norm(np.cross(a, b))
            expected[[i, j], [j, i]] -= half
            expected[[i, j], [i, j]] += half
    assert np.abs(laplacian - expected).max() <= 1e-10


def test_its_square_is_the_deformers_laplacian() -> None:
    laplacian_module = pytest.importorskip("track.laplacian")
    mesh = grid_template().mesh
    operator = gradient_operator(mesh.vertices, mesh.triangles)
    other = laplacian_module.cotangent_laplacian(mesh.vertices, mesh.triangles, clip=False)
    assert np.abs((operator.T @ operator) - other).max() <= 1e-9


def test_triangles_without_area_do_nothing() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]], dtype=float)
    operator = gradient_operator(vertices, np.array([[0, 1, 2], [0, 1, 3]], dtype=np.int32))
    dense = operator.toarray()
    assert np.isfinite(dense).all()
    assert (dense[:3] == 0).all()


def test_deformation_gradients_of_a_linear_map_are_that_map_in_the_surface() -> None:
    mesh = grid_template().mesh
    linear = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.3, 1.2]])
    found = deformation_gradients(mesh.vertices, mesh.vertices @ linear.T, mesh.triangles)
    corner = mesh.vertices[mesh.triangles]
    for k in (1, 2):
        edge = corner[:, k] - corner[:, 0]
        assert np.einsum("tij,tj->ti", found, edge) == pytest.approx(edge @ linear.T, abs=1e-9)


def test_deformation_gradients_at_rest_are_exactly_the_identity() -> None:
    mesh = grid_template().mesh
    found = deformation_gradients(mesh.vertices, mesh.vertices, mesh.triangles)
    assert (found == np.eye(3)).all()


def test_components_are_counted_with_lone_vertices() -> None:
    triangles = np.array([[0, 1, 2], [4, 5, 6]], dtype=np.int32)
    labels = components(triangles, 7)
    assert len(set(labels.tolist())) == 3
    assert labels[0] == labels[2] != labels[4]
