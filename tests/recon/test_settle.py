"""Moving a mesh onto its points: against the literal form, to a known surface, across a fold."""

from __future__ import annotations

import numpy as np
import pytest

from capture.arrays import Floats32
from capture.errors import ShapeError
from recon.settle import openness, settled


def _sphere(rng: np.random.Generator, count: int, radius: float) -> tuple[Floats32, Floats32]:
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return (radius * directions).astype(np.float32), directions.astype(np.float32)


def _literally(
    vertices: Floats32, normals: Floats32, positions: Floats32, lines: Floats32, reach: float
) -> Floats32:
    out = vertices.astype(np.float64)
    for i, normal in enumerate(normals.astype(np.float64)):
        direction = normal
        for _ in range(2):
            away = out[i] - positions
            near = np.maximum(1.0 - (away**2).sum(axis=1) / reach**2, 0.0)
            alike = lines @ direction
            weight = np.where(alike >= 0.5, near**3 * alike, 0.0)
            if weight.sum() < 0.2:
                break
            mean = weight @ lines
            direction = mean / np.linalg.norm(mean)
            out[i] -= weight @ (away * lines).sum(axis=1) / weight.sum() * direction
    return out.astype(np.float32)


def test_agrees_with_the_literal_form() -> None:
    rng = np.random.default_rng(3)
    positions, lines = _sphere(rng, 4000, 10.0)
    positions += rng.normal(scale=0.05, size=positions.shape).astype(np.float32)
    vertices, normals = _sphere(rng, 200, 10.2)
    vertices[-1] *= 3.0  # with nothing near
    found = settled(vertices, normals, positions, lines, 1.3)
    expected = _literally(vertices, normals, positions, lines, 1.3)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.array_equal(found[-1], vertices[-1])
    assert found.tobytes() == settled(vertices, normals, positions, lines, 1.3).tobytes()


def test_a_shrunken_ball_grows_to_its_points() -> None:
    rng = np.random.default_rng(5)
    positions, lines = _sphere(rng, 6000, 8.0)
    vertices, normals = _sphere(rng, 300, 7.8)
    radius = np.linalg.norm(settled(vertices, normals, positions, lines, 1.0), axis=1)
    assert abs(radius - 8.0).max() < 0.03


def test_the_other_side_of_a_fold_does_not_pull() -> None:
    """Two sheets 0.3 mm apart that look away from each other: each vertex goes to its own."""
    grid = np.stack(np.meshgrid(np.arange(-5, 5, 0.2), np.arange(-5, 5, 0.2)), -1).reshape(-1, 2)
    up = np.tile(np.float32([0, 0, 1]), (len(grid), 1))
    front = np.concatenate([grid, np.full((len(grid), 1), 0.15)], axis=1).astype(np.float32)
    back = front * np.float32([1, 1, -1])
    inside = np.abs(grid).max(axis=1) < 4
    vertices = front[inside] - np.float32([0, 0, 0.1])
    found = settled(
        vertices, up[inside], np.concatenate([front, back]), np.concatenate([up, -up]), 1.0
    )
    np.testing.assert_allclose(found[:, 2], 0.15, atol=1e-5)


def test_without_points_all_stays() -> None:
    vertices = np.zeros((2, 3), np.float32)
    none = np.zeros((0, 3), np.float32)
    assert np.array_equal(settled(vertices, vertices, none, none, 1.0), vertices)


def test_shapes_are_checked() -> None:
    with pytest.raises(ShapeError, match="normals"):
        settled(
            np.zeros((2, 3), np.float32), np.zeros((3, 3), np.float32),
            np.zeros((4, 3), np.float32), np.zeros((4, 3), np.float32), 1.0,
        )  # fmt: skip


def test_openness_is_none_in_the_midst_two_by_pi_at_a_border_and_one_outside() -> None:
    rng = np.random.default_rng(7)
    flat = np.concatenate([rng.uniform([-6, -6], [0, 6], (20000, 2)), np.zeros((20000, 1))], axis=1)
    up = np.tile(np.float32([0, 0, 1]), (len(flat), 1))
    places = np.float32([[-3, 0, 0.1], [0, 0, 0.0], [1.9, 0, 0.0], [5, 0, 0.0], [-3, 0, 0.0]])
    normals = np.float32([[0, 0, 1]] * 4 + [[0, 0, -1]])
    found = openness(places, normals, flat.astype(np.float32), up, 2.0)
    assert found[0] < 0.05
    assert abs(found[1] - 2 / np.pi) < 0.03
    assert found[2] > 0.95
    assert found[3] == found[4] == 1.0  # no point within reach; none that looks the same way


def test_openness_agrees_with_the_literal_form() -> None:
    rng = np.random.default_rng(11)
    positions, lines = _sphere(rng, 3000, 10.0)
    vertices, normals = _sphere(rng, 50, 10.1)
    cut = positions[:, 0] < 5.0
    positions, lines = positions[cut], lines[cut]
    expected = []
    for vertex, normal in zip(vertices.astype(float), normals.astype(float), strict=True):
        away = positions - vertex
        away = away[(np.linalg.norm(away, axis=1) < 2.0) & (lines @ normal >= 0.5)]
        flat = away - (away @ normal)[:, None] * normal
        units = flat / np.linalg.norm(flat, axis=1, keepdims=True)
        expected.append(np.linalg.norm(units.mean(axis=0)) if len(units) else 1.0)
    found = openness(vertices, normals, positions, lines, 2.0)
    np.testing.assert_allclose(found, expected, atol=1e-5)
