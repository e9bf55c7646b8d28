"""The neutral stage: a template mesh registered to the actor at the first frame."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.archive import write_archive
from capture.arrays import Floats
from capture.camera import CameraArray
from capture.errors import TakeError
from capture.product import (
    hash_file,
    is_current,
    is_made_of,
    replacing,
    stage_record,
    write_record,
)
from capture.progress import Progress, silent
from capture.settings import check_ranges
from capture.take import Take
from recon.images import mono
from recon.mesh import Mesh, read_obj, write_obj
from recon.scan import load_scan, reconstruct
from recon.surface import Scan
from track.appearance import bake_appearance
from track.face_landmarks import LandmarkDetector
from track.landmark_file import Landmarks, read_landmarks
from track.landmark_map import LandmarkMap
from track.landmark_place import DetectedPlace, place_detected
from track.nonrigid import Fit, NonrigidFit, Step
from track.placement import Placement, Placer, Viewpoint, place_by_landmarks
from track.rigid import Similarity

_SIZE_MM = (80.0, 600.0)  # the largest side of a face or a head with neck and shoulders
_UNITS = ((1000.0, "metres"), (10.0, "centimetres"), (25.4, "inches"), (0.001, "micrometres"))


@dataclass(frozen=True, kw_only=True)
class NeutralSettings:
    """Settings of the neutral stage; pairs of first and last run geometrically over the steps.

    Attributes:
        steps: how many solves of the non-rigid registration.
        bending_first_mm: stiffness length at first: shorter waves of a step are smoothed away.
        bending_last_mm: stiffness length at last.
        reach_first_mm: matches further than this are dropped, at first.
        reach_last_mm: the same, at last.
        angle_first_deg: matches whose normals differ by more are dropped, at first.
        angle_last_deg: the same, at last.
        normal_first_mm: what a unit of normal difference counts in the search, at first.
        normal_last_mm: the same, at last.
        landmark_first_share: weight of all landmarks against all matches, at first.
        landmark_last_share: the same, at last.
    """

    steps: int = 20
    bending_first_mm: float = 100.0
    bending_last_mm: float = 2.5
    reach_first_mm: float = 25.0
    reach_last_mm: float = 3.0
    angle_first_deg: float = 60.0
    angle_last_deg: float = 30.0
    normal_first_mm: float = 60.0
    normal_last_mm: float = 12.0
    landmark_first_share: float = 1.0
    landmark_last_share: float = 0.02

    def __post_init__(self) -> None:
        check_ranges(
            "neutral", self, steps=(2, 200),
            bending_first_mm=(0.1, 1000.0), bending_last_mm=(0.1, 1000.0),
            reach_first_mm=(0.5, 200.0), reach_last_mm=(0.5, 200.0),
            angle_first_deg=(5.0, 89.0), angle_last_deg=(5.0, 89.0),
            normal_first_mm=(0.01, 500.0), normal_last_mm=(0.01, 500.0),
            landmark_first_share=(1e-6, 100.0), landmark_last_share=(1e-6, 100.0),
        )  # fmt: skip

    def schedule(self) -> list[Step]:
        """The steps, each pair mixed geometrically from first to last."""

        def mix(name: str, unit: str, share: float) -> float:
            first, last = getattr(self, f"{name}_first{unit}"), getattr(self, f"{name}_last{unit}")
            return float(first * (last / first) ** share)

        return [
            Step(
                bending_mm=mix("bending", "_mm", share),
                reach_mm=mix("reach", "_mm", share),
                angle_rad=float(np.radians(mix("angle", "_deg", share))),
                normal_mm=mix("normal", "_mm", share),
                landmark_share=mix("landmark", "_share", share),
            )
            for share in np.linspace(0.0, 1.0, self.steps)
        ]


@dataclass(frozen=True, eq=False, kw_only=True)
class Detected:
    """How the template's place is to be detected.

    Attributes:
        detector: of landmarks in the first frame.
        where: the same landmarks on the template.
    """

    detector: LandmarkDetector
    where: LandmarkMap


def register_neutral(
    take: Take,
    template: Mesh,
    settings: NeutralSettings,
    out: Path,
    *,
    landmarks: Path | None = None,
    detected: Detected | None = None,
    progress: Progress = silent,
) -> Mesh:
    """Register a template face mesh, placed or not, to the actor at the first frame of a take.

    The scan of that frame is taken from the take's products, and made when it is not there.
    Beside `out` (world mm, the template's polygons and uv) stand, without its suffix,
    `OUT.report.json`, `OUT.residual.npz` (residual_mm (V,), -1 where unmatched) and
    `OUT.appearance.npz` (grey (C, V) of every vertex in every view, -1 where the view does not
    show it; camera_names (C)).

    Args:
        take: whose first frame is neutral; it has cameras.
        template: any face mesh in mm.
        settings: of the registration.
        out: the OBJ to write.
        landmarks: hand marks (`track.landmark_file.read_landmarks`); they place the template when
            there are three or more, and guide it in any case.
        detected: a detector, and the template's landmarks: what it finds in the first frame is one
            more place to try.
        progress: told after each step.

    Returns:
        The registered mesh, as `out` holds it.

    Raises:
        TakeError: when the template is empty or not in mm, or the landmarks do not fit.
        CameraError: when the take has no cameras.
        SolveError: when the template cannot be placed on the scan.
    """
    check_template(template)
    cameras = take.cameras()
    marks = None
    if landmarks is not None:
        marks = read_landmarks(landmarks, len(template.vertices), cameras)
    scan_path = _scan_path(take, progress)
    inputs = {
        "take": take.input_hash(),
        "scan": hash_file(scan_path),
        "template": _mesh_hash(template),
        "landmarks": "none" if landmarks is None else hash_file(landmarks),
        "detector": "none" if detected is None else type(detected.detector).__name__,
    }
    record = stage_record("neutral", settings, inputs)
    if is_current(out, record):
        return read_obj(out)
    scan = load_scan(scan_path)
    place = None if detected is None else _detected_place(take, template, detected)
    hint = None if place is None else place.world_from_template
    mesh, report, fit = fit_template(
        template, scan, cameras, settings, marks, hint=hint, progress=progress
    )
    if place is not None:
        report["detected"] = dict(place.report)
    with replacing(out.with_suffix(".report.json")) as partial:
        partial.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    residual = np.nan_to_num(fit.residual_mm, nan=-1.0).astype(np.float32)
    write_archive(out.with_suffix(".residual.npz"), {"residual_mm": residual})
    write_archive(out.with_suffix(".appearance.npz"), _appearance(take, mesh))
    write_obj(out, mesh)
    write_record(out, record)
    return read_obj(out)  # as a second run finds it: what is made of it is then current


def fit_template(
    template: Mesh,
    scan: Scan,
    cameras: CameraArray,
    settings: NeutralSettings,
    landmarks: Landmarks | None = None,
    *,
    hint: Similarity | None = None,
    progress: Progress = silent,
) -> tuple[Mesh, dict[str, Any], Fit]:
    """Place a template on a scan and register it; the stage without its files.

    Returns:
        The registered mesh, the report (fit for JSON), and the fit vertex by vertex.
    """
    view = viewpoint(cameras, scan.vertices.astype(np.float64))
    progress(0, settings.steps, "place")
    placement = _place(template, scan, view, landmarks, hint)
    placed = placement.world_from_template.apply(template.vertices)
    fitter = NonrigidFit(template.triangles, scan, view.eyes)
    fit = fitter.run(placed, settings.schedule(), landmarks, progress=progress)
    mesh = template.with_vertices(fit.vertices)
    return mesh, _report(placement, fit, landmarks, settings), fit


def check_template(template: Mesh) -> None:
    """Refuse a template that is no face mesh in millimetres.

    Raises:
        TakeError: saying what was found and which factor would bring it to mm.
    """
    if len(template.polygons) == 0:
        raise TakeError("template: expected a face mesh, found no faces")
    used = template.vertices[np.unique(template.triangles)]
    size = float(np.ptp(used, axis=0).max())
    if _SIZE_MM[0] <= size <= _SIZE_MM[1]:
        return
    hint = "expected millimetres"
    for factor, unit in _UNITS:
        if _SIZE_MM[0] <= size * factor <= _SIZE_MM[1]:
            hint = f"it looks like {unit}: multiply its vertices by {factor:g}"
            break
    raise TakeError(
        f"template: its largest side is {size:.4g} mm, a face or head has "
        f"{_SIZE_MM[0]:g} to {_SIZE_MM[1]:g} mm; {hint}"
    )


def viewpoint(cameras: CameraArray, points: Floats) -> Viewpoint:
    """Where the array looks from: centres, mean direction from the points, mean up."""
    eyes = np.array([camera.centre for camera in cameras])
    forward = eyes.mean(axis=0) - np.median(points, axis=0)
    forward /= np.linalg.norm(forward)
    up = -np.sum([camera.camera_from_world.rotation[1] for camera in cameras], axis=0)
    up = up - forward * (up @ forward)
    if np.linalg.norm(up) < 0.1 * len(eyes):  # cameras of all rolls: their own up says nothing
        up = np.array([0.0, 1.0, 0.0]) - forward * forward[1]
    return Viewpoint(eyes=eyes, forward=forward, up=up / np.linalg.norm(up))


def _place(
    template: Mesh,
    scan: Scan,
    view: Viewpoint,
    landmarks: Landmarks | None,
    hint: Similarity | None,
) -> Placement:
    surface = (scan.vertices.astype(np.float64), scan.triangles)
    if landmarks is not None and len(landmarks.vertices) >= 3:
        marked = template.vertices[landmarks.vertices]
        motion = place_by_landmarks(marked, landmarks.positions)
        return Placement(world_from_template=motion, score_mm=float("nan"))
    return Placer((template.vertices, template.triangles), surface, view).search(hint)


def _appearance(take: Take, mesh: Mesh) -> dict[str, NDArray[Any]]:
    """What every view of the first frame shows at the vertices."""
    frame = take.frames[0]
    cameras = {camera.name: camera for camera in take.cameras()}
    images = {name: mono(take.image(name, frame)) for name in cameras if take.present(name, frame)}
    grey = bake_appearance(mesh.vertices, mesh.triangles, cameras, images)
    names = np.array(list(cameras))
    return {"grey": np.nan_to_num(grey, nan=-1.0), "camera_names": names}


def _detected_place(take: Take, template: Mesh, detected: Detected) -> DetectedPlace:
    frame = take.frames[0]
    images = {n: take.image(n, frame) for n in take.device_names if take.present(n, frame)}
    return place_detected(
        detected.detector, images, take.cameras(), template.vertices, detected.where
    )


def _scan_path(take: Take, progress: Progress) -> Path:
    """The scan of the first frame, made when it is missing or of other frames or cameras."""
    frame = take.frames[0]
    path = take.products / "recon" / f"frame_{frame:04d}.ply"
    if is_made_of(path, {"take": take.input_hash()}):
        return path
    return reconstruct(take, [frame], progress=progress)[0]


def _mesh_hash(mesh: Mesh) -> str:
    digest = hashlib.sha256(mesh.vertices.tobytes() + mesh.polygons.tobytes())
    if mesh.uv is not None:
        digest.update(mesh.uv.tobytes())
    return digest.hexdigest()


def _report(
    placement: Placement, fit: Fit, landmarks: Landmarks | None, settings: NeutralSettings
) -> dict[str, Any]:
    """What a reader wants to know of a registration, fit for JSON."""
    matched = np.isfinite(fit.residual_mm)
    residual = fit.residual_mm[matched]
    report: dict[str, Any] = {
        "placed_by": "landmarks" if np.isnan(placement.score_mm) else "search",
        "world_from_template": placement.world_from_template.matrix().round(6).tolist(),
        "scale": round(placement.world_from_template.scale, 5),
        "steps": settings.steps,
        "vertices": len(fit.vertices),
        "seen": int(fit.seen.sum()),
        "matched": int(matched.sum()),
        "matched_share_of_seen": round(float(matched.sum() / max(fit.seen.sum(), 1)), 4),
    }
    if np.isfinite(placement.score_mm):
        report["placement_score_mm"] = round(placement.score_mm, 3)
    if len(residual):
        report["residual_median_mm"] = round(float(np.median(residual)), 4)
        report["residual_p95_mm"] = round(float(np.quantile(residual, 0.95)), 4)
    if landmarks is not None:
        gap = np.linalg.norm(fit.vertices[landmarks.vertices] - landmarks.positions, axis=1)
        report["landmarks"] = [
            {"vertex": int(v), "residual_mm": round(float(g), 3), "ray_miss_mm": round(float(m), 3)}
            for v, g, m in zip(landmarks.vertices, gap, landmarks.miss_mm, strict=True)
        ]
    return report
