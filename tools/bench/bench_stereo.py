"""Stereo against a plain opponent on the same frame of a visiting take, in one run.

    python -m tools.bench.bench_stereo TAKE FRAME [--score SCORE_SCAN.py] [--out FOLDER] [--ours]
        [--prior SCAN.ply] [--no-mesh]
    python -m tools.bench.bench_stereo TAKE FRAME --scaling FOLDER

The opponent is what sixty lines of OpenCV and Open3D give: fourteen horizontal pairs of neighbours,
semi-global matching (eight paths) at full resolution, points of one pair kept where another has one
within 0.5 mm, Poisson at depth 9, trimmed generously. `--score` names a script called with TAKE
FRAME SCAN that prints one JSON line, such as score_scan.py. Printed: seconds of wall clock and of
processor, the peak memory of the process so far, and the scores. `--prior` looks near a mesh, an
earlier scan say; `--no-mesh` stops at the oriented points. `--scaling` times ours on smaller images
and fewer views, twice each, and writes the better times to scaling.json and a plot to scaling.svg.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from scipy.spatial import cKDTree

from capture.arrays import Floats, Image
from capture.camera import Camera, CameraArray
from capture.camera_file import read_cameras
from recon.fusion import DepthView, FusionSettings, Points, fuse, lift
from recon.images import mono
from recon.pairs import PairSettings, StereoPair, scene_centre, select_pairs
from recon.png import decode_png
from recon.prior import PriorMesh
from recon.rectify import rectification, resample, spline_coefficients
from recon.scan import ReconSettings, load_scan, reconstruct_images
from recon.surface import Scan, SurfaceSettings, poisson_scan, write_ply
from tools.bench.bench_disparity import PairCase, matchers
from tools.report.charts import Labels, Series, line_chart

_Value = TypeVar("_Value")
_PLAIN_PAIRS, _PLAIN_BEST_DEG, _PLAIN_AGREE_MM = 14, 18.0, 0.5
_PLAIN_ANGLES = PairSettings(angle_min_deg=9.0, angle_max_deg=27.0, partners=64)
_PLAIN_SLOPE = 0.6  # of a horizontal baseline
_PLAIN_EXTENT_MM, _PLAIN_NEARER_MM, _PLAIN_FARTHER_MM = 160.0, 85.0, 50.0
_PLAIN_VOXEL_PX, _PLAIN_SURFACE = (
    1.5,
    SurfaceSettings(cell_spacings=0.5, depth_max=9, evidence_spacings=5.0),
)
_FRACTIONS, _VIEWS, _TURNS = (0.5, 0.75, 1.0), (8, 12, 16), 2


@dataclass(frozen=True, eq=False)
class Instant:
    """The images of one instant, by camera name, the cameras, and a mesh to look near to."""

    cameras: CameraArray
    images: dict[str, Image]
    prior: PriorMesh | None = None
    mesh: bool = True


@dataclass
class Stopwatch:
    """Wall-clock and processor seconds of named steps."""

    steps: dict[str, dict[str, float]] = field(default_factory=dict)

    def run(self, name: str, work: Callable[[], _Value]) -> _Value:
        """Do the work and note what it took."""
        wall, processor = time.perf_counter(), time.process_time()
        value = work()
        self.steps[name] = {
            "wall_s": round(time.perf_counter() - wall, 2),
            "cpu_s": round(time.process_time() - processor, 2),
        }
        return value


def load_instant(take: Path, frame: int) -> Instant:
    """One frame of a visiting take."""
    cameras = read_cameras(take / "cameras.json")
    images = {}
    for camera in cameras:
        path = take / camera.name / f"{frame:04d}.png"
        images[camera.name] = decode_png(path.read_bytes(), path)
    return Instant(cameras, images)


def ours(instant: Instant, watch: Stopwatch) -> Scan:
    """The stage's own way; its own wall clock by step, the processor as a whole."""
    settings = ReconSettings(mesh=instant.mesh)
    result = watch.run(
        "all",
        lambda: reconstruct_images(instant.cameras, instant.images, settings, prior=instant.prior),
    )
    for name, seconds in result.report["seconds"].items():
        watch.steps[name] = {"wall_s": round(seconds, 2)}
    return result.scan


