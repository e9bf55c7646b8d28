"""How far the skin lies from the neutral: heights along its normals, read off the frame's scan."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from capture.arrays import Bools, Floats, Ints32, check_shape
from recon.surface import Scan
from track.displacement import bind_points
from track.surface_samples import vertex_rings

_FACING = 0.7  # least cosine between the neutral's normal and the scan's above it
_POINTS = 100_000  # about as many of the scan's points are enough, twelve a vertex
_SMOOTHING = 2  # rounds of averaging: a scan's noise is finer than a registration's error


def skin_heights(vertices: Floats, triangles: Ints32, scan: Scan, limit_mm: float) -> Floats:
    """Heights of the skin over the vertices, along their normals.

    Every point u of the scan is bound to the mesh as u = b + h n; a vertex's height is the mean
    of those around it by their base points' weights, averaged over its neighbours.

    Args:
        vertices: (V, 3) mm, registered to the scan.
        triangles: (T, 3).
        scan: in the same space.
        limit_mm: farther than this the scan shows something else.

    Returns:
        (V,) mm, outwards positive; 0 where the scan has no skin near.

    References:
        Kobbelt et al. 1999; Ma et al. 2016, section 2.2.
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    chosen = slice(None, None, 1 + len(scan.vertices) // _POINTS)
    bound = bind_points(scan.vertices[chosen].astype(np.float64), vertices, triangles)
    facing = np.einsum("nx,nx->n", bound.normals(vertices, triangles), scan.normals[chosen])
    good: Bools = (bound.triangle >= 0) & (np.abs(bound.height_mm) < limit_mm) & (facing > _FACING)
    corners, share = bound.corners[good].ravel(), bound.barycentric[good].ravel()
    count = len(vertices)
    known = np.bincount(corners, share, minlength=count)
    total = np.bincount(corners, share * np.repeat(bound.height_mm[good], 3), minlength=count)
    height: Floats = np.divide(total, known, out=np.zeros(count), where=known > 0)
    return _averaged(height, (known > 0).astype(np.float64), triangles)


def _averaged(height: Floats, known: Floats, triangles: Ints32) -> Floats:
    rings = sparse.csr_matrix(vertex_rings(triangles, len(height), 1), dtype=np.float64)
    for _ in range(_SMOOTHING):
        count = rings @ known
        height = np.where(count > 0, (rings @ (known * height)) / np.maximum(count, 1e-9), 0.0)
        height = height * (known > 0)
    return height
