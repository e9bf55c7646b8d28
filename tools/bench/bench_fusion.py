"""Ways of turning the same depth views into a surface, on one frame of a visiting take, in one run.

    python -m tools.bench.bench_fusion TAKE FRAME [--score SCORE_SCAN.py] [--cells 0.7,0.9,1.4]
        [--out FOLDER]

The pairs are matched once, and their aims corrected where the stage would. Then each way is timed
by itself: our points as they are, the screened Poisson surface through them with several finest
cells, mm; Open3D's TSDF of the same depth maps; COLMAP's `stereo_fusion` of them, with its own
settings and with ours (three pixels, `agree_px` of depth), its points as they are and under the
same Poisson surface. `--score` names a script called with TAKE FRAME SCAN that prints one JSON
line, such as score_scan.py; points are scored as a mesh of one tiny triangle each. One JSON line a
way: seconds of wall clock and of processor, memory beyond what was held before, and the score; of a
Poisson surface the seconds are those of its points and its own, the memory is the more of both. At
the end the same as a Markdown table.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture.camera_file import read_cameras
from recon.aim import aimed, estimate_aims
from recon.fusion import DepthView, Points, fuse
from recon.png import decode_png
from recon.scan import ReconSettings
from recon.stereo import match_views
from recon.surface import Scan, SurfaceSettings, poisson_scan, write_ply
from tools.bench.cost import measured
from tools.bench.fusion_opponents import (
    ColmapSettings,
    TsdfSettings,
    colmap_fusion,
    footprint_mm,
    tsdf_scan,
)

_TINY_MM = 1e-3
_TSDF_PAIRS = (1, 2, 3)
_COARSE_VOXELS = 2.0  # of truncation, with voxels of the size of our Poisson cells
_SCORES = (
    ("median mm", "median", 1.0, "{:.3f}"),
    ("rms mm", "rms", 1.0, "{:.3f}"),
    ("beyond 1 mm", "outliers_1mm", 100.0, "{:.3f} %"),
    ("complete 0.5 mm", "completeness_05", 100.0, "{:.1f} %"),
    ("complete 0.2 mm", "completeness_02", 100.0, "{:.1f} %"),
)


def main() -> None:
    """Match one frame, then print one JSON line for each way of making a surface of it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("take", type=Path)
    parser.add_argument("frame", type=int)
    parser.add_argument("--score", type=Path, help="script called with TAKE FRAME SCAN")
    parser.add_argument("--cells", default="0.7,0.9,1.4", help="finest Poisson cells, mm")
    parser.add_argument("--out", type=Path, help="folder to keep the scans in")
    arguments = parser.parse_args()
    settings, workers = ReconSettings(), os.cpu_count() or 1
    views, cost = measured(lambda: matched(arguments.take, arguments.frame, settings, workers))
    print(json.dumps({"way": "match", "pairs": len(views), **cost}), flush=True)
    cells = [float(cell) for cell in arguments.cells.split(",")]
    with tempfile.TemporaryDirectory() as folder:
        report = _Report(arguments, arguments.out or Path(folder))
        _run(views, settings, cells, workers, report)
    print("\n" + report.table())


def matched(take: Path, frame: int, settings: ReconSettings, workers: int) -> list[DepthView]:
    """The depth views of one frame, as the stage gives them to fusion."""
    cameras = read_cameras(take / "cameras.json")
    images = {}
    for camera in cameras:
        path = take / camera.name / f"{frame:04d}.png"
        images[camera.name] = decode_png(path.read_bytes(), path)
    pairs = match_views(cameras, images, settings.stereo(), workers=workers)
    aims = estimate_aims(cameras, pairs)
    true = [aimed(pair, aims) for pair in pairs] if aims.correct else pairs
    return [pair.view for pair in true if pair.view is not None]


def alike(views: Sequence[DepthView], settings: ReconSettings) -> ColmapSettings:
    """COLMAP's settings nearest to ours: as many must agree, to the same part of a pixel."""
    shares = []
    for view in views:
        offset = view.geometry.left_column - view.geometry.right_column
        known = view.disparity[np.isfinite(view.disparity)]
        if len(known):
            shares.append(settings.agree_px / (float(np.median(known)) - offset))
    return ColmapSettings(
        pixels=settings.agreeing + 1,
        reprojection_px=1.0,
        depth_share=float(np.median(shares)),
        normal_deg=25.0,  # of single pixels: a plane through a few of them turns so much by noise
    )


