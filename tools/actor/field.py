"""What the shape makers work on: the neutral, its mirror image, smooth interpolation."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from capture.arrays import Bools, Floats, Ints
from recon.mesh import vertex_normals
from tools.actor.identity import Identity
from tools.actor.lattice import Lattice
from tools.actor.sculpt import Sculpture, mirror_ids


class Field:
    """The neutral as the shape makers see it.

    Args:
        lattice: the topology.
        sculpture: the neutral.
        who: the proportions.
    """

    def __init__(self, lattice: Lattice, sculpture: Sculpture, who: Identity) -> None:
        self.lattice = lattice
        self.sculpture = sculpture
        self.who = who
        self.points = sculpture.vertices
        self.x, self.y, self.z = self.points.T
        self.wide: Floats = np.abs(self.x)
        self.left: Floats = _half(self.x, 9.0)

    @cached_property
    def mirror(self) -> Ints:
        """(V,) id of each vertex's mirror image."""
        return mirror_ids(self.lattice)

    @cached_property
    def normals(self) -> Floats:
        """(V, 3) of the neutral, unit, averaged with their mirror image."""
        polygons = self.lattice.polygons
        triangles = np.concatenate([polygons[:, [0, 1, 2]], polygons[:, [0, 2, 3]]])
        normals = vertex_normals(self.points, triangles)
        normals = normals + normals[self.mirror] * [-1.0, 1.0, 1.0]  # quads split one way only
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        unit: Floats = normals / np.maximum(length, 1e-9)
        return unit

    def both_sides(self, name: str, left: Floats) -> dict[str, Floats]:
        """A shape of the left side and its mirror image, under both names."""
        return {f"{name}Left": left, f"{name}Right": left[self.mirror] * [-1.0, 1.0, 1.0]}

    def vector(self, weight: Floats, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Floats:
        """(V, 3) one direction, mm, times a weight (V,)."""
        moved: Floats = weight[:, None] * np.array([x, y, z])
        return moved

    def interpolator(self, held: Bools) -> Interpolator:
        """Smooth interpolation over the outer skin from the vertices `held` (V,)."""
        return Interpolator(self.lattice, self.points, held)


class Interpolator:
    """Biharmonic interpolation over the outer skin, factorised once for many right-hand sides.

    The slits stay cut, so that the two lips move apart freely.

    References:
        Botsch, Kobbelt 2004, "An intuitive framework for real-time freeform modeling", the
        thin-plate energy with handle and fixed vertices.
    """

    def __init__(self, lattice: Lattice, points: Floats, held: Bools) -> None:
        outer = lattice.ring == 0
        self._free = np.flatnonzero(outer & ~held)
        self._held = np.flatnonzero(outer & held)
        self._count = len(points)
        polygons = lattice.polygons[outer[lattice.polygons].all(axis=1)]
        edges = np.concatenate([polygons[:, [k, (k + 1) % 4]] for k in range(4)])
        edges = np.unique(np.sort(edges, axis=1), axis=0)
        length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
        weight = 1.0 / np.maximum(length, 0.2)
        link = sparse.coo_matrix(
            (weight, (edges[:, 0], edges[:, 1])), (self._count, self._count)
        ).tocsr()
        link = link + link.T
        degree = np.asarray(link.sum(axis=1)).ravel()
        laplacian = sparse.diags_array(degree) - link
        inverse = sparse.diags_array(1.0 / np.maximum(degree, 1e-9))
        plate = (laplacian @ inverse @ laplacian).tocsr()
        rows = plate[self._free]
        free = rows[:, self._free].tocsc()
        self._solver = splu(free, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        self._coupling = rows[:, self._held]

    def spread(self, values: Floats) -> Floats:
        """(V, k) smooth values that agree with `values` (V, k) where held; rings get 0."""
        out = np.zeros((self._count, values.shape[1]))
        out[self._held] = values[self._held]
        out[self._free] = self._solver.solve(-(self._coupling @ values[self._held]))
        return out


def _half(x: Floats, reach_mm: float) -> Floats:
    part = np.clip(0.5 + 0.5 * x / reach_mm, 0.0, 1.0)
    half: Floats = part * part * (3.0 - 2.0 * part)
    return half
