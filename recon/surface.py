"""Surfaces through Open3D, which no other stage imports: Poisson meshes, queries, PLY files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from capture.arrays import Bools, Floats, Floats32, Ints, Ints32, check_finite, check_shape
from capture.errors import SolveError, TakeError
from capture.product import replacing
from capture.settings import check_ranges
from recon.fusion import Points
from recon.settle import openness, settled

_SURROUNDED = 0.66  # openness below which a vertex lies in a gap; at a straight border it is 0.64
_MARGIN = 1.1  # Poisson's cube over the extent of the points


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan mesh in world space.

    Attributes:
        vertices: (V, 3) float32 mm.
        triangles: (T, 3) int32, counter-clockwise seen from outside.
        normals: (V, 3) float32 unit, out of the surface.
        confidence: (V,) float32 0..1.
    """

    vertices: Floats32
    triangles: Ints32
    normals: Floats32
    confidence: Floats32


@dataclass(frozen=True, kw_only=True)
class SurfaceSettings:
    """How a mesh is drawn through oriented points.

    Attributes:
        cell_spacings: side of the finest Poisson cell, in point spacings.
        depth_max: no cell is smaller than the extent of the points over two to this power.
        evidence_spacings: vertices farther than this from every point are cut away: holes stay
            holes.
        lone_spacings: the same where the nearest point is known to one pair alone: its rim may
            hang over.
        bridge_spacings: vertices up to this far from the points stay all the same where points
            surround them: a gap is bridged, a border does not hang over.
        settle_spacings: points so near draw a vertex to themselves, past what a cell can follow; 0
            leaves the surface as the solver drew it.
        component_share: pieces with a smaller share of the largest one's triangles are dropped.
        threads: of the Poisson solver.
    """

    cell_spacings: float = 2.2
    depth_max: int = 9
    evidence_spacings: float = 3.0
    lone_spacings: float = 1.2
    bridge_spacings: float = 3.5
    settle_spacings: float = 3.0
    component_share: float = 0.01
    threads: int = 1

    def __post_init__(self) -> None:
        check_ranges(
            "surface", self, cell_spacings=(0.5, 20.0), depth_max=(5, 12),
            evidence_spacings=(1.0, 50.0), lone_spacings=(0.0, 50.0), bridge_spacings=(0.0, 50.0),
            settle_spacings=(0.0, 20.0),
            component_share=(0.0, 1.0), threads=(1, 256),
        )  # fmt: skip


def poisson_scan(points: Points, settings: SurfaceSettings) -> Scan:
    """Screened Poisson surface through oriented points, cut back to where there is evidence.

    Raises:
        SolveError: when fewer than a hundred points are given, or no surface is left.

    References:
        Kazhdan and Hoppe, Screened Poisson surface reconstruction, TOG 32(3), 2013; Open3D's
        binding.
    """
    check_shape(positions=(points.positions, "N 3"), normals=(points.normals, "N 3"))
    if len(points) < 100:
        raise SolveError(f"a surface needs at least 100 points, found {len(points)}")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.positions.astype(np.float64)))
    cloud.normals = o3d.utility.Vector3dVector(points.normals.astype(np.float64))
    cell = settings.cell_spacings * points.spacing_mm
    extent = float(np.ptp(points.positions, axis=0).max()) * _MARGIN
    cell = max(cell, extent / 2**settings.depth_max)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
            cloud, width=cell, scale=_MARGIN, linear_fit=False, n_threads=settings.threads
        )
    vertices = np.asarray(mesh.vertices)
    triangles = np.asarray(mesh.triangles).astype(np.int32)
    return _trim(points, vertices, triangles, settings)


def _trim(points: Points, vertices: Floats, triangles: Ints32, settings: SurfaceSettings) -> Scan:
    """Cut away what no point supports, drop small pieces, and carry the confidence over."""
    distance, nearest = _nearest(points, vertices, settings)
    near = _evident(points, vertices, triangles, distance, nearest, settings)
    kept = triangles[near[triangles].all(axis=1)]
    kept = kept[_large_pieces(kept, len(vertices), settings.component_share)]
    if len(kept) == 0:
        raise SolveError("no surface is left where the points give evidence")
    kept = _welded(vertices.astype(np.float32), kept)
    used, compact = np.unique(kept, return_inverse=True)
    out = vertices[used].astype(np.float32)
    faces = compact.reshape(-1, 3).astype(np.int32)
    if settings.settle_spacings > 0:
        reach = settings.settle_spacings * points.spacing_mm
        out = settled(out, _normals(out, faces), points.positions, points.normals, reach)
    confidence = points.confidence[np.minimum(nearest[used], len(points) - 1)]
    return Scan(out, faces, _normals(out, faces), confidence.astype(np.float32))