def plain(instant: Instant, watch: Stopwatch) -> Scan:
    """The opponent."""
    views = watch.run("match", lambda: _plain_views(instant.cameras, instant.images))
    points = watch.run("fuse", lambda: _plain_points(views))
    return watch.run("mesh", lambda: poisson_scan(points, _PLAIN_SURFACE))


def horizontal_neighbours(cameras: CameraArray) -> tuple[StereoPair, ...]:
    """The pairs a plain script takes: neighbours side by side, about 18 degrees apart."""
    pairs = []
    for pair in select_pairs(cameras, scene_centre(cameras), _PLAIN_ANGLES):
        left, right = cameras[pair.left], cameras[pair.right]
        axes = left.camera_from_world.rotation + right.camera_from_world.rotation
        along = np.abs(axes @ (right.centre - left.centre))
        if along[1] < _PLAIN_SLOPE * along[0]:
            pairs.append(pair)
    pairs.sort(key=lambda pair: abs(pair.angle_deg - _PLAIN_BEST_DEG))
    return tuple(sorted(pairs[:_PLAIN_PAIRS], key=lambda pair: (pair.left, pair.right)))


def shrunk(instant: Instant, fraction: float) -> Instant:
    """The same instant at a fraction of its resolution, pixels averaged by area."""
    cameras, images = [], {}
    for camera in instant.cameras:
        size = (round(camera.width * fraction), round(camera.height * fraction))
        image = cv2.resize(instant.images[camera.name], size, interpolation=cv2.INTER_AREA)
        images[camera.name] = image
        cameras.append(_resized(camera, *size))
    return replace(instant, cameras=CameraArray(tuple(cameras)), images=images)


def fewer(instant: Instant, count: int) -> Instant:
    """The same instant seen by `count` of its cameras, next to each other in the array's order."""
    first = (len(instant.cameras) - count) // 2
    chosen = CameraArray(instant.cameras.cameras[first : first + count])
    return replace(
        instant, cameras=chosen, images={name: instant.images[name] for name in chosen.names}
    )


