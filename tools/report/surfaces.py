"""The sections with pictures of surfaces: scans, and the tracked mesh over plates."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from recon.mesh import Mesh
from recon.surface import Scan, read_ply
from tools.report.charts import colour_scale
from tools.report.inputs import ReportInputs, ScanFile, TakeInputs, scan_page
from tools.report.page import (
    Section,
    Verdict,
    facts,
    figure,
    folded,
    gallery,
    table,
    wipe,
)
from tools.report.picture import Pixels, displayable, jpeg_tag, sequential, stops, warm
from tools.report.scan_remarks import remarks_table, remarks_verdict, warnings_told
from tools.report.shade import Studio, cropped, enlarged, studio_camera
from tools.report.svg import escape, number
from track.performance import Performance

_SCANS, _FRAMES = 12, 16  # at most about so many of all takes together, at least one of each
_PORTRAIT = 330  # px
_PLATE = 440  # px
_ERROR_MM = 1.0  # the dark end of error colours
_WIRE = (30, 120, 200)
_YAWS = (-0.75, 0.0, 0.75)
_GOOD_MM, _FAIR_MM = 0.15, 0.4  # agreement of pairs, median
_TOLD = {
    "matched_share": "share of skin pixels matched",
    "points": "points",
    "spacing_mm": "spacing of points, mm",
    "agreement_median_mm": "agreement of pairs, median mm",
    "agreement_p95_mm": "agreement of pairs, 95 % mm",
    "support_median": "pairs behind a point, median",
}


def scan_section(inputs: ReportInputs) -> list[Section]:
    """Scans from three sides, with confidence colours, and error colours where truth is told."""
    parts: list[str] = []
    verdicts: list[Verdict] = []
    for item in inputs.takes:
        warnings = {scan.frame: warnings_told(scan.report) for scan in item.scans}
        parts.append(remarks_table(warnings, inputs.address(scan_page(item.take))))
        verdicts += remarks_verdict(item.take.name, warnings)
        for scan in _spread(item.scans, max(1, min(3, _SCANS // len(inputs.takes)))):
            surface = read_ply(scan.path)
            parts.append(f"<h3>{escape(item.take.name)}, frame {scan.frame}</h3>")
            parts.append(facts(_scan_facts(scan, surface)))
            parts.append(_pair_table(scan))
            parts.append(_scan_pictures(surface, _front(item.cameras)))
            errors = {} if item.errors is None else item.errors.scan_mm
            if scan.frame in errors:
                parts.append(_scan_errors(surface, errors[scan.frame], _front(item.cameras)))
                verdicts.append(_scan_verdict(item.take.name, scan.frame, errors[scan.frame]))
            else:
                verdicts += _agreement_verdict(item.take.name, scan)
    if not any(parts):
        return []
    return [Section(anchor="scans", title="Scans", body="".join(parts), verdicts=tuple(verdicts))]


def overlay_section(inputs: ReportInputs) -> list[Section]:
    """The tracked mesh over plates of several frames and views, and neutral beside expression."""
    parts: list[str] = []
    most = max(1, _FRAMES // max(1, len(inputs.takes)))
    for item in inputs.takes:
        if item.performance is None:
            parts.append(_neutral_overlay(item))
            continue
        if item.cameras is None:
            continue
        performance = item.performance
        first = performance.vertices[0].astype(np.float64)
        studio = Studio(Mesh(first, performance.polygons))
        parts.append(f"<h3>{escape(item.take.name)}</h3>")
        views = front_views(item.cameras, first)
        for index in sorted(key_frames(performance)[:most]):
            frame = int(performance.frames[index])
            vertices = performance.vertices[index].astype(np.float64)
            parts.append(_overlays(item, studio, frame, vertices, views))
        parts.append(_expression(performance, studio))
    if not any(parts):
        return []
    return [Section(anchor="tracking", title="Tracked mesh over plates", body="".join(parts))]


def key_frames(performance: Performance) -> list[int]:
    """Indices of frames worth seeing, best first: peak expression, last, least confident, first."""
    moved = stilled(performance) - performance.vertices[0]
    motion = np.sqrt((moved**2).sum(axis=2).mean(axis=1))
    doubt = performance.confidence.mean(axis=1)
    wanted = [int(motion.argmax()), len(performance.vertices) - 1, int(doubt.argmin()), 0]
    return list(dict.fromkeys(wanted))


def stilled(performance: Performance) -> Floats:
    """Vertices (F, V, 3) with the head motion taken out, in the first frame's place, mm."""
    out = np.empty(performance.vertices.shape)
    back = performance.head_from_neutral
    first = back[0]
    for index, vertices in enumerate(performance.vertices):
        motion = first @ np.linalg.inv(back[index])
        out[index] = vertices @ motion[:3, :3].T + motion[:3, 3]
    return out


