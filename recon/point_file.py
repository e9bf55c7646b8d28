"""Oriented points as a product of their own: the PLY of a frame that was not meshed."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from capture.errors import TakeError
from recon.fusion import Points
from recon.surface import Scan

_HEADER_BYTES = 4096
_NUMBERS = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}


def points_scan(points: Points) -> Scan:
    """Oriented points as a scan without triangles, fit for `write_ply`."""
    return Scan(points.positions, np.zeros((0, 3), np.int32), points.normals, points.confidence)


def is_points_file(path: Path) -> bool:
    """Whether a PLY file says that it holds vertices and no faces; False when there is none."""
    header = _header(path)
    return re.search(r"^element face [1-9]", header, re.MULTILINE) is None and bool(header)


def read_points(path: Path) -> Scan:
    """Read points that `likeness recon` wrote: positions, normals, confidence; no triangles.

    Raises:
        TakeError: naming the file and what was found.
    """
    header = _header(path)
    count = re.search(r"^element vertex (\d+)$", header, re.MULTILINE)
    names = re.findall(r"^property (\w+) (\w+)$", header, re.MULTILINE)
    wanted = {"x", "y", "z", "nx", "ny", "nz", "confidence"}
    if "format binary_little_endian" not in header or count is None:
        raise TakeError(f"{path}: expected a binary PLY file of points")
    if not wanted <= {name for _, name in names} or not {kind for kind, _ in names} <= set(
        _NUMBERS
    ):
        raise TakeError(
            f"{path}: expected points with normals and confidence, found "
            f"{', '.join(name for _, name in names)}"
        )
    kind = np.dtype([(name, _NUMBERS[word]) for word, name in names])
    data = Path(path).read_bytes()[len(header.encode("ascii")) :]
    if len(data) < int(count[1]) * kind.itemsize:
        raise TakeError(f"{path}: expected {count[1]} points, the file ends before the last")
    rows = np.frombuffer(data, kind, int(count[1]))
    stacked = [
        np.stack([rows[name] for name in three], axis=1).astype(np.float32)
        for three in (("x", "y", "z"), ("nx", "ny", "nz"))
    ]
    return Scan(
        stacked[0], np.zeros((0, 3), np.int32), stacked[1], rows["confidence"].astype(np.float32)
    )


def _header(path: Path) -> str:
    """The header of a PLY file, its last line included; empty when it has none."""
    if not Path(path).is_file():
        return ""
    with Path(path).open("rb") as file:
        start = file.read(_HEADER_BYTES)
    end = start.find(b"end_header\n")
    if not start.startswith(b"ply\n") or end < 0:
        return ""
    return start[: end + len(b"end_header\n")].decode("ascii", errors="replace")
