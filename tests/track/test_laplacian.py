import numpy as np
import pytest

from capture.arrays import Floats, Ints32
from capture.errors import SettingsError, ShapeError
from track.laplacian import (
    Constraints,
    LaplacianDeformer,
    Stiffness,
    cotangent_laplacian,
    vertex_areas,
)


def grid(columns: int, rows: int, spacing_mm: float, bump_mm: float = 0.0) -> tuple[Floats, Ints32]:
    """A jittered sheet, spacing_mm between vertices, optionally with hills."""
    rng = np.random.default_rng(columns * 100 + rows)
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    flat = np.stack([x.ravel(), y.ravel()], 1).astype(np.float64)
    flat += rng.uniform(-0.2, 0.2, flat.shape)
    height = bump_mm * np.sin(flat[:, 0] * 0.7) * np.cos(flat[:, 1] * 0.5)
    vertices = np.concatenate([flat * spacing_mm, height[:, None]], axis=1)
    index = np.arange(columns * rows).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return vertices, triangles.astype(np.int32)


def rotation(axis: Floats, angle: float) -> Floats:
    axis = axis / np.linalg.norm(axis)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn: Floats = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    return turn


def constrain(
    vertices: Floats, triangles: Ints32, count: int, moved: Floats, seed: int = 0
) -> Constraints:
    """`count` random surface points of `vertices` that should go where `moved` has them."""
    rng = np.random.default_rng(seed)
    corners = triangles[rng.integers(0, len(triangles), count)]
    barycentric = rng.dirichlet([1.0, 1.0, 1.0], count)
    return Constraints(
        corners=corners,
        barycentric=barycentric,
        targets=np.einsum("nk,nkx->nx", barycentric, moved[corners]),
        weights=rng.uniform(0.2, 1.0, count),
    )


def boundary(triangles: Ints32) -> set[int]:
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, uses = np.unique(sides, axis=0, return_counts=True)
    return set(edges[uses == 1].ravel().tolist())


def test_linear_functions_have_no_laplacian_inside_a_flat_mesh() -> None:
    vertices, triangles = grid(12, 9, 3.0)
    laplacian = cotangent_laplacian(vertices, triangles, clip=False)
    linear = vertices @ np.array([0.3, -1.2, 0.0]) + 5.0
    inside = np.setdiff1d(np.arange(len(vertices)), list(boundary(triangles)))
    assert len(inside) == 10 * 7
    assert np.abs((laplacian @ linear)[inside]).max() < 1e-12
    assert np.abs(laplacian @ linear).max() > 0.1  # the border feels it


@pytest.mark.parametrize("clip", [True, False])
def test_laplacian_is_symmetric_semidefinite_with_constants_in_its_null_space(clip: bool) -> None:
    vertices, triangles = grid(9, 8, 2.0, bump_mm=4.0)
    dense = cotangent_laplacian(vertices, triangles, clip=clip).toarray()
    assert np.array_equal(dense, dense.T)
    assert np.abs(dense.sum(axis=1)).max() < 1e-12
    values = np.linalg.eigvalsh(dense)
    assert values[0] > -1e-12
    assert values[1] > 1e-3


def test_laplacian_does_not_change_with_the_unit() -> None:
    vertices, triangles = grid(6, 6, 2.0, bump_mm=3.0)
    one = cotangent_laplacian(vertices, triangles)
    other = cotangent_laplacian(vertices * 10.0, triangles)
    assert abs(one - other).max() < 1e-12


