"""The stereo stage: a scan mesh for each frame of a take."""

from __future__ import annotations

import json
import os
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from capture.arrays import Image
from capture.camera import CameraArray
from capture.errors import (
    InputError,
    LikenessError,
    SettingsError,
    SolveError,
    TakeError,
    raise_all,
)
from capture.product import hash_file, is_current, replacing, stage_record, write_record
from capture.progress import Progress, silent
from capture.settings import check_ranges
from capture.take import Take
from recon.aim import aimed, estimate_aims
from recon.depth_maps import write_depth_maps
from recon.disparity import DisparitySettings
from recon.fusion import FusionSettings, Points, fuse
from recon.mesh_process import Meshed, Mesher
from recon.pairs import PairSettings
from recon.point_file import is_points_file, points_scan
from recon.prior import PriorMesh, PriorMeshes
from recon.scan_numbers import aim_numbers, scan_numbers
from recon.scan_warnings import aim_warnings
from recon.stereo import StereoSettings, match_views
from recon.surface import Scan, SurfaceSettings, poisson_scan, read_ply, write_ply

_Value = TypeVar("_Value")
_TOLD = 20  # failed frames named in one message


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
        radius_px: of the matching window; up to twice that where skin shows little.
        iterations: of refinement at each resolution.
        smoothness: weight of the smooth surface against a match known to 0.1 px.
        ncc_min: least correlation of matched windows.
        agree_px: two pairs agree when their disparities of a point differ by less.
        agreeing: other pairs that must confirm a point, where so many can see it.
        voxel_px: points are averaged in voxels of this many pixel footprints.
        cell_spacings: finest Poisson cell, in point spacings.
        evidence_spacings: surface farther than this from every point is cut away.
        prior_mm: with a prior mesh, how far from it the surface is looked for.
        correct_aims: find by how much the images have moved since calibration, from how pairs
            disagree, tell it, and scan as if they had not (`recon.aim`).
        mesh: make a mesh; without, the oriented points are the product.
        depth_maps: also write the depth map of the mesh in each camera.
        workers: threads; 0 takes one a processor. The result does not depend on it.
        frames_at_once: frames in the making: one is matched while others are meshed, each in a
            process of its own. The result does not depend on it.
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
    agree_px: float = 1.0
    agreeing: int = 2
    voxel_px: float = 1.6
    cell_spacings: float = 2.2
    evidence_spacings: float = 3.0
    prior_mm: float = 8.0
    correct_aims: bool = True
    mesh: bool = True
    depth_maps: bool = False
    workers: int = 0
    frames_at_once: int = 2

    def __post_init__(self) -> None:
        check_ranges(
            "recon", self, workers=(0, 1024), frames_at_once=(1, 64), prior_mm=(0.1, 1000.0)
        )
        if self.depth_maps and not self.mesh:
            raise SettingsError(
                "recon.depth_maps = True with recon.mesh = False: depth maps are rendered from "
                "the mesh; ask for both or for neither"
            )
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
        scan: the mesh, world mm; without triangles, the points, when no mesh was asked for.
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
    prior: PriorMeshes | None = None,
    progress: Progress = silent,
) -> list[Path]:
    """Reconstruct the surface at some frames of a take, a mesh and a page of numbers for each.

    Writes `TAKE/products/recon/frame_0000.ply` (without `settings.mesh`: `points_0000.ply`), a
    JSON of the same name and a record; a frame whose record is current is skipped, so that an
    interrupted run goes on where it stopped. Views lost by the capture are left out and named in
    the numbers. A frame that fails does not stop the others.

    Args:
        take: a take with cameras.
        frames: frame numbers.
        settings: None takes the defaults.
        prior: where the surface was about then, to look near to; None looks everywhere.
        progress: told after each frame.

    Returns:
        The meshes' (or points') paths, in the order of `frames`.

    Raises:
        CameraError: when the take has no cameras, or no two of them can be paired.
        TakeError: when a frame is not in the take, or fewer than two views of it are.
        SolveError: when no surface is found; or, after all frames were tried, naming those of
            several that failed.
    """
    settings = settings or ReconSettings()
    cameras = take.cameras()
    unknown = [frame for frame in frames if frame not in take.frames]
    if unknown:
        raise TakeError(
            f"{take.folder}: asked for frames {unknown}, the take has 0 to {len(take.frames) - 1}"
        )
    run = _Run(take, cameras, settings, prior, tuple(dict.fromkeys(frames)), progress)
    run.go()
    return [run.path(frame) for frame in frames]


