"""Drawing the actor for one camera: the face, its eyes and teeth, under lamps, seen by a sensor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from capture.arrays import Floats32, Image, Ints32
from capture.camera import Camera
from recon.mesh import vertex_normals
from tools.actor.canvas import Canvas
from tools.actor.model import ActorModel, PosedActor
from tools.actor.sensor import Sensor, expose
from tools.actor.skin import TILE_MM, make_tile
from track.raster import Rasterizer

BACKGROUND = 0.06
_RADIANCE, _ALBEDO = 0, 1
_KINDS = ("PLAIN", "RICH", "EYE", "TOOTH")  # one program each: the CPU rasterizer runs every branch


@dataclass(frozen=True)
class Exposure:
    """Which exposure is drawn: what decides its noise.

    Attributes:
        seed: of the simulation.
        t_ns: time stamp of the exposure.
    """

    seed: int = 0
    t_ns: int = 0


class ActorRenderer:
    """Draws one actor through moderngl, for any camera.

    Args:
        model: the actor.
        canvas: the surface to draw on; a new one when left out.
    """

    def __init__(self, model: ActorModel, canvas: Canvas | None = None) -> None:
        self.model = model
        self.canvas = Canvas() if canvas is None else canvas
        self._triangles = model.surface_triangles
        fixed = _fixed_attributes(model)
        tile = make_tile(model.identity.seed, round(model.identity.freckles, 6))
        with self.canvas.context as context:
            self._fixed = context.buffer(fixed.tobytes())
            self._moving = context.buffer(reserve=len(fixed) * 24, dynamic=True)
            self._draws = [
                self._draw_call(kind, triangles)
                for kind, triangles in zip(_KINDS, _split(model), strict=True)
            ]
            self._tile = context.texture(
                tile.shape[1::-1], 4, np.rint(tile * 255).astype(np.uint8).tobytes()
            )
            self._tile.build_mipmaps()
            self._tile.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
            self._tile.repeat_x = self._tile.repeat_y = True
        self._posed: PosedActor | None = None
        self._rasterizer: Rasterizer | None = None

    def radiance(self, camera: Camera, posed: PosedActor) -> Floats32:
        """The light that reaches each pixel through the lens, (H, W) float32, 1 for white."""
        return self._draw(camera, posed, _RADIANCE)

    def albedo(self, camera: Camera, posed: PosedActor) -> Floats32:
        """The albedo that each pixel sees, (H, W) float32."""
        return self._draw(camera, posed, _ALBEDO)

    def depth(self, camera: Camera, posed: PosedActor) -> Floats32:
        """Camera-space Z at each pixel, (H, W) float32 mm; NaN where there is no actor."""
        if self._rasterizer is None:
            self._rasterizer = Rasterizer(self._triangles, len(posed.surface))
        return self._rasterizer.render(camera, posed.surface).depth

    def render(
        self, camera: Camera, posed: PosedActor, sensor: Sensor, exposure: Exposure
    ) -> Image:
        """One image of the actor as a device would deliver it, noise and all.

        Args:
            camera: the true projection; its name names the device.
            posed: the actor at that instant.
            sensor: the device's sensor.
            exposure: decides the noise.

        Returns:
            (H, W) uint8, or uint16 for a sensor of more than 8 bits.
        """
        return expose(
            self.radiance(camera, posed), sensor, (exposure.seed, camera.name, exposure.t_ns)
        )

    def _draw_call(self, kind: str, triangles: Ints32) -> Any:
        """A program and vertex array for the triangles (T, 3) of one kind of surface."""
        context, here = self.canvas.context, Path(__file__).parent
        head = f"#version 430\n#define {kind}\n"
        program = context.program(
            vertex_shader=head + (here / "actor.vert.glsl").read_text(encoding="utf-8"),
            fragment_shader=head + (here / "actor.frag.glsl").read_text(encoding="utf-8"),
        )
        moving, fixed = ("position", "normal"), ("rest", "rest_normal", "paint", "wet")
        content = []
        for buffer, sizes, names in (
            (self._moving, (3, 3), moving), (self._fixed, (3, 3, 4, 1), fixed),
        ):  # fmt: skip
            used = [name in program for name in names]
            layout = [f"{n}f" if on else f"{4 * n}x" for n, on in zip(sizes, used, strict=True)]
            kept = [name for name, on in zip(names, used, strict=True) if on]
            content.append((buffer, " ".join(layout), *kept))
        indices = context.buffer(np.ascontiguousarray(triangles, np.int32).tobytes())
        return context.vertex_array(program, content, index_buffer=indices, index_element_size=4)

    def _draw(self, camera: Camera, posed: PosedActor, wanted: int) -> Floats32:
        with self.canvas.context:
            return self._draw_here(camera, posed, wanted)

    def _draw_here(self, camera: Camera, posed: PosedActor, wanted: int) -> Floats32:
        if posed is not self._posed:
            surface = posed.surface
            normals = np.nan_to_num(vertex_normals(surface, self._triangles))
            moving = np.concatenate([surface, normals], axis=1).astype(np.float32)
            self._moving.write(moving.tobytes())
            self._posed = posed
        view = self.canvas.view(camera)
        self.canvas.begin(view, BACKGROUND)
        values = {
            "clip_from_world": view.clip_from_world.T, "eye": camera.centre,
            "gloss": np.array([self.model.identity.gloss]), "tile_mm": np.array([TILE_MM]),
        }  # fmt: skip
        self._tile.use(0)
        for draw in self._draws:
            for name, value in values.items():
                if name in draw.program:
                    draw.program[name].write(np.ascontiguousarray(value, np.float32).tobytes())
            draw.program["wanted"].value = wanted
            draw.render()
        return self.canvas.finish(view)


def _split(model: ActorModel) -> list[Ints32]:
    """Triangles of plain skin, of skin with hair, brow or lip, of the eyes, of the teeth."""
    paint, count = model.paint, len(model.neutral.vertices)
    rich = (paint.brow > 0) | (paint.hair > 0) | (paint.lip > 0)
    skin = model.neutral.triangles
    hit = rich[skin].any(axis=1)
    groups: dict[str, list[Ints32]] = {"eye": [], "teeth": []}
    for part in model.parts:
        groups[part.kind].append(part.mesh.triangles + np.int32(count))
        count += len(part.mesh.vertices)
    return [skin[~hit], skin[hit], np.concatenate(groups["eye"]), np.concatenate(groups["teeth"])]


def _fixed_attributes(model: ActorModel) -> Floats32:
    """(Vs, 11) what never moves: rest position, rest normal, paint, wetness."""
    paint = model.paint
    rows = [np.stack([paint.albedo, paint.brow, paint.hair, paint.lip, paint.wet], axis=1)]
    rest, normals = [model.neutral.vertices], [model.rest_normals]
    for part in model.parts:
        rest.append(part.local)
        normals.append(np.tile([0.0, 0.0, 1.0], (len(part.local), 1)))
        rows.append(np.ones((len(part.local), 5)))
    stacked = [np.concatenate(block) for block in (rest, normals, rows)]
    return np.concatenate(stacked, axis=1).astype(np.float32)