def _run(
    views: Sequence[DepthView],
    settings: ReconSettings,
    cells: Sequence[float],
    workers: int,
    report: _Report,
) -> None:
    points, cost = measured(lambda: fuse(views, settings.fusion(), workers=workers))
    report.add("ours, points", as_triangles(points), cost)
    for cell in cells:
        scan, more = measured(_poisson(points, cell))
        report.add(f"ours, Poisson {cell:g} mm", scan, together(cost, more))
    footprint = footprint_mm(views)
    cell_px = settings.cell_spacings * settings.voxel_px
    grids = [TsdfSettings(voxel_px=settings.voxel_px, pairs=pairs) for pairs in _TSDF_PAIRS]
    grids.append(TsdfSettings(voxel_px=cell_px, truncation_voxels=_COARSE_VOXELS, pairs=2))
    for grid in grids:
        scan, cost = measured(partial(tsdf_scan, views, grid))
        size = grid.voxel_px * footprint
        report.add(f"TSDF, voxels {size:.1f} mm, pairs >= {grid.pairs}", scan, cost)
    spacing = settings.voxel_px * footprint
    cell = cell_px * footprint
    for whose, chosen in (("its", ColmapSettings()), ("our", alike(views, settings))):
        fused = partial(colmap_fusion, views, chosen, spacing, workers=workers)
        theirs, cost = measured(fused)
        report.add(f"stereo_fusion, {whose} settings, points", as_triangles(theirs), cost)
        scan, more = measured(_poisson(theirs, cell))
        name = f"stereo_fusion, {whose} settings, Poisson {cell:.1f} mm"
        report.add(name, scan, together(cost, more))


def together(first: dict[str, float], second: dict[str, float]) -> dict[str, float]:
    """The cost of two pieces of work, one after the other: seconds add up, memory does not."""
    return {
        key: round(first[key] + second[key], 2)
        if key.endswith("_s")
        else max(first[key], second[key])
        for key in first
    }


def _poisson(points: Points, cell_mm: float) -> Callable[[], Scan]:
    settings = SurfaceSettings(cell_spacings=cell_mm / points.spacing_mm, depth_max=12)
    return lambda: poisson_scan(points, settings)


def as_triangles(points: Points) -> Scan:
    """Each point as a triangle far below the noise, so that points and meshes score alike."""
    corners = _TINY_MM * np.eye(3, dtype=np.float32)
    vertices = (points.positions[:, None, :] + corners[None]).reshape(-1, 3)
    triangles = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Scan(
        vertices, triangles, np.repeat(points.normals, 3, axis=0), np.repeat(points.confidence, 3)
    )


class _Report:
    """Rows as they come, scored and printed."""

    def __init__(self, arguments: argparse.Namespace, folder: Path) -> None:
        self._arguments, self._folder = arguments, folder
        self._rows: list[dict[str, Any]] = []
        folder.mkdir(parents=True, exist_ok=True)

    def add(self, way: str, scan: Scan, cost: dict[str, float]) -> None:
        """Write a scan, have it scored, print its row."""
        row: dict[str, Any] = {"way": way, "triangles": len(scan.triangles), **cost}
        path = self._folder / f"scan{len(self._rows)}.ply"
        write_ply(path, scan)
        if self._arguments.score:
            command = [sys.executable, str(self._arguments.score), str(self._arguments.take)]
            done = subprocess.run(
                [*command, str(self._arguments.frame), str(path)],
                check=True, capture_output=True, text=True,
            )  # fmt: skip
            row["score"] = json.loads(done.stdout.splitlines()[-1])
        if not self._arguments.out:
            path.unlink()
        self._rows.append(row)
        print(json.dumps(row), flush=True)

    def table(self) -> str:
        """All rows in Markdown."""
        head = ["way", *(title for title, *_ in _SCORES), "processor s", "own MiB"]
        lines = [head, ["---"] * len(head)]
        for row in self._rows:
            score = row.get("score", {})
            cells = [
                form.format(scale * score[key]) if key in score else ""
                for _, key, scale, form in _SCORES
            ]
            lines.append([row["way"], *cells, f"{row['cpu_s']:.1f}", f"{row['own_mib']:.0f}"])
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    main()
