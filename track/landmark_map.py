"""Which point of a mesh each of the 68 landmarks is: from a file, or from another mesh."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape
from capture.documents import read_json
from capture.errors import ShapeError, TakeError, raise_all
from capture.product import replacing
from recon.mesh import Mesh
from track.face_landmarks import LANDMARK_NAMES, LANDMARKS
from track.surface_match import MatchSurface
from track.surface_samples import SurfaceSamples

_ABSENT = "no such landmark map; docs/landmarks.md tells what it holds, --map names another"
_NORMAL_MM = 5.0  # what a unit of normal difference counts: the other lip lies near


@dataclass(frozen=True, eq=False, kw_only=True)
class LandmarkMap:
    """N named points of a mesh.

    Attributes:
        names: (N) of the 68-point layout, or others.
        surface: the N points.
    """

    names: tuple[str, ...]
    surface: SurfaceSamples

    def select(self, names: Sequence[str]) -> LandmarkMap:
        """The points of these names, in their order."""
        chosen = np.array([self.names.index(name) for name in names], dtype=np.int32)
        return LandmarkMap(names=tuple(names), surface=self.surface.select(chosen))

    def document(self) -> dict[str, Any]:
        """What `parse_landmark_map` reads, fit for JSON."""
        corners, weights = self.surface.corners.tolist(), self.surface.barycentric.round(6).tolist()
        return {
            "points": {
                name: {"corners": where, "weights": share}
                for name, where, share in zip(self.names, corners, weights, strict=True)
            }
        }


def vertex_map(named: Mapping[str, int], triangles: Ints32) -> LandmarkMap:
    """The map that sets each name on a vertex of a mesh with triangles (T, 3).

    Raises:
        ShapeError: when a vertex is in no triangle.
    """
    vertices = np.array(list(named.values()), dtype=np.int64)
    used, first = np.unique(triangles.ravel(), return_index=True)
    slot = np.minimum(np.searchsorted(used, vertices), len(used) - 1)
    stray = [name for name, at in zip(named, used[slot] != vertices, strict=True) if at]
    if stray:
        raise ShapeError(f"landmarks {', '.join(stray)}: their vertices are in no polygon")
    place = first[slot]
    surface = SurfaceSamples(
        triangle=(place // 3).astype(np.int32),
        corners=triangles[place // 3].astype(np.int32),
        barycentric=np.eye(3)[place % 3],
    )
    return LandmarkMap(names=tuple(named), surface=surface)


def transferred(known: LandmarkMap, source: Mesh, target: Mesh) -> LandmarkMap:
    """The same landmarks on another mesh of the same actor: its nearest points that face alike.

    Args:
        known: the landmarks of `source`.
        source: registered to the actor, world mm.
        target: registered to him too, of any topology.
    """
    points = known.surface.points(source.vertices)
    normals = known.surface.points(np.nan_to_num(source.normals()))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    surface = MatchSurface(target.vertices, target.triangles, normal_mm=_NORMAL_MM)
    met = surface.match(points, normals)
    return LandmarkMap(
        names=known.names, surface=_located(met.corners, met.barycentric, target.triangles)
    )


def read_landmark_map(path: Path, mesh: Mesh) -> LandmarkMap:
    """Read which points of a mesh the landmarks are.

    ::

        {"vertices": {"nose_bridge_3": 4857, "lip_outer_0": 5708}}
        {"vertices": [1225, 1888, null, ...]}
        {"points": {"lip_outer_0": {"corners": [5708, 5709, 5695], "weights": [0.5, 0.5, 0]}}}

    A list has the 68 of the layout, null where the mesh has none.

    Args:
        path: the file.
        mesh: what the numbers count vertices of.

    Raises:
        TakeError: listing what does not fit, by its place in the file.
    """
    document = read_json(path, TakeError, absent=_ABSENT)
    problems: list[str] = []
    found = parse_landmark_map(document, mesh, problems)
    if not problems and not found.names:
        problems.append("no landmarks: expected vertices or points")
    raise_all(f"{path}", problems, TakeError)
    return found


def write_landmark_map(path: Path, where: LandmarkMap) -> None:
    """Write what `read_landmark_map` reads, whole or not at all."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(where.document(), indent=1) + "\n", encoding="utf-8")


