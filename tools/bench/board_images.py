"""Rendered images of a bowed, held, unevenly lit board through a lens with a depth of field.

`render_board` of `tools.bench.board_scene` draws a flat board in plain light. Here the ray of every
second pixel meets the bowed paper; between them the print's coordinates are linear to 1e-3 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from capture.arrays import Floats, Floats32, Image
from capture.camera import Camera
from capture.pose import Pose
from recon.board.charuco import Board
from tools.bench.board_scene import bow_height

_PRINT = 8  # pixels of the print a millimetre
_FINE = 3  # samples a pixel, along each axis
_STEP = 2  # pixels from one exact ray to the next, along each axis
_PAPER_MM = 12.0  # white margin about the pattern
_INK, _WHITE, _SKIN, _ROOM = 18.0, 205.0, 120.0, 45.0
_MARGIN_PX = 24
_FAR = 1e5  # texels: off the sheet
_BENDINGS = 3  # steps from the flat board to the bowed one; each is some hundred times nearer


@dataclass(frozen=True, kw_only=True)
class Optics:
    """How images are spoilt.

    Attributes:
        blur_px: standard deviation of the blur in focus.
        defocus_px: what is added to it, in quadrature, at `depth_mm` out of focus.
        depth_mm: distance from the plane of sharp focus.
        noise_dn: standard deviation of the noise, 8-bit counts.
        falloff: fraction of the light that is lost in the corners of the image.
    """

    blur_px: float = 0.7
    defocus_px: float = 0.7
    depth_mm: float = 120.0
    noise_dn: float = 2.0
    falloff: float = 0.25


class BoardCamera:
    """One camera that takes many images of a board; its rays are undistorted once.

    Args:
        camera: the true projection.
        board: the board's pattern.
        bow_mm: how far the middle of the board stands out of its plane.
        optics: how images are spoilt.
    """

    def __init__(
        self, camera: Camera, board: Board, bow_mm: float, optics: Optics | None = None
    ) -> None:
        self._camera, self._board, self._bow = camera, board, bow_mm
        self._optics = Optics() if optics is None else optics
        self._print = _paper(board)
        columns = np.arange((_STEP - 1) / 2, camera.width, _STEP)
        rows = np.arange((_STEP - 1) / 2, camera.height, _STEP)
        grid = np.stack(np.meshgrid(columns, rows), axis=-1)
        flat = camera.undistort(grid.reshape(-1, 2)).reshape(grid.shape)
        self._rays = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=-1)
        across = (grid - [camera.cx, camera.cy]) / np.hypot(camera.width / 2, camera.height / 2)
        self._light = (1.0 - self._optics.falloff * (across**2).sum(axis=-1)).astype(np.float32)

    def image(self, world_from_board: Pose, seed: int) -> Image:
        """One 8-bit image (H, W) of the board; the room behind it where it does not reach.

        Args:
            world_from_board: where the board is held, mm.
            seed: of the noise and of where the hands hold the board.
        """
        camera, optics = self._camera, self._optics
        random = np.random.default_rng([seed, 6])
        scene = np.full((camera.height, camera.width), _ROOM, np.float32)
        soft = np.full_like(scene, 0.5)
        window = self._window(world_from_board)
        if window is not None:
            top, low, left, right = window
            places, depth = self._meet(world_from_board, window)
            shown = self._print.copy()
            _hold(shown, random)
            drawn = _draw(shown, places)
            box = np.s_[_STEP * top : _STEP * low, _STEP * left : _STEP * right]
            size = drawn.shape[1::-1]
            scene[box] = drawn
            focus = np.linalg.norm(camera.centre)
            out = np.clip(np.abs(depth - focus) / optics.depth_mm, 0.0, 1.0)
            soft[box] = cv2.resize(out.astype(np.float32) ** 2, size)
        light = cv2.resize(self._light * self._slope(random), scene.shape[::-1])
        sharp = cv2.GaussianBlur(scene, (0, 0), optics.blur_px)
        wide = cv2.GaussianBlur(scene, (0, 0), float(np.hypot(optics.blur_px, optics.defocus_px)))
        noise = random.standard_normal(scene.shape, np.float32) * np.float32(optics.noise_dn)
        seen = light * (sharp + soft * (wide - sharp)) + noise
        result: Image = np.clip(np.rint(seen), 0, 255).astype(np.uint8)
        return result

    def _slope(self, random: np.random.Generator) -> Floats32:
        """Light that comes from one side, on the grid of rays."""
        across, down = random.uniform(-0.1, 0.1, 2)
        rows, columns = self._light.shape
        y, x = np.linspace(-1.0, 1.0, rows)[:, None], np.linspace(-1.0, 1.0, columns)[None, :]
        slope: Floats32 = (1.0 + across * x + down * y).astype(np.float32)
        return slope

    def _window(self, world_from_board: Pose) -> tuple[int, int, int, int] | None:
        """Rows and columns of the rays that can meet the paper: top, bottom, left, right."""
        wide, high = _size_mm(self._board)
        edge = np.linspace(-_PAPER_MM, 1.0, 9)
        outline = [(a * 1.0, b) for a in (-_PAPER_MM, wide + _PAPER_MM) for b in _ends(high, edge)]
        outline += [(a, b * 1.0) for a in _ends(wide, edge) for b in (-_PAPER_MM, high + _PAPER_MM)]
        points = np.array([(a, b, 0.0) for a, b in outline])
        pixels = self._camera.project(world_from_board.apply(points))
        if not np.isfinite(pixels).all():
            return None
        low = np.floor((pixels.min(axis=0) - _MARGIN_PX) / _STEP).astype(int)
        high_px = np.ceil((pixels.max(axis=0) + _MARGIN_PX) / _STEP).astype(int)
        left, top = np.maximum(low, 0).tolist()
        right, bottom = np.minimum(high_px, self._rays.shape[1::-1]).tolist()
        return (top, bottom, left, right) if bottom - top > 1 and right - left > 1 else None

    def _meet(
        self, world_from_board: Pose, window: tuple[int, int, int, int]
    ) -> tuple[Floats, Floats]:
        """Where rays meet the bowed paper: (h, w, 2) board mm, and their depth (h, w), mm."""
        top, bottom, left, right = window
        board_from_camera = (self._camera.camera_from_world @ world_from_board).inverse()
        rays = self._rays[top:bottom, left:right] @ board_from_camera.rotation.T
        start = board_from_camera.translation
        height: Floats | float = 0.0
        for _ in range(_BENDINGS):
            depth = (height - start[2]) / rays[..., 2]
            places = start[:2] + depth[..., None] * rays[..., :2]
            height = bow_height(self._board, self._bow, places)
        return places, depth


def _ends(length: float, edge: Floats) -> list[float]:
    middle = np.linspace(0.0, length, 9)
    return [*edge.tolist(), *middle.tolist(), *(length - edge).tolist()]


def _size_mm(board: Board) -> tuple[float, float]:
    return board.squares_x * board.square_mm, board.squares_y * board.square_mm


def _paper(board: Board) -> Image:
    """The printed sheet with its white margin, 8 bits, `_PRINT` pixels a millimetre."""
    wide, high = _size_mm(board)
    pattern = board.pattern().generateImage(
        (round(wide * _PRINT), round(high * _PRINT)), marginSize=0
    )
    inked = _INK + (_WHITE - _INK) / 255.0 * pattern.astype(np.float64)
    margin = round(_PAPER_MM * _PRINT)
    sheet: Image = np.rint(np.pad(inked, margin, constant_values=_WHITE)).astype(np.uint8)
    return sheet


def _hold(sheet: Image, random: np.random.Generator) -> None:
    """Put two thumbs on the sides of the sheet, a few corners deep."""
    height, width = sheet.shape
    for side in (0, width - 1):
        deep = int(random.uniform(20.0, 50.0) * _PRINT)
        place = (side, int(random.uniform(0.25, 0.75) * height))
        cv2.ellipse(
            sheet, place, (deep, 9 * _PRINT), random.uniform(-25.0, 25.0), 0, 360, _SKIN, -1
        )


def _draw(sheet: Image, places: Floats) -> Floats32:
    """The light of every pixel: the sheet sampled finely at places (h, w, 2), mm, and averaged."""
    factor = _STEP * _FINE
    rows, columns = places.shape[:2]
    texels = np.clip((places + _PAPER_MM) * _PRINT - 0.5, -_FAR, _FAR).astype(np.float32)
    x, y = (
        cv2.resize(texels[..., axis], (factor * columns, factor * rows)) for axis in (0, 1)
    )  # linear between the rays
    drawn = cv2.remap(sheet, x, y, cv2.INTER_LINEAR, borderValue=_ROOM)
    size = (_STEP * columns, _STEP * rows)
    image = cv2.resize(drawn.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(image, dtype=np.float32)