def _nearest(points: Points, vertices: Floats, settings: SurfaceSettings) -> tuple[Floats, Ints]:
    """Distance (V,) in spacings to the nearest point, infinite beyond reach, and which it is."""
    reach = max(settings.evidence_spacings, settings.bridge_spacings) * points.spacing_mm
    answer = cKDTree(points.positions).query(vertices, distance_upper_bound=reach)
    return np.asarray(answer[0]) / points.spacing_mm, np.asarray(answer[1])


def _evident(
    points: Points,
    vertices: Floats,
    triangles: Ints32,
    distance: Floats,
    nearest: Ints,
    settings: SurfaceSettings,
) -> Bools:
    """Which vertices (V,) stay: those near a point, and those of a narrow gap between points."""
    lone = np.append(points.support < 2, True)[nearest]
    reach = np.where(lone, settings.lone_spacings, settings.evidence_spacings)
    near: Bools = distance <= reach
    gap = np.flatnonzero(~near & (distance <= settings.bridge_spacings))
    if len(gap):
        places = vertices.astype(np.float32)
        normals = _normals(places, triangles)
        wide = settings.bridge_spacings * points.spacing_mm
        open_ = openness(places[gap], normals[gap], points.positions, points.normals, wide)
        near[gap[open_ < _SURROUNDED]] = True
    return near


def _welded(vertices: Floats32, triangles: Ints32) -> Ints32:
    """Triangles with vertices that fall together made one; those that vanish by it are dropped."""
    _, first, group = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    joined = first[group.reshape(-1)].astype(np.int32)[triangles]
    a, b, c = joined.T
    whole: Ints32 = joined[(a != b) & (b != c) & (c != a)]
    return whole


def _large_pieces(triangles: Ints32, vertex_count: int, share: float) -> Bools:
    """Which triangles belong to a connected piece of at least `share` of the largest."""
    if len(triangles) == 0:
        return np.zeros(0, np.bool_)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    graph = coo_matrix(
        (np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])),
        shape=(vertex_count, vertex_count),
    )
    _, label = connected_components(graph, directed=False)
    piece = label[triangles[:, 0]]
    sizes = np.bincount(piece)
    large: Bools = sizes[piece] >= share * sizes.max()
    return large


def _normals(vertices: Floats32, triangles: Ints32) -> Floats32:
    mesh = o3d.t.geometry.TriangleMesh(_tensor(vertices), _tensor(triangles))
    mesh.compute_vertex_normals()
    return np.ascontiguousarray(mesh.vertex.normals.numpy(), dtype=np.float32)


def _tensor(array: NDArray[Any]) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))


class SurfaceQuery:
    """Closest points and rays against one triangle mesh, built once and asked often."""

    def __init__(self, vertices: Floats | Floats32, triangles: Ints32) -> None:
        """Build from vertices (V, 3), mm, and triangles (T, 3)."""
        check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
        check_finite(vertices=vertices)
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            _tensor(vertices.astype(np.float32)),
            _tensor(triangles.astype(np.uint32)),
        )

    def closest_points(self, queries: Floats | Floats32) -> tuple[Floats32, Ints32, Floats32]:
        """The nearest surface point of each query (N, 3).

        Returns:
            Points (N, 3), mm; triangle of each (N,); distance (N,), mm. float32 throughout.
        """
        check_shape(queries=(queries, "N 3"))
        check_finite(queries=queries)
        asked = np.ascontiguousarray(queries, dtype=np.float32)
        answer = self._scene.compute_closest_points(_tensor(asked))
        points = answer["points"].numpy()
        distance = np.linalg.norm(points - asked, axis=1)
        return points, answer["primitive_ids"].numpy().astype(np.int32), distance

    def cast_rays(
        self, origins: Floats | Floats32, directions: Floats | Floats32
    ) -> tuple[Floats32, Ints32]:
        """First hit of rays (N, 3) + (N, 3).

        Returns:
            Distance (N,) in lengths of the direction, infinite where nothing is hit; triangle
            (N,), -1 where nothing is hit.
        """
        check_shape(origins=(origins, "N 3"), directions=(directions, "N 3"))
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        answer = self._scene.cast_rays(_tensor(rays))
        distance = answer["t_hit"].numpy()
        triangle = answer["primitive_ids"].numpy().astype(np.int64)
        return distance, np.where(np.isfinite(distance), triangle, -1).astype(np.int32)

    def occluded(self, points: Floats | Floats32, eye: Floats, margin_mm: float = 0.05) -> Bools:
        """Whether the surface stands between points (N, 3) and the eye (3,), both world mm.

        Args:
            points: (N, 3) on or near the surface.
            eye: (3,) where they are looked at from.
            margin_mm: the ray starts this far from the point, so that it does not hit its own
                surface.
        """
        check_shape(points=(points, "N 3"), eye=(eye, "3"))
        towards = np.asarray(eye, dtype=np.float64) - points
        length = np.linalg.norm(towards, axis=1, keepdims=True)
        unit = towards / np.maximum(length, 1e-9)
        distance, _ = self.cast_rays(points + margin_mm * unit, unit)
        blocked: Bools = distance < length[:, 0] - margin_mm
        return blocked


