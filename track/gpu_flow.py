"""Dense flow on the graphics card: GLSL compute shaders with the results of the processor's.

`GpuFlow` does what `track.guide.guided_view`, `track.flow.search_flow` and
`track.flow.refine_flow` do. A reference level is sent to the card once and kept while it lives;
of a frame only its image and the projected vertices are sent, and the warped view stays on the
card for search and refinement. Sums run in another order, in single precision, so results differ
by rounding: see docs/tracking.md for how far.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any
from weakref import WeakKeyDictionary

import moderngl
import numpy as np

from capture.arrays import Bools, Floats, Floats32, Ints32, check_shape
from capture.camera import Camera
from capture.errors import SettingsError, WorkError
from track.flow import ALIGNED, FlowMatches, padded, window_weights
from track.gpu_context import current_context
from track.guide import GuidedView
from track.reference import ReferenceLevel

_LANES = 32  # invocations that share a window
_ROW = 32768  # work groups in a row of a dispatch; 65535 is the least that OpenGL promises
_TILE = (16, 4)  # pixels of a work group of the warp
_PACKED = 256  # pixels of a work group of the solid mask
_FARTHEST_PX = 1e6  # beyond it a vertex's place is not told in whole pixels and parts
_VERSION = 430  # of OpenGL: compute shaders and storage buffers


class GpuFlow:
    """Dense flow by compute shaders, as a `track.flow_backend.FlowBackend`.

    Threads may call it at once: they take turns with the process's one OpenGL context. Levels and
    views are known by identity, so their arrays must not be changed once they have been given.

    Args:
        levels: reference levels to send to the card now; others are sent on first use. They leave
            it when they are dropped.

    Raises:
        WorkError: without headless OpenGL 4.3, or when a level is larger than what the device
            takes in one buffer.

    References:
        Ma et al. 2016, section 2.1, where both the motion field and the flow run on the GPU.
    """

    def __init__(self, levels: Iterable[ReferenceLevel] = ()) -> None:
        self._device: tuple[int, _Device] | None = None
        with current_context() as context:
            device = self._current(context)
            for level in levels:
                device.level(level)

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
            The warped view; it stays on the card too while it lives.
        """
        check_shape(triangles=(triangles, "T 3"), vertices=(vertices, "V 3"), image=(image, "H W"))
        places = _split_places(level.camera, vertices)
        with current_context() as context:
            return self._current(context).warp(level, triangles, places, image, occluders)

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
        uniforms = {"radius": radius_px, "aligned": ALIGNED}
        with current_context() as context:
            found = self._current(context).match("flow_search", level, view, start, uniforms)
        return _matches(found, start)

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
        uniforms = {"iterations": iterations}
        with current_context() as context:
            found = self._current(context).match("flow_refine", level, view, start, uniforms)
        return _matches(found, start)

    def _current(self, context: Any) -> _Device:
        """What this process keeps on the card; a forked one sends everything anew."""
        if self._device is None or self._device[0] != os.getpid():
            self._device = os.getpid(), _Device(context)
        return self._device[1]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Level:
    """Buffers of a reference level."""

    reference: Any
    gradient: Any
    windows: Any
    triangle: Any
    weights: Any


@dataclass(frozen=True, eq=False, kw_only=True)
class _View:
    """Buffers of a guided view."""

    image: Any
    solid: Any


