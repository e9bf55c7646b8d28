"""Stereo against a plain opponent on the same frame of a visiting take, in one run.

    python -m tools.bench.bench_stereo TAKE FRAME [--score SCORE_SCAN.py] [--out FOLDER] [--ours]

The opponent is what sixty lines of OpenCV and Open3D give: fourteen pairs, semi-global matching
(eight paths) at full resolution, points of one pair kept where another has one within 0.5 mm,
Poisson at depth 9. `--score` names a script called with TAKE FRAME SCAN that prints one JSON line,
such as score_scan.py. Printed: seconds of wall clock and of processor by step, the peak memory of
the process so far, and the scores.
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
from scipy.spatial import cKDTree

from capture.arrays import Image
from capture.camera import CameraArray
from capture.camera_file import read_cameras
from recon.disparity import seed_disparity
from recon.fusion import DepthView, FusionSettings, Points, fuse, lift
from recon.images import mono
from recon.png import decode_png
from recon.rectify import rectification, resample, spline_coefficients
from recon.scan import ReconSettings
from recon.stereo import match_views, stereo_pairs
from recon.surface import Scan, SurfaceSettings, poisson_scan, write_ply

_Value = TypeVar("_Value")
_PLAIN_PAIRS, _PLAIN_AGREE_MM, _PLAIN_VOXEL_PX, _PLAIN_DEPTH = 14, 0.5, 1.0, 9


class Stopwatch:
    """Wall-clock and processor seconds of named steps."""

    def __init__(self) -> None:
        self.steps: dict[str, dict[str, float]] = {}

    def run(self, name: str, work: Callable[[], _Value]) -> _Value:
        """Do the work and note what it took."""
        wall, processor = time.perf_counter(), time.process_time()
        value = work()
        self.steps[name] = {
            "wall_s": round(time.perf_counter() - wall, 2),
            "cpu_s": round(time.process_time() - processor, 2),
        }
        return value


def ours(cameras: CameraArray, images: dict[str, Image], watch: Stopwatch) -> Scan:
    """The stage's own way, step by step."""
    settings, workers = ReconSettings(), os.cpu_count() or 1
    pairs = watch.run(
        "match", lambda: match_views(cameras, images, settings.stereo(), workers=workers)
    )
    views = [pair.view for pair in pairs if pair.view is not None]
    points = watch.run("fuse", lambda: fuse(views, settings.fusion(), workers=workers))
    return watch.run("mesh", lambda: poisson_scan(points, settings.surface()))


def plain(cameras: CameraArray, images: dict[str, Image], watch: Stopwatch) -> Scan:
    """The opponent."""
    views = watch.run("match", lambda: _plain_views(cameras, images))
    points = watch.run("fuse", lambda: _plain_points(views))
    settings = SurfaceSettings(cell_spacings=0.5, depth_max=_PLAIN_DEPTH)
    return watch.run("mesh", lambda: poisson_scan(points, settings))


def main() -> None:
    """Run both on one frame and print a JSON object a line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("take", type=Path)
    parser.add_argument("frame", type=int)
    parser.add_argument("--score", type=Path, help="script called with TAKE FRAME SCAN")
    parser.add_argument("--out", type=Path, help="folder to keep the scans in")
    parser.add_argument("--ours", action="store_true", help="leave the opponent out")
    arguments = parser.parse_args()
    cameras = read_cameras(arguments.take / "cameras.json")
    images = {}
    for camera in cameras:
        path = arguments.take / camera.name / f"{arguments.frame:04d}.png"
        images[camera.name] = decode_png(path.read_bytes(), path)
    with tempfile.TemporaryDirectory() as folder:
        out = arguments.out or Path(folder)
        for name, way in (("ours", ours), ("plain", plain)):
            if name == "plain" and arguments.ours:
                continue
            print(json.dumps(_measure(name, way, (cameras, images), arguments, out)), flush=True)


def _measure(
    name: str,
    way: Callable[[CameraArray, dict[str, Image], Stopwatch], Scan],
    scene: tuple[CameraArray, dict[str, Image]],
    arguments: argparse.Namespace,
    out: Path,
) -> dict[str, Any]:
    watch = Stopwatch()
    scan = way(*scene, watch)
    path = out / f"{name}.ply"
    write_ply(path, scan)
    row: dict[str, Any] = {"way": name, "vertices": len(scan.vertices), "steps": watch.steps}
    for key in ("wall_s", "cpu_s"):
        row[key] = round(sum(step[key] for step in watch.steps.values()), 2)
    row["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    if arguments.score:
        command = [sys.executable, str(arguments.score), str(arguments.take), str(arguments.frame)]
        done = subprocess.run([*command, str(path)], check=True, capture_output=True, text=True)
        row["score"] = json.loads(done.stdout.splitlines()[-1])
    return row


def _plain_views(cameras: CameraArray, images: dict[str, Image]) -> list[DepthView]:
    settings = ReconSettings().stereo()
    centre, pairs = stereo_pairs(cameras, settings)
    step = max(len(pairs) // _PLAIN_PAIRS, 1)
    views = []
    for pair in pairs[::step][:_PLAIN_PAIRS]:
        geometry = rectification(
            cameras[pair.left], cameras[pair.right], centre, settings.extent_mm
        )
        planes = []
        for side, index in (("left", pair.left), ("right", pair.right)):
            coefficients = spline_coefficients(mono(images[cameras[index].name]))
            plane, inside = resample(coefficients, *geometry.maps(side))
            plane[~inside] = np.nan
            planes.append(plane)
        depth = float(geometry.rotation[2] @ (centre - geometry.left.centre))
        reach = settings.depth_mm
        low, high = geometry.disparity(np.array([depth + reach, depth - reach])).tolist()
        disparity = seed_disparity(planes[0], planes[1], (low, high), 5)
        views.append(DepthView(geometry, disparity, np.full_like(disparity, 0.15)))
    return views


def _plain_points(views: list[DepthView]) -> Points:
    lifted = [lift(view) for view in views]
    trees = [cKDTree(points) for points, _, _ in lifted]
    kept, directions = [], []
    for own, (points, normals, _) in enumerate(lifted):
        confirmed = np.zeros(len(points), np.bool_)
        for other, tree in enumerate(trees):
            if other != own:
                rest = np.flatnonzero(~confirmed)
                gap, _ = tree.query(points[rest], distance_upper_bound=_PLAIN_AGREE_MM)
                confirmed[rest[np.isfinite(gap)]] = True
        confirmed &= np.isfinite(normals).all(axis=1)
        kept.append(points[confirmed])
        directions.append(normals[confirmed])
    positions, normals = np.concatenate(kept), np.concatenate(directions)
    one = np.ones(len(positions), np.float32)
    spacing = _PLAIN_VOXEL_PX * fuse(views[:1], FusionSettings()).spacing_mm
    return Points(positions, normals, one, one.astype(np.int32), spacing, (np.nan, np.nan))


if __name__ == "__main__":
    main()
