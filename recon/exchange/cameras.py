"""Cameras in and out of every format that likeness knows; docs/cameras.md tells the conventions."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from capture.camera import CameraArray
from capture.camera_file import read_cameras, write_cameras
from capture.errors import CameraError, raise_all
from capture.names import is_plain_name, known_hint
from recon.camera_parts import read_bytes
from recon.exchange.kalibr import read_kalibr, write_kalibr
from recon.exchange.metashape import read_metashape, write_metashape
from recon.exchange.opencv import read_opencv, write_opencv

_HEAD = 1 << 16  # bytes in which a file tells what it is
_GRID = 9  # places a side of an image at which two arrays are compared
_DEPTHS_MM = (200.0, 1000.0)


@dataclass(frozen=True, kw_only=True)
class CameraFormat:
    """A format of cameras.

    Attributes:
        name: as on the command line.
        suffixes: of the files it may be written to; empty for a folder.
        unit_mm: millimetres of its unit, unless told otherwise.
        open_unit: whether a file may be in another unit.
        notes: how its numbers differ from ours, in words.
    """

    name: str
    suffixes: tuple[str, ...]
    unit_mm: float
    open_unit: bool
    notes: tuple[str, ...]


_FORMATS = (
    CameraFormat(
        name="likeness", suffixes=(".json",), unit_mm=1.0, open_unit=False, notes=("as it is",)
    ),
    CameraFormat(
        name="colmap", suffixes=(), unit_mm=1.0, open_unit=True,
        notes=("principal point half a pixel further", "place as sensor of one rig"),
    ),
    CameraFormat(
        name="colmap-text", suffixes=(), unit_mm=1.0, open_unit=True,
        notes=("principal point half a pixel further", "place as sensor of one rig"),
    ),
    CameraFormat(
        name="opencv", suffixes=(".yml", ".yaml", ".xml"), unit_mm=1.0, open_unit=True,
        notes=("as it is",),
    ),
    CameraFormat(
        name="metashape", suffixes=(".xml",), unit_mm=1000.0, open_unit=True,
        notes=(
            "principal point from the image's centre", "fx as f + b1", "p1 and p2 change places",
            "place as chunk_from_camera",
        ),
    ),
    CameraFormat(
        name="kalibr", suffixes=(".yaml", ".yml"), unit_mm=1000.0, open_unit=True,
        notes=("place from the camera before it",),
    ),
)  # fmt: skip
FORMATS: dict[str, CameraFormat] = {known.name: known for known in _FORMATS}
"""Every format by name."""


def read_any(path: Path, kind: str | None = None, unit_mm: float | None = None) -> CameraArray:
    """Read cameras of any format.

    Args:
        path: a file, or the folder of a COLMAP model.
        kind: a name in `FORMATS`; None recognises it by content.
        unit_mm: millimetres of the file's unit; None takes the format's own.

    Raises:
        CameraError: naming the file, and every camera that likeness cannot hold exactly.
    """
    path = Path(path)
    known = _known(kind) if kind is not None else FORMATS[recognise(path)]
    unit = _unit(known, unit_mm, path)
    try:
        array = _reader(known.name, unit)(path)
    except CameraError as error:
        if str(path) in str(error):
            raise
        raise CameraError(f"{path}: {error}") from error
    _check_names(path, array)
    return array


def write_any(
    path: Path, cameras: CameraArray, kind: str | None = None, unit_mm: float | None = None
) -> None:
    """Write cameras in any format, whole or not at all.

    Args:
        path: the file, or for COLMAP the folder.
        cameras: the array.
        kind: a name in `FORMATS`; None takes the one that the suffix means.
        unit_mm: millimetres of the file's unit; None takes the format's own.

    Raises:
        CameraError: naming every camera that the format cannot hold exactly.
    """
    path = Path(path)
    known = _known(kind) if kind is not None else FORMATS[kind_of_suffix(path)]
    suffix = path.suffix.lower()
    if known.suffixes and suffix not in known.suffixes:
        raise CameraError(f"{path}: {known.name} is written to {' or '.join(known.suffixes)}")
    if not known.suffixes and path.is_file():
        raise CameraError(f"{path}: {known.name} is written to a folder, and this is a file")
    if known.suffixes and path.is_dir():
        raise CameraError(f"{path}: {known.name} is written to a file, and this is a folder")
    if not len(cameras):
        raise CameraError(f"{path}: expected at least one camera, found none")
    unit = _unit(known, unit_mm, path)
    _check_names(path, cameras)
    _writer(known.name, unit)(path, cameras)


def recognise(path: Path) -> str:
    """The name of the format of a file or folder, by its content.

    Raises:
        CameraError: when it is none that likeness knows.
    """
    path = Path(path)
    if path.is_dir():
        return "colmap"
    if path.stem in ("cameras", "images", "points3D", "rigs", "frames") and path.suffix in (
        ".bin", ".txt"
    ):  # fmt: skip
        raise CameraError(f"{path}: one file of a COLMAP model; give its folder, {path.parent}")
    try:
        with path.open("rb") as handle:
            head = handle.read(_HEAD).decode("utf-8-sig", errors="replace")
    except OSError:
        head = read_bytes(path, _HEAD).decode()  # tells what is wrong
    start = head.lstrip()
    if re.search(r"^cam0\s*:", head, flags=re.MULTILINE):
        return "kalibr"
    if start.startswith("%YAML") or "<opencv_storage" in head:
        return "opencv"
    if start.startswith("<"):
        return "metashape"
    if start.startswith("{"):
        return "likeness"
    raise CameraError(
        f"{path}: no cameras that likeness knows; it reads {', '.join(FORMATS)}: name one with "
        "--from"
    )


def kind_of_suffix(path: Path) -> str:
    """The name of the format that a name to write to means.

    Raises:
        CameraError: when it means several, or none.
    """
    suffix = Path(path).suffix.lower()
    able = [known.name for known in _FORMATS if suffix in known.suffixes]
    if not suffix:
        return "colmap"
    if len(able) == 1:
        return able[0]
    meant = f"{suffix} may be {' or '.join(able)}" if able else f"{suffix} is none of likeness's"
    raise CameraError(f"{path}: {meant}; name the format with --to: {', '.join(FORMATS)}")


def largest_difference_px(one: CameraArray, other: CameraArray) -> float:
    """How far two arrays differ, as images: the largest distance between their projections.

    Every camera of `one` casts a grid of its pixels to 200 mm and 1000 mm before it; the camera of
    `other` in the same place of the order projects what it hits.

    Returns:
        Pixels; infinity when a point is lost behind a camera.

    Raises:
        CameraError: when the arrays have different numbers of cameras.
    """
    if len(one) != len(other):
        raise CameraError(f"arrays of {len(one)} and {len(other)} cameras cannot be compared")
    worst = 0.0
    for a, b in zip(one, other, strict=True):
        columns = np.linspace(0.0, a.width - 1.0, _GRID)
        rows = np.linspace(0.0, a.height - 1.0, _GRID)
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        for depth in _DEPTHS_MM:
            with np.errstate(over="ignore", invalid="ignore"):
                points = a.unproject(pixels, np.full(len(pixels), depth))
                points = points[np.isfinite(points).all(axis=1)]  # within the fold of the lens
                apart = np.linalg.norm(a.project(points) - b.project(points), axis=1)
            worst = max(worst, float(np.nan_to_num(apart, nan=np.inf).max(initial=0.0)))
    return worst


def _known(kind: str) -> CameraFormat:
    if kind not in FORMATS:
        raise CameraError(f"no format {kind!r} of cameras; {known_hint(kind, FORMATS)}")
    return FORMATS[kind]


def _unit(known: CameraFormat, unit_mm: float | None, path: Path) -> float:
    if unit_mm is None:
        return known.unit_mm
    if not known.open_unit and unit_mm != known.unit_mm:
        raise CameraError(
            f"{path}: cameras.json is always in millimetres, found unit_mm = {unit_mm:g}; "
            "to change the size of the array, scale it"
        )
    return unit_mm


def _check_names(path: Path, cameras: CameraArray) -> None:
    problems = [
        f"{name!r}: a camera's name must be letters, digits, '-', '_' or '.', at most 64"
        for name in cameras.names
        if not is_plain_name(name)
    ]
    raise_all(str(path), problems, CameraError)


def _reader(name: str, unit_mm: float) -> Callable[[Path], CameraArray]:
    if name.startswith("colmap"):
        from recon.colmap import read_model  # a slow import that only these formats need

        return partial(read_model, unit_mm=unit_mm)
    if name == "likeness":
        return read_cameras
    readers = {"opencv": read_opencv, "metashape": read_metashape, "kalibr": read_kalibr}
    return partial(readers[name], unit_mm=unit_mm)


def _writer(name: str, unit_mm: float) -> Callable[[Path, CameraArray], None]:
    if name.startswith("colmap"):
        from recon.colmap import write_model

        return partial(write_model, unit_mm=unit_mm, text=name == "colmap-text")
    if name == "likeness":
        return write_cameras
    writers = {"opencv": write_opencv, "metashape": write_metashape, "kalibr": write_kalibr}
    return partial(writers[name], unit_mm=unit_mm)
