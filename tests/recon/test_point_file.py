"""Points as a product: read back bit for bit, told from meshes, damage refused by name."""

from pathlib import Path

import numpy as np
import pytest

from capture.errors import TakeError
from recon.point_file import is_points_file, points_scan, read_points
from recon.surface import Scan, write_ply
from tests.recon.test_mesh_process import cloud
from tests.recon.test_prior import sphere


def written(folder: Path) -> Path:
    path = folder / "points_0000.ply"
    write_ply(path, points_scan(cloud(8)))
    return path


def test_points_come_back_bit_for_bit(tmp_path: Path):
    path = written(tmp_path)
    points, found = cloud(8), read_points(path)
    assert found.vertices.tobytes() == points.positions.tobytes()
    assert found.normals.tobytes() == points.normals.tobytes()
    assert found.confidence.tobytes() == points.confidence.tobytes()
    assert found.triangles.shape == (0, 3)


def test_points_are_told_from_meshes(tmp_path: Path):
    assert is_points_file(written(tmp_path))
    vertices, triangles = sphere(6)
    flat = vertices.astype(np.float32)
    mesh = Scan(flat, triangles, flat, np.ones(len(flat), np.float32))
    write_ply(tmp_path / "mesh.ply", mesh)
    assert not is_points_file(tmp_path / "mesh.ply")
    assert not is_points_file(tmp_path / "gone.ply")
    (tmp_path / "text.ply").write_text("no header\n", encoding="utf-8")
    assert not is_points_file(tmp_path / "text.ply")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda data: b"", "expected a binary PLY file of points"),
        (lambda data: data.replace(b"binary_little", b"binary_bigger"), "expected a binary PLY"),
        (lambda data: data.replace(b"float confidence", b"float doubtfully"), "confidence"),
        (lambda data: data[:-40], "ends before the last"),
    ],
)
def test_damage_is_named(tmp_path: Path, damage, words: str):
    path = written(tmp_path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(TakeError, match=rf"points_0000\.ply.*{words}"):
        read_points(path)
