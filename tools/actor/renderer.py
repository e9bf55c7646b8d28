"""Drawing the actor for one camera: the face, its eyes and teeth, under lamps, seen by a sensor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import moderngl
import numpy as np

from capture.arrays import Floats, Floats32, Image
from capture.camera import Camera
from recon.mesh import vertex_normals
from tools.actor.canvas import Canvas
from tools.actor.model import ActorModel, PosedActor
from tools.actor.sensor import Sensor, expose
from tools.actor.skin import TILE_MM, make_tile

BACKGROUND = 0.06
_RADIANCE, _ALBEDO, _DEPTH = 0, 1, 2
_KINDS = {"skin": 0.0, "eye": 1.0, "teeth": 2.0}


@dataclass(frozen=True)
class Shot:
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
        context = self.canvas.context
        here = Path(__file__).parent
        self._program = context.program(
            vertex_shader=(here / "actor.vert.glsl").read_text(encoding="utf-8"),
            fragment_shader=(here / "actor.frag.glsl").read_text(encoding="utf-8"),
        )
        self._triangles = model.surface_triangles
        self._indices = context.buffer(np.ascontiguousarray(self._triangles, np.int32).tobytes())
        fixed = _fixed_attributes(model)
        self._fixed = context.buffer(fixed.tobytes())
        self._moving = context.buffer(reserve=len(fixed) * 24, dynamic=True)
        self._vertex_array = context.vertex_array(
            self._program,
            [(self._moving, "3f 3f", "position", "normal"),
             (self._fixed, "3f 3f 4f 2f", "rest", "rest_normal", "paint", "kind")],
            index_buffer=self._indices, index_element_size=4,
        )  # fmt: skip
        tile = make_tile(model.identity.seed, round(model.identity.freckles, 6))
        self._tile = context.texture(tile.shape[1::-1], 4, np.rint(tile * 255).astype(np.uint8).tobytes())
        self._tile.build_mipmaps()
        self._tile.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self._tile.repeat_x = self._tile.repeat_y = True
        self._posed: PosedActor | None = None

    def radiance(self, camera: Camera, posed: PosedActor) -> Floats32:
        """The light that reaches each pixel through the lens, (H, W) float32, 1 for white."""
        return self._draw(camera, posed, _RADIANCE)

    def albedo(self, camera: Camera, posed: PosedActor) -> Floats32:
        """The albedo that each pixel sees, (H, W) float32."""
        return self._draw(camera, posed, _ALBEDO)

    def depth(self, camera: Camera, posed: PosedActor) -> Floats32:
        """Camera-space Z at each pixel, (H, W) float32 mm; NaN where there is no actor."""
        depth = self._draw(camera, posed, _DEPTH)
        depth[depth <= 0.0] = np.nan
        return depth

    def render(self, camera: Camera, posed: PosedActor, sensor: Sensor, shot: Shot) -> Image:
        """One image of the actor as a device would deliver it, noise and all.

        Args:
            camera: the true projection; its name names the device.
            posed: the actor at that instant.
            sensor: the device's sensor.
            shot: decides the noise.

        Returns:
            (H, W) uint8, or uint16 for a sensor of more than 8 bits.
        """
        return expose(self.radiance(camera, posed), sensor, (shot.seed, camera.name, shot.t_ns))

    def _draw(self, camera: Camera, posed: PosedActor, wanted: int) -> Floats32:
        if posed is not self._posed:
            surface = posed.surface
            normals = np.nan_to_num(vertex_normals(surface, self._triangles))
            moving = np.concatenate([surface, normals], axis=1).astype(np.float32)
            self._moving.write(moving.tobytes())
            self._posed = posed
        view = self.canvas.view(camera)
        self.canvas.begin(view, 0.0 if wanted == _DEPTH else BACKGROUND)
        rigid = camera.camera_from_world
        values = {
            "clip_from_world": view.clip_from_world.T, "eye": camera.centre,
            "eye_row": rigid.rotation[2], "eye_depth": rigid.translation[2:],
            "gloss": np.array([self.model.identity.gloss]), "tile_mm": np.array([TILE_MM]),
        }  # fmt: skip
        for name, value in values.items():
            self._program[name].write(np.ascontiguousarray(value, np.float32).tobytes())
        self._program["wanted"].value = wanted
        self._tile.use(0)
        self._vertex_array.render()
        return self.canvas.finish_depth(view) if wanted == _DEPTH else self.canvas.finish(view)


def _fixed_attributes(model: ActorModel) -> Floats32:
    """(Vs, 12) what never moves: rest position, rest normal, paint, kind."""
    skin = model.neutral
    paint = model.paint
    rows = [_rows(skin.vertices, model.rest_normals, _KINDS["skin"], paint.wet)]
    rows[0][:, 6:10] = np.stack([paint.albedo, paint.brow, paint.hair, paint.lip], axis=1)
    for part in model.parts:
        count = len(part.local)
        rows.append(_rows(part.local, np.tile([0.0, 0.0, 1.0], (count, 1)), _KINDS[part.kind], np.ones(count)))
    return np.concatenate(rows).astype(np.float32)


def _rows(rest: Floats, normals: Floats, kind: float, wet: Floats) -> Floats:
    count = len(rest)
    return np.concatenate(
        [rest, normals, np.zeros((count, 4)), np.full((count, 1), kind), wet[:, None]], axis=1
    )
