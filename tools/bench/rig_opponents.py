"""What the rig solver is measured against: the papers' systems as printed, and public solvers.

cvxopt (GPL-3) and daqp (MIT) come with the extra `bench` alone; they are imported when they are
needed, and `missing` says in words what to do about it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import lsqr, spsolve

from capture.arrays import Bools, Floats, Ints32
from rig.evidence import Evidence
from rig.gradient import gradient_operator
from rig.hable import HableSettings
from rig.influence import neighbours
from rig.neutral_frame import align_frame
from rig.template import Template
from rig.update import UpdatePriors, mean_vertex_area, offset_stiffness


def missing(*packages: str) -> str:
    """What to say of optional packages that are not installed; empty when all are."""
    absent = [name for name in packages if find_spec(name) is None]
    return f"skipped: {', '.join(absent)} not installed (pip install -e .[bench])" if absent else ""


def literal_update(
    template: Template, targets: Floats, support: Bools, evidence: Evidence, priors: UpdatePriors
) -> tuple[Floats, tuple[float, float]]:
    """Ma et al. Eq 7 as it is printed: one sparse system over every scalar, `spsolve`.

    Returns:
        (B + 1, V, 3) the neutral's change (0) and the shapes, mm; seconds of wall clock and of CPU
        that `spsolve` took, building the system left out.
    """
    count, columns = len(template.neutral), len(targets) + 1
    triangles = template.mesh.triangles
    operator = gradient_operator(template.neutral, triangles)
    bending = sparse.kron(
        sparse.eye_array(columns), sparse.kron(operator.T @ operator, sparse.eye_array(3))
    ) * (priors.gradient_mm2 / mean_vertex_area(template.neutral, triangles))
    factors = evidence.factors
    offset = sparse.diags_array(np.repeat(offset_stiffness(targets, priors).T.ravel(), 3))
    data = sparse.kron(sparse.csr_array(factors.T @ factors), sparse.eye_array(3 * count))
    wanted = np.concatenate([np.zeros((1, count, 3)), targets]).ravel()
    seen = np.tensordot(factors.T, evidence.offsets, axes=1).ravel()
    right = seen + bending @ wanted + offset @ wanted
    active = np.concatenate([np.ones((1, count), dtype=bool), support]).ravel()
    kept = np.flatnonzero(np.repeat(active, 3))
    matrix = sparse.csc_array(sparse.csr_array(data + bending + offset)[kept][:, kept])
    out = np.zeros(len(wanted))
    wall, processor = time.perf_counter(), time.process_time()
    out[kept] = spsolve(matrix, right[kept])
    cost = time.perf_counter() - wall, time.process_time() - processor
    return out.reshape(columns, count, 3), cost


def update_residual(
    template: Template,
    found: Floats,
    support: Bools,
    evidence: Evidence,
    priors: UpdatePriors,
    targets: Floats,
) -> float:
    """Relative residual of (B + 1, V, 3) neutral's change and shapes in the same system.

    The product is formed from the energies, without the system: |A x - b| / |b| over the unknowns,
    where x is the departure from the targets, as the solver counts it.
    """
    triangles = template.mesh.triangles
    operator = gradient_operator(template.neutral, triangles)
    scale = priors.gradient_mm2 / mean_vertex_area(template.neutral, triangles)
    factors, square = evidence.factors, evidence.confidence[:, :, None] ** 2
    away = found.copy()
    away[1:] -= targets
    residual = evidence.offsets - np.tensordot(evidence.weights, targets, axes=1)
    right = np.tensordot(factors.T, square * residual, axes=1)
    product = np.tensordot(factors.T, square * np.tensordot(factors, away, axes=1), axes=1)
    product += offset_stiffness(targets, priors).T[:, :, None] * away
    flat = away.transpose(1, 0, 2).reshape(len(template.neutral), -1)
    bent = scale * (operator.T @ (operator @ flat))
    product += bent.reshape(len(template.neutral), -1, 3).transpose(1, 0, 2)
    active = np.concatenate([np.ones((1, support.shape[1]), dtype=bool), support])
    return float(np.linalg.norm((product - right)[active]) / np.linalg.norm(right[active]))


def literal_weights(
    template: Template, points: Floats, sparsity: float, turns: int
) -> tuple[Floats, Floats]:
    """Ma et al. Eqs 3-4 as they are printed: SVD and a quadratic program in turn, frame by frame.

    Args:
        template: the shapes.
        points: (F, V, 3) world, mm.
        sparsity: lambda_s, of sums over the vertices, mm^2.
        turns: alternations of a frame.

    Returns:
        weights (F, B) from CVXOPT and rotations (F, 3, 3), of the rig into the world.
    """
    found = np.zeros((len(points), len(template.names)))
    rotations = np.tile(np.eye(3), (len(points), 1, 1))
    columns = template.deltas.reshape(len(template.names), -1).T
    hessian = columns.T @ columns + sparsity
    solve = cvxopt_qp(hessian)
    ones = np.ones(len(template.neutral))
    for frame, target in enumerate(points):
        for _ in range(turns):
            posed = template.neutral + np.tensordot(found[frame], template.deltas, axes=1)
            rotation, shift = align_frame(posed, target, ones)
            local = (target @ rotation.T + shift - template.neutral).ravel()
            found[frame] = solve(columns.T @ local)
            rotations[frame] = rotation.T
    return found, rotations


def cvxopt_qp(hessian: Floats) -> Callable[[Floats], Floats]:
    """`minimise x.H.x / 2 - c.x` in the unit box by CVXOPT, as a function of c."""
    cvxopt: Any = import_module("cvxopt")
    cvxopt.solvers.options["show_progress"] = False
    count = len(hessian)
    matrix, box = cvxopt.matrix(hessian), np.concatenate([np.eye(count), -np.eye(count)])
    sides = cvxopt.matrix(box), cvxopt.matrix(np.repeat([1.0, 0.0], count))

    def solve(linear: Floats) -> Floats:
        answer = cvxopt.solvers.qp(matrix, cvxopt.matrix(-linear), *sides)
        return np.array(answer["x"], dtype=np.float64).ravel()

    return solve


def daqp_qp(hessian: Floats) -> Callable[[Floats], Floats]:
    """The same by daqp, as a function of c."""
    daqp: Any = import_module("daqp")
    count = len(hessian)
    dense = np.ascontiguousarray(hessian)
    none = np.zeros((0, count))
    upper, lower = np.ones(count), np.zeros(count)
    sense = np.zeros(count, dtype=np.int32)

    def solve(linear: Floats) -> Floats:
        answer = daqp.solve(dense, -linear, none, upper, lower, sense)[0]
        return np.array(answer, dtype=np.float64)

    return solve


def literal_hable(
    polygons: Ints32,
    sources: Floats,
    influence: Floats,
    evidence: Evidence,
    settings: HableSettings,
    tolerance: float = 1e-7,
) -> tuple[Floats, tuple[float, float, float], int]:
    """Hable's rows written out, x, y and z one after the other by LSQR from the sources.

    Returns:
        (B, V, 3) shapes, mm; seconds to build the matrix, and of wall clock and CPU to solve with
        it; most iterations.
    """
    wall = time.perf_counter()
    matrix, firm = _hable_rows(polygons, influence, evidence, settings)
    built, processor = time.perf_counter(), time.process_time()
    frames, (shapes, count) = len(evidence.weights), influence.shape
    out, most = np.empty_like(sources), 0
    laplacian = matrix[frames * count + shapes * count :]
    for axis in range(3):
        start = sources[:, :, axis].ravel()
        shown = (evidence.confidence * evidence.offsets[:, :, axis]).ravel()
        right = np.concatenate([shown, firm * start, laplacian @ start])
        answer = lsqr(matrix, right - matrix @ start, atol=tolerance, btol=tolerance)
        out[:, :, axis] = (start + answer[0]).reshape(shapes, count)
        most = max(most, int(answer[2]))
    cost = built - wall, time.perf_counter() - built, time.process_time() - processor
    return out, cost, most


def _hable_rows(
    polygons: Ints32, influence: Floats, evidence: Evidence, settings: HableSettings
) -> tuple[sparse.csr_array, Floats]:
    shapes, count = influence.shape
    weights = np.where(evidence.weights >= settings.weight_floor, evidence.weights, 0.0)
    acting = influence >= settings.influence_floor
    blocks = []
    for sure, row in zip(evidence.confidence, weights, strict=True):
        used = np.flatnonzero(row)
        parts = [sparse.diags_array(row[k] * sure * acting[k]) for k in used]
        part = sparse.hstack(parts) if len(used) else sparse.csr_array((count, 0))
        columns = (used[:, None] * count + np.arange(count)).ravel()
        entries = sparse.coo_array(part)
        blocks.append(
            sparse.csr_array(
                (entries.data, (entries.row, columns[entries.col])), shape=(count, shapes * count)
            )
        )
    share = np.sqrt(np.clip(influence, 0.0, 1.0))
    firm = settings.source_outside + share * (settings.source_inside - settings.source_outside)
    link = neighbours(polygons, count)
    degree = np.maximum(np.asarray(link.sum(axis=1)).ravel(), 1.0)
    umbrella = sparse.eye_array(count) - sparse.diags_array(1.0 / degree) @ link
    rows = [*blocks, sparse.diags_array(firm.ravel())]
    rows.append(settings.laplacian * sparse.kron(sparse.eye_array(shapes), umbrella))
    matrix = sparse.csr_array(sparse.vstack(rows))
    matrix.eliminate_zeros()
    return matrix, firm.ravel()


def kkt_residual(hessian: Floats, linears: Floats, found: Floats) -> float:
    """How far solutions (N, n) in the unit box are from optimal, in units of the solution.

    The largest step that projected gradient descent, scaled by the Hessian's diagonal, would take:
    0 exactly at the optimum, and as fair to an interior point as to an active set.
    """
    slope = (found @ hessian - linears) / np.diag(hessian)
    return float(np.abs(found - np.clip(found - slope, 0.0, 1.0)).max())
