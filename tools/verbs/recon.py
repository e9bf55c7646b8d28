"""Reconstruct the surface of frames by stereo.

Writes TAKE/products/recon/frame_0000.ply, a mesh in world millimetres, for each chosen frame, and
report.html beside them. With --prior the surface is looked for near a mesh that is known.
Example: likeness recon takes/smile --frames 0:12
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from capture.errors import SolveError, TakeError
from capture.progress import Progress
from capture.take import Take
from recon.mesh import Mesh, read_obj
from recon.prior import PriorMeshes
from recon.scan import ReconSettings, reconstruct
from tools.report.inputs import scan_page
from tools.report.scan import write_scan_report
from tools.verbs.options import Options, parse_frames
from track.performance import read_performance

REQUIRED = ("take",)
_SMALLEST_MM, _LARGEST_MM = 20.0, 5000.0  # of a prior mesh: metres and inches are not taken for mm


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness recon`."""

    take: tyro.conf.Positional[Path]
    """The take; it needs cameras."""
    frames: str | None = None
    """A:B (B excluded), A:B:STEP, A, or A,B,C; all frames when left out."""
    prior: Path | None = None
    """Where the surface is about: a performance.npz, of which each frame takes its own mesh or
    that of the nearest frame before it; or one OBJ mesh for all frames, world mm."""
    settings: Annotated[ReconSettings, tyro.conf.arg(name="")] = field(
        default_factory=ReconSettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Reconstruct, draw the page, and report the files written and what they warn of."""
    take = Take.open(arguments.take)
    frames = parse_frames(arguments.frames, take.frames)
    prior = None if arguments.prior is None else read_prior(arguments.prior)
    page = scan_page(take)
    try:
        scans = reconstruct(take, frames, arguments.settings, prior=prior, progress=progress)
    except SolveError:
        write_scan_report(take, frames, page)  # of what is there: the others are done
        raise
    warnings = write_scan_report(take, frames, page)
    return {
        "take": str(take.folder),
        "frames": frames,
        "scans": [str(scan) for scan in scans],
        "page": str(page),
        "warnings": list(warnings),
    }


def read_prior(path: Path) -> PriorMeshes:
    """Read meshes to look near to: a performance (.npz), or one mesh (.obj) for all frames.

    Raises:
        InputError: when the file is neither, cannot be read, or is not in mm.
    """
    if path.suffix.lower() == ".obj":
        mesh = read_obj(path)
        return _meshes(path, [0], mesh.vertices[None], mesh)
    if path.suffix.lower() != ".npz":
        raise TakeError(
            f"{path}: expected the performance.npz that `likeness track` wrote, or an .obj mesh"
        )
    tracked = read_performance(path)
    order = np.argsort(tracked.frames, kind="stable")
    vertices = tracked.vertices[order]
    mesh = Mesh(vertices[0].astype(np.float64), tracked.polygons)
    return _meshes(path, tracked.frames[order].tolist(), vertices, mesh)


def _meshes(path: Path, frames: Sequence[int], vertices: Any, mesh: Mesh) -> PriorMeshes:
    size = float(np.ptp(vertices[0], axis=0).max())
    if not _SMALLEST_MM <= size <= _LARGEST_MM:
        raise TakeError(
            f"{path}: expected a face or head in world mm, found a mesh {size:.3g} across"
        )
    return PriorMeshes(
        np.asarray(frames, dtype=np.int64), np.asarray(vertices, dtype=np.float32), mesh.triangles
    )