def closest_points(
    vertices: Floats | Floats32, triangles: Ints32, queries: Floats | Floats32
) -> tuple[Floats32, Ints32, Floats32]:
    """Nearest surface points (N, 3), their triangles (N,) and distances (N,), mm, of one mesh."""
    return SurfaceQuery(vertices, triangles).closest_points(queries)


def write_ply(path: Path, scan: Scan) -> None:
    """Write a scan as binary PLY: normals, confidence, and a colour from red (0) to green (1)."""
    check_shape(
        vertices=(scan.vertices, "V 3"), normals=(scan.normals, "V 3"),
        confidence=(scan.confidence, "V"), triangles=(scan.triangles, "T 3"),
    )  # fmt: skip
    vertex = np.zeros(len(scan.vertices), dtype=_VERTEX)
    for axis, name in enumerate("xyz"):
        vertex[name] = scan.vertices[:, axis]
        vertex["n" + name] = scan.normals[:, axis]
    level = np.clip(scan.confidence, 0.0, 1.0)
    vertex["red"] = np.rint(255 * np.clip(2 - 2 * level, 0, 1))
    vertex["green"] = np.rint(255 * np.clip(2 * level, 0, 1))
    vertex["blue"] = 60
    vertex["confidence"] = scan.confidence
    face = np.zeros(len(scan.triangles), dtype=_FACE)
    face["count"], face["index"] = 3, scan.triangles
    kinds = {"<f4": "float", "|u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", "comment likeness scan, world mm"]
    lines.append(f"element vertex {len(vertex)}")
    lines += [f"property {kinds[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()]
    lines += [
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    with replacing(path) as partial:
        partial.write_bytes("\n".join(lines).encode("ascii") + vertex.tobytes() + face.tobytes())


def read_ply(path: Path) -> Scan:
    """Read a triangle mesh from a PLY file; without a confidence of its own every vertex gets 1.

    Raises:
        TakeError: naming the file and what was found.
    """
    if not Path(path).is_file():
        raise TakeError(f"{path}: no such scan; `likeness recon` writes one")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.t.io.read_triangle_mesh(str(path))
    if "positions" not in mesh.vertex or "indices" not in mesh.triangle:
        raise TakeError(f"{path}: expected a PLY file with vertices and triangles")
    vertices = mesh.vertex.positions.numpy().astype(np.float32)
    triangles = mesh.triangle.indices.numpy().astype(np.int32)
    confidence = np.ones(len(vertices), np.float32)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.t.io.read_point_cloud(Path(path))  # unlike the mesh reader, it keeps scalars
    if "confidence" in cloud.point and len(cloud.point.positions) == len(vertices):
        confidence = cloud.point["confidence"].numpy().astype(np.float32).reshape(-1)
    return Scan(vertices, triangles, _normals(vertices, triangles), confidence)


_VERTEX = np.dtype(
    [(n, "<f4") for n in ("x", "y", "z", "nx", "ny", "nz")]
    + [(n, "u1") for n in ("red", "green", "blue")]
    + [("confidence", "<f4")]
)
_FACE = np.dtype([("count", "u1"), ("index", "<i4", (3,))])
