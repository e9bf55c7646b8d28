"""Texture stability: does the skin stick to the mesh, asked of a flow that took no part in it.

Each frame is brought back into its reference view by the motion of the tracked mesh. If every
vertex stays on its pore, the two pictures show the same skin in the same place; what flow is left
between them is what an artist sees as sliding. The flow is DIS, on pictures freed of light and
contrast, not the matching that the tracker used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.arrays import Bools, Floats, Floats32
from capture.camera import Camera
from recon.mesh import Mesh
from track.guide import guided_view
from track.raster import Rasterizer
from track.reference import ReferenceLevel

_LIGHT_PX = 8.0  # light and contrast are those of a neighbourhood of this standard deviation
_RIM_PX = 7  # pixels beside the edge of what is shown are left out: flow bleeds across it
_FLAT = 0.006  # standard deviation of skin, images in 0..1, below which there is nothing to see
_LEAST = 200  # pixels that a view must show
_ALIKE = 0.5  # correlation, flow taken out, below which a view shows something else

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, eq=False, kw_only=True)
class ResidualFlow:
    """What is left to move between a view's reference and a frame brought back into it.

    Attributes:
        flow_px: (H, W, 2) float32, px of the view; NaN where the skin is not shown in both.
        median_px: of its length; NaN when too little skin is shown, or none that the reference
            shows too, as in a frame that was lost or overexposed.
        p95_px: its 95th percentile.
    """

    flow_px: Floats32
    median_px: float
    p95_px: float


class TextureWatch:
    """Brings frames back into the reference views of a take and measures what still moves.

    Args:
        neutral: at the reference frame, world mm.
        cameras: by name.
        images: the reference frame's images (H, W) float32 in 0..1, of the views to watch.
    """

    def __init__(
        self, neutral: Mesh, cameras: Mapping[str, Camera], images: Mapping[str, Floats32]
    ) -> None:
        self._triangles = neutral.triangles
        self._raster = Rasterizer(neutral.triangles, len(neutral.vertices))
        self._views = {
            name: self._reference(cameras[name], image, neutral.vertices)
            for name, image in images.items()
        }

    def residual(self, vertices: Floats, images: Mapping[str, Floats32]) -> dict[str, ResidualFlow]:
        """The flow that is left in each watched view that has the frame.

        Args:
            vertices: (V, 3) the tracked mesh at the frame, world mm.
            images: the frame's images.

        References:
            Kroeger et al. 2016, "Fast optical flow using dense inverse search".
        """
        return {
            name: self._left_over(level, vertices, images[name])
            for name, level in self._views.items()
            if name in images
        }

    def _reference(self, camera: Camera, image: Floats32, vertices: Floats) -> ReferenceLevel:
        drawn = self._raster.render(camera, vertices)
        nothing = np.zeros(0, np.int32)
        return ReferenceLevel(
            camera=camera,
            image=image,
            gradient=np.zeros((2, 0, 0), np.float32),
            triangle=drawn.triangle,
            barycentric=drawn.barycentric,
            samples=nothing,
            centres=nothing.reshape(0, 2),
            windows=np.zeros((0, 1, 1), np.uint8),
        )

    def _left_over(self, level: ReferenceLevel, vertices: Floats, image: Floats32) -> ResidualFlow:
        depth = self._raster.render(level.camera, vertices).depth
        view = guided_view(level, self._triangles, vertices, image, (depth, 1.0))
        shown = _inner(view.solid > 0) & _textured(level.image)
        before, after = _even(level.image), _even(view.image)
        engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        engine.setFinestScale(0)
        found = engine.calc(before, after, None)  # type: ignore[call-overload]
        if not _alike(before, after, np.asarray(found), shown):
            shown = np.zeros_like(shown)
        flow = np.where(shown[:, :, None], found, np.nan).astype(np.float32)
        length = np.linalg.norm(flow[shown], axis=1)
        if len(length) < _LEAST:
            return ResidualFlow(flow_px=flow, median_px=float("nan"), p95_px=float("nan"))
        median, tail = np.percentile(length, [50.0, 95.0]).tolist()
        return ResidualFlow(flow_px=flow, median_px=median, p95_px=tail)


def _even(image: Floats32) -> Pixels:
    """A picture freed of its light and contrast, 8 bits."""
    mean = cv2.GaussianBlur(image, (0, 0), _LIGHT_PX)
    away = image - mean
    size = np.sqrt(cv2.GaussianBlur(away * away, (0, 0), _LIGHT_PX)) + _FLAT
    even: Pixels = np.clip(128.0 + 48.0 * away / size, 0.0, 255.0).astype(np.uint8)
    return even


def _alike(before: Pixels, after: Pixels, flow: Floats32, shown: Bools) -> bool:
    """Whether the pictures show the same once the flow is taken out; noise does not."""
    y, x = np.indices(shown.shape, dtype=np.float32)
    back = cv2.remap(after, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR)
    one, two = before[shown].astype(np.float64), back[shown].astype(np.float64)
    if len(one) < _LEAST or one.std() < 1e-6 or two.std() < 1e-6:
        return False
    return float(np.corrcoef(one, two)[0, 1]) > _ALIKE


def _textured(image: Floats32) -> Bools:
    away = image - cv2.GaussianBlur(image, (0, 0), 0.5 * _LIGHT_PX)
    textured: Bools = cv2.GaussianBlur(away * away, (0, 0), 0.5 * _LIGHT_PX) > _FLAT**2
    return textured


def _inner(shown: Bools) -> Bools:
    side = 2 * _RIM_PX + 1
    kernel = np.ones((side, side), np.uint8)
    inner = cv2.erode(shown.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(inner) > 0