def scaling(instant: Instant, folder: Path) -> list[dict[str, float]]:
    """Time ours over sizes and numbers of views; write scaling.json and scaling.svg.

    Returns:
        Rows of megapixels (of all views together), views, wall_s, cpu_s and pairs.
    """
    rows = []
    cases = [(fraction, len(instant.cameras)) for fraction in _FRACTIONS]
    cases += [(1.0, count) for count in _VIEWS if count < len(instant.cameras)]
    for fraction, count in cases:
        some = shrunk(fewer(instant, count), fraction)
        pixels = sum(camera.width * camera.height for camera in some.cameras)
        wall, processor, pairs = np.inf, np.inf, 0
        for _ in range(_TURNS):
            watch = Stopwatch()
            result = watch.run("all", partial(reconstruct_images, some.cameras, some.images))
            wall = min(wall, watch.steps["all"]["wall_s"])
            processor = min(processor, watch.steps["all"]["cpu_s"])
            pairs = len(result.report["pairs"])
        rows.append(
            {
                "megapixels": round(pixels / 1e6, 3), "views": count, "fraction": fraction,
                "pairs": pairs, "wall_s": wall, "cpu_s": processor,
            }
        )  # fmt: skip
        print(json.dumps(rows[-1]), flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scaling.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    (folder / "scaling.svg").write_text(_plot(rows), encoding="utf-8")
    return rows


def main() -> None:
    """Run both on one frame and print a JSON object a line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("take", type=Path)
    parser.add_argument("frame", type=int)
    parser.add_argument("--score", type=Path, help="script called with TAKE FRAME SCAN")
    parser.add_argument("--out", type=Path, help="folder to keep the scans in")
    parser.add_argument("--ours", action="store_true", help="leave the opponent out")
    parser.add_argument("--prior", type=Path, help="a mesh (PLY) for ours to look near to")
    parser.add_argument("--no-mesh", action="store_true", help="ours stops at oriented points")
    parser.add_argument("--scaling", type=Path, help="folder for times over sizes and views")
    arguments = parser.parse_args()
    instant = load_instant(arguments.take, arguments.frame)
    if arguments.scaling:
        scaling(instant, arguments.scaling)
        return
    near = None
    if arguments.prior:
        mesh = load_scan(arguments.prior)
        near = PriorMesh(mesh.vertices, mesh.triangles, ReconSettings().prior_mm)
    instant = replace(instant, prior=near, mesh=not arguments.no_mesh)
    ways = {"ours": ours} if arguments.ours else {"ours": ours, "plain": plain}
    with tempfile.TemporaryDirectory() as folder:
        out = arguments.out or Path(folder)
        for name, way in ways.items():
            watch = Stopwatch()
            write_ply(out / f"{name}.ply", way(instant, watch))
            print(json.dumps(_told(name, watch, arguments, out / f"{name}.ply")), flush=True)


def _told(name: str, watch: Stopwatch, arguments: argparse.Namespace, path: Path) -> dict[str, Any]:
    row: dict[str, Any] = {"way": name, "steps": watch.steps}
    for key in ("wall_s", "cpu_s"):
        whole = watch.steps.get("all")
        total = whole[key] if whole else sum(step[key] for step in watch.steps.values())
        row[key] = round(total, 2)
    row["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    if arguments.score:
        command = [sys.executable, str(arguments.score), str(arguments.take), str(arguments.frame)]
        done = subprocess.run([*command, str(path)], check=True, capture_output=True, text=True)
        row["score"] = json.loads(done.stdout.splitlines()[-1])
    return row


def _resized(camera: Camera, width: int, height: int) -> Camera:
    """The same lens before larger pixels; their centres lie at integers again."""
    across, down = width / camera.width, height / camera.height
    return replace(
        camera, width=width, height=height, fx=across * camera.fx, fy=down * camera.fy,
        cx=across * (camera.cx + 0.5) - 0.5, cy=down * (camera.cy + 0.5) - 0.5,
    )  # fmt: skip


def _plot(rows: list[dict[str, float]]) -> str:
    """Seconds over megapixels of all views together, as a drawing that stands alone."""
    full = max(row["views"] for row in rows)
    lines = []
    for key, words in (("wall_s", "wall clock"), ("cpu_s", "processor")):
        sizes = sorted((r["megapixels"], r[key]) for r in rows if r["views"] == full)
        views = sorted((r["megapixels"], r[key]) for r in rows if r["fraction"] == 1.0)
        for name, line in ((f"{words}, smaller images", sizes), (f"{words}, fewer views", views)):
            x, y = zip((0.0, 0.0), *line, strict=True)
            lines.append(Series(name=name, x=x, y=y))
    drawn = line_chart(
        lines, Labels(title="Cost of a scan", x="megapixels of all views", y="seconds")
    )
    style = resources.files("tools.report").joinpath("page.css").read_text(encoding="utf-8")
    head, _, rest = drawn.partition(">")
    return f'{head} xmlns="http://www.w3.org/2000/svg"><style>{style}</style>{rest}\n'


def _plain_views(cameras: CameraArray, images: dict[str, Image]) -> list[DepthView]:
    match = matchers()["SGBM HH"]
    centre = scene_centre(cameras)
    views = []
    for pair in horizontal_neighbours(cameras):
        geometry = rectification(cameras[pair.left], cameras[pair.right], centre, _PLAIN_EXTENT_MM)
        planes = []
        for side, index in (("left", pair.left), ("right", pair.right)):
            coefficients = spline_coefficients(mono(images[cameras[index].name]))
            plane, inside = resample(coefficients, *geometry.maps(side))
            plane[~inside] = np.nan
            planes.append(plane)
        depth = float(geometry.rotation[2] @ (centre - geometry.left.centre))
        reach: Floats = np.array([depth + _PLAIN_FARTHER_MM, depth - _PLAIN_NEARER_MM])
        low, high = geometry.disparity(reach).tolist()
        disparity = match(PairCase(planes[0], planes[1], (low, high), np.empty((0, 0))))
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
