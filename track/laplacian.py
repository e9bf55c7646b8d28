"""Laplacian deformation of a mesh under barycentric constraints (Ma et al. 2016, Eq. 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import SuperLU, splu

from capture.arrays import Floats, Ints, Ints32, check_finite, check_shape
from capture.errors import SettingsError, ShapeError, SolveError
from track.rigid import Similarity, fit_similarity, nearest_rotations

_COTANGENTS = (0.01, 20.0)  # no edge lets go, and no sliver (2.9 degrees) outweighs the rest
_HOLD = 1e-9  # pull to the start that keeps a constrained component regular
_HOLD_FREE = 1e-3  # the same for a component that no constraint touches


@dataclass(frozen=True, eq=False, kw_only=True)
class Constraints:
    """Points of the surface and where they should go.

    Attributes:
        corners: (N, 3) vertex indices of the triangle that holds each point.
        barycentric: (N, 3) weights of the corners; rows sum to 1 (they may lie outside 0..1).
        targets: (N, 3) world mm.
        weights: (N,) non-negative quality; 0 drops the constraint.
    """

    corners: Ints | Ints32
    barycentric: Floats
    targets: Floats
    weights: Floats

    def __post_init__(self) -> None:
        check_shape(
            corners=(self.corners, "N 3"),
            barycentric=(self.barycentric, "N 3"),
            targets=(self.targets, "N 3"),
            weights=(self.weights, "N"),
        )
        check_finite(barycentric=self.barycentric, targets=self.targets, weights=self.weights)
        if self.weights.size and float(self.weights.min()) < 0.0:
            raise ShapeError(f"weights: expected >= 0, found {float(self.weights.min()):g}")

    @classmethod
    def joined(cls, parts: Sequence[Constraints]) -> Constraints:
        """Several sets, at least one, as one."""
        return cls(
            corners=np.concatenate([part.corners for part in parts]),
            barycentric=np.concatenate([part.barycentric for part in parts]),
            targets=np.concatenate([part.targets for part in parts]),
            weights=np.concatenate([part.weights for part in parts]),
        )

    def points(self, vertices: Floats) -> Floats:
        """Where the constrained points (N, 3) are on a surface with vertices (V, 3)."""
        found: Floats = np.einsum("nk,nkx->nx", self.barycentric, vertices[self.corners])
        return found


@dataclass(frozen=True, kw_only=True)
class Stiffness:
    """How the surface resists, as lengths: independent of the mesh's resolution.

    With dense constraints of data weight 1, a wave of the displacement with wavenumber k (radians
    per mm) keeps the share 1 / (1 + (bending_mm k)^4 + (membrane_mm k)^2) of itself: waves shorter
    than about 2 pi times these lengths are smoothed away.

    Attributes:
        bending_mm: length of the bi-Laplacian term.
        membrane_mm: length of the as-rigid-as-possible membrane term; 0 leaves it out.
    """

    bending_mm: float = 4.0
    membrane_mm: float = 0.0

    def __post_init__(self) -> None:
        for name in ("bending_mm", "membrane_mm"):
            value = getattr(self, name)
            if not 0.0 <= value < 1e4:
                raise SettingsError(f"{name}: expected 0 <= {name} < 10000, found {value}")
        if self.bending_mm == 0.0 and self.membrane_mm == 0.0:
            raise SettingsError("bending_mm, membrane_mm: expected one above 0, found both 0")


def cotangent_laplacian(
    vertices: Floats, triangles: Ints32, *, clip: bool = True
) -> sparse.csr_matrix:
    """Assemble the positive semi-definite, mass-free cotangent Laplacian of a triangle mesh.

    Row v of L p is the area-integrated Laplacian of p at v, with natural boundary conditions;
    constants are in its null space, and a vertex that no triangle uses has an empty row.

    Args:
        vertices: (V, 3) mm.
        triangles: (T, 3) vertex indices.
        clip: force cotangents into 0.01..20, as quads of production meshes with their obtuse
            halves and slivers need. Without it L is exact for linear functions, and semi-definite
            all the same.

    Returns:
        (V, V) csr, dimensionless.

    Raises:
        ShapeError: when shapes do not fit or an index has no vertex.

    References:
        Pinkall and Polthier 1993, "Computing discrete minimal surfaces and their conjugates".
        Botsch and Sorkine 2008, "On linear variational surface deformation methods", Sec. 3.
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    check_finite(vertices=vertices)
    count = len(vertices)
    if len(triangles) and not 0 <= int(triangles.min()) <= int(triangles.max()) < count:
        raise ShapeError(f"triangles: indices must lie in 0..{count - 1}")
    rows, columns, values = [], [], []
    for k in range(3):
        apex, i, j = triangles[:, k], triangles[:, (k + 1) % 3], triangles[:, (k + 2) % 3]
        one, two = vertices[i] - vertices[apex], vertices[j] - vertices[apex]
        area = np.linalg.norm(np.cross(one, two), axis=1)
        dot = np.einsum("tx,tx->t", one, two)
        cotangent = np.divide(dot, area, out=np.zeros_like(dot), where=area > 0.0)
        if clip:
            cotangent = np.clip(cotangent, *_COTANGENTS)
        rows += [i, j]
        columns += [j, i]
        values += [0.5 * cotangent, 0.5 * cotangent]
    edges = sparse.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (count, count)
    )
    return sparse.csr_matrix(sparse.diags(np.asarray(edges.sum(axis=1)).ravel()) - edges)


