"""The stereo stage: a scan mesh for each frame of a take."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from capture.arrays import Image
from capture.camera import CameraArray
from capture.errors import SolveError, TakeError
from capture.product import is_current, replacing, stage_record, write_record
from capture.progress import Progress, silent
from capture.settings import check_range
from capture.take import Take
from recon.disparity import DisparitySettings, Reason
from recon.fusion import FusionSettings, Points, fuse
from recon.pairs import PairSettings
from recon.stereo import PairDepth, StereoSettings, match_views
from recon.surface import Scan, SurfaceSettings, poisson_scan, read_ply, write_ply

_Value = TypeVar("_Value")


@dataclass(frozen=True, kw_only=True)
class ReconSettings:
    """Settings of the stereo stage.

    Attributes:
        centre_mm: the place of the face, world; None takes the meeting point of the optical axes.
        depth_mm: depths searched, on either side of the centre.
        extent_mm: radius around the centre that is looked at.
        angle_min_deg: least angle between the two views of a pair.
        angle_max_deg: greatest angle between the two views of a pair.
        partners: pairs a camera asks for.
        radius_px: of the matching window at full resolution.
        iterations: of refinement at each resolution.
        smoothness: weight of the smooth surface against a match known to 0.1 px.
        ncc_min: least correlation of matched windows.
        agree_px: two pairs agree when their disparities of a point differ by less.
        agreeing: other pairs that must confirm a point, where so many can see it.
        voxel_px: points are averaged in voxels of this many pixel footprints.
        cell_spacings: finest Poisson cell, in point spacings.
        evidence_spacings: surface farther than this from every point is cut away.
        workers: threads; 0 takes one a processor. The result does not depend on it.
    """

    centre_mm: tuple[float, float, float] | None = None
    depth_mm: float = 180.0
    extent_mm: float = 240.0
    angle_min_deg: float = 9.0
    angle_max_deg: float = 27.0
    partners: int = 4
    radius_px: int = 3
    iterations: int = 5
    smoothness: float = 20.0
    ncc_min: float = 0.5
    agree_px: float = 0.7
    agreeing: int = 2
    voxel_px: float = 1.2
    cell_spacings: float = 2.2
    evidence_spacings: float = 2.5
    workers: int = 0

    def __post_init__(self) -> None:
        check_range("recon.workers", self.workers, 0, 1024)
        # The parts check their own ranges.
        self.stereo()
        self.fusion()
        self.surface()

    def stereo(self) -> StereoSettings:
        """The part that concerns pairs and matching."""
        best = min(max(19.0, self.angle_min_deg + 0.1), self.angle_max_deg - 0.1)
        return StereoSettings(
            centre_mm=self.centre_mm,
            depth_mm=self.depth_mm,
            extent_mm=self.extent_mm,
            pairs=PairSettings(
                angle_min_deg=self.angle_min_deg,
                angle_best_deg=best,
                angle_max_deg=self.angle_max_deg,
                angle_last_deg=max(45.0, self.angle_max_deg),
                partners=self.partners,
            ),
            matching=DisparitySettings(
                radius=self.radius_px,
                iterations=self.iterations,
                smoothness=self.smoothness,
                ncc_min=self.ncc_min,
            ),
        )

    def fusion(self) -> FusionSettings:
        """The part that concerns agreement between pairs."""
        return FusionSettings(
            agree_px=self.agree_px, agreeing=self.agreeing, voxel_px=self.voxel_px
        )

    def surface(self) -> SurfaceSettings:
        """The part that concerns the mesh."""
        return SurfaceSettings(
            cell_spacings=self.cell_spacings, evidence_spacings=self.evidence_spacings
        )


@dataclass(frozen=True, eq=False)
class FrameScan:
    """One instant reconstructed.

    Attributes:
        scan: the mesh, world mm.
        points: the oriented points under it.
        report: numbers of how it went, fit for JSON.
    """

    scan: Scan
    points: Points
    report: Mapping[str, Any]


def reconstruct(
    take: Take,
    frames: Sequence[int],
    settings: ReconSettings | None = None,
    *,
    progress: Progress = silent,
) -> list[Path]:
    """Reconstruct the surface at some frames of a take, a mesh and a page of numbers for each.

    Writes `TAKE/products/recon/frame_0000.ply`, `frame_0000.json` and a record; a frame whose
    record is current is skipped, so that an interrupted run goes on where it stopped. Views lost
    by the capture are left out and named in the numbers.

    Args:
        take: a take with cameras.
        frames: frame numbers.
        settings: None takes the defaults.
        progress: told after each frame.

    Returns:
        The meshes' paths, in the order of `frames`.

    Raises:
        CameraError: when the take has no cameras, or no two of them can be paired.
        TakeError: when a frame is not in the take, or fewer than two views of it are.
        SolveError: when no surface is found.
    """
    settings = settings or ReconSettings()
    cameras = take.cameras()
    unknown = [frame for frame in frames if frame not in take.frames]
    if unknown:
        raise TakeError(
            f"{take.folder}: asked for frames {unknown}, the take has 0 to {len(take.frames) - 1}"
        )
    inputs = take.input_hash()
    paths = []
    for done, frame in enumerate(frames):
        path = take.products / "recon" / f"frame_{frame:04d}.ply"
        record = stage_record("recon", settings, {"take": inputs})
        if not is_current(path, record):
            _reconstruct_one(take, cameras, frame, settings, path)
            write_record(path, record)
        paths.append(path)
        progress(done + 1, len(frames), "recon")
    return paths


def reconstruct_images(
    cameras: CameraArray, images: Mapping[str, Image], settings: ReconSettings | None = None
) -> FrameScan:
    """Reconstruct the surface that the images of one instant show.

    Args:
        cameras: the array; cameras without an image are left out.
        images: by camera name, (H, W) or (H, W, 3), uint8, uint16 or float in 0..1.
        settings: None takes the defaults.

    Raises:
        CameraError: when fewer than two cameras have an image, or no two can be paired.
        SolveError: when no surface is found.
    """
    settings = settings or ReconSettings()
    workers = settings.workers or os.cpu_count() or 1
    there = CameraArray(tuple(camera for camera in cameras if camera.name in images))
    seconds: dict[str, float] = {}
    pairs = _timed(
        seconds, "match", lambda: match_views(there, images, settings.stereo(), workers=workers)
    )
    views = [pair.view for pair in pairs if pair.view is not None]
    if not views:
        raise SolveError(f"nothing found: none of {len(pairs)} pairs of views match anywhere")
    points = _timed(seconds, "fuse", lambda: fuse(views, settings.fusion(), workers=workers))
    if len(points) < 100:
        raise SolveError(
            f"nothing found: {len(points)} points are seen alike by {len(pairs)} pairs; "
            "are the cameras those of this take?"
        )
    scan = _timed(seconds, "mesh", lambda: poisson_scan(points, settings.surface()))
    return FrameScan(scan, points, _numbers(there, pairs, points, scan, seconds))


def load_scan(path: Path) -> Scan:
    """Read the scan of one frame: vertices, triangles, normals and confidence.

    Raises:
        TakeError: when there is none, or it is no mesh.
    """
    return read_ply(path)


def _reconstruct_one(
    take: Take, cameras: CameraArray, frame: int, settings: ReconSettings, path: Path
) -> None:
    names = [name for name in take.device_names if take.present(name, frame)]
    missing = [name for name in take.device_names if name not in names]
    if len(names) < 2:
        raise TakeError(
            f"{take.folder}: frame {frame} has {len(names)} views; stereo needs at least 2; "
            f"lost: {', '.join(missing)}"
        )
    images = {name: take.image(name, frame) for name in names}
    try:
        result = reconstruct_images(cameras, images, settings)
    except SolveError as error:
        raise SolveError(f"{take.folder}: frame {frame}: {error}") from error
    report = {"frame": frame, "missing": missing, **result.report}
    with replacing(path.with_suffix(".json")) as partial:
        partial.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    write_ply(path, result.scan)


def _timed(seconds: dict[str, float], name: str, work: Callable[[], _Value]) -> _Value:
    start = time.perf_counter()
    value = work()
    seconds[name] = round(time.perf_counter() - start, 3)
    return value


def _numbers(
    cameras: CameraArray,
    pairs: Sequence[PairDepth],
    points: Points,
    scan: Scan,
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """What a reader wants to know of a scan, fit for JSON."""
    reasons = {
        reason.name: sum(pair.reasons.get(reason.name, 0) for pair in pairs) for reason in Reason
    }
    textured = sum(reasons.values()) - reasons["OUTSIDE"] - reasons["NO_TEXTURE"]
    return {
        "cameras": list(cameras.names),
        "pairs": [
            {
                "left": cameras[pair.pair.left].name,
                "right": cameras[pair.pair.right].name,
                "angle_deg": round(pair.pair.angle_deg, 2),
                "coverage": round(pair.coverage, 4),
            }
            for pair in pairs
        ],
        "reasons": reasons,
        "matched_share": round(reasons["KEPT"] / max(textured, 1), 4),
        "points": len(points),
        "spacing_mm": round(points.spacing_mm, 4),
        "agreement_median_mm": round(points.agreement_mm[0], 4),
        "agreement_p95_mm": round(points.agreement_mm[1], 4),
        "support_median": float(np.median(points.support)),
        "vertices": len(scan.vertices),
        "triangles": len(scan.triangles),
        "seconds": dict(seconds),
    }
