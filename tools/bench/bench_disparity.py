"""Disparity of rectified pairs against truth: ready-made matchers and ours, each by itself.

    python -m tools.bench.bench_disparity --take TAKE [--frame 0] [--pairs 4]
    python -m tools.bench.bench_disparity --cones FOLDER

`--take` rectifies some pairs of a visiting take that has truth.npz, crops them to the face, and
gives every matcher the same views and the same range. Each works in a process of its own, so that
its peak memory is its own. Scored on skin that both views see within 70 degrees: the median error,
the rms of what lies within 1 px, the share beyond 1 px, and the share that is filled. `--cones`
scores the Middlebury pair in that folder on its unoccluded pixels. One JSON object a line.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.archive import read_archive
from capture.arrays import Bools, Floats, Floats32, Ints32
from capture.camera_file import read_cameras
from capture.errors import TakeError
from recon.disparity import DisparitySettings, SeedShape, match_pair
from recon.images import mono
from recon.pairs import StereoPair, scene_centre, select_pairs
from recon.png import decode_png
from recon.rectify import Rectification, rectification, resample, spline_coefficients
from recon.scan import ReconSettings
from recon.surface import SurfaceQuery
from tools.bench.cost import measured

_FACING = 0.35  # 70 degrees
_FACE_VERTICES = 6706  # of the ICT face, where the truth names no region
_MARGIN = 0.06
_BLOCK = 5
# A scene of steps and colours, not skin: nothing is cut off at edges, small patches stay
STEPPED = DisparitySettings(
    seed_px=512, seed_block=1, jump_px=2, contrast_min=0.0, left_right_px=100.0,
    fragment_px=40, edge_px=0,
    seed=SeedShape(jump_cost=16, uniqueness=20, flat_px=25.0, flat_floor=0.08),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class PairCase:
    """A rectified pair with its truth.

    Attributes:
        left: (H, W) float32 0..1; NaN off the image.
        right: (H, W) float32 0..1; NaN off the image.
        limits_px: least and greatest disparity.
        truth: (H, W) float64 px; NaN where it is not scored.
    """

    left: Floats32
    right: Floats32
    limits_px: tuple[float, float]
    truth: Floats


@dataclass(frozen=True, eq=False)
class TrueSurface:
    """The true mesh of one frame, mm, and which of its triangles count."""

    vertices: Floats
    triangles: Ints32
    counted: Bools


def score(disparity: Floats32, truth: Floats) -> dict[str, float]:
    """Errors of a disparity map (H, W) where the truth (H, W) is known; both NaN elsewhere."""
    known = np.isfinite(truth)
    filled = known & np.isfinite(disparity)
    error = np.abs(disparity[filled] - truth[filled])
    near = error[error <= 1.0]
    return {
        "filled": round(float(filled.sum() / max(known.sum(), 1)), 4),
        "bad_1px": round(float((error > 1.0).mean()), 4) if len(error) else float("nan"),
        "median_px": round(float(np.median(error)), 4) if len(error) else float("nan"),
        "rms_px": round(float(np.sqrt((near**2).mean())), 4) if len(near) else float("nan"),
    }


def true_surface(take: Path, frame: int) -> TrueSurface:
    """The true mesh of a frame, teeth and eyes included where the truth has them."""
    truth = read_archive(
        take / "truth.npz", ["vertices", "faces"], ["face_region", "surface", "surface_tri"]
    )
    vertices = truth["vertices"][frame].astype(np.float64)
    faces = truth["faces"].astype(np.int32)
    region = np.zeros(len(vertices), np.bool_)
    region[truth.get("face_region", np.arange(min(_FACE_VERTICES, len(vertices))))] = True
    if faces.shape[1] == 4:
        faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    if "surface" in truth:
        vertices = np.concatenate([vertices, truth["surface"][frame].astype(np.float64)])
        faces = truth["surface_tri"].astype(np.int32)
        region = np.concatenate([region, np.zeros(len(vertices) - len(region), np.bool_)])
    counted: Bools = np.asarray(region[faces].all(axis=1))
    return TrueSurface(vertices, faces, counted)


def true_disparity(geometry: Rectification, surface: TrueSurface) -> Floats:
    """Disparity (H, W), px, of the counted surface that both views see; NaN elsewhere."""
    columns, rows = np.meshgrid(np.arange(geometry.width), np.arange(geometry.height))
    flat = np.stack(
        [
            (columns.ravel() - geometry.left_column) / geometry.focal_px,
            (rows.ravel() - geometry.row) / geometry.focal_px,
            np.ones(columns.size),
        ],
        axis=1,
    )
    rays = flat @ geometry.rotation
    query = SurfaceQuery(surface.vertices, surface.triangles)
    depth, triangle = query.cast_rays(np.broadcast_to(geometry.left.centre, rays.shape), rays)
    hit = np.flatnonzero(triangle >= 0)
    hit = hit[surface.counted[triangle[hit]]]
    points = geometry.left.centre + rays[hit] * depth[hit, None].astype(np.float64)
    corner = surface.vertices[surface.triangles[triangle[hit]]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    good = np.ones(len(hit), np.bool_)
    for camera in (geometry.left, geometry.right):
        towards = camera.centre - points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        good &= (normal * towards).sum(axis=1) > _FACING
        good &= camera.contains(camera.project(points))
    good &= ~query.occluded(points, geometry.right.centre)
    out = np.full(columns.size, np.nan)
    out[hit[good]] = geometry.disparity(depth[hit[good]].astype(np.float64))
    return out.reshape(columns.shape)


def take_cases(take: Path, frame: int, count: int) -> list[tuple[StereoPair, PairCase]]:
    """Some pairs of a take, evenly chosen, rectified and cropped to the counted surface."""
    cameras = read_cameras(take / "cameras.json")
    surface = true_surface(take, frame)
    settings = ReconSettings().stereo()
    centre = scene_centre(cameras)
    pairs = select_pairs(cameras, centre, settings.pairs)
    chosen = np.linspace(0, len(pairs) - 1, min(count, len(pairs))).round().astype(int)
    coefficients: dict[str, Floats32] = {}
    cases = []
    for pair in (pairs[index] for index in chosen):
        whole = rectification(cameras[pair.left], cameras[pair.right], centre, settings.extent_mm)
        crop, limits = _cropped(whole, surface)
        views = []
        for side, index in (("left", pair.left), ("right", pair.right)):
            name = cameras[index].name
            if name not in coefficients:
                path = take / name / f"{frame:04d}.png"
                coefficients[name] = spline_coefficients(mono(decode_png(path.read_bytes(), path)))
            view, inside = resample(coefficients[name], *crop.maps(side))
            view[~inside] = np.nan
            views.append(view)
        cases.append((pair, PairCase(views[0], views[1], limits, true_disparity(crop, surface))))
    return cases


def cones_case(folder: Path) -> PairCase:
    """The Middlebury pair "cones": truth on its unoccluded pixels.

    References:
        Scharstein and Szeliski, High-accuracy stereo depth maps using structured light, CVPR 2003.
    """
    names = ("Cones_LEFT.tif", "Cones_RIGHT.tif", "Cones_LEFT_GT.tif", "Occlusion_LEFT.png")
    pictures = [cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED) for name in names]
    for name, picture in zip(names, pictures, strict=True):
        if picture is None:
            raise TakeError(f"{folder / name}: no such picture")
    left, right, truth, open_sight = (np.asarray(picture) for picture in pictures)
    if open_sight.ndim == 3:
        open_sight = open_sight[:, :, 0]
    known = (open_sight == 255) & (truth > 0)
    return PairCase(mono(left), mono(right), (0.0, 64.0), np.where(known, truth, np.nan))


def matchers() -> dict[str, Callable[[PairCase], Floats32]]:
    """Every way by name: a function of a case that gives a disparity map (H, W)."""
    hh, three = cv2.STEREO_SGBM_MODE_HH, cv2.STEREO_SGBM_MODE_SGBM_3WAY
    return {
        "StereoBM": lambda case: _ready_made(case, cv2.StereoBM.create),
        "SGBM 3WAY": lambda case: _ready_made(case, lambda count, b: _semi_global(count, b, three)),
        "SGBM HH": lambda case: _ready_made(case, lambda count, b: _semi_global(count, b, hh)),
        "SGBM 3WAY + WLS": _filtered,
        "ours": lambda case: _ours(case, ReconSettings().stereo().matching),
        "ours, settings for steps": lambda case: _ours(case, STEPPED),
    }


def main() -> None:
    """Match, score, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--take", type=Path, help="visiting take with truth.npz")
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--pairs", type=int, default=4, help="how many of the take's pairs")
    parser.add_argument("--cones", type=Path, help="folder of the Middlebury pair")
    parser.add_argument(
        "--child", nargs=4, metavar=("WAY", "LOW", "HIGH", "FILE"), help=argparse.SUPPRESS
    )
    arguments = parser.parse_args()
    if arguments.child:
        way, low, high, path = arguments.child
        _work(way, (float(low), float(high)), Path(path))
        return
    with tempfile.TemporaryDirectory() as folder:
        if arguments.cones:
            ways = ["SGBM HH", "ours", "ours, settings for steps"]
            _table([("cones", cones_case(arguments.cones))], ways, Path(folder))
        if arguments.take:
            cases = take_cases(arguments.take, arguments.frame, arguments.pairs)
            named = [(f"{p.left}-{p.right} {p.angle_deg:.0f} deg", case) for p, case in cases]
            _table(
                named,
                [way for way in matchers() if way != "ours, settings for steps"],
                Path(folder),
            )