def vertex_areas(vertices: Floats, triangles: Ints32) -> Floats:
    """The lumped area (V,) of each vertex, mm^2: a third of its triangles; 0 where it has none."""
    corner = vertices[triangles]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    share = np.repeat(area / 6.0, 3)
    return np.bincount(triangles.ravel(), share, minlength=len(vertices)).astype(np.float64)


class LaplacianDeformer:
    """Deforms a rest mesh to meet barycentric constraints, keeping its differential coordinates.

    Minimises, with areas m_v, total area A, N constraints, lengths b and s of the stiffness,

        b^4/A sum_v |(L p)_v - R_v (L p0)_v|^2 / m_v                          (bending)
      + s^2/A sum_ij w_ij |(p_i - p_j) - (R_i + R_j)/2 (p0_i - p0_j)|^2        (membrane)
      + data_weight/N sum_n weights_n |(B p)_n - c_n|^2 + 1/A sum_v prior_v m_v |p_v - start_v|^2

    so that every term is a mean of squared mm. The first and the third are Eq. 1 of Ma et al.;
    R_v, the rotation of v's neighbourhood, is estimated from the current solution and the system,
    which does not depend on it, is factored once a solve.

    References:
        Ma et al. 2016, "Semantically-aware blendshape rigs from facial performance measurements",
        Sec. 2.2 Eq. 1. Botsch and Sorkine 2008. Sorkine and Alexa 2007, "As-rigid-as-possible
        surface modeling", Eqs. 3-9.
    """

    def __init__(
        self,
        rest: Floats,
        triangles: Ints32,
        stiffness: Stiffness | None = None,
        *,
        vertex_stiffness: Floats | None = None,
    ) -> None:
        """Assemble the terms that do not depend on constraints.

        Args:
            rest: (V, 3) rest vertices, mm.
            triangles: (T, 3).
            stiffness: lengths of the two terms.
            vertex_stiffness: (V,) positive factors on both terms, vertex by vertex.
        """
        stiff = np.ones(len(rest)) if vertex_stiffness is None else vertex_stiffness
        check_shape(rest=(rest, "V 3"), vertex_stiffness=(stiff, "V"))
        lengths = stiffness or Stiffness()
        laplacian = cotangent_laplacian(rest, triangles)
        area = vertex_areas(rest, triangles)
        mean = float(area[area > 0].mean()) if (area > 0).any() else 1.0
        area = np.maximum(area, 0.05 * mean)
        self._rest = rest
        self._share = area / area.sum()
        edges = sparse.coo_matrix(sparse.triu(laplacian, 1))
        self._i, self._j, self._w = edges.row, edges.col, -edges.data
        self._edge = rest[self._i] - rest[self._j]
        self._smooth = _averaging(len(rest), self._i, self._j)
        _, self._component = csgraph.connected_components(laplacian, directed=False)
        total = float(area.sum())
        scale = lengths.bending_mm**4 / total
        self._bending = sparse.csr_matrix(laplacian @ sparse.diags(scale * stiff / area))
        self._laplacian, self._delta = laplacian, laplacian @ rest
        self._soft = lengths.membrane_mm**2 / total * self._w * 0.5
        self._soft *= stiff[self._i] + stiff[self._j]
        membrane = _edge_laplacian(len(rest), self._i, self._j, self._soft)
        self._system = sparse.csc_matrix(self._bending @ laplacian + membrane)

    def solve(
        self,
        constraints: Constraints,
        *,
        start: Floats,
        data_weight: float = 1.0,
        rotation_iterations: int = 2,
        prior: Floats | None = None,
        about: tuple[Floats, Floats] | None = None,
    ) -> Floats:
        """Solve for the vertices that meet the constraints (Ma et al. 2016, Eq. 1).

        The rotations start from `start` moved by the constraints' own best rigid motion, so a
        rigid motion of the targets is reproduced exactly. A component without constraints follows
        that motion.

        Args:
            constraints: what to meet.
            start: (V, 3) the current vertices, mm.
            data_weight: lambda of Eq. 1.
            rotation_iterations: how often rotations are estimated and the system is solved, >= 1.
            prior: (V,) non-negative weights that pull vertices to `start`; None for no pull.
            about: another shape (V, 3), mm, that the surface bends from instead of its rest, and
                the share (V,) 0..1 that this one has. What the surface has already left its rest by
                is then not smoothed away. None: the rest.

        Returns:
            (V, 3) vertices, mm.

        Raises:
            ShapeError: when shapes do not agree or a constraint names an unknown vertex.
            SettingsError: when data_weight or rotation_iterations is out of range.
            SolveError: when the system cannot be factored.
        """
        self._check(constraints, start, data_weight, rotation_iterations)
        moved = _rigid_part(constraints, start).apply(start)
        pull = np.zeros(len(start)) if prior is None else prior
        check_shape(start=(start, "V 3"), prior=(pull, "V"))
        if about is not None:
            check_shape(start=(start, "V 3"), about=(about[0], "V 3"), share=(about[1], "V"))
        hold = self._share * self._hold(constraints, pull)
        pull = self._share * pull
        count = max(len(constraints.weights), 1)
        scatter = _scatter(constraints, len(start))
        weighted = scatter.T @ sparse.diags(data_weight / count * constraints.weights)
        solver = _factor(self._system + weighted @ scatter + sparse.diags(hold + pull))
        fixed = weighted @ constraints.targets + hold[:, None] * moved + pull[:, None] * start
        vertices = moved
        for _ in range(rotation_iterations):
            resting = self._resting(vertices, about)
            vertices = solver.solve(np.ascontiguousarray(fixed + resting))
        if not np.isfinite(vertices).all():
            raise SolveError(f"Laplacian deformation of {len(start)} vertices: not finite")
        return vertices

    def _check(
        self, constraints: Constraints, start: Floats, data_weight: float, iterations: int
    ) -> None:
        check_shape(rest=(self._rest, "V 3"), start=(start, "V 3"))
        check_finite(start=start)
        corners = constraints.corners
        if corners.size and not 0 <= int(corners.min()) <= int(corners.max()) < len(start):
            raise ShapeError(
                f"corners: vertices must lie in 0..{len(start) - 1}, "
                f"found {int(corners.min())}..{int(corners.max())}"
            )
        if not data_weight >= 0.0 or not np.isfinite(data_weight):
            raise SettingsError(f"data_weight: expected >= 0, found {data_weight}")
        if iterations < 1:
            raise SettingsError(f"rotation_iterations: expected >= 1, found {iterations}")

    def _hold(self, constraints: Constraints, prior: Floats) -> Floats:
        """The pull (V,) to the start that makes every component regular."""
        count = int(self._component.max()) + 1
        weights = np.repeat(constraints.weights, 3) * (constraints.barycentric.ravel() != 0.0)
        touched = np.concatenate([self._component[constraints.corners.ravel()], self._component])
        held = np.bincount(touched, np.concatenate([weights, prior]), minlength=count)
        return np.where(held > 0.0, _HOLD, _HOLD_FREE)[self._component]

    def _rotations(self, vertices: Floats, edge: Floats | None = None) -> Floats:
        """Rotations (V, 3, 3) of the neighbourhoods to `vertices`, from rest or these edges."""
        rest = self._edge if edge is None else edge
        now = vertices[self._i] - vertices[self._j]
        product = self._w[:, None, None] * now[:, :, None] * rest[:, None, :]
        flat = product.reshape(-1, 9)
        total = np.stack(
            [
                np.bincount(self._i, column, minlength=len(vertices))
                + np.bincount(self._j, column, minlength=len(vertices))
                for column in flat.T
            ],
            axis=1,
        )
        return nearest_rotations((self._smooth @ total).reshape(-1, 3, 3))

    def _resting(self, vertices: Floats, about: tuple[Floats, Floats] | None) -> Floats:
        """The right-hand side (V, 3) of the two stiffness terms."""
        rotations = self._rotations(vertices)
        turned = np.einsum("vxy,vy->vx", rotations, self._delta)
        if about is not None:
            shape, share = about
            own = self._rotations(vertices, shape[self._i] - shape[self._j])
            bent = np.einsum("vxy,vy->vx", own, self._laplacian @ shape)
            turned += share[:, None] * (bent - turned)
        out: Floats = self._bending @ turned
        if self._soft.any():
            between = 0.5 * (rotations[self._i] + rotations[self._j])
            pull = self._soft[:, None] * np.einsum("exy,ey->ex", between, self._edge)
            for axis in range(3):
                out[:, axis] += np.bincount(self._i, pull[:, axis], minlength=len(out))
                out[:, axis] -= np.bincount(self._j, pull[:, axis], minlength=len(out))
        return out


