"""Pictures of a scan: from three sides, by confidence, and as each camera's depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from capture.arrays import Floats, Floats32
from capture.camera import Camera, CameraArray
from recon.depth_maps import depth_maps
from recon.mesh import Mesh
from recon.surface import Scan
from tools.report.charts import colour_scale
from tools.report.page import figure, gallery
from tools.report.picture import Pixels, jpeg_tag, sequential, stops
from tools.report.shade import Studio, enlarged, studio_camera

_PORTRAIT = 330  # px
_THUMB = 150  # px, longer side
_YAWS = {"from its right": -0.75, "from the front": 0.0, "from its left": 0.75}
_LIGHT = np.array([-0.35, -0.4, -0.85]) / np.linalg.norm([-0.35, -0.4, -0.85])


def scan_pictures(scan: Scan, cameras: CameraArray) -> str:
    """The scan as clay from three sides, and coloured by confidence."""
    vertices = scan.vertices.astype(np.float64)
    front = _front(cameras)
    views = {words: studio_camera(vertices, front + yaw, _PORTRAIT) for words, yaw in _YAWS.items()}
    confidence = sequential(scan.confidence.astype(np.float64), 0.0, 1.0)
    if len(scan.triangles):
        studio = Studio(Mesh(vertices, scan.triangles))
        drawn = {words: studio.portrait(vertices, view) for words, view in views.items()}
        coloured = studio.portrait(vertices, views["from the front"], confidence)
    else:
        drawn = {words: _dots(scan, view) for words, view in views.items()}
        coloured = _dots(scan, views["from the front"], confidence)
    figures = [
        figure(jpeg_tag(picture, f"scan {words}"), f"Scan {words}")
        for words, picture in drawn.items()
    ]
    figures.append(figure(jpeg_tag(coloured, "confidence"), "Confidence: how many pairs saw it"))
    scale = colour_scale(stops("sequential"), 0.0, 1.0, "confidence")
    return gallery(figures, "four") + scale


def depth_thumbnails(scan: Scan, cameras: CameraArray) -> str:
    """The depth of the mesh in each camera, near bright and far dark; empty without a mesh."""
    if len(scan.triangles) == 0:
        return ""
    small = [
        enlarged(camera, min(1.0, _THUMB / max(camera.width, camera.height))) for camera in cameras
    ]
    maps = depth_maps(small, scan.vertices, scan.triangles)
    figures = []
    for camera in cameras:
        depth = maps[camera.name]
        known = depth[np.isfinite(depth)]
        low, high = np.percentile(known, [1, 99]).tolist() if len(known) else (0.0, 1.0)
        words = f"{camera.name}: {low:.0f} to {high:.0f} mm" if len(known) else "sees nothing of it"
        figures.append(
            figure(jpeg_tag(_depth_picture(depth, low, high), f"depth of {camera.name}"), words)
        )
    return gallery(figures, "small")


def _depth_picture(depth: Floats32, low: float, high: float) -> Pixels:
    colours = sequential(-depth.astype(np.float64), -high, -low)
    colours[~np.isfinite(depth)] = 1.0
    shown: Pixels = np.rint(255 * colours).astype(np.uint8)
    return shown


def _dots(scan: Scan, camera: Camera, colours: Floats | None = None) -> Pixels:
    """Points as dots of two pixels, the near over the far, those that face away left out."""
    vertices = scan.vertices.astype(np.float64)
    normals = scan.normals @ camera.camera_from_world.rotation.T
    facing = np.flatnonzero(normals[:, 2] < 0)
    order = facing[np.argsort(-camera.depths(vertices[facing]), kind="stable")]
    shade = 0.25 + 0.75 * np.maximum(normals[order] @ _LIGHT, 0.0)
    albedo = np.array([0.80, 0.74, 0.70]) if colours is None else colours[order]
    value = np.rint(255 * np.clip(albedo * shade[:, None], 0, 1)).astype(np.uint8)
    canvas = np.full((camera.height, camera.width, 3), 255, np.uint8)
    column, row = np.rint(camera.project(vertices[order])).astype(int).T
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        r = np.clip(row + i, 0, camera.height - 1)
        canvas[r, np.clip(column + j, 0, camera.width - 1)] = value
    return canvas


def _front(cameras: Sequence[Camera] | CameraArray) -> float:
    """The yaw, radians, from which the array looks on the whole."""
    axes = -np.array([camera.camera_from_world.rotation[2] for camera in cameras]).mean(axis=0)
    return float(np.arctan2(axes[0], axes[2]))