def _table(cases: Sequence[tuple[str, PairCase]], ways: Sequence[str], folder: Path) -> None:
    """One line a way and pair, and one a way over all pairs."""
    for way in ways:
        rows, maps = [], []
        for index, (name, case) in enumerate(cases):
            path = folder / f"case{index}.npy"
            if not path.exists():
                np.save(path, np.stack([case.left, case.right]))
            limits = [str(limit) for limit in case.limits_px]
            command = [sys.executable, "-m", "tools.bench.bench_disparity", "--child", way, *limits]
            done = subprocess.run([*command, str(path)], check=True, capture_output=True, text=True)
            cost = json.loads(done.stdout.splitlines()[-1])
            maps.append(np.load(path.with_suffix(".out.npy"), allow_pickle=False))
            rows.append(cost)
            line = {"way": way, "pair": name, **score(maps[-1], case.truth), **cost}
            print(json.dumps(line), flush=True)
        if len(cases) > 1:
            flat = np.concatenate([found.ravel() for found in maps])
            truth = np.concatenate([case.truth.ravel() for _, case in cases])
            total: dict[str, Any] = {"way": way, "pair": "all", **score(flat, truth)}
            for key in ("wall_s", "cpu_s"):
                total[key] = round(sum(row[key] for row in rows), 2)
            total["peak_mib"] = max(row["peak_mib"] for row in rows)
            total["own_mib"] = max(row["own_mib"] for row in rows)
            print(json.dumps(total), flush=True)