def _averaging(count: int, i: Ints32, j: Ints32) -> sparse.csr_matrix:
    """Sums a vertex and its neighbours: rotations from one ring alone follow noise."""
    edges = sparse.csr_matrix((np.full(len(i), 0.5), (i, j)), (count, count))
    return sparse.csr_matrix(edges + edges.T + sparse.identity(count))


def _edge_laplacian(count: int, i: Ints32, j: Ints32, w: Floats) -> sparse.csr_matrix:
    edges = sparse.csr_matrix((w, (i, j)), (count, count))
    edges = edges + edges.T
    return sparse.csr_matrix(sparse.diags(np.asarray(edges.sum(axis=1)).ravel()) - edges)


def _scatter(constraints: Constraints, count: int) -> sparse.csr_matrix:
    """B of Eq. 1, (N, V)."""
    rows = np.repeat(np.arange(len(constraints.weights)), 3)
    where = (rows, constraints.corners.ravel())
    shape = (len(constraints.weights), count)
    return sparse.csr_matrix((constraints.barycentric.ravel(), where), shape)


def _rigid_part(constraints: Constraints, start: Floats) -> Similarity:
    """The rigid motion of the constraints; none when they do not determine one."""
    still = Similarity(rotation=np.eye(3), translation=np.zeros(3))
    if int((constraints.weights > 0).sum()) < 3:
        return still
    try:
        return fit_similarity(constraints.points(start), constraints.targets, constraints.weights)
    except SolveError:
        return still


def _factor(system: sparse.spmatrix) -> SuperLU:
    try:
        return splu(
            sparse.csc_matrix(system),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:
        raise SolveError(
            f"Laplacian deformation: the system cannot be factored: {error}"
        ) from error
