"""Carry calibrated cameras from one format to another: ours, COLMAP, OpenCV, Metashape, Kalibr.

What was written is read back and compared with what was read. Distortion that a format, or likeness
itself, cannot hold is refused, never dropped. docs/cameras.md tells the conventions of each format.
Example: likeness cameras cameras.json --out camchain.yaml --to kalibr
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from capture.camera import Camera, CameraArray
from capture.errors import CameraError
from capture.progress import Progress
from recon.camera_parts import TERMS, check_unit, scaled
from recon.exchange.cameras import (
    FORMATS,
    CameraFormat,
    kind_of_suffix,
    largest_difference_px,
    read_any,
    recognise,
    write_any,
)
from tools.verbs.options import Options

Kind = Literal["likeness", "colmap", "colmap-text", "opencv", "metashape", "kalibr"]


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness cameras`."""

    source: tyro.conf.Positional[Path]
    """The cameras to read: a file, or the folder of a COLMAP model."""
    out: Path
    """The file to write; for COLMAP a folder."""
    source_kind: Annotated[Kind | None, tyro.conf.arg(name="from")] = None
    """The format to read; recognised by content when left out."""
    to: Kind | None = None
    """The format to write; the suffix of --out tells it when left out, if only one has it."""
    unit_mm: float | None = None
    """Millimetres of one unit of what is read: 1 for COLMAP and OpenCV, 1000 for Metashape and
    Kalibr when left out."""
    out_unit_mm: float | None = None
    """Millimetres of one unit of what is written; the same when left out."""
    scale: float = 1.0
    """Multiply all distances by this, about the world's origin: true length over found length."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Read, scale, write, read back, and report by camera what was converted."""
    check_unit(arguments.scale, "--scale")
    if arguments.out.resolve() == arguments.source.resolve():
        raise CameraError(
            f"--out {arguments.out}: is what is read, and holds what a copy does not (gains, the "
            "calibration's report, points); choose another name"
        )
    kind = arguments.source_kind or recognise(arguments.source)
    to = arguments.to or kind_of_suffix(arguments.out)
    cameras = read_any(arguments.source, kind, arguments.unit_mm)
    if arguments.scale != 1.0:
        cameras = scaled(cameras, arguments.scale)
    write_any(arguments.out, cameras, to, arguments.out_unit_mm)
    again = read_any(arguments.out, to, arguments.out_unit_mm)
    progress(1, 1, "cameras")
    known = (FORMATS[kind], FORMATS[to])
    units = (arguments.unit_mm or known[0].unit_mm, arguments.out_unit_mm or known[1].unit_mm)
    return {
        "out": str(arguments.out),
        "from": kind,
        "to": to,
        "unit_mm": units[0],
        "out_unit_mm": units[1],
        "scale": arguments.scale,
        "read_back_px": largest_difference_px(cameras, in_order(again, cameras)),
        "cameras": {camera.name: _told(camera, known) for camera in cameras},
    }


def in_order(found: CameraArray, wanted: CameraArray) -> CameraArray:
    """The cameras of `found` in the order of `wanted`.

    Raises:
        CameraError: when the names are not the same.
    """
    if set(found.names) != set(wanted.names):
        raise CameraError(f"wrote {', '.join(wanted.names)}, read back {', '.join(found.names)}")
    return CameraArray(tuple(found.by_name(name) for name in wanted.names))


def _told(camera: Camera, known: tuple[CameraFormat, CameraFormat]) -> dict[str, Any]:
    terms = dict(zip(TERMS, camera.distortion.tolist(), strict=True))
    return {
        "size_px": [camera.width, camera.height],
        "focal_px": [camera.fx, camera.fy],
        "centre_px": [camera.cx, camera.cy],
        "distortion": {term: value for term, value in terms.items() if value != 0},
        "place_mm": camera.centre.tolist(),
        "read": list(known[0].notes),
        "written": list(known[1].notes),
    }
