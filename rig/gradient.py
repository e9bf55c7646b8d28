"""Area-weighted gradients of vertex functions on a mesh, and deformation gradients."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape


def gradient_operator(vertices: Floats, triangles: Ints32) -> sparse.csr_array:
    """Area-weighted gradient operator G: rows 3t..3t+2 hold sqrt(area_t) grad of the hat functions.

    No fourth vertex along the normal is added, so `G.T @ G` is the cotangent Laplacian, and
    `|G u|^2` is the integral of `|grad u|^2` over the mesh (u in mm: mm^2). A triangle without
    area has zero rows.

    Args:
        vertices: (V, 3) any space, mm.
        triangles: (T, 3) vertex ids.

    Returns:
        (3T, V) sparse, 1 (mm of function for mm of mesh, times mm of sqrt(area)).

    References:
        Botsch, Sumner, Pauly, Gross 2006, Deformation transfer for detail-preserving surface
        editing, section 3; Ma et al. 2016, section 3.2.
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    corner = np.asarray(vertices, dtype=np.float64)[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    double_area = np.linalg.norm(normal, axis=1)
    flat = double_area <= 1e-12 * max(float(double_area.max(initial=0.0)), 1e-30)
    safe = np.where(flat, 1.0, double_area)
    # grad of corner k's hat: unit normal x opposite edge / (2 area); times sqrt(area)
    scale = np.where(flat, 0.0, np.sqrt(safe / 2.0) / safe**2)
    count = len(triangles)
    blocks = np.empty((count, 3, 3))  # triangle, axis, corner
    for k in range(3):
        edge = corner[:, (k + 2) % 3] - corner[:, (k + 1) % 3]
        blocks[:, :, k] = np.cross(normal, edge) * scale[:, None]
    columns = np.broadcast_to(triangles[:, None, :], (count, 3, 3)).ravel()
    start = np.arange(0, 9 * count + 1, 3)
    operator = sparse.csr_array(
        (blocks.ravel(), columns, start), shape=(3 * count, len(vertices)), dtype=np.float64
    )
    operator.sort_indices()
    return operator


def deformation_gradients(rest: Floats, deformed: Floats, triangles: Ints32) -> Floats:
    """Deformation gradient of each triangle: 3x3, carries rest edges and normal to deformed.

    Unit normals stand for the third direction. Where the deformed triangle has collapsed to a line
    (a shut eyelid) the rest normal is kept; where the rest triangle has no area the identity is.

    Args:
        rest: (V, 3), mm.
        deformed: (V, 3), mm.
        triangles: (T, 3).

    Returns:
        (T, 3, 3), acting on column vectors; exactly the identity where nothing moved.

    References:
        Sumner and Popovic 2004, Deformation transfer for triangle meshes, section 3.
    """
    check_shape(rest=(rest, "V 3"), deformed=(deformed, "V 3"), triangles=(triangles, "T 3"))
    frames = RestFrames(rest, triangles)
    return frames.gradients((deformed - rest)[triangles], np.arange(len(triangles)))


class RestFrames:
    """The frame of every triangle at rest, inverted once for any number of deformations."""

    def __init__(self, rest: Floats, triangles: Ints32) -> None:
        self._corners = np.asarray(rest, dtype=np.float64)[triangles]
        self._source, self._flat = _frames(self._corners)
        square = self._source.copy()
        square[self._flat] = np.eye(3)
        self._inverse = np.linalg.inv(square)

    def gradients(self, moved: Floats, chosen: Ints) -> Floats:
        """As `deformation_gradients`, where corners move by (n, 3, 3), of triangles (n,): n 3x3."""
        target, flat = _frames(self._corners[chosen] + moved)
        target[flat, :, 2] = self._source[chosen[flat], :, 2]
        target[self._flat[chosen]] = np.eye(3)
        gradients: Floats = target @ self._inverse[chosen]
        gradients[(moved == 0.0).all(axis=(1, 2))] = np.eye(3)
        return gradients


def components(triangles: Ints32, vertex_count: int) -> Ints:
    """(V,) the number of the connected component of each vertex; a lone vertex is its own."""
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    ones = np.ones(len(edges))
    graph = sparse.coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(vertex_count,) * 2)
    labels = sparse.csgraph.connected_components(graph, directed=False)[1]
    return np.asarray(labels, dtype=np.int64)


def _frames(corner: Floats) -> tuple[Floats, Bools]:
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    normal = np.cross(first, second)
    length = np.linalg.norm(normal, axis=1)
    size = np.maximum((first**2).sum(axis=1), (second**2).sum(axis=1))
    flat = length <= 1e-6 * np.maximum(size, 1e-30)
    unit = normal / np.where(flat, 1.0, length)[:, None]
    return np.stack([first, second, unit], axis=2), flat
