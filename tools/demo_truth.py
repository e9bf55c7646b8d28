"""How far the demo's scans and tracked meshes are from the simulated actor's truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.archive import read_archive
from capture.arrays import Floats, Ints32
from capture.camera import CameraArray
from capture.take import Take
from recon.scan import load_scan
from tools.report import TakeErrors
from tools.truth import SkinPoints, scan_distances, world_from_truth
from track.performance import read_performance

_BESIDE_MM = 0.05
_FAR_MM = 2.0  # a neutral vertex farther off the true skin is not on it: mouth bag, neck's rim


def take_errors(take: Take, true_cameras: CameraArray, truth: Path) -> TakeErrors:
    """Errors of every scan of a take, and of its performance, in mm.

    A tracked vertex is held against the true motion of the skin point it sits on at the first
    frame, so where the neutral sits on the skin, and how far off it, is not counted.

    Args:
        take: a take with cameras.
        true_cameras: the simulated array.
        truth: the folder that `tools.actor.truth.write_truth` wrote.
    """
    keys = ["vertices", "surface", "surface_tri", "face_region"]
    arrays = read_archive(truth / "truth.npz", keys)
    motion = world_from_truth(take.cameras(), true_cameras, _near(arrays))
    skin = motion.apply(arrays["vertices"].astype(np.float64))
    whole = np.concatenate([skin, motion.apply(arrays["surface"].astype(np.float64))], axis=1)
    triangles = arrays["surface_tri"].astype(np.int32)
    scans = {
        frame: scan_distances(
            load_scan(path).vertices.astype(np.float64), whole[take.frames.index(frame)], triangles
        )
        for frame in take.frames
        if (path := take.products / "recon" / f"frame_{frame:04d}.ply").exists()
    }
    performance = take.products / "track" / "performance.npz"
    if not performance.exists():
        return TakeErrors(scan_mm=scans)
    on_face = np.isin(triangles, arrays["face_region"]).all(axis=1)
    tracked = read_performance(performance).vertices.astype(np.float64)
    return TakeErrors(track_mm=_track_errors(tracked, skin, triangles[on_face]), scan_mm=scans)


def _near(arrays: Mapping[str, NDArray[Any]]) -> Floats:
    """Every tenth skin point of the face at the first frame."""
    points: Floats = arrays["vertices"][0, arrays["face_region"][::10]].astype(np.float64)
    return points


def _track_errors(tracked: Floats, skin: Floats, triangles: Ints32) -> Floats:
    points = SkinPoints.attach(tracked[0], skin[0], triangles)
    truth = np.stack([points.at(vertices) for vertices in skin])
    errors: Floats = np.linalg.norm(tracked - truth, axis=2)
    beside = errors[0] > _BESIDE_MM  # the nearest skin is the region's rim: not on the face
    errors[:, beside | (np.abs(points.offset_mm) > _FAR_MM)] = np.nan
    return errors
