"""Boards of every kind as `tools.bench.board_scene.render_board` draws them, for tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from capture.arrays import Bools, Floats, Image
from capture.camera import Camera
from capture.errors import TakeError
from capture.pose import Pose
from recon.board.april_grid import AprilGrid
from recon.board.charuco import Board
from recon.board.marker_dictionary import marker_cells
from tools.bench.board_scene import render_board


@dataclass(frozen=True)
class Print:
    """A printed sheet: what `render_board` asks a board for.

    Attributes:
        size: (width, height) in squares of one millimetre.
        draw: from a size in px, the sheet (H, W), 0 black, 255 white.
    """

    size: tuple[float, float]
    draw: Callable[[tuple[int, int]], Image]
    square_mm: float = 1.0

    @property
    def squares_x(self) -> float:
        return self.size[0]

    @property
    def squares_y(self) -> float:
        return self.size[1]

    def pattern(self) -> Print:
        return self

    def generateImage(self, size: tuple[int, int], marginSize: int = 0) -> Image:  # noqa: N802
        return self.draw(size)


def grid_print(grid: AprilGrid) -> Print:
    """The sheet of an AprilGrid, black squares at all crossings."""

    def draw(size: tuple[int, int]) -> Image:
        scale = size[0] / grid.size_mm[0]
        sheet = np.full(size[::-1], 255, np.uint8)
        step = grid.tag_mm + grid.gap_mm
        for row in range(grid.tags_y + 1):
            for column in range(grid.tags_x + 1):
                paint(sheet, scale, (column * step, row * step), grid.gap_mm, np.ones((1, 1), bool))
        for index in range(grid.tags_x * grid.tags_y):
            cells = marker_cells(grid.dictionary, grid.first_id + index, grid.border_bits)
            cells = np.rot90(cells, 2) if grid.half_turned else cells
            paint(sheet, scale, grid.place(index), grid.tag_mm, cells)
        return sheet

    return Print(grid.size_mm, draw)


def markers_print(
    dictionary: str, places: dict[int, tuple[float, float]], side_mm: float,
    size_mm: tuple[float, float],
) -> Print:  # fmt: skip
    """A white sheet with single markers, by id the top left corner of each, mm."""

    def draw(size: tuple[int, int]) -> Image:
        sheet = np.full(size[::-1], 255, np.uint8)
        for marker, place in places.items():
            cells = marker_cells(dictionary, marker, 1)
            paint(sheet, size[0] / size_mm[0], place, side_mm, cells)
        return sheet

    return Print(size_mm, draw)


def paint(
    sheet: Image, scale: float, place: tuple[float, float], side_mm: float, cells: Bools
) -> None:
    edges = np.round(side_mm * scale * np.arange(len(cells) + 1) / len(cells)).astype(int)
    left, top = round(place[0] * scale), round(place[1] * scale)
    for row, column in np.argwhere(cells):
        sheet[
            top + edges[row] : top + edges[row + 1], left + edges[column] : left + edges[column + 1]
        ] = 0


def render(camera: Camera, pose: Pose, board: Board | Print, **how: float) -> Image:
    """`render_board` of a board or of a sheet."""
    return render_board(camera, pose, board, **how)  # type: ignore[arg-type]


def flipped(image: Image) -> Image:
    """The image of a device that mirrors left to right."""
    return np.ascontiguousarray(cv2.flip(image, 1))


def turned(yaw: float, pitch: float, spin: float, middle: Floats, away_mm: float = 620.0) -> Pose:
    """camera_from_board of a board turned by these angles, degrees, about its middle."""
    turn = Pose.identity()
    for vector in ([0, yaw, 0], [pitch, 0, 0], [0, 0, spin]):
        turn = turn @ Pose.from_rotation_vector(np.radians(np.array(vector, float)), np.zeros(3))
    away = Pose(np.eye(3), np.array([5.0, -4.0, away_mm]))
    return away @ turn @ Pose(np.eye(3), -middle)


@dataclass
class MemoryTake:
    """A board take in memory: what calibration reads of one; None is a lost frame.

    Attributes:
        shown: by device, its images, one a frame.
        reads: how many images were read so far.
    """

    shown: dict[str, list[Image | None]]
    reads: int = 0

    @property
    def device_names(self) -> tuple[str, ...]:
        return tuple(self.shown)

    @property
    def frames(self) -> tuple[int, ...]:
        return tuple(range(len(next(iter(self.shown.values())))))

    def size(self, device: str) -> tuple[int, int]:
        image = next(image for image in self.shown[device] if image is not None)
        return image.shape[1], image.shape[0]

    def present(self, device: str, frame: int) -> bool:
        return self.shown[device][frame] is not None

    def image(self, device: str, frame: int) -> Image:
        image = self.shown[device][frame]
        if image is None:
            raise TakeError(f"frame {frame} of {device} was lost")
        self.reads += 1
        return image


@cache
def small_camera() -> Camera:
    """A camera of 400 x 400 px that sees an A4 board at 620 mm whole."""
    return Camera(
        name="cam", width=400, height=400, fx=900.0, fy=900.0, cx=201.0, cy=198.5,
        distortion=np.array([-0.1, 0.1, 0, 0, 0.0]), camera_from_world=Pose.identity(),
    )  # fmt: skip
