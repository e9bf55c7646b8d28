"""Small rendered board takes whose board file, board or images are not what they should be."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from capture.arrays import Image
from recon.board.body import BoardBody
from recon.board.charuco import Board
from recon.board.corners import CornerLimits
from recon.board.diagnosis import explain_blind, merged_words
from recon.board.sightings import observe_board
from tools.bench.board_images import BoardCamera
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state

_SCENE = BoardScene(
    size_px=640, focal_px=1440.0, radius_mm=620.0, devices=4, span_deg=40.0, poses=6, seed=60
)
_ODD_ONE = 2


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageTake:
    """A take in memory, as `recon.board.corners.BoardTake` wants it.

    Attributes:
        device_names: names of the devices.
        frames: frame numbers.
        images: by device and frame.
    """

    device_names: tuple[str, ...]
    frames: tuple[int, ...]
    images: Mapping[tuple[str, int], Image]

    def size(self, device: str) -> tuple[int, int]:
        """(width, height) of a device's images, px."""
        height, width = self.images[device, self.frames[0]].shape[:2]
        return width, height

    def present(self, device: str, frame: int) -> bool:
        """Whether that image is there."""
        return (device, frame) in self.images

    def image(self, device: str, frame: int) -> Image:
        """The image."""
        return self.images[device, frame]


@dataclass(frozen=True, kw_only=True)
class ImageFault:
    """A fault that shows in images only.

    Attributes:
        words: what it is.
        filed: the board as its file has it.
        odd: the board that the odd device was shown instead, or None.
        mirrored: whether the images of the odd device are mirrored.
        expected: what the message must hold.
    """

    words: str
    expected: tuple[str, ...]
    filed: Board = A4_BOARD
    odd: Board | None = None
    mirrored: bool = False

    @property
    def guilty(self) -> tuple[str, ...]:
        """Names of the devices to be named; none when the board file is wrong for all."""
        return (f"cam{_ODD_ONE:02d}",) if self.mirrored or self.odd is not None else ()


_OTHER = dataclasses.replace(A4_BOARD, dictionary="DICT_4X4_250")
IMAGE_FAULTS = (
    ImageFault(
        words="board file with another dictionary",
        filed=_OTHER,
        expected=("DICT_5X5", "DICT_4X4"),
    ),
    ImageFault(
        words="one device was shown a board of another dictionary",
        odd=_OTHER,
        expected=("DICT_5X5", "DICT_4X4"),
    ),
    ImageFault(words="one device mirrors its images", mirrored=True, expected=("mirror",)),
    ImageFault(
        words="board file calls the pattern legacy, and it is not",
        filed=dataclasses.replace(A4_BOARD, squares_y=8, squares_x=12, legacy=True),
        expected=("legacy",),
    ),
    ImageFault(
        words="board file with rows and columns exchanged",
        filed=dataclasses.replace(A4_BOARD, squares_x=9, squares_y=12),
        expected=("12 squares a row", "squares_x = 9"),
    ),
    ImageFault(words="nothing wrong", expected=()),
)


def image_take(fault: ImageFault, scene: BoardScene = _SCENE) -> ImageTake:
    """The take with that fault, rendered."""
    printed = A4_BOARD
    if fault.filed.legacy:
        printed = dataclasses.replace(fault.filed, legacy=False)
    truth = make_state(scene, printed)
    images: dict[tuple[str, int], Image] = {}
    for index, camera in enumerate(truth.cameras):
        odd = index == _ODD_ONE
        board = fault.odd if odd and fault.odd is not None else printed
        lens = BoardCamera(camera, board, scene.bow_mm)
        for pose, world_from_board in enumerate(truth.array_from_board):
            image = lens.image(world_from_board, 100 * index + pose)
            if odd and fault.mirrored:
                image = np.ascontiguousarray(image[:, ::-1])
            images[camera.name, pose] = image
    return ImageTake(
        device_names=truth.cameras.names, frames=tuple(range(scene.poses)), images=images
    )


def diagnosis(fault: ImageFault) -> list[str]:
    """What the program says of devices that found no board in that take."""
    take = image_take(fault)
    body = BoardBody.of(fault.filed)
    sightings = observe_board(take, body, CornerLimits())
    words = explain_blind(take, body, sightings)
    return merged_words(words, len(take.device_names))