def reconstruct_images(
    cameras: CameraArray,
    images: Mapping[str, Image],
    settings: ReconSettings | None = None,
    *,
    prior: PriorMesh | None = None,
) -> FrameScan:
    """Reconstruct the surface that the images of one instant show.

    Args:
        cameras: the array; cameras without an image are left out.
        images: by camera name, (H, W) or (H, W, 3), uint8, uint16 or float in 0..1.
        settings: None takes the defaults.
        prior: where the surface is expected; None looks everywhere.

    Raises:
        CameraError: when fewer than two cameras have an image, or no two can be paired.
        SolveError: when no surface is found.
    """
    settings = settings or ReconSettings()
    points, report = _matched(cameras, images, settings, prior)
    seconds = report["seconds"]
    if settings.mesh:
        scan = _timed(seconds, "mesh", lambda: poisson_scan(points, settings.surface()))
    else:
        scan = points_scan(points)
    sizes = {"vertices": len(scan.vertices), "triangles": len(scan.triangles)}
    return FrameScan(scan, points, {**report, **sizes})


def load_scan(path: Path) -> Scan:
    """Read the scan of one frame: vertices, triangles, normals and confidence.

    Raises:
        TakeError: when there is none, or it is no mesh.
    """
    if is_points_file(path):
        raise TakeError(
            f"{path}: holds points without faces; run `likeness recon` with a mesh "
            "(mesh = true in [recon])"
        )
    return read_ply(path)


class _Waiting(NamedTuple):
    """A frame that is matched and not written yet."""

    frame: int
    points: Points
    report: dict[str, Any]
    scan: Future[Meshed] | None


class _Run:
    """The frames of one call: matched one after the other, meshed beside that, then written."""

    def __init__(
        self,
        take: Take,
        cameras: CameraArray,
        settings: ReconSettings,
        prior: PriorMeshes | None,
        frames: tuple[int, ...],
        progress: Progress,
    ) -> None:
        self._take, self._cameras, self._settings = take, cameras, settings
        self._prior, self._frames, self._progress = prior, frames, progress
        self._inputs = {"take": take.input_hash()}
        self._failed: dict[int, LikenessError] = {}
        self._waiting: deque[_Waiting] = deque()
        self._done = 0

    def go(self) -> None:
        """Make what is not current; then raise one error for all frames that failed."""
        todo = []
        for frame in self._frames:
            if is_current(self.path(frame), self._record(frame)):
                self._add_depth_maps(frame)
                self._tell()
            else:
                todo.append(frame)
        beside = max(min(self._settings.frames_at_once, len(todo)) - 1, 0)
        with Mesher(self._settings.surface(), beside if self._settings.mesh else 0) as mesher:
            for frame in todo:
                self._start(frame, mesher)
                while len(self._waiting) > beside:
                    self._finish()
            while self._waiting:
                self._finish()
        self._raise_failed()

    def path(self, frame: int) -> Path:
        """Where the mesh, or the points, of a frame stand."""
        kind = "frame" if self._settings.mesh else "points"
        return self._take.products / "recon" / f"{kind}_{frame:04d}.ply"

    def _start(self, frame: int, mesher: Mesher) -> None:
        """Match a frame and have it meshed."""
        take = self._take
        names = [name for name in take.device_names if take.present(name, frame)]
        try:
            if len(names) < 2:
                missing = [name for name in take.device_names if name not in names]
                raise TakeError(
                    f"{take.folder}: frame {frame} has {len(names)} views; stereo needs at "
                    f"least 2; lost: {', '.join(missing)}"
                )
            images = {name: take.image(name, frame) for name in names}
            expected = self._prior.at(frame, self._settings.prior_mm) if self._prior else None
            points, report = _matched(self._cameras, images, self._settings, expected)
        except (SolveError, InputError) as error:
            self._fail(frame, error)
            return
        report = {"frame": frame, **report}
        scan = mesher.submit(points) if self._settings.mesh else None
        self._waiting.append(_Waiting(frame, points, report, scan))

    def _finish(self) -> None:
        """Write the frame that was started first."""
        frame, points, report, meshed = self._waiting.popleft()
        scan = points_scan(points)
        if meshed is not None:
            try:
                scan, seconds = meshed.result()
            except SolveError as error:
                self._fail(frame, error)
                return
            report["seconds"]["mesh"] = round(seconds, 3)
        report["vertices"], report["triangles"] = len(scan.vertices), len(scan.triangles)
        path = self.path(frame)
        with replacing(path.with_suffix(".json")) as partial:
            partial.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        write_ply(path, scan)
        write_record(path, self._record(frame))
        self._add_depth_maps(frame)
        self._tell()

    def _add_depth_maps(self, frame: int) -> None:
        """Render the depth maps of a finished frame, unless they are there."""
        if not self._settings.depth_maps:
            return
        path = self.path(frame)
        out = path.parent / "depth" / f"{path.stem}.npz"
        record = stage_record("depth_maps", self._settings.surface(), {"scan": hash_file(path)})
        if not is_current(out, record):
            scan = read_ply(path)
            write_depth_maps(out, self._cameras, scan.vertices, scan.triangles)
            write_record(out, record)

    def _record(self, frame: int) -> dict[str, Any]:
        """What makes a frame what it is; not what only changes how fast it is made."""
        plain = replace(self._settings, depth_maps=False, workers=0, frames_at_once=1)
        inputs = dict(self._inputs)
        digest = "none" if self._prior is None else self._prior.digest(frame)
        if digest != "none":
            inputs["prior"] = digest
        return stage_record("recon", plain, inputs)

    def _fail(self, frame: int, error: LikenessError) -> None:
        self._failed[frame] = error
        self._tell()

    def _tell(self) -> None:
        self._done += 1
        self._progress(self._done, len(self._frames), "recon")

    def _raise_failed(self) -> None:
        if not self._failed:
            return
        count = len(self._failed)
        if count == 1 and len(self._frames) == 1:
            ((frame, error),) = self._failed.items()
            if isinstance(error, InputError):
                raise error
            raise SolveError(f"{self._take.folder}: frame {frame}: {error}") from error
        problems = [f"frame {frame}: {error}" for frame, error in sorted(self._failed.items())]
        kinds = [type(e) for e in self._failed.values() if isinstance(e, InputError)]
        if len(kinds) == len(self._frames):
            raise_all(str(self._take.folder), problems, kinds[0])
        told = [*problems[:_TOLD], *([f"and {count - _TOLD} more"] if count > _TOLD else [])]
        lines = "\n".join(f"  - {problem}" for problem in told)
        raise SolveError(
            f"{self._take.folder}: {count} of {len(self._frames)} frames failed, the others are "
            f"done:\n{lines}"
        )


