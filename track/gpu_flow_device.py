"""What dense flow keeps on the graphics card, and how its compute shaders are run.

Everything here is to be used while the OpenGL context is current: see `track.gpu_context`. What
is to be read back is copied into one buffer that serves for nothing else, so that the driver
leaves the others in the card's own memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import Any
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
from numpy.typing import NDArray

from capture.arrays import Floats32, Ints32
from capture.errors import WorkError
from track.flow import padded, window_weights
from track.gpu_context import current_context
from track.guide import GuidedView
from track.reference import ReferenceLevel

_LANES = 32  # invocations that share a window
_ROW = 32768  # work groups in a row of a dispatch; 65535 is the least that OpenGL promises
_TILE = (16, 4)  # pixels of a work group of the warp
_PACKED = 256  # pixels of a work group of the solid mask
_VERSION = 430  # of OpenGL: compute shaders and storage buffers


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


class _CardView(GuidedView):
    """A guided view on the card; what is asked of it is fetched when it is first asked for."""

    def __init__(self, device: FlowDevice, view: _View, place: Any, size: tuple[int, int]) -> None:
        # not the parent's: its fields are the properties below
        self.__dict__.update(_device=device, _view=view, _place=place, _size=size)

    @cached_property
    def image(self) -> Floats32:
        """(H, W) float32."""
        image: Floats32 = self._fetched(self.__dict__["_view"].image, (), np.float32)
        return image

    @cached_property
    def place(self) -> Floats32:
        """(H, W, 2) float32 px."""
        place: Floats32 = self._fetched(self.__dict__["_place"], (2,), np.float32)
        return place

    @cached_property
    def solid(self) -> NDArray[np.uint8]:
        """(H, W) uint8."""
        solid: NDArray[np.uint8] = self._fetched(self.__dict__["_view"].solid, (), np.uint8)
        return solid

    def _fetched(self, buffer: Any, channels: tuple[int, ...], kind: Any) -> Any:
        with current_context():
            shape = (*self.__dict__["_size"], *channels)
            return self.__dict__["_device"].fetched(buffer, shape, kind)


class FlowDevice:
    """Buffers and programs of dense flow in the current context.

    Raises:
        WorkError: when the context is older than OpenGL 4.3.
    """

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

    def keep(self, level: ReferenceLevel) -> _Level:
        """The buffers of a level, sent on first sight and kept while it lives."""
        if level not in self._levels:
            self._levels[level] = _Level(
                reference=self._sent(level.image, np.float32),
                gradient=self._sent(level.gradient, np.float32),
                windows=self._sent(level.windows, np.uint8),
                triangle=self._sent(level.triangle, np.int32),
                weights=self._sent(level.barycentric[..., 1:], np.float32),
            )
        return self._levels[level]

    def holds(self, view: GuidedView) -> bool:
        """Whether a view is on the card for this object's kernels."""
        return view in self._views

    def warp(
        self,
        level: ReferenceLevel,
        triangles: Ints32,
        places: Floats32,
        image: Floats32,
        occluders: tuple[Floats32, float] | None,
    ) -> GuidedView:
        """Send image and vertices, and warp.

        Args:
            level: the reference.
            triangles: (T, 3).
            places: (V, 5) of the vertices: column and row in whole pixels, their parts, depth in
                mm; depth 0 where there is no place.
            image: (H, W) the frame's.
            occluders: as for `track.guide.guided_view`.
        """
        held, (height, width) = self.keep(level), level.image.shape
        depths, scale = occluders if occluders is not None else (np.zeros((0, 0), np.float32), 0.0)
        self._texture(image, "f4").use(0)
        self._texture(depths if depths.size else np.zeros((1, 1), np.float32), "u4").use(1)
        view = _View(image=self._buffer(4 * height * width), solid=self._buffer(height * width))
        place, shown = self._buffer(8 * height * width), self._room("shown", 4 * height * width)
        vertices = self._room("vertices", places.nbytes)
        vertices.write(np.ascontiguousarray(places))
        program = self._program("flow_warp")
        program["size"].value = (width, height)
        program["scale"].value = scale if depths.size else 0.0
        groups = -(-width // _TILE[0]), -(-height // _TILE[1])
        self._run(
            program, groups, held.triangle, held.weights, self._corners(triangles), vertices,
            held.reference, view.image, place, shown,
        )  # fmt: skip
        program = self._program("flow_solid")
        program["size"].value = (width, height)
        self._run(program, (min(-(-height * width // _PACKED), _ROW), 1), shown, view.solid)
        guided = _CardView(self, view, place, (height, width))
        self._views[guided] = view
        return guided

    def match(
        self,
        kernel: str,
        level: ReferenceLevel,
        view: GuidedView,
        records: Ints32,
        uniforms: Mapping[str, float],
    ) -> Floats32:
        """Run a kernel on samples.

        Args:
            kernel: flow_search or flow_refine.
            level: the reference.
            view: one that `warp` gave, or another that needs no fetching.
            records: (N, 8) the kernels' `Sample`, floats by their bits.
            uniforms: what else the kernel asks for.

        Returns:
            (N, 8) the kernels' `Match`.
        """
        held, seen = self.keep(level), self._seen(view)
        if not len(records):
            return np.zeros((0, 8), np.float32)
        room = self._room("samples", records.nbytes), self._room("matches", records.nbytes)
        room[0].write(records)
        program = self._program(kernel, int(level.windows.shape[1]))
        program["size"].value = level.image.shape[::-1]
        program["count"].value = len(records)
        for name, value in uniforms.items():
            program[name].value = value
        columns = min(len(records), _ROW)
        self._run(
            program, (columns, -(-len(records) // columns)), held.reference, held.gradient,
            held.windows, seen.image, seen.solid, *room,
        )  # fmt: skip
        found: Floats32 = self.fetched(room[1], (len(records), 8), np.float32)
        return found

    def fetched(self, buffer: Any, shape: tuple[int, ...], kind: Any) -> np.ndarray[Any, Any]:
        """An array of what a buffer begins with.

        Raises:
            WorkError: when OpenGL has met an error since it was last asked.
        """
        out = np.empty(shape, kind)
        room = self._room("fetched", buffer.size)
        self._context.copy_buffer(room, buffer, (out.nbytes + 3) // 4 * 4)
        room.read_into(out, size=out.nbytes)
        if (error := self._context.error) != "GL_NO_ERROR":  # out of memory, of this call or before
            raise WorkError(
                f"flow on the GPU: {self._context.info['GL_RENDERER']} reports {error}: use fewer "
                'or smaller images, or flow = "cpu"'
            )
        return out

    def _seen(self, view: GuidedView) -> _View:
        """The buffers of a view: those of its warp, or sent now for one that was made elsewhere."""
        if view not in self._views:
            image, solid = self._sent(view.image, np.float32), self._sent(view.solid, np.uint8)
            self._views[view] = _View(image=image, solid=solid)
        return self._views[view]

    def _corners(self, triangles: Ints32) -> Any:
        if self._triangles is None or self._triangles[0] is not triangles:
            self._triangles = triangles, self._sent(triangles, np.int32)
        return self._triangles[1]

    def _run(self, program: Any, groups: tuple[int, int], *buffers: Any) -> None:
        for binding, buffer in enumerate(buffers):
            buffer.bind_to_storage_buffer(binding)
        program.run(*groups)
        self._context.memory_barrier()

    def _sent(self, values: np.ndarray[Any, Any], kind: Any) -> Any:
        """A buffer that holds an array."""
        buffer = self._buffer(values.size * np.dtype(kind).itemsize)
        if values.size:
            buffer.write(np.ascontiguousarray(values, dtype=kind))
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

    def _texture(self, values: Floats32, kind: str) -> Any:
        """A texture of passing use that holds an image (H, W) as f4, or its bits as u4."""
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
