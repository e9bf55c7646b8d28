"""The drawing surface: supersampled pinhole drawing, seen through the true lens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import moderngl
import numpy as np

from capture.arrays import Floats, Floats32
from capture.camera import Camera
from capture.errors import SettingsError
from track.gpu_context import gl_context

_NEAR_MM, _FAR_MM = 40.0, 4000.0


@dataclass(frozen=True, eq=False)
class View:
    """One camera prepared for drawing.

    Attributes:
        size: (width, height) of the supersampled pinhole image.
        clip_from_world: (4, 4) for the vertex shader.
        columns: (H, W) float32, where each sensor pixel's centre lies in the pinhole image.
        rows: (H, W) float32, likewise.
    """

    size: tuple[int, int]
    clip_from_world: Floats
    columns: Floats32
    rows: Floats32


class Canvas:
    """An off-screen OpenGL target shared by everything a scene draws.

    Args:
        supersample: pinhole samples along each side of a sensor pixel.

    Raises:
        SettingsError: when `supersample` is not 1..4.
        WorkError: when no OpenGL context can be made.
    """

    def __init__(self, supersample: int = 2) -> None:
        if not 1 <= supersample <= 4:
            raise SettingsError(f"supersample: must lie in 1..4, found {supersample}")
        self.supersample = supersample
        self.context: Any = gl_context()
        self._targets: dict[tuple[int, int], Any] = {}
        self._lenses: dict[tuple[float, ...], tuple[Floats, Floats32, Floats32]] = {}

    def view(self, camera: Camera) -> View:
        """Prepare a camera: the pinhole image that covers its sensor, the map through its lens."""
        key = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
               *camera.distortion.tolist())  # fmt: skip
        if key not in self._lenses:
            self._lenses[key] = self._lens(camera)
        bounds, columns, rows = self._lenses[key]
        width, height, left, top = bounds
        rigid = camera.camera_from_world.matrix()
        near, far = _NEAR_MM, _FAR_MM
        lens = np.array([
            [2.0 * camera.fx / width, 0.0, 2.0 * (camera.cx - left + 0.5) / width - 1.0, 0.0],
            [0.0, -2.0 * camera.fy / height, 1.0 - 2.0 * (camera.cy - top + 0.5) / height, 0.0],
            [0.0, 0.0, (far + near) / (far - near), -2.0 * far * near / (far - near)],
            [0.0, 0.0, 1.0, 0.0],
        ])  # fmt: skip
        size = (int(width) * self.supersample, int(height) * self.supersample)
        return View(size, lens @ rigid, columns, rows)

    def _lens(self, camera: Camera) -> tuple[Floats, Floats32, Floats32]:
        column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.stack([column.ravel(), row.ravel()], axis=1).astype(np.float64)
        ideal = camera.undistort(pixels) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        left, top = np.floor(np.nanmin(ideal, axis=0)) - 3.0
        right, bottom = np.ceil(np.nanmax(ideal, axis=0)) + 3.0
        width, height = right - left + 1.0, bottom - top + 1.0
        inside = np.nan_to_num((ideal - [left, top] + 0.5) * self.supersample - 0.5, nan=-9.0)
        maps = inside.reshape(camera.height, camera.width, 2).astype(np.float32)
        bounds = np.array([width, height, left, top])
        return bounds, np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])

    def begin(self, view: View, background: float = 0.0) -> None:
        """Clear the target for a view and make it the place that is drawn to."""
        if view.size not in self._targets:
            self._targets[view.size] = self.context.framebuffer(
                [self.context.texture(view.size, 1, dtype="f2")],
                self.context.depth_renderbuffer(view.size),
            )
        self._targets[view.size].use()
        self.context.enable_only(moderngl.DEPTH_TEST)
        self._targets[view.size].clear(background, 0.0, 0.0, 1.0)

    def pinhole(self, view: View) -> Floats32:
        """What was drawn, supersampled and without the lens: float32, first row at the top."""
        raw = self._targets[view.size].read(components=1, dtype="f2")
        width, height = view.size
        return np.frombuffer(raw, np.float16).reshape(height, width)[::-1].astype(np.float32)

    def finish(self, view: View) -> Floats32:
        """What the sensor sees through the lens, (H, W) float32, each pixel an area average.

        The average is symmetric about the pixel's centre, so that nothing shifts.
        """
        drawn = self.pinhole(view)
        if self.supersample > 1:
            reach = 2 * (self.supersample // 2) + 1
            kernel = cv2.getGaussianKernel(reach, 0.36 * self.supersample, cv2.CV_32F)
            drawn = np.asarray(cv2.sepFilter2D(drawn, cv2.CV_32F, kernel, kernel), np.float32)
        bent = cv2.remap(
            drawn, view.columns, view.rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(bent, dtype=np.float32)
