"""Landmarks of a take with truth: a predictor of its actor against dlib's generic model.

Example: python -m tools.bench.bench_landmarks SRC --take TAKE --frames 0 6 12

SRC is a visiting take with neutral.obj and truth.npz; TAKE is the same imported, made when it is
not there, and kept nowhere when it is not given. The generic model is measured where the extra
`landmarks` is installed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from capture.arrays import Floats, Image
from capture.camera import CameraArray
from capture.errors import ExtraError
from capture.take import Take
from recon.mesh import read_obj
from recon.visiting import import_take
from track.face_landmarks import LANDMARK_NAMES, Detection
from track.landmark_dlib import GenericDetector
from track.landmark_map import vertex_map
from track.landmark_points import meet_landmarks
from track.landmark_stage import LandmarkSettings, train_landmarks

_REGIONS = {"brows": (17, 27), "nose": (27, 36), "lids": (36, 48), "lips": (48, 68)}


def regions_mm(found: Floats, truth: Floats) -> str:
    """Median and worst distance by region of landmarks (68, 3), mm; how many were found."""
    gap = np.linalg.norm(found - truth, axis=1)
    parts = []
    for name, (low, high) in _REGIONS.items():
        own = gap[low:high][np.isfinite(gap[low:high])]
        told = f"{np.median(own):5.2f} {own.max():5.1f}" if len(own) else "    -     -"
        parts.append(f"{name} {told}")
    return "  ".join(parts) + f"  found {int(np.isfinite(gap[17:]).sum())}/51"


def pixel_errors(
    detections: Mapping[str, Detection], cameras: CameraArray, truth: Floats
) -> tuple[float, float]:
    """Median pixel error a coordinate, and rms error over what the detector says of itself."""
    errors, shares = [], []
    for name, found in detections.items():
        miss = np.linalg.norm(found.pixels - cameras.by_name(name).project(truth), axis=1)[17:]
        known = np.isfinite(miss)
        errors.append(miss[known] / np.sqrt(2.0))
        shares.append(errors[-1] / found.sigma_px[17:][known])
    every = np.concatenate(errors)
    return float(np.median(every)), float(np.sqrt((np.concatenate(shares) ** 2).mean()))


def main() -> None:
    """Train, detect, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("--take", type=Path)
    parser.add_argument("--frames", type=int, nargs="+", default=[0])
    parser.add_argument("--pictures", type=int, default=LandmarkSettings().pictures)
    options = parser.parse_args()
    settings = LandmarkSettings(pictures=options.pictures)
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.take or Path(scratch) / "take"
        take = Take.open(folder) if folder.is_dir() else import_take(options.source, folder)
        _measure(take, options.source, settings, options.frames)


def _measure(take: Take, source: Path, settings: LandmarkSettings, frames: Sequence[int]) -> None:
    with np.load(source / "truth.npz") as data:
        ids, truth = data["landmarks68"], data["vertices"][frames].astype(np.float64)
    mesh = read_obj(source / "neutral.obj")
    where = vertex_map(dict(zip(LANDMARK_NAMES, ids.tolist(), strict=True)), mesh.triangles)
    began = time.process_time()
    detector = train_landmarks(take, mesh, where, settings)
    files = list((take.products / "landmarks" / "predictor").glob("*.dat"))
    size = sum(path.stat().st_size for path in files) / 1e6
    spent = time.process_time() - began
    print(f"trained {len(files)} predictors: {size:.1f} MB, {spent:.0f} CPU s")
    print("by region: median and worst, mm, of the landmarks met over the views")
    head: Floats | None = None
    for frame, now in zip(frames, truth, strict=True):
        images = {name: take.image(name, frame) for name in take.device_names}
        began = time.process_time()
        found = detector.detect_frame(images, head, settings.passes)
        spent, head = time.process_time() - began, found.head
        middle, share = pixel_errors(found.detections, take.cameras(), now[ids])
        told = regions_mm(found.points.positions, now[ids])
        print(
            f"frame {frame:3d}  actor's  {told}  {middle:.2f} px, {share:.2f} of what it says, "
            f"{spent:.2f} CPU s",
            flush=True,
        )
    _generic(take, images, truth[-1][ids], frames[-1])


def _generic(take: Take, images: Mapping[str, Image], truth: Floats, frame: int) -> None:
    try:
        detector = GenericDetector()
    except ExtraError as error:
        print(f"the generic model was left out: {error}")
        return
    found = {}
    for name, image in images.items():
        one = detector.detect(image, name)
        if isinstance(one, Detection):
            found[name] = one
    points = meet_landmarks(take.cameras(), found)
    print(
        f"frame {frame:3d}  generic  {regions_mm(points.positions, truth)}  in {len(found)} views"
    )


if __name__ == "__main__":
    main()
