"""Texture stability in the report: what still moves when frames are brought back to the first."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from capture.arrays import Floats32
from recon.images import mono
from recon.mesh import Mesh
from tools.report.charts import colour_scale
from tools.report.inputs import TakeInputs
from tools.report.page import figure, gallery, table
from tools.report.picture import Pixels, displayable, jpeg_tag, sequential, stops
from tools.report.surfaces import front_views
from track.quality_texture import ResidualFlow, TextureWatch

_BRIGHT_PX = 1.0  # the light end of the pictures' scale
_WIDE = 330  # px


def texture_part(item: TakeInputs, rows: Sequence[int]) -> str:
    """Residual flow of some frames in the three front views, as table and pictures.

    Args:
        item: a take with cameras, performance and images.
        rows: places of the frames in the performance.

    Returns:
        HTML; empty when no view has the first frame.
    """
    performance, cameras = item.performance, item.cameras
    if performance is None or cameras is None:
        return ""
    first = Mesh(performance.vertices[0].astype(np.float64), performance.polygons)
    chosen = {camera.name: camera for camera in front_views(cameras, first.vertices)}
    reference = _images(item, list(chosen), int(performance.frames[0]))
    if not reference:
        return ""
    watch = TextureWatch(first, chosen, reference)
    cells: list[tuple[object, ...]] = []
    figures = []
    for row in sorted(rows):
        frame = int(performance.frames[row])
        images = _images(item, list(reference), frame)
        found = watch.residual(performance.vertices[row].astype(np.float64), images)
        cells += [(frame, name, flow.median_px, flow.p95_px) for name, flow in found.items()]
        shown = list(found)[len(found) // 2 : len(found) // 2 + 1]
        for name in shown:
            words = f"Residual flow, frame {frame} in {name}"
            plate = displayable(item.take.image(name, int(performance.frames[0])))
            figures.append(figure(jpeg_tag(_picture(plate, found[name]), words), words))
    if not cells:
        return ""
    scale = colour_scale(stops("sequential"), 0.0, _BRIGHT_PX, "residual flow, px")
    return (
        "<h4>Texture stability</h4><p>Frames brought back into their reference views by the mesh; "
        "what a flow that took no part in tracking still finds to move there. A tenth of a pixel "
        "is as good as it can tell.</p>"
        + table(("frame", "view", "median, px", "95 % below, px"), cells)
        + gallery(figures, "four")
        + scale
    )


def _images(item: TakeInputs, names: Sequence[str], frame: int) -> dict[str, Floats32]:
    take = item.take
    return {name: mono(take.image(name, frame)) for name in names if take.present(name, frame)}


def _picture(plate: Pixels, flow: ResidualFlow) -> Pixels:
    """The reference plate, grey, with the length of the flow over it where it was measured."""
    length = np.linalg.norm(flow.flow_px, axis=2).astype(np.float64)
    over = np.rint(255.0 * sequential(length, 0.0, _BRIGHT_PX)).astype(np.uint8)
    mixed = np.where(np.isfinite(length)[:, :, None], over, plate // 2)
    known = np.argwhere(np.isfinite(length))
    if len(known):
        (top, left), (low, right) = known.min(axis=0), known.max(axis=0) + 1
        mixed = mixed[top:low, left:right]
    height = max(1, round(_WIDE * mixed.shape[0] / mixed.shape[1]))
    small = cv2.resize(np.ascontiguousarray(mixed), (_WIDE, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)
