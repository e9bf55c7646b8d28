"""Every marker in an image, of whatever dictionary: for boards that are not as their file says."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from capture.arrays import Bools, Floats, Image, Ints
from recon.board.april_grid import AprilGrid
from recon.board.body import FlatBoard
from recon.board.marker_dictionary import cut_dictionary, dictionary_family, dictionary_names

_TAG_BORDERS = (1, 2)
_COUNTED = re.compile(r"DICT_\dX\d_(\d+)")
_SAMPLES = 3  # places looked at in each cell, along each side
_CONTRAST = 20.0  # of 255, between the dark and the bright cells of a marker
_BORDER = 0.9  # of the border's cells must be dark


@dataclass(frozen=True)
class MarkerKind:
    """How markers look.

    Attributes:
        family: of dictionaries that share markers, see `dictionary_family`.
        border_bits: width of their black border, cells.
    """

    family: str
    border_bits: int = 1

    @classmethod
    def of(cls, board: FlatBoard) -> MarkerKind:
        """That of a board's markers."""
        border = board.border_bits if isinstance(board, AprilGrid) else 1
        return cls(dictionary_family(board.dictionary), border)

    def dictionary(self, highest: int) -> str:
        """The smallest dictionary of the family that holds a marker id."""
        sizes = {name: _size(name) for name in _members(self.family)}
        fitting = [name for name, size in sizes.items() if size > highest]
        return min(fitting or sizes, key=lambda name: (sizes[name], name.swapcase()))


@dataclass(frozen=True, eq=False)
class MarkerSet:
    """The markers of one look in one image, each id once.

    Attributes:
        ids: (K,) ids in the family's largest dictionary.
        corners: (K, 4, 2) px, in OpenCV's order.
    """

    ids: Ints
    corners: Floats


def marker_census(in_bytes: Image) -> Mapping[MarkerKind, MarkerSet]:
    """The markers of each look in an 8-bit image (H, W).

    A marker counts when every bit is right: chance reads few of those, and those lie anywhere. An
    id that is seen twice is left out. Looks without a marker are not in the answer.
    """
    quads = _squares(in_bytes)
    if not len(quads):
        return {}
    read: dict[tuple[int, int], tuple[Floats, Bools]] = {}
    found: dict[MarkerKind, MarkerSet] = {}
    for kind in _kinds():
        side, codes = _codes(kind.family)
        look = side, kind.border_bits
        if look not in read:
            read[look] = _bordered(in_bytes, quads, *look)
        ids, corners = [], []
        for quad, bits in zip(*read[look], strict=True):
            for turn in range(4):
                marker = codes.get(np.rot90(bits, turn).tobytes())
                if marker is not None:
                    ids.append(marker)
                    corners.append(np.roll(quad, -turn, axis=0))
        if ids:
            every = np.array(ids, dtype=np.int64)
            once = np.bincount(every)[every] == 1
            found[kind] = MarkerSet(every[once], np.array(corners)[once].reshape(-1, 4, 2))
    return found


def _squares(in_bytes: Image) -> Floats:
    """Corners (K, 4, 2), clockwise, of all that could be a marker."""
    settings = cv2.aruco.DetectorParameters()
    settings.adaptiveThreshWinSizeMin = 5
    settings.adaptiveThreshWinSizeMax = 25
    settings.adaptiveThreshConstant = 15
    detector = cv2.aruco.ArucoDetector(cut_dictionary("DICT_4X4_50", range(1)), settings)
    read, _, others = detector.detectMarkers(in_bytes)
    return np.asarray([*read, *others], dtype=np.float64).reshape(-1, 4, 2)


def _cells(in_bytes: Image, quads: Floats, across: int) -> Floats:
    """Mean brightness (K, across, across) of the cells of each quad."""
    count = across * _SAMPLES
    places = (np.arange(count) + 0.5) / count
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(1, -1, 2)
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    out = np.zeros((len(quads), across, across))
    for index, quad in enumerate(quads):
        onto = cv2.getPerspectiveTransform(square, quad.astype(np.float32))
        where = cv2.perspectiveTransform(grid, onto).astype(np.float32).reshape(count, count, 2)
        shades = cv2.remap(in_bytes, where[:, :, 0], where[:, :, 1], cv2.INTER_LINEAR)
        blocks = shades.reshape(across, _SAMPLES, across, _SAMPLES).astype(np.float64)
        out[index] = blocks.mean(axis=(1, 3))
    return out


def _bordered(in_bytes: Image, quads: Floats, side: int, border: int) -> tuple[Floats, Bools]:
    """The quads (K, 4, 2) with a black border, and the white cells (K, side, side) inside it."""
    shades = _cells(in_bytes, quads, side + 2 * border)
    dark, bright = np.percentile(shades, [5, 95], axis=(1, 2))
    white = shades > 0.5 * (dark + bright)[:, None, None]
    inner = white[:, border:-border, border:-border]
    rim = white.shape[1] ** 2 - side**2
    in_rim = white.sum(axis=(1, 2)) - inner.sum(axis=(1, 2))
    good = (bright - dark >= _CONTRAST) & (in_rim <= (1.0 - _BORDER) * rim)
    return quads[good], inner[good]


def _kinds() -> list[MarkerKind]:
    """Every look that OpenCV knows; AprilTags with borders of one and two cells."""
    families = sorted({dictionary_family(name) for name in dictionary_names()})
    return [
        MarkerKind(family, border)
        for family in families
        for border in (_TAG_BORDERS if "APRILTAG" in family else _TAG_BORDERS[:1])
    ]


@lru_cache(maxsize=32)
def _codes(family: str) -> tuple[int, dict[bytes, int]]:
    """Bits along the side of a marker, and the id of each pattern of white bits."""
    whole = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, max(_members(family), key=_size)))
    side = int(whole.markerSize)
    codes = {}
    for marker in range(len(whole.bytesList)):
        white = cv2.aruco.Dictionary.getBitsFromByteList(
            whole.bytesList[marker : marker + 1], side
        ).reshape(side, side)
        codes[(white != 0).tobytes()] = marker
    return side, codes


def _members(family: str) -> list[str]:
    return [name for name in dictionary_names() if dictionary_family(name) == family]


@lru_cache(maxsize=64)
def _size(name: str) -> int:
    counted = _COUNTED.fullmatch(name)
    if counted:
        return int(counted[1])
    return len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)
