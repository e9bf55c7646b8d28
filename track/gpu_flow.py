"""Dense flow on the graphics card: GLSL compute shaders with the results of the processor's.

`GpuFlow` does what `track.guide.guided_view`, `track.flow.search_flow` and
`track.flow.refine_flow` do. A reference level is sent to the card once and kept while it lives;
of a frame only its image and the projected vertices are sent, and the warped view stays on the
card for search and refinement. Sums run in another order, in single precision: displacements
agree within 1e-3 px for 99.9 % of samples, correlations within 1e-4, and the same samples are
matched but for one in a thousand that lies on a threshold.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from capture.arrays import Bools, Floats, Floats32, Ints32, check_shape
from capture.camera import Camera
from capture.errors import SettingsError
from track.flow import ALIGNED, FlowMatches
from track.gpu_context import current_context
from track.gpu_flow_device import FlowDevice
from track.guide import GuidedView
from track.reference import ReferenceLevel

_FARTHEST_PX = 1e6  # beyond it a vertex's place is not told in whole pixels and parts


class GpuFlow:
    """Dense flow by compute shaders, as a `track.flow_backend.FlowBackend`.

    Threads may call it at once: they take turns with the process's one OpenGL context. It belongs
    to the process that made it; others make their own. Levels and views are known by identity, so
    their arrays must not be changed once they have been given.

    Args:
        levels: reference levels to send to the card now; others are sent on first use. They leave
            it when they are dropped.

    Raises:
        WorkError: without headless OpenGL 4.3, or when a level is larger than what the device
            takes in one buffer.

    References:
        Ma et al. 2016, section 2.1, where the motion field is rendered on the GPU.
    """

    def __init__(self, levels: Iterable[ReferenceLevel] = ()) -> None:
        with current_context() as context:
            self._device = FlowDevice(context)
            for level in levels:
                self._device.keep(level)

    @property
    def device_name(self) -> str:
        """The name that OpenGL gives its device."""
        with current_context() as context:
            return str(context.info["GL_RENDERER"])

    def warp(
        self,
        level: ReferenceLevel,
        triangles: Ints32,
        vertices: Floats,
        image: Floats32,
        occluders: tuple[Floats32, float] | None = None,
    ) -> GuidedView:
        """Warp a frame's image into the reference by the motion field of the mesh.

        Args:
            level: the view's reference.
            triangles: (T, 3).
            vertices: (V, 3) world mm: the mesh in the frame.
            image: (H, W) the frame's image at the level.
            occluders: as for `track.guide.guided_view`.

        Returns:
            The warped view. It stays on the card while it lives; each of its arrays is fetched
            when it is first asked for.
        """
        check_shape(triangles=(triangles, "T 3"), vertices=(vertices, "V 3"), image=(image, "H W"))
        places = _split_places(level.camera, vertices)
        with current_context():
            return self._device.warp(level, triangles, places, image, occluders)

    def search(
        self, level: ReferenceLevel, view: GuidedView, chosen: Bools, radius_px: int
    ) -> FlowMatches:
        """Find the whole-pixel displacement of highest NCC within a square.

        Args:
            level: the reference of the view.
            view: the frame's image, guided into it.
            chosen: (M,) bool: which of the level's samples to search; the others stay unmatched.
            radius_px: half side of the square, >= 0.

        Returns:
            Matches of all M samples; `information` is 0.
        """
        if radius_px < 0:
            raise SettingsError(f"radius_px: expected at least 0, found {radius_px}")
        check_shape(chosen=(chosen, "M"), samples=(level.samples, "M"))
        start = np.where(chosen[:, None], np.zeros((1, 2)), np.nan)
        return self._match("flow_search", level, view, start, radius=radius_px, aligned=ALIGNED)

    def refine(
        self, level: ReferenceLevel, view: GuidedView, start: Floats, iterations: int
    ) -> FlowMatches:
        """Refine displacements to a fraction of a pixel.

        Args:
            level: the reference of the view.
            view: the frame's image, guided into it.
            start: (M, 2) px displacements to start from; NaN skips the sample.
            iterations: Gauss-Newton steps, each at most one pixel long.

        Returns:
            Matches of all M samples.

        References:
            Baker and Matthews 2004, "Lucas-Kanade 20 years on", section 3.2.
        """
        check_shape(start=(start, "M 2"), samples=(level.samples, "M"))
        return self._match("flow_refine", level, view, start, iterations=iterations)

    def _match(
        self,
        kernel: str,
        level: ReferenceLevel,
        view: GuidedView,
        start: Floats,
        **uniforms: float,
    ) -> FlowMatches:
        """Run a kernel on the samples that have a start; matches of all."""
        which = np.flatnonzero(np.isfinite(start[:, 0]))
        records = np.zeros((len(which), 8), np.int32)  # flow_window.glsl: Sample
        records[:, 0] = which
        records[:, 1:3] = level.centres[which] - level.windows.shape[1] // 2
        records[:, 4:6] = np.rint(start[which])
        records[:, 6:8] = start[which].astype(np.float32).view(np.int32)
        if not self._device.holds(view):
            _ = view.image, view.solid  # of another card's view: fetched before its turn is ours
        with current_context():
            found = self._device.match(kernel, level, view, records, uniforms)
        count = len(start)
        displacement, information = np.full((count, 2), np.nan), np.zeros((count, 3))
        correlation = np.full(count, -1.0)
        correlation[which] = found[:, 2]
        displacement[which] = np.where(found[:, 2:3] > -1.0, found[:, :2], np.nan)
        information[which] = found[:, 4:7]
        return FlowMatches(
            displacement=displacement, correlation=correlation, information=information
        )


def _split_places(camera: Camera, vertices: Floats) -> Floats32:
    """Places (V, 5) of vertices in the image: whole pixels, parts, depth; depth 0 if not seen."""
    pixels, depth = camera.project(vertices), camera.depths(vertices)
    good = (np.abs(pixels) < _FARTHEST_PX).all(axis=1) & (depth > 0.0)
    pixels = np.where(good[:, None], pixels, 0.0)
    base = np.floor(pixels)
    return np.column_stack([base, pixels - base, np.where(good, depth, 0.0)]).astype(np.float32)