def front_views(array: CameraArray, vertices: Floats) -> list[Camera]:
    """The camera most in front of the face, and those nearest to 45 degrees on its two sides."""
    centre = vertices.mean(axis=0)
    rays = np.array([camera.centre - centre for camera in array])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    yaw = np.arctan2(rays[:, 0], rays[:, 2])
    chosen: list[int] = []
    for wanted in (-0.8, 0.0, 0.8):
        ray = np.array([np.sin(wanted), 0.0, np.cos(wanted)])
        near = rays @ ray - 0.2 * (np.abs(yaw - wanted) > 0.7)
        for index in chosen:
            near[index] = -2.0
        if near.max() > -1.5:
            chosen.append(int(near.argmax()))
    return [array[index] for index in chosen]


def _neutral_overlay(item: TakeInputs) -> str:
    """Before tracking: whether the neutral sits on the face at the first frame."""
    if item.neutral is None or item.cameras is None:
        return ""
    vertices = item.neutral.vertices
    views = front_views(item.cameras, vertices)
    pictures = _overlays(item, Studio(item.neutral), item.take.frames[0], vertices, views)
    return f"<h3>{escape(item.take.name)}: the neutral, not yet tracked</h3>{pictures}"


def _overlays(
    item: TakeInputs, studio: Studio, frame: int, vertices: Floats, views: Sequence[Camera]
) -> str:
    figures = []
    for camera in views:
        if not item.take.present(camera.name, frame):
            continue
        plate, view = framed(displayable(item.take.image(camera.name, frame)), camera, vertices)
        over = wired(studio.over(plate, vertices, view), studio, vertices, view)
        words = f"{camera.name}, frame {frame}"
        content = wipe(jpeg_tag(plate, words), jpeg_tag(over, f"mesh over {words}"), words)
        figures.append(figure(content, f"{words}: plate left of the slider, mesh right of it"))
    return gallery(figures, "trio")


def framed(plate: Pixels, camera: Camera, vertices: Floats) -> tuple[Pixels, Camera]:
    """The square of a plate around the mesh at a fixed size, and the camera that sees just that."""
    pixels = camera.project(vertices)
    pixels = pixels[camera.contains(pixels)]
    if len(pixels) == 0:
        pixels = np.array([[0.0, 0.0], [camera.width - 1.0, camera.height - 1.0]])
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    side = int(min(max(1.08 * float((high - low).max()), 32.0), camera.width, camera.height))
    corner = np.rint(0.5 * (low + high) - 0.5 * side).astype(int)
    left = int(np.clip(corner[0], 0, camera.width - side))
    top = int(np.clip(corner[1], 0, camera.height - side))
    part = plate[top : top + side, left : left + side]
    view = enlarged(cropped(camera, left, top, side, side), _PLATE / side)
    way = cv2.INTER_AREA if side > _PLATE else cv2.INTER_CUBIC
    resized = cv2.resize(part, (view.width, view.height), interpolation=way)
    return np.asarray(resized, dtype=np.uint8), view


def wired(picture: Pixels, studio: Studio, vertices: Floats, camera: Camera) -> Pixels:
    """Draw the visible polygon edges of the mesh over a picture (H, W, 3) of that camera."""
    polygons = studio.mesh.polygons
    closing = np.where(polygons[:, 3] < 0, polygons[:, 2], polygons[:, 3])
    rings = np.column_stack([polygons[:, :3], closing, polygons[:, 0]])
    edges = np.concatenate([rings[:, k : k + 2] for k in range(4)])
    edges = np.unique(np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1), axis=0)
    seen = studio.visible(vertices, camera)
    edges = edges[seen[edges].all(axis=1)]
    pixels = camera.project(vertices)
    lines = np.rint(16.0 * pixels[edges]).astype(np.int32)
    drawn = picture.copy()
    cv2.polylines(drawn, list(lines), False, _WIRE, 1, cv2.LINE_AA, 4)
    blended = cv2.addWeighted(drawn, 0.3, picture, 0.7, 0.0)
    return np.asarray(blended, dtype=np.uint8)


