"""A small take with everything a report can show: two cameras, a ball of a head, a rig."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from capture.camera import Camera, CameraArray
from capture.camera_file import write_cameras
from capture.pose import Pose
from capture.take import Take
from recon.mesh import Mesh, write_obj
from recon.surface import Scan, write_ply
from recon.visiting import import_take
from rig.face_rig import FaceRig, write_rig
from track.performance import Performance, write_performance

NASTY = "smile_<b>&\"'"
FRAMES = 4


def ball(columns: int = 16, rows: int = 10) -> Mesh:
    """A ball of 90 mm radius in quads, open at the poles."""
    yaw, pitch = np.meshgrid(
        np.linspace(0.0, 2 * np.pi, columns, endpoint=False), np.linspace(-1.3, 1.3, rows)
    )
    points = np.stack(
        [np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], axis=-1
    )
    index = np.arange(columns * rows).reshape(rows, columns)
    right = np.roll(index, -1, axis=1)
    quads = np.stack([index[:-1], right[:-1], right[1:], index[1:]], axis=-1).reshape(-1, 4)
    return Mesh(90.0 * points.reshape(-1, 3), quads.astype(np.int32))


def camera(name: str, yaw: float, size: int = 96) -> Camera:
    """A camera 600 mm from the origin, looking at it."""
    away = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    forward = -away
    right = np.cross(forward, [0.0, 1.0, 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    middle = 0.5 * (size - 1)
    return Camera(
        name=name, width=size, height=size, fx=2.2 * size, fy=2.2 * size, cx=middle, cy=middle,
        distortion=np.zeros(5), camera_from_world=Pose(rotation, -rotation @ (600.0 * away)),
    )  # fmt: skip


def make_take(folder: Path, *, cameras: bool = True, neutral: bool = True) -> Take:
    """An imported take of noise images; with cameras and neutral when asked."""
    source = folder / "source"
    rng = np.random.default_rng(4)
    array = CameraArray((camera("left", -0.6), camera("right", 0.6)))
    for one in array:
        (source / one.name).mkdir(parents=True)
        for frame in range(FRAMES):
            image = rng.integers(0, 255, (one.height, one.width), dtype=np.uint8)
            cv2.imwrite(str(source / one.name / f"{frame:04d}.png"), image)
    if cameras:
        write_cameras(source / "cameras.json", array)
    if neutral:
        write_obj(source / "neutral.obj", ball())
    return import_take(source, folder / "take")


def track(take: Take) -> Performance:
    """A performance beside the take, with the tracker's own numbers."""
    mesh = ball()
    vertices = np.stack([mesh.vertices * [1.0, 1.0 + 0.1 * f, 1.0] for f in range(FRAMES)])
    performance = Performance(
        vertices=vertices.astype(np.float32),
        confidence=np.full(vertices.shape[:2], 0.8, np.float32),
        polygons=mesh.polygons,
        frames=np.arange(FRAMES),
        head_from_neutral=np.tile(np.eye(4), (FRAMES, 1, 1)),
        reference=np.full(FRAMES, -1),
    )
    write_performance(take.products / "track" / "performance.npz", performance)
    rows = [{"frame": f, "ncc": 0.9 - 0.02 * f, "lost": False} for f in range(FRAMES)]
    text = json.dumps({"frames": rows, "reprojection_px": [0.1, 0.2, None, 0.3]})
    (take.products / "track" / "report.json").write_text(text, encoding="utf-8")
    return performance


def scan(take: Take) -> int:
    """A scan of frame 1 beside the take; gives its vertex count."""
    mesh = ball()
    count = len(mesh.vertices)
    confidence = np.linspace(0.0, 1.0, count).astype(np.float32)
    surface = Scan(
        mesh.vertices.astype(np.float32),
        mesh.triangles,
        mesh.normals().astype(np.float32),
        confidence,
    )
    folder = take.products / "recon"
    folder.mkdir(parents=True, exist_ok=True)
    write_ply(folder / "frame_0001.ply", surface)
    report = {"agreement_median_mm": 0.05, "pairs": [{"left": "left", "right": "right"}]}
    (folder / "frame_0001.json").write_text(json.dumps(report), encoding="utf-8")
    return count


def rig(folder: Path) -> Path:
    """A rig folder with a report."""
    mesh = ball()
    deltas = np.zeros((3, len(mesh.vertices), 3))
    deltas[0, :40, 1] = -8.0
    deltas[1, 40:60, 0] = 3.0
    weights = np.zeros((FRAMES, 3))
    weights[:, 0] = [0.0, 0.4, 0.8, 0.2]
    solved = FaceRig(
        neutral=mesh.vertices,
        deltas=deltas,
        names=("jawOpen", NASTY, "still"),
        polygons=mesh.polygons,
        weights=weights,
        head_from_rig=np.tile(np.eye(4), (FRAMES, 1, 1)),
    )
    write_rig(folder / "rig.npz", solved)
    report = {"residual_transferred_mm": 1.0, "residual_refined_mm": 0.4, "ratio": 0.4}
    (folder / "report.json").write_text(json.dumps(report), encoding="utf-8")
    return folder


def calibration(folder: Path, warnings: list[str]) -> Path:
    """A calibration's report.json for the two cameras."""
    devices = [
        {
            "name": name,
            "mean_reprojection_px": 0.1,
            "coverage": [[0, 2], [5, 1]],
            "views": 9,
        }
        for name in ("left", "right")
    ]
    report = {
        "mean_reprojection_px": 0.1,
        "held_out": {"ratio": 1.3},
        "devices": devices,
        "poses": [
            {"frame": 0, "mean_reprojection_px": 0.1},
            {"frame": 3, "mean_reprojection_px": None},
        ],
        "residual_vectors": {"left": [[10.0, 20.0, 0.1, -0.1]]},
        "warnings": warnings,
    }
    (folder / "report.json").write_text(json.dumps(report), encoding="utf-8")
    return folder / "report.json"
