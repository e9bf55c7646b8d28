"""Rasterizer: a mesh seen by a camera, as triangle ids, barycentrics, depth and motion.

Vertices are projected and distorted on the CPU by `Camera`, so the buffers lie in the camera's
real, distorted pixels; between the vertices of a triangle OpenGL interpolates perspective-
correctly. Within a triangle the lens is thus taken as locally projective, which for triangles of
a few dozen pixels is right to a hundredth of a pixel. No multi-sampling and no blending: an id
or a barycentric coordinate must never be a mixture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats, Floats32, Ints32, check_shape
from capture.camera import Camera
from capture.errors import ShapeError
from track.gpu_context import current_context

_NEAR_MM = 1.0
_VERTEX = """#version 330
in vec4 clip; in vec4 moved;
out vec3 weights; out float depth; out vec3 motion;
void main() {
    int corner = gl_VertexID % 3;
    weights = vec3(corner == 0, corner == 1, corner == 2);
    depth = clip.w;
    motion = moved.xyz;
    gl_Position = clip;
}"""
_FRAGMENT = """#version 330
in vec3 weights; in float depth; in vec3 motion;
layout(location = 0) out int triangle;
layout(location = 1) out vec4 barycentric_depth;
layout(location = 2) out vec4 motion_depth;
void main() {
    triangle = gl_PrimitiveID + 1;
    barycentric_depth = vec4(weights / (weights.x + weights.y + weights.z), depth);
    motion_depth = vec4(motion, 1.0);
}"""


@dataclass(frozen=True, eq=False, kw_only=True)
class RasterBuffers:
    """What a camera sees of a mesh, at every pixel centre.

    Attributes:
        triangle: (H, W) int32 index of the nearest triangle; -1 where there is none.
        barycentric: (H, W, 3) float32 weights of its corners on the surface, sum 1; 0 where none.
        depth: (H, W) float32 camera-space Z, mm; NaN where there is none.
        motion: (H, W, 2) float32 px from the surface point's image to the image of the same point
            of the moved mesh; NaN where there is none or it goes behind the camera. None when no
            moved vertices were given.
        moved_depth: (H, W) float32 mm, camera-space Z of the moved point; as `motion`.
    """

    triangle: Ints32
    barycentric: Floats32
    depth: Floats32
    motion: Floats32 | None = None
    moved_depth: Floats32 | None = None


class Rasterizer:
    """Draws one topology into any camera.

    Args:
        triangles: (T, 3) vertex indices.
        vertex_count: V.

    Raises:
        ShapeError: when an index is outside 0..V-1.
        WorkError: when there is no headless OpenGL.

    References:
        Ma et al. 2016, section 2.1: "We use the registered mesh at the current iteration to
        render a dense motion field using hardware accelerated rasterization."
    """

    def __init__(self, triangles: Ints32, vertex_count: int) -> None:
        check_shape(triangles=(triangles, "T 3"))
        if triangles.size and not 0 <= int(triangles.min()) <= int(triangles.max()) < vertex_count:
            raise ShapeError(
                f"triangles: indices must lie in 0..{vertex_count - 1}, "
                f"found {int(triangles.min())}..{int(triangles.max())}"
            )
        self._triangles = np.ascontiguousarray(triangles, dtype=np.int32)
        self._vertex_count = vertex_count
        self._frames: dict[tuple[int, int], Any] = {}
        with current_context() as context:
            self._program = context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
            size = max(1, 48 * len(self._triangles))
            self._clip, self._moved = context.buffer(reserve=size), context.buffer(reserve=size)
            self._array = context.vertex_array(
                self._program, [(self._clip, "4f", "clip"), (self._moved, "4f", "moved")]
            )

    def render(
        self, camera: Camera, vertices: Floats, moved_vertices: Floats | None = None
    ) -> RasterBuffers:
        """Rasterize the mesh into the distorted image of a camera.

        Triangles with a vertex nearer than 1 mm, behind the camera, or beyond the radius at which
        the distortion folds the image over are left out.

        Args:
            camera: the camera.
            vertices: (V, 3) world, mm.
            moved_vertices: (V, 3) world, mm: the same mesh elsewhere, for the motion field.

        Returns:
            Buffers of the camera's height and width; the same bytes for the same input.
        """
        check_shape(vertices=(vertices, f"{self._vertex_count} 3"))
        pixels, depth, good = _project(camera, np.asarray(vertices, dtype=np.float64))
        clip = self._clip_corners(camera, pixels, depth, good)
        moved = None
        if moved_vertices is not None:
            check_shape(vertices=(vertices, "V 3"), moved_vertices=(moved_vertices, "V 3"))
            target, far, there = _project(camera, np.asarray(moved_vertices, dtype=np.float64))
            lines = np.where(there[:, None], np.column_stack([target - pixels, far]), np.nan)
            moved = np.zeros_like(clip)
            moved[:, :3] = lines[self._triangles.ravel()]
        triangle, surface, motion = self._draw(camera, clip, moved)
        empty = triangle < 0
        surface[empty, 3] = np.nan
        if motion is not None:
            motion[empty] = np.nan
        return RasterBuffers(
            triangle=triangle,
            barycentric=np.ascontiguousarray(surface[..., :3]),
            depth=np.ascontiguousarray(surface[..., 3]),
            motion=None if motion is None else np.ascontiguousarray(motion[..., :2]),
            moved_depth=None if motion is None else np.ascontiguousarray(motion[..., 2]),
        )

    def _clip_corners(self, camera: Camera, pixels: Floats, depth: Floats, good: Bools) -> Floats32:
        """Clip coordinates (3 T, 4) of all corners; row 0 of the image is GL's lowest row."""
        far = float(depth[good].max(initial=2 * _NEAR_MM)) + 1.0
        near = max(float(depth[good].min(initial=far)) - 1.0, 0.5 * _NEAR_MM)
        ndc = np.empty((len(pixels), 3))
        ndc[:, 0] = (2.0 * pixels[:, 0] + 1.0) / camera.width - 1.0
        ndc[:, 1] = (2.0 * pixels[:, 1] + 1.0) / camera.height - 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            ndc[:, 2] = (far + near - 2.0 * far * near / depth) / (far - near)
        rows = np.column_stack([ndc * depth[:, None], depth])
        rows[~good] = [2.0, 2.0, 2.0, 1.0]
        corners = rows[self._triangles.ravel()].astype(np.float32)
        bad = ~good[self._triangles].all(axis=1)
        corners.reshape(-1, 3, 4)[bad] = [2.0, 2.0, 2.0, 1.0]  # outside the clip volume: not drawn
        return corners

    def _draw(
        self, camera: Camera, clip: Floats32, moved: Floats32 | None
    ) -> tuple[Ints32, Floats32, Floats32 | None]:
        height, width = camera.height, camera.width
        with current_context() as context:
            if (width, height) not in self._frames:
                self._frames[width, height] = _framebuffer(context, width, height)
            frame = self._frames[width, height]
            self._clip.write(np.ascontiguousarray(clip).tobytes())
            if moved is not None:
                self._moved.write(np.ascontiguousarray(moved).tobytes())
            frame.use()
            context.enable_only(context.DEPTH_TEST)
            frame.clear()
            if len(self._triangles):
                self._array.render()
            ids = np.empty((height, width), np.int32)
            surface = np.empty((height, width, 4), np.float32)
            frame.read_into(ids, components=1, attachment=0, dtype="i4")
            frame.read_into(surface, components=4, attachment=1, dtype="f4")
            motion = None
            if moved is not None:
                motion = np.empty((height, width, 4), np.float32)
                frame.read_into(motion, components=4, attachment=2, dtype="f4")
        return ids - 1, surface, motion


