"""One picture of the demo: of each expression the plate, the scan, the tracked mesh, the rig."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from capture.arrays import Floats
from capture.errors import WorkError
from capture.product import replacing
from capture.take import Take
from recon.mesh import Mesh
from recon.scan import load_scan
from rig.face_rig import FaceRig
from tools.report.picture import Pixels, displayable
from tools.report.shade import Studio, cropped
from tools.report.surfaces import wired
from track.performance import read_performance

_PANEL_PX = 300


def write_picture(path: Path, takes: Sequence[tuple[Take, int]], rig: FaceRig, device: str) -> None:
    """Write a JPEG of four rows: plate, scan, tracked mesh over the plate, and the solved rig.

    Args:
        path: the file.
        takes: each take with the frame to show; its scan and performance must be there.
        rig: solved from the performances of these takes, in this order.
        device: which view.
    """
    columns, first = [], 0
    for take, frame in takes:
        camera = take.cameras().by_name(device)
        performance = read_performance(take.products / "track" / "performance.npz")
        index = int(np.flatnonzero(performance.frames == frame)[0])
        vertices = performance.vertices[index].astype(np.float64)
        left, top, size = _window(camera.project(vertices), camera.width, camera.height)
        view = cropped(camera, left, top, size, size)
        plate = displayable(take.image(device, frame))[top : top + size, left : left + size]
        scan = load_scan(take.products / "recon" / f"frame_{frame:04d}.ply")
        surface = Mesh(scan.vertices.astype(np.float64), scan.triangles)
        studio = Studio(Mesh(vertices, performance.polygons))
        panels = [
            plate,
            Studio(surface).portrait(surface.vertices, view),
            wired(studio.over(plate, vertices, view), studio, vertices, view),
            studio.portrait(rig.evaluate(first + index), view),
        ]
        columns.append(np.concatenate([_fitted(panel) for panel in panels]))
        first += len(performance.frames)
    picture = np.concatenate(columns, axis=1)[..., ::-1]
    with replacing(path) as partial:
        if not cv2.imwrite(str(partial), picture, [cv2.IMWRITE_JPEG_QUALITY, 85]):
            raise WorkError(f"{path}: the picture could not be written")


def _window(pixels: Floats, width: int, height: int) -> tuple[int, int, int]:
    """Left, top and size of the square about the head that the image holds, px."""
    low, high = np.nanmin(pixels, axis=0), np.nanmax(pixels, axis=0)
    size = int(min(0.86 * (high - low).max(), width, height))
    middle = 0.5 * (low + high)
    left = int(np.clip(middle[0] - size / 2, 0, width - size))
    top = int(np.clip(middle[1] - size / 2, 0, height - size))
    return left, top, size


def _fitted(panel: Pixels) -> Pixels:
    fitted = cv2.resize(panel, (_PANEL_PX, _PANEL_PX), interpolation=cv2.INTER_AREA)
    return np.asarray(fitted, dtype=np.uint8)
