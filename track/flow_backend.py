"""Who measures dense flow: the processor, or the graphics card with the same results."""

from __future__ import annotations

from typing import Literal, Protocol

from capture.arrays import Bools, Floats, Floats32, Ints32
from capture.errors import SettingsError
from track.flow import FlowMatches, refine_flow, search_flow
from track.gpu_flow import GpuFlow
from track.guide import GuidedView, guided_view
from track.reference import ReferenceLevel


class FlowBackend(Protocol):
    """The three steps of dense flow, callable from several threads at once.

    Arguments and results are those of `track.guide.guided_view`, `track.flow.search_flow` and
    `track.flow.refine_flow`. Levels and views are never changed once they have been given.
    """

    def warp(
        self,
        level: ReferenceLevel,
        triangles: Ints32,
        vertices: Floats,
        image: Floats32,
        occluders: tuple[Floats32, float] | None = None,
    ) -> GuidedView:
        """Warp a frame's image into the reference by the motion field of the mesh."""
        ...

    def search(
        self, level: ReferenceLevel, view: GuidedView, chosen: Bools, radius_px: int
    ) -> FlowMatches:
        """Find the whole-pixel displacement of highest NCC within a square."""
        ...

    def refine(
        self, level: ReferenceLevel, view: GuidedView, start: Floats, iterations: int
    ) -> FlowMatches:
        """Refine displacements to a fraction of a pixel."""
        ...


class CpuFlow:
    """Dense flow on the processor; the graphics card's is `track.gpu_flow.GpuFlow`."""

    def warp(
        self,
        level: ReferenceLevel,
        triangles: Ints32,
        vertices: Floats,
        image: Floats32,
        occluders: tuple[Floats32, float] | None = None,
    ) -> GuidedView:
        """Warp a frame's image into the reference: `track.guide.guided_view`."""
        return guided_view(level, triangles, vertices, image, occluders)

    def search(
        self, level: ReferenceLevel, view: GuidedView, chosen: Bools, radius_px: int
    ) -> FlowMatches:
        """Find whole-pixel displacements: `track.flow.search_flow`."""
        return search_flow(level, view, chosen, radius_px)

    def refine(
        self, level: ReferenceLevel, view: GuidedView, start: Floats, iterations: int
    ) -> FlowMatches:
        """Refine displacements to a fraction of a pixel: `track.flow.refine_flow`."""
        return refine_flow(level, view, start, iterations)


def make_flow(where: Literal["cpu", "gpu"]) -> FlowBackend:
    """The dense flow of a process, on the processor or through OpenGL.

    Args:
        where: cpu, or gpu; the latter runs on whatever device OpenGL has, and is slow where that
            is the processor again (`GpuFlow.device_name` says llvmpipe).

    Raises:
        SettingsError: when `where` is neither.
        WorkError: for gpu, without headless OpenGL 4.3.
    """
    if where not in ("cpu", "gpu"):
        raise SettingsError(f'flow: expected "cpu" or "gpu", found "{where}"')
    return GpuFlow() if where == "gpu" else CpuFlow()