def _framebuffer(context: Any, width: int, height: int) -> Any:
    colours = [
        context.texture((width, height), 1, dtype="i4"),
        context.texture((width, height), 4, dtype="f4"),
        context.texture((width, height), 4, dtype="f4"),
    ]
    # a depth texture, not a renderbuffer: moderngl issues 199 and 267
    return context.framebuffer(colours, context.depth_texture((width, height)))


def _project(camera: Camera, points: Floats) -> tuple[Floats, Floats, Bools]:
    """Pixels (V, 2), depths (V,) and whether each point can be drawn."""
    local = camera.camera_from_world.apply(points)
    depth = local[:, 2]
    good = depth > _NEAR_MM
    flat = local[:, :2] / np.where(good, depth, 1.0)[:, None]
    good &= (flat**2).sum(axis=1) < _fold_radius(camera) ** 2
    bent = camera.distort(np.where(good[:, None], flat, 0.0))
    return bent * [camera.fx, camera.fy] + [camera.cx, camera.cy], depth, good


def _fold_radius(camera: Camera) -> float:
    """Ideal radius at which the radial distortion stops growing: beyond it the image folds."""
    k1, k2, _, _, k3 = camera.distortion
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])  # d/dr of r (1 + k1 r2 + k2 r4 + k3 r6)
    real = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if len(real) else float("inf")