def _work(way: str, limits: tuple[float, float], path: Path) -> None:
    """In a process of its own: match one pair, write the map, print what it took."""
    left, right = np.load(path, allow_pickle=False)
    case = PairCase(left, right, limits, np.empty((0, 0)))
    match = matchers()[way]
    corner = [np.ascontiguousarray(view[:96, :160]) for view in (left, right)]
    match(PairCase(corner[0], corner[1], (0.0, 30.0), case.truth))  # compiled code is loaded
    found, cost = measured(lambda: match(case))
    np.save(path.with_suffix(".out.npy"), found)
    print(json.dumps(cost))


def _cropped(
    whole: Rectification, surface: TrueSurface
) -> tuple[Rectification, tuple[float, float]]:
    """The window that holds the counted surface in both views, and its disparities, with room."""
    used = np.unique(surface.triangles[surface.counted])
    column, row, disparity = whole.project(surface.vertices[used]).T
    room = _MARGIN * (row.max() - row.min())
    low = np.array([min(column.min(), (column - disparity).min()), row.min()]) - room
    high = np.array([max(column.max(), (column - disparity).max()), row.max()]) + room
    size = [whole.width, whole.height]
    left, top, right, bottom = (
        int(v) for v in np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)])
    )
    span = _MARGIN * (disparity.max() - disparity.min())
    limits = (float(disparity.min() - span), float(disparity.max() + span))
    return whole.cropped(left, top, right - left, bottom - top), limits