class _Device:
    """Buffers and programs in one OpenGL context; to be used while that is current."""

    def __init__(self, context: Any) -> None:
        if context.version_code < _VERSION:
            raise WorkError(
                f"flow on the GPU needs OpenGL 4.3; {context.info['GL_RENDERER']} offers "
                f'{context.version_code / 100:.1f}: use flow = "cpu"'
            )
        self._context = context
        most = int(context.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"])
        self._most = most if most > 0 else 2**31 - 1  # some drivers' answer overflows
        self._levels: WeakKeyDictionary[ReferenceLevel, _Level] = WeakKeyDictionary()
        self._views: WeakKeyDictionary[GuidedView, _View] = WeakKeyDictionary()
        self._programs: dict[tuple[str, int], Any] = {}
        self._rooms: dict[str, Any] = {}
        self._textures: dict[tuple[int, int, str], Any] = {}
        self._triangles: tuple[Ints32, Any] | None = None

    def level(self, level: ReferenceLevel) -> _Level:
        """The buffers of a level, sent on first sight."""
        if level not in self._levels:
            self._levels[level] = _Level(
                reference=self._sent(level.image.astype(np.float32, copy=False)),
                gradient=self._sent(level.gradient.astype(np.float32, copy=False)),
                windows=self._sent(_whole_words(level.windows)),
                triangle=self._sent(level.triangle.astype(np.int32, copy=False)),
                weights=self._sent(level.barycentric[..., 1:].astype(np.float32, copy=False)),
            )
        return self._levels[level]

    def warp(
        self,
        level: ReferenceLevel,
        triangles: Ints32,
        places: Floats32,
        image: Floats32,
        occluders: tuple[Floats32, float] | None,
    ) -> GuidedView:
        """Send image and vertices, warp, and fetch the view."""
        held, (height, width) = self.level(level), level.image.shape
        depths, scale = occluders if occluders is not None else (np.zeros((0, 0), np.float32), 0.0)
        scale = scale if depths.size else 0.0
        self._texture(image, "f4").use(0)
        self._texture(depths if depths.size else np.zeros((1, 1)), "u4").use(1)
        view = _View(image=self._buffer(4 * height * width), solid=self._buffer(height * width))
        vertices, place = (
            self._room("vertices", places.nbytes),
            self._room("place", 8 * width * height),
        )
        vertices.write(np.ascontiguousarray(places))
        shown = self._room("shown", 4 * height * width)
        program = self._program("flow_warp")
        program["size"].value, program["scale"].value = (width, height), scale
        groups = -(-width // _TILE[0]), -(-height // _TILE[1])
        self._run(
            program, groups, held.triangle, held.weights, self._corners(triangles), vertices,
            held.reference, view.image, place, shown,
        )  # fmt: skip
        program = self._program("flow_solid")
        program["size"].value = (width, height)
        self._run(program, (min(-(-height * width // _PACKED), _ROW), 1), shown, view.solid)
        guided = GuidedView(
            image=_fetched(view.image, (height, width), np.float32),
            place=_fetched(place, (height, width, 2), np.float32),
            solid=_fetched(view.solid, (height, width), np.uint8),
        )
        self._views[guided] = view
        return guided

    def match(
        self,
        kernel: str,
        level: ReferenceLevel,
        view: GuidedView,
        start: Floats,
        uniforms: Mapping[str, float],
    ) -> Floats32:
        """Run a kernel on the samples that have a start; (M', 8) what it found, in their order."""
        held, seen = self.level(level), self._view(view)
        side = int(level.windows.shape[1])
        records = _records(level, start)
        room = self._room("samples", records.nbytes), self._room("matches", records.nbytes)
        if not len(records):
            return np.zeros((0, 8), np.float32)
        room[0].write(records)
        program = self._program(kernel, side)
        program["size"].value = level.image.shape[::-1]
        program["count"].value = len(records)
        for name, value in uniforms.items():
            program[name].value = value
        columns = min(len(records), _ROW)
        self._run(
            program, (columns, -(-len(records) // columns)), held.reference, held.gradient,
            held.windows, seen.image, seen.solid, *room,
        )  # fmt: skip
        return _fetched(room[1], (len(records), 8), np.float32)

    def _view(self, view: GuidedView) -> _View:
        """The buffers of a view: those of its warp, or sent now for one that was made elsewhere."""
        if view not in self._views:
            image = self._sent(view.image.astype(np.float32, copy=False))
            self._views[view] = _View(image=image, solid=self._sent(_whole_words(view.solid)))
        return self._views[view]

    def _corners(self, triangles: Ints32) -> Any:
        if self._triangles is None or self._triangles[0] is not triangles:
            self._triangles = triangles, self._sent(triangles.astype(np.int32, copy=False))
        return self._triangles[1]

    def _run(self, program: Any, groups: tuple[int, int], *buffers: Any) -> None:
        for binding, buffer in enumerate(buffers):
            buffer.bind_to_storage_buffer(binding)
        program.run(*groups)
        self._context.memory_barrier()

    def _sent(self, values: np.ndarray[Any, Any]) -> Any:
        buffer = self._buffer(values.nbytes)
        if values.nbytes:
            buffer.write(np.ascontiguousarray(values))
        return buffer

    def _buffer(self, count: int) -> Any:
        """A buffer of whole words for `count` bytes."""
        if count > self._most:
            raise WorkError(
                f"flow on the GPU: a buffer of {count / 2**20:.0f} MiB was asked for, "
                f"{self._context.info['GL_RENDERER']} takes {self._most / 2**20:.0f} MiB: use "
                'smaller images or flow = "cpu"'
            )
        return self._context.buffer(reserve=max(4, (count + 3) // 4 * 4))

    def _room(self, name: str, count: int) -> Any:
        """A buffer for passing use, of at least `count` bytes."""
        if name not in self._rooms or self._rooms[name].size < count:
            self._rooms[name] = self._buffer(count)
        return self._rooms[name]

    def _texture(self, values: np.ndarray[Any, Any], kind: str) -> Any:
        """A texture of passing use that holds the float32 values (H, W), or their bits."""
        rows, columns = values.shape
        if (rows, columns, kind) not in self._textures:
            self._textures[rows, columns, kind] = self._context.texture(
                (columns, rows), 1, dtype=kind
            )
        texture = self._textures[rows, columns, kind]
        texture.write(np.ascontiguousarray(values, dtype=np.float32))
        return texture

    def _program(self, kernel: str, side: int = 0) -> Any:
        """A compiled kernel, for windows of `side` pixels where it has windows."""
        if (kernel, side) not in self._programs:
            try:
                self._programs[kernel, side] = self._context.compute_shader(_source(kernel, side))
            except moderngl.Error as error:
                name = self._context.info["GL_RENDERER"]
                raise WorkError(f"{name} does not compile {kernel}.glsl: {error}") from error
        return self._programs[kernel, side]


def _source(kernel: str, side: int) -> str:
    """The GLSL of a kernel, with what it needs for windows of `side` pixels before it."""
    folder = resources.files("track")
    texts = [f"#version {_VERSION} core"]
    if side:
        line = window_weights(side // 2)[side // 2]
        values = ", ".join(f"{value:.9g}" for value in line)
        texts += [
            f"#define SIDE {side}",
            f"#define COLUMNS {padded(side)}",
            f"#define LANES {_LANES}",
            f"const float LINE[SIDE] = float[SIDE]({values});",
            folder.joinpath("flow_window.glsl").read_text(encoding="utf-8"),
        ]
    return "\n".join([*texts, folder.joinpath(f"{kernel}.glsl").read_text(encoding="utf-8")])


def _split_places(camera: Camera, vertices: Floats) -> Floats32:
    """Places (V, 5) of vertices in the image: whole pixels, parts, depth; depth 0 if not seen."""
    pixels, depth = camera.project(vertices), camera.depths(vertices)
    good = (np.abs(pixels) < _FARTHEST_PX).all(axis=1) & (depth > 0.0)
    pixels = np.where(good[:, None], pixels, 0.0)
    base = np.floor(pixels)
    return np.column_stack([base, pixels - base, np.where(good, depth, 0.0)]).astype(np.float32)


def _records(level: ReferenceLevel, start: Floats) -> Ints32:
    """The kernels' `Sample` (M', 8) of every sample that has a start."""
    which = np.flatnonzero(np.isfinite(start[:, 0]))
    out = np.zeros((len(which), 8), np.int32)
    out[:, 0] = which
    out[:, 1:3] = level.centres[which] - level.windows.shape[1] // 2
    out[:, 4:6] = np.rint(start[which])
    out[:, 6:8] = start[which].astype(np.float32).view(np.int32)
    return out


def _matches(found: Floats32, start: Floats) -> FlowMatches:
    """Matches of all samples from the kernels' `Match` of those that had a start."""
    count, which = len(start), np.flatnonzero(np.isfinite(start[:, 0]))
    displacement, information = np.full((count, 2), np.nan), np.zeros((count, 3))
    correlation = np.full(count, -1.0)
    correlation[which] = found[:, 2]
    displacement[which] = np.where(found[:, 2:3] > -1.0, found[:, :2], np.nan)
    information[which] = found[:, 4:7]
    return FlowMatches(displacement=displacement, correlation=correlation, information=information)


def _whole_words(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The bytes of an array, filled up to whole words of four."""
    flat = np.ascontiguousarray(values, dtype=np.uint8).ravel()
    return np.pad(flat, (0, -len(flat) % 4))


def _fetched(buffer: Any, shape: tuple[int, ...], kind: Any) -> np.ndarray[Any, Any]:
    out = np.empty(shape, kind)
    buffer.read_into(out, size=out.nbytes)
    return out
