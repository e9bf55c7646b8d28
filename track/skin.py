"""How far the skin lies from the neutral: heights along its normals, read off the frame's scan."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from capture.arrays import Floats, Floats32, Ints32, check_shape
from recon.mesh import vertex_normals
from recon.surface import SurfaceQuery
from track.surface_samples import vertex_rings

_FACING = 0.7  # least cosine between the neutral's normal and the scan's where it is hit
_SMOOTHING = 2  # rounds of averaging: a scan's noise is finer than a registration's error


def skin_heights(
    vertices: Floats,
    triangles: Ints32,
    scan: tuple[Floats32, Ints32],
    limit_mm: float,
) -> Floats:
    """Heights of the skin over the vertices, along their normals.

    Args:
        vertices: (V, 3) mm, registered to the scan.
        triangles: (T, 3).
        scan: vertices and triangles of the scan, in the same space.
        limit_mm: farther than this the scan shows something else.

    Returns:
        (V,) mm, outwards positive, averaged over neighbours; 0 where the scan has no skin near.

    References:
        Kobbelt et al. 1999; Ma et al. 2016, section 2.2: u = b + h n.
    """
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    normals = np.nan_to_num(vertex_normals(vertices, triangles))
    distance, hit = SurfaceQuery(*scan).cast_rays(vertices + limit_mm * normals, -normals)
    height = limit_mm - distance.astype(np.float64)
    corner = scan[0][scan[1][np.maximum(hit, 0)]].astype(np.float64)
    face = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-12)
    known = (hit >= 0) & (np.abs(height) < limit_mm)
    known &= np.einsum("vx,vx->v", face, normals) > _FACING
    return _averaged(np.where(known, height, 0.0), known.astype(np.float64), triangles)


def _averaged(height: Floats, known: Floats, triangles: Ints32) -> Floats:
    rings = sparse.csr_matrix(vertex_rings(triangles, len(height), 1), dtype=np.float64)
    for _ in range(_SMOOTHING):
        count = rings @ known
        height = np.where(count > 0, (rings @ (known * height)) / np.maximum(count, 1e-9), 0.0)
        height = height * (known > 0)
    return height