def _ours(case: PairCase, settings: DisparitySettings) -> Floats32:
    return match_pair(case.left, case.right, case.limits_px, settings).disparity


def _semi_global(count: int, block: int, mode: int) -> Any:
    """OpenCV's semi-global matcher with the settings of its samples."""
    return cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=count, blockSize=block, P1=8 * block * block,
        P2=32 * block * block, disp12MaxDiff=1, preFilterCap=63, uniquenessRatio=10,
        speckleWindowSize=100, speckleRange=2, mode=mode,
    )  # fmt: skip


def _ready_made(case: PairCase, create: Callable[[int, int], Any]) -> Floats32:
    block = 15 if create is cv2.StereoBM.create else _BLOCK
    low, count, left, right = _eight_bit(case)
    pad = left.shape[1] - case.left.shape[1] - max(-low, 0)
    matcher = create(count, block)
    matcher.setMinDisparity(low)
    raw = matcher.compute(left, right)[:, pad : pad + case.left.shape[1]]
    found = np.where(raw < 16 * low, np.float32(np.nan), raw.astype(np.float32) / 16.0)
    found[np.isnan(case.left)] = np.nan
    return np.asarray(found, dtype=np.float32)


def _filtered(case: PairCase) -> Floats32:
    """SGBM 3WAY under the weighted least-squares filter, as OpenCV's sample has it."""
    low, count, left, right = _eight_bit(case)
    pad = left.shape[1] - case.left.shape[1] - max(-low, 0)
    matcher = _semi_global(count, _BLOCK, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    matcher.setMinDisparity(low)
    smooth = cv2.ximgproc.createDisparityWLSFilter(matcher)
    other = cv2.ximgproc.createRightMatcher(matcher)
    smooth.setLambda(8000.0)
    smooth.setSigmaColor(1.5)
    first, second = matcher.compute(left, right), other.compute(right, left)
    raw = smooth.filter(first, left, disparity_map_right=second)
    raw = raw[:, pad : pad + case.left.shape[1]].astype(np.float32)
    found = np.where(raw < 16 * low, np.float32(np.nan), raw / np.float32(16.0))
    found[np.isnan(case.left)] = np.nan
    return np.asarray(found, dtype=np.float32)


def _eight_bit(case: PairCase) -> tuple[int, int, NDArray[np.uint8], NDArray[np.uint8]]:
    """Least disparity, number of them, and both views in 8 bits with room for them at the sides."""
    low = int(np.floor(case.limits_px[0]))
    count = int(np.ceil((case.limits_px[1] + 1 - low) / 16.0)) * 16
    room = max(low + count, 0), max(-low, 0)
    views = []
    for view in (case.left, case.right):
        grey = np.rint(255.0 * np.nan_to_num(view)).clip(0, 255).astype(np.uint8)
        views.append(cv2.copyMakeBorder(grey, 0, 0, *room, cv2.BORDER_REPLICATE))
    return low, count, views[0], views[1]


if __name__ == "__main__":
    main()