def test_degenerate_triangles_and_lone_vertices_stay_finite() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [7, 7, 7]], dtype=np.float64)
    triangles = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 3]], dtype=np.int32)
    laplacian = cotangent_laplacian(vertices, triangles)
    assert np.isfinite(laplacian.data).all()
    assert laplacian[[4]].nnz == 0 or abs(laplacian[[4]]).max() == 0.0
    assert vertex_areas(vertices, triangles)[4] == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_rigid_motion_of_the_constraints_is_reproduced(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, triangles = grid(15, 12, 3.0, bump_mm=5.0)
    turn = rotation(rng.normal(size=3), 0.4)
    moved = vertices @ turn.T + np.array([30.0, -12.0, 5.0])
    deformer = LaplacianDeformer(vertices, triangles, Stiffness(bending_mm=8.0, membrane_mm=3.0))
    found = deformer.solve(constrain(vertices, triangles, 60, moved, seed), start=vertices)
    assert np.abs(found - moved).max() < 1e-6


def test_quarter_turn_does_not_shrink() -> None:
    """Half the sheet stays, the other half is turned by 90 degrees about the line between them."""
    vertices, triangles = grid(41, 11, 2.0)
    middle = 40.0
    far = vertices[:, 0] > middle + 12.0
    near = vertices[:, 0] < middle - 12.0
    bent = vertices.copy()
    bent[far] = (vertices[far] - [middle, 0, 0]) @ rotation(np.array([0.0, 1.0, 0.0]), -np.pi / 2).T
    bent[far] += [middle, 0.0, 0.0]
    used = triangles[far[triangles].all(1) | near[triangles].all(1)]
    constraints = constrain(vertices, used, 600, bent)
    deformer = LaplacianDeformer(vertices, triangles, Stiffness(bending_mm=3.0, membrane_mm=2.0))
    found = deformer.solve(constraints, start=vertices, rotation_iterations=30)
    held = far | near
    assert np.abs(found - bent)[held].max() < 0.5
    before = np.linalg.norm(vertices[triangles[:, 0]] - vertices[triangles[:, 1]], axis=1)
    after = np.linalg.norm(found[triangles[:, 0]] - found[triangles[:, 1]], axis=1)
    clamped = used
    inside = np.linalg.norm(found[clamped[:, 0]] - found[clamped[:, 1]], axis=1)
    rest = np.linalg.norm(vertices[clamped[:, 0]] - vertices[clamped[:, 1]], axis=1)
    assert np.median(inside / rest) == pytest.approx(1.0, abs=0.01)
    assert after.sum() / before.sum() > 0.95


def test_whole_turn_by_90_degrees_with_sparse_constraints_keeps_size() -> None:
    vertices, triangles = grid(20, 20, 2.0, bump_mm=6.0)
    moved = vertices @ rotation(np.array([1.0, 1.0, 0.2]), np.pi / 2).T
    deformer = LaplacianDeformer(vertices, triangles, Stiffness(bending_mm=10.0))
    found = deformer.solve(constrain(vertices, triangles, 12, moved), start=vertices)
    assert np.linalg.norm(found - moved, axis=1).max() < 1e-5


def test_agrees_with_the_literal_dense_problem() -> None:
    """The energy of the docstring, stacked row by row and solved by dense least squares."""
    vertices, triangles = grid(8, 7, 3.0, bump_mm=3.0)
    count = len(vertices)
    rng = np.random.default_rng(5)
    start = vertices + rng.normal(0.0, 0.3, vertices.shape)
    constraints = constrain(vertices, triangles, 90, start)
    stiffness = Stiffness(bending_mm=5.0, membrane_mm=2.0)
    prior = rng.uniform(0.0, 0.1, count)
    deformer = LaplacianDeformer(vertices, triangles, stiffness)
    found = deformer.solve(
        constraints, start=start, data_weight=2.0, rotation_iterations=1, prior=prior
    )

    moved = _rigidly(constraints, start)
    turns = deformer._rotations(moved)
    laplacian = cotangent_laplacian(vertices, triangles).toarray()
    areas = np.maximum(vertex_areas(vertices, triangles), 0.0)
    areas = np.maximum(areas, 0.05 * areas.mean())
    bend = np.sqrt(stiffness.bending_mm**4 / areas.sum() / areas)[:, None]
    rows = [bend * laplacian]
    right = [bend * np.einsum("vxy,vy->vx", turns, laplacian @ vertices)]
    for i in range(count):
        for j in range(i + 1, count):
            if laplacian[i, j]:
                root = np.sqrt(-laplacian[i, j] * stiffness.membrane_mm**2 / areas.sum())
                row = np.zeros(count)
                row[i], row[j] = root, -root
                edge = 0.5 * (turns[i] + turns[j]) @ (vertices[i] - vertices[j])
                rows.append(row[None])
                right.append(root * edge[None])
    lift = np.zeros((90, count))
    for k in range(3):
        lift[np.arange(90), constraints.corners[:, k]] = constraints.barycentric[:, k]
    quality = np.sqrt(2.0 / 90 * constraints.weights)[:, None]
    hold = np.sqrt(1e-9 * areas / areas.sum())[:, None]
    pull = np.sqrt(prior * areas / areas.sum())[:, None]
    rows += [quality * lift, hold * np.eye(count), pull * np.eye(count)]
    right += [quality * constraints.targets, hold * moved, pull * start]
    want = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    assert np.abs(found - want).max() < 1e-9


def _rigidly(constraints: Constraints, start: Floats) -> Floats:
    from track.rigid import fit_similarity

    motion = fit_similarity(constraints.points(start), constraints.targets, constraints.weights)
    return motion.apply(start)


def test_weights_do_not_depend_on_the_resolution() -> None:
    """The same dent in the same cloth of two resolutions comes out the same."""
    dents = []
    for spacing in (2.0, 1.0):
        side = int(60 / spacing) + 1
        vertices, triangles = grid(side, side, spacing)
        target = vertices.copy()
        away = np.linalg.norm(vertices[:, :2] - 30.0, axis=1)
        target[:, 2] = 5.0 * np.exp(-0.5 * (away / 4.0) ** 2)
        constraints = constrain(vertices, triangles, 12000, target)
        constraints.weights[:] = 1.0
        deformer = LaplacianDeformer(vertices, triangles, Stiffness(bending_mm=4.0))
        found = deformer.solve(constraints, start=vertices)
        dents.append(float(found[np.argmin(away), 2]))
    assert dents[0] == pytest.approx(dents[1], rel=0.05)
    assert dents[0] < 4.0  # the stiffness does smooth it


def test_components_without_constraints_follow_the_rigid_motion() -> None:
    vertices, triangles = grid(8, 8, 3.0, bump_mm=3.0)
    both = np.concatenate([vertices, vertices + [0.0, 0.0, 20.0], [[5.0, 5.0, 40.0]]])
    doubled = np.concatenate([triangles, triangles + len(vertices)])
    turn = rotation(np.array([0.2, 1.0, 0.0]), 0.5)
    moved = both @ turn.T + [5.0, 0.0, 0.0]
    constraints = constrain(both, triangles, 50, moved)
    found = LaplacianDeformer(both, doubled).solve(constraints, start=both)
    assert np.abs(found - moved).max() < 1e-6


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_constraints_are_not_singular(count: int) -> None:
    vertices, triangles = grid(6, 6, 3.0, bump_mm=2.0)
    moved = vertices + [1.0, 2.0, 3.0]
    constraints = constrain(vertices, triangles, count, moved)
    found = LaplacianDeformer(vertices, triangles).solve(constraints, start=vertices)
    assert np.isfinite(found).all()
    want = vertices if count == 0 else moved
    assert np.abs(found - want).max() < 0.05


def test_prior_holds_vertices() -> None:
    vertices, triangles = grid(10, 10, 3.0)
    constraints = constrain(vertices, triangles[:20], 40, vertices + [0.0, 0.0, 4.0])
    deformer = LaplacianDeformer(vertices, triangles, Stiffness(bending_mm=5.0))
    prior = np.where(vertices[:, 1] > 20.0, 1e4, 0.0)
    found = deformer.solve(constraints, start=vertices, prior=prior)
    assert np.abs(found - vertices)[prior > 0].max() < 0.05
    assert found[:15, 2].mean() > 3.0


def test_vertex_stiffness_resists_locally() -> None:
    vertices, triangles = grid(20, 10, 2.0)
    noisy = vertices + [0.0, 0.0, 1.0] * np.random.default_rng(0).normal(size=(200, 1))
    constraints = constrain(vertices, triangles, 1500, noisy)
    left = vertices[:, 0] < 20.0
    deformer = LaplacianDeformer(
        vertices,
        triangles,
        Stiffness(bending_mm=1.0),
        vertex_stiffness=np.where(left, 1e4, 1.0),
    )
    found = deformer.solve(constraints, start=vertices)
    assert found[left, 2].std() < 0.5 * found[~left, 2].std()


def test_same_input_gives_the_same_bytes() -> None:
    vertices, triangles = grid(12, 12, 2.0, bump_mm=2.0)
    moved = vertices + np.random.default_rng(1).normal(0, 0.2, vertices.shape)
    answers = [
        LaplacianDeformer(vertices, triangles, Stiffness(membrane_mm=1.0))
        .solve(constrain(vertices, triangles, 500, moved), start=vertices)
        .tobytes()
        for _ in range(2)
    ]
    assert answers[0] == answers[1]


def test_refusals() -> None:
    vertices, triangles = grid(4, 4, 1.0)
    deformer = LaplacianDeformer(vertices, triangles)
    good = constrain(vertices, triangles, 5, vertices)
    with pytest.raises(ShapeError, match=r"corners: vertices must lie in 0\.\.15, found .*\.\.99"):
        deformer.solve(
            Constraints(
                corners=np.full((1, 3), 99),
                barycentric=np.full((1, 3), 1 / 3),
                targets=np.zeros((1, 3)),
                weights=np.ones(1),
            ),
            start=vertices,
        )
    with pytest.raises(ShapeError, match="start: expected shape"):
        deformer.solve(good, start=vertices[:-1])
    with pytest.raises(SettingsError, match="data_weight: expected >= 0, found -1"):
        deformer.solve(good, start=vertices, data_weight=-1.0)
    with pytest.raises(SettingsError, match="rotation_iterations"):
        deformer.solve(good, start=vertices, rotation_iterations=0)
    with pytest.raises(ShapeError, match="weights: expected >= 0, found -1"):
        Constraints(
            corners=good.corners,
            barycentric=good.barycentric,
            targets=good.targets,
            weights=-np.ones(5),
        )
    with pytest.raises(SettingsError, match="found both 0"):
        Stiffness(bending_mm=0.0)
    with pytest.raises(SettingsError, match="bending_mm: expected 0 <= bending_mm"):
        Stiffness(bending_mm=-1.0)
    with pytest.raises(ShapeError, match=r"triangles: indices must lie in 0\.\.3"):
        cotangent_laplacian(vertices[:4], triangles)


def test_bending_from_another_shape_keeps_what_that_shape_has() -> None:
    """A bump the surface already has, held nowhere, stays; from rest it is smoothed away."""
    from tests.track.moving_patch import patch_mesh

    mesh = patch_mesh()
    bump = 3.0 * np.exp(-(mesh.vertices[:, 0] ** 2 + mesh.vertices[:, 1] ** 2) / 60.0)
    shape = mesh.vertices + bump[:, None] * [0.0, 0.0, 1.0]
    border = np.flatnonzero(bump < 0.01)
    constraints = Constraints(
        corners=np.repeat(border[:, None], 3, axis=1),
        barycentric=np.tile([1.0, 0.0, 0.0], (len(border), 1)),
        targets=shape[border],
        weights=np.ones(len(border)),
    )
    deformer = LaplacianDeformer(mesh.vertices, mesh.triangles, Stiffness(bending_mm=2.0))
    every = np.ones(len(shape))
    kept = deformer.solve(constraints, start=shape, about=(shape, every))
    smoothed = deformer.solve(constraints, start=shape)
    half = deformer.solve(constraints, start=shape, about=(shape, 0.5 * every))
    assert np.abs(kept - shape).max() < 1e-6  # mm
    assert np.abs(smoothed - shape).max() > 2.0
    assert 0.5 < np.abs(half - shape).max() < np.abs(smoothed - shape).max()
