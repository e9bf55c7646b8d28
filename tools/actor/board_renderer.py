"""Drawing a ChArUco board through the same lens and sensor as the actor."""

from __future__ import annotations

from typing import Any

import numpy as np

from capture.arrays import Floats32
from capture.camera import Camera
from capture.pose import Pose
from recon.board.charuco import Board
from tools.actor.canvas import Canvas

_TEXELS = 64  # of one square's side
_MARGIN_SQUARES = 0.5  # white paper about the pattern
_INK, _PAPER = 0.05, 0.75
_BACKGROUND = 0.06
_VERTEX = """#version 430
in vec3 position; in vec2 texel; uniform mat4 clip_from_world; out vec2 place;
void main() { place = texel; gl_Position = clip_from_world * vec4(position, 1.0); }"""
_FRAGMENT = """#version 430
in vec2 place; uniform sampler2D pattern; uniform vec2 tones; uniform float shade; out float result;
void main() { result = shade * mix(tones.x, tones.y, texture(pattern, place).r); }"""


class BoardRenderer:
    """Draws one board for any camera.

    Args:
        board: the board.
        canvas: the surface to draw on; a new one when left out.
    """

    def __init__(self, board: Board, canvas: Canvas | None = None) -> None:
        self.board = board
        self.canvas = Canvas() if canvas is None else canvas
        margin = round(_TEXELS * _MARGIN_SQUARES)
        wide, high = board.squares_x * _TEXELS, board.squares_y * _TEXELS
        drawn = board.pattern().generateImage((wide, high), marginSize=0, borderBits=1)
        image = np.pad(np.asarray(drawn, np.uint8), margin, constant_values=255)
        edge = _MARGIN_SQUARES * board.square_mm
        right, down = (
            board.squares_x * board.square_mm + edge,
            board.squares_y * board.square_mm + edge,
        )
        self._corners = np.array(
            [[-edge, -edge, 0], [right, -edge, 0], [-edge, down, 0], [right, down, 0]]
        )
        texels = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
        with self.canvas.context as context:
            self._program: Any = context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
            self._position = context.buffer(reserve=48, dynamic=True)
            self._texels = context.buffer(texels.tobytes())
            self._array = context.vertex_array(
                self._program, [(self._position, "3f", "position"), (self._texels, "2f", "texel")]
            )
            self._texture = context.texture(image.shape[1::-1], 1, image.tobytes(), alignment=1)
            self._texture.build_mipmaps()
            self._texture.anisotropy = 8.0

    def radiance(self, camera: Camera, world_from_board: Pose) -> Floats32:
        """The light that reaches each pixel through the lens, (H, W) float32, 1 for white.

        Args:
            camera: the true projection.
            world_from_board: where the board is held; board space is that of
                `recon.board.charuco`. Its back shows no pattern.
        """
        corners = world_from_board.apply(self._corners)
        outward = -world_from_board.rotation[:, 2]
        toward = camera.centre - corners.mean(axis=0)
        facing = float(outward @ toward / np.linalg.norm(toward))
        tones = np.array([_INK, _PAPER] if facing > 0 else [0.3, 0.3], np.float32)
        light = 0.75 + 0.25 * float(outward @ np.array([0.35, 0.45, 0.82]))
        view = self.canvas.view(camera)
        with self.canvas.context:
            self.canvas.begin(view, _BACKGROUND)
            self._position.write(corners.astype(np.float32).tobytes())
            matrix = np.ascontiguousarray(view.clip_from_world.T, np.float32)
            self._program["clip_from_world"].write(matrix.tobytes())
            self._program["tones"].write(tones.tobytes())
            self._program["shade"].value = light
            self._texture.use(0)
            self._array.render(self.canvas.context.TRIANGLE_STRIP)
            return self.canvas.finish(view)