def _expression(performance: Performance, studio: Studio) -> str:
    still = stilled(performance)
    moved = np.linalg.norm(still - still[0], axis=2)
    peak = int(np.sqrt((moved**2).mean(axis=1)).argmax())
    camera = studio_camera(still[0], 0.0, _PORTRAIT)
    side = studio_camera(still[0], 0.7, _PORTRAIT)
    top = max(float(np.percentile(moved[peak], 99.5)), 1e-3)
    colours = warm(moved[peak], 0.0, top)
    frames = performance.frames
    figures = [
        figure(
            jpeg_tag(studio.portrait(still[0], camera), "first frame"),
            f"Frame {int(frames[0])}",
        ),
        figure(
            jpeg_tag(studio.portrait(still[peak], camera), "peak of the expression"),
            f"Frame {int(frames[peak])}, the peak, head motion taken out",
        ),
        figure(
            jpeg_tag(studio.portrait(still[peak], side, colours), "displacement"),
            f"Displacement at the peak, up to {number(float(moved[peak].max()))} mm",
        ),
    ]
    scale = colour_scale(stops("warm"), 0.0, top, "displacement, mm")
    return gallery(figures) + scale


def _scan_pictures(surface: Scan, front: float) -> str:
    mesh = Mesh(surface.vertices.astype(np.float64), surface.triangles)
    studio = Studio(mesh)
    figures = []
    cameras = [studio_camera(mesh.vertices, front + yaw, _PORTRAIT) for yaw in _YAWS]
    for camera, words in zip(
        cameras, ("from its right", "from the front", "from its left"), strict=True
    ):
        picture = studio.portrait(mesh.vertices, camera)
        figures.append(figure(jpeg_tag(picture, f"scan {words}"), f"Scan {words}"))
    colours = sequential(surface.confidence.astype(np.float64), 0.0, 1.0)
    picture = studio.portrait(mesh.vertices, cameras[1], colours)
    figures.append(figure(jpeg_tag(picture, "confidence"), "Confidence of each vertex"))
    return gallery(figures, "four") + colour_scale(stops("sequential"), 0.0, 1.0, "confidence")


def _scan_errors(surface: Scan, errors: Floats, front: float) -> str:
    mesh = Mesh(surface.vertices.astype(np.float64), surface.triangles)
    studio = Studio(mesh)
    colours = warm(np.abs(errors), 0.0, _ERROR_MM)
    figures = [
        figure(
            jpeg_tag(
                studio.portrait(
                    mesh.vertices, studio_camera(mesh.vertices, front + yaw, _PORTRAIT), colours
                ),
                "distance to the true surface",
            ),
            "Distance to the true surface",
        )
        for yaw in _YAWS
    ]
    scale = colour_scale(stops("warm"), 0.0, _ERROR_MM, "distance, mm")
    return gallery(figures) + scale


def _scan_verdict(name: str, frame: int, errors: Floats) -> Verdict:
    finite = np.abs(errors[np.isfinite(errors)])
    median = float(np.median(finite)) if len(finite) else float("nan")
    share = float((finite <= 0.5).mean()) if len(finite) else 0.0
    level = "good" if median <= 0.25 and share >= 0.9 else "warn" if median <= 0.5 else "bad"
    words = f"median {median:.3f} mm from the true surface, {100 * share:.0f} % within 0.5 mm"
    return Verdict(level=level, subject=f"Scan of {name}, frame {frame}:", words=words)


def _scan_facts(scan: ScanFile, surface: Scan) -> dict[str, object]:
    values: dict[str, object] = {
        "vertices": len(surface.vertices),
        "mean confidence": float(surface.confidence.mean()),
    }
    return values | {words: scan.report[key] for key, words in _TOLD.items() if key in scan.report}


def _agreement_verdict(name: str, scan: ScanFile) -> list[Verdict]:
    median = scan.report.get("agreement_median_mm")
    if not isinstance(median, (int, float)):
        return []
    level = "good" if median <= _GOOD_MM else "warn" if median <= _FAIR_MM else "bad"
    words = f"pairs of views agree to {number(float(median))} mm (median)"
    return [Verdict(level=level, subject=f"Scan of {name}, frame {scan.frame}:", words=words)]


def _pair_table(scan: ScanFile) -> str:
    pairs = scan.report.get("pairs")
    if not isinstance(pairs, list) or not pairs:
        return ""
    head = list(pairs[0])
    rows = [[pair.get(key, "") for key in head] for pair in pairs]
    words = [key.replace("_", " ") for key in head]
    return folded(f"{len(pairs)} pairs of views", table(words, rows))


def _front(array: CameraArray | None) -> float:
    """The yaw, radians, from which the array sees the most: towards its cameras' mean."""
    if array is None:
        return 0.0
    axes = -np.array([camera.camera_from_world.rotation[2] for camera in array]).mean(axis=0)
    return float(np.arctan2(axes[0], axes[2]))


def _spread(scans: Sequence[ScanFile], count: int) -> list[ScanFile]:
    if len(scans) <= count:
        return list(scans)
    places = np.unique(np.rint(np.linspace(0, len(scans) - 1, count)).astype(int))
    return [scans[place] for place in places]
