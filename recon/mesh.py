"""`Mesh`: vertices, quads or triangles, uv; triangles derived. OBJ in and out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from capture.arrays import Floats, Floats32, Ints32, check_finite, check_shape
from capture.errors import ShapeError, TakeError
from capture.product import replacing


@dataclass(frozen=True, eq=False)
class Mesh:
    """A polygon mesh in world or model space.

    Attributes:
        vertices: (V, 3) float64, mm.
        polygons: (P, 4) int32 vertex indices; -1 in the last column pads a triangle.
        uv: (P, 4, 2) float32 texture coordinates of each polygon corner, or None.
    """

    vertices: Floats
    polygons: Ints32
    uv: Floats32 | None = None

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        polygons = np.ascontiguousarray(self.polygons, dtype=np.int32)
        if polygons.ndim == 2 and polygons.shape[1] == 3:
            polygons = np.concatenate([polygons, np.full((len(polygons), 1), -1, np.int32)], axis=1)
        check_shape(vertices=(vertices, "V 3"), polygons=(polygons, "P 4"))
        check_finite(vertices=vertices)
        if len(polygons):
            low, high = int(polygons[:, :3].min()), int(polygons.max())
            if low < 0 or int(polygons[:, 3].min()) < -1 or high >= len(vertices):
                raise ShapeError(
                    f"polygons: indices must lie in 0..{len(vertices) - 1} (-1 pads a triangle), "
                    f"found {low}..{high}"
                )
        if self.uv is not None:
            check_shape(polygons=(polygons, "P 4"), uv=(self.uv, "P 4 2"))
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "polygons", polygons)

    @cached_property
    def triangles(self) -> Ints32:
        """(T, 3) int32: each quad split along its first diagonal, quads' first halves first."""
        quads = self.polygons[:, 3] >= 0
        first = self.polygons[:, :3]
        second = self.polygons[quads][:, [0, 2, 3]]
        return np.ascontiguousarray(np.concatenate([first, second]), dtype=np.int32)

    def with_vertices(self, vertices: Floats) -> Mesh:
        """The same topology with other vertices (V, 3)."""
        check_shape(old=(self.vertices, "V 3"), vertices=(vertices, "V 3"))
        return Mesh(vertices, self.polygons, self.uv)

    def normals(self) -> Floats:
        """Area-weighted unit vertex normals (V, 3); NaN at a vertex that no triangle uses."""
        return vertex_normals(self.vertices, self.triangles)


def vertex_normals(vertices: Floats, triangles: Ints32) -> Floats:
    """Area-weighted unit normals (V, 3) of vertices (V, 3), triangles (T, 3); NaN where none."""
    corner = vertices[triangles]
    face = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    total = np.zeros_like(vertices)
    for k in range(3):
        for axis in range(3):
            total[:, axis] += np.bincount(triangles[:, k], face[:, axis], minlength=len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    unit: Floats = total / np.where(length > 0, length, np.nan)
    return unit


def read_obj(path: Path) -> Mesh:
    """Read vertices, triangles and quads, and uv when every corner has one, from an OBJ file.

    Raises:
        TakeError: naming the file, the line and what does not fit.
    """
    positions: list[list[float]] = []
    texture: list[list[float]] = []
    faces: list[list[int]] = []
    corners: list[list[int]] = []
    try:
        lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise TakeError(f"{path}: not readable: {error.strerror}") from error
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0] not in ("v", "vt", "f"):
            continue
        try:
            if words[0] == "v":
                positions.append(_floats(words[1:4], 3))
            elif words[0] == "vt":
                texture.append(_floats(words[1:3], 2))
            else:
                face, corner = _face(words[1:], len(positions), len(texture))
                faces.append(face)
                corners.append(corner)
        except (ValueError, IndexError) as error:
            raise TakeError(
                f"{path}:{number}: expected an OBJ line, found {line[:60]!r}: {error}"
            ) from error
    if not positions or not faces:
        raise TakeError(
            f"{path}: expected vertices and faces, found {len(positions)} and {len(faces)}"
        )
    uv = None
    corner_array = np.array(corners, dtype=np.int64)
    if texture and (corner_array[:, :3] >= 0).all():
        uv = np.array(texture, dtype=np.float32)[np.maximum(corner_array, 0)]
    try:
        return Mesh(np.array(positions), np.array(faces, dtype=np.int32), uv)
    except (ShapeError, ValueError) as error:
        raise TakeError(f"{path}: {error}") from error


def write_obj(path: Path, mesh: Mesh) -> None:
    """Write an OBJ file, whole or not at all; vertex order, quads, uv and float32 are kept."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    if mesh.uv is not None:
        lines += [f"vt {u:.7f} {v:.7f}" for u, v in mesh.uv.reshape(-1, 2).tolist()]
    for index, polygon in enumerate(mesh.polygons.tolist()):
        count = 3 if polygon[3] < 0 else 4
        if mesh.uv is None:
            lines.append("f " + " ".join(str(v + 1) for v in polygon[:count]))
        else:
            lines.append(
                "f " + " ".join(f"{polygon[k] + 1}/{4 * index + k + 1}" for k in range(count))
            )
    with replacing(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _face(words: list[str], positions: int, texture: int) -> tuple[list[int], list[int]]:
    if len(words) not in (3, 4):
        raise ValueError(f"faces of 3 or 4 corners are supported, found {len(words)}")
    face, corner = [], []
    for word in words:
        parts = word.split("/")
        face.append(_index(parts[0], positions))
        corner.append(_index(parts[1], texture) if len(parts) > 1 and parts[1] else -1)
    return face + [-1] * (4 - len(face)), corner + [-1] * (4 - len(corner))


def _floats(words: list[str], count: int) -> list[float]:
    if len(words) != count:
        raise ValueError(f"{count} numbers are needed, found {len(words)}")
    return [float(word) for word in words]


def _index(word: str, count: int) -> int:
    value = int(word)
    index = value - 1 if value > 0 else count + value
    if value == 0 or not 0 <= index < count:
        raise ValueError(f"index {value} of {count}")
    return index
