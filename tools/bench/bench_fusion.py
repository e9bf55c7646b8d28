"""Ways of turning the same depth views into a surface, on one frame of a visiting take, in one run.

    python -m tools.bench.bench_fusion TAKE FRAME [--score SCORE_SCAN.py] [--cells 0.7,0.9,1.4]

The pairs are matched once. Then each way is timed by itself: the fused points as they are, and
the screened Poisson surface through them with several finest cells, mm. `--score` names a script
called with TAKE FRAME SCAN that prints one JSON line, such as score_scan.py; points are scored
as a mesh of one tiny triangle each. One JSON line a way: seconds of wall clock and of processor,
peak memory of the process so far, and the score.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from capture.camera_file import read_cameras
from recon.fusion import Points, fuse
from recon.png import decode_png
from recon.scan import ReconSettings
from recon.stereo import match_views
from recon.surface import Scan, SurfaceSettings, poisson_scan, write_ply

_Value = TypeVar("_Value")
_TINY_MM = 1e-3


def main() -> None:
    """Match one frame, then print one JSON line for each way of making a surface of it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("take", type=Path)
    parser.add_argument("frame", type=int)
    parser.add_argument("--score", type=Path, help="script called with TAKE FRAME SCAN")
    parser.add_argument("--cells", default="0.7,0.9,1.4", help="finest Poisson cells, mm")
    arguments = parser.parse_args()
    settings, workers = ReconSettings(), os.cpu_count() or 1
    cameras = read_cameras(arguments.take / "cameras.json")
    images = {}
    for camera in cameras:
        path = arguments.take / camera.name / f"{arguments.frame:04d}.png"
        images[camera.name] = decode_png(path.read_bytes(), path)
    pairs, times = _timed(lambda: match_views(cameras, images, settings.stereo(), workers=workers))
    print(json.dumps({"way": "match", **times}), flush=True)
    views = [pair.view for pair in pairs if pair.view is not None]
    points, times = _timed(lambda: fuse(views, settings.fusion(), workers=workers))
    row = {"way": "points", "count": len(points), "rejected": dict(points.rejected)}
    _report({**row, **times}, _as_triangles(points), arguments)
    for cell in arguments.cells.split(","):
        scan, times = _timed(_poisson(points, float(cell)))
        row = {"way": f"poisson {cell} mm", "count": len(scan.vertices)}
        _report({**row, **times}, scan, arguments)


def _poisson(points: Points, cell_mm: float) -> Callable[[], Scan]:
    settings = SurfaceSettings(cell_spacings=cell_mm / points.spacing_mm, depth_max=12)
    return lambda: poisson_scan(points, settings)


def _timed(work: Callable[[], _Value]) -> tuple[_Value, dict[str, float]]:
    wall, processor = time.perf_counter(), time.process_time()
    value = work()
    return value, {
        "wall_s": round(time.perf_counter() - wall, 2),
        "cpu_s": round(time.process_time() - processor, 2),
    }


def _as_triangles(points: Points) -> Scan:
    """Each point as a triangle far below the noise, so that points and meshes score alike."""
    corners = _TINY_MM * np.eye(3, dtype=np.float32)
    vertices = (points.positions[:, None, :] + corners[None]).reshape(-1, 3)
    triangles = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Scan(
        vertices, triangles, np.repeat(points.normals, 3, axis=0), np.repeat(points.confidence, 3)
    )


def _report(row: dict[str, Any], scan: Scan, arguments: argparse.Namespace) -> None:
    row["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    if arguments.score:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scan.ply"
            write_ply(path, scan)
            command = [sys.executable, str(arguments.score), str(arguments.take)]
            done = subprocess.run(
                [*command, str(arguments.frame), str(path)],
                check=True, capture_output=True, text=True,
            )  # fmt: skip
        row["score"] = json.loads(done.stdout.splitlines()[-1])
    print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