def map_beside(mesh_path: Path) -> Path:
    """Where a mesh's landmark map stands: `head.obj` -> `head.landmarks.json`."""
    return Path(mesh_path).with_suffix(".landmarks.json")


def parse_landmark_map(document: Any, mesh: Mesh, problems: list[str]) -> LandmarkMap:
    """The map in a JSON document; what does not fit is added to `problems` and left out."""
    nothing = vertex_map({}, mesh.triangles)
    if not isinstance(document, dict):
        problems.append(f"expected an object, found a {type(document).__name__}")
        return nothing
    used = np.zeros(len(mesh.vertices), dtype=np.bool_)
    used[mesh.triangles] = True
    named = _named_vertices(document.get("vertices", {}), used, problems)
    corners, weights, names = [], [], []
    entries = document.get("points", {})
    if not isinstance(entries, dict):
        problems.append("points: expected an object of names")
        entries = {}
    rows = {tuple(sorted(row)) for row in mesh.triangles.tolist()} if entries else set()
    for name, point in entries.items():
        fault = _point_fault(point, rows)
        if fault:
            problems.append(f"points.{name}: {fault}")
        elif name not in named:
            names.append(name)
            corners.append(point["corners"])
            weights.append(point["weights"])
    whole = vertex_map(named, mesh.triangles)
    if not names:
        return whole
    more = _located(np.array(corners), np.array(weights, dtype=np.float64), mesh.triangles)
    return LandmarkMap(
        names=whole.names + tuple(names),
        surface=SurfaceSamples(
            triangle=np.concatenate([whole.surface.triangle, more.triangle]),
            corners=np.concatenate([whole.surface.corners, more.corners]),
            barycentric=np.concatenate([whole.surface.barycentric, more.barycentric]),
        ),
    )


def _named_vertices(given: Any, used: Bools, problems: list[str]) -> dict[str, int]:
    if isinstance(given, list):
        if len(given) != LANDMARKS:
            problems.append(f"vertices: a list has {LANDMARKS} entries, found {len(given)}")
            return {}
        pairs = [(f"vertices[{i}]", LANDMARK_NAMES[i], v) for i, v in enumerate(given)]
        pairs = [pair for pair in pairs if pair[2] is not None]
    elif isinstance(given, dict):
        pairs = [(f"vertices.{name}", name, vertex) for name, vertex in given.items()]
    else:
        problems.append(f"vertices: expected a list of {LANDMARKS} or an object of names")
        return {}
    found: dict[str, int] = {}
    for place, name, vertex in pairs:
        whole = isinstance(vertex, int) and not isinstance(vertex, bool)
        if not whole or not 0 <= vertex < len(used):
            problems.append(
                f"{place}: vertex must be a whole number in 0..{len(used) - 1}, found {vertex!r}"
            )
        elif not used[vertex]:
            problems.append(f"{place}: vertex {vertex} is in no polygon")
        else:
            found[name] = vertex
    return found


def _point_fault(point: Any, rows: set[tuple[int, ...]]) -> str:
    """What is wrong with {"corners": [a, b, c], "weights": [u, v, w]}; empty when nothing is."""
    if not isinstance(point, dict) or set(point) != {"corners", "weights"}:
        return f"expected corners and weights, found {point!r}"
    corners, weights = point["corners"], point["weights"]
    if not isinstance(corners, list) or not all(type(c) is int for c in corners):
        return f"corners must be three vertices, found {corners!r}"
    if tuple(sorted(corners)) not in rows:
        return f"corners {corners!r} are no triangle of the mesh"
    if not isinstance(weights, list) or not all(type(w) in (int, float) for w in weights):
        return f"weights must be three numbers, found {weights!r}"
    if len(weights) != 3 or not abs(sum(weights) - 1.0) < 1e-4:
        return f"weights must be three numbers of sum 1, found {weights!r}"
    return ""


def _located(corners: Ints, barycentric: Floats, triangles: Ints32) -> SurfaceSamples:
    """Surface points whose triangles are found again by their corners, in any order."""
    check_shape(corners=(corners, "N 3"), barycentric=(barycentric, "N 3"))
    keys = {tuple(row): index for index, row in enumerate(np.sort(triangles, axis=1).tolist())}
    owner = np.array([keys[tuple(sorted(row))] for row in corners.tolist()], dtype=np.int32)
    return SurfaceSamples(triangle=owner, corners=corners.astype(np.int32), barycentric=barycentric)