def _matched(
    cameras: CameraArray,
    images: Mapping[str, Image],
    settings: ReconSettings,
    prior: PriorMesh | None,
) -> tuple[Points, dict[str, Any]]:
    """Oriented points of one instant, and numbers of how they came about."""
    workers = settings.workers or os.cpu_count() or 1
    there = CameraArray(tuple(camera for camera in cameras if camera.name in images))
    seconds: dict[str, float] = {}
    pairs = _timed(
        seconds,
        "match",
        lambda: match_views(there, images, settings.stereo(), prior=prior, workers=workers),
    )
    aims = estimate_aims(there, pairs) if settings.correct_aims else None
    true = [aimed(pair, aims) for pair in pairs] if aims and aims.correct else pairs
    views = [pair.view for pair in true if pair.view is not None]
    if not views:
        raise SolveError(f"nothing found: none of {len(pairs)} pairs of views match anywhere")
    points = _timed(seconds, "fuse", lambda: fuse(views, settings.fusion(), workers=workers))
    if len(points) < 100:
        raise SolveError(
            f"nothing found: {len(points)} points are seen alike by {len(pairs)} pairs; "
            "are the cameras those of this take?"
        )
    numbers = _timed(
        seconds,
        "quality",
        lambda: scan_numbers(cameras, images, pairs, points, points.spacing_mm / settings.voxel_px),
    )
    if aims is not None:
        numbers["aims"] = aim_numbers(there.names, aims)
        numbers["warnings"] = numbers["warnings"] + aim_warnings(there.names, aims)
    return points, {**numbers, "seconds": seconds}


def _timed(seconds: dict[str, float], name: str, work: Callable[[], _Value]) -> _Value:
    start = time.perf_counter()
    value = work()
    seconds[name] = round(time.perf_counter() - start, 3)
    return value
