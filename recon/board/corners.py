"""Corners of a board, or of the faces of a body, in one image, and whether the view is good."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from capture.arrays import Floats, Floats32, Image, Ints
from recon.board.april_grid import AprilGrid
from recon.board.body import BoardBody
from recon.board.charuco import Board
from recon.board.marker_search import BarSearch, FaceSearch, levels

NO_BOARD = "no board"
FEW_CORNERS = "few corners"
ONE_LINE = "corners on one line"
BLURRED = "blurred"
LOST = "lost frame"
STILL = "board had not moved"
SPARE = "more poses than needed"
USED = "used"
_LINE = 0.5  # corners must spread by this much of a square across their main direction
_TAG_LINE = 0.45  # the same of a tag: one row of tags is enough
_BLUR_PATCHES = 16
_REFUSALS = (NO_BOARD, FEW_CORNERS, ONE_LINE, BLURRED)  # the later, the nearer to a good view


class BoardTake(Protocol):
    """The part of a take that calibration reads."""

    @property
    def device_names(self) -> tuple[str, ...]:
        """Names of the devices, in order."""

    @property
    def frames(self) -> tuple[int, ...]:
        """Frame numbers."""

    def size(self, device: str) -> tuple[int, int]:
        """(width, height) of a device's images, px."""

    def present(self, device: str, frame: int) -> bool:
        """Whether that frame was not lost."""

    def image(self, device: str, frame: int) -> Image:
        """The image."""


@dataclass(frozen=True, kw_only=True)
class CornerLimits:
    """When a view of the board is good enough to use.

    Attributes:
        min_corners: fewer corners of one face than this are refused.
        max_blur_px: a wider edge (standard deviation of its spread, px) is refused.
        still_px: a frame where no corner moved by more than this since the last is left out.
        max_poses: of more board poses than this, so many are used, those that show most.
    """

    min_corners: int = 6
    max_blur_px: float = 3.0
    still_px: float = 0.5
    max_poses: int = 60


@dataclass(frozen=True, eq=False)
class CornerView:
    """What one image shows of the board.

    Attributes:
        ids: (N,) corner ids of the body, ascending.
        pixels: (N, 2) (column, row), px, centre of the first pixel at 0.
        blur_px: standard deviation of the spread of the board's edges, of the softest face that is
            used; NaN when there is no board.
        refusal: why the view must not be used, or "".
    """

    ids: Ints
    pixels: Floats
    blur_px: float
    refusal: str


@dataclass(frozen=True, eq=False)
class FaceCorners:
    """The corners of one face in one image, before anyone judged them.

    Attributes:
        ids: (N,) corner ids on that face, ascending.
        pixels: (N, 2) px.
        blur_px: width of the edges there, see `edge_spread`; NaN without corners.
    """

    ids: Ints
    pixels: Floats
    blur_px: float


@dataclass(frozen=True, eq=False)
class CornerFinds:
    """All that was found in one image: it does not depend on any limit.

    Attributes:
        faces: of each face of the body, its corners.
        ends: (E,) which ends of the scale bar were found, 0 or 1.
        end_pixels: (E, 2) the centres of their markers, px.
    """

    faces: tuple[FaceCorners, ...]
    ends: Ints
    end_pixels: Floats


class CornerDetector:
    """Finds the corners of a board or a body in images of 8 to 16 bits, mono or colour.

    One detector may be used by several threads, as long as each call has its own image.
    """

    def __init__(
        self, board: Board | AprilGrid | BoardBody, limits: CornerLimits | None = None
    ) -> None:
        body = board if isinstance(board, BoardBody) else BoardBody.of(board)
        self._body = body
        self._limits = limits or CornerLimits()
        self._flat = [face.board.corners_mm()[:, :2] for face in body.faces]
        alike: dict[tuple[str, str, int], list[int]] = {}
        for place, face in enumerate(body.faces):
            alike.setdefault(FaceSearch.alike(face.board), []).append(place)
        self._searches = [
            (places, FaceSearch([body.faces[place].board for place in places]))
            for places in alike.values()
        ]
        self._bar = None if body.scale_bar is None else BarSearch(body.scale_bar)

    @property
    def body(self) -> BoardBody:
        """What is searched for."""
        return self._body

    def detect(self, image: Image) -> CornerView:
        """Corners of the board in one image, with the reason when they must not be used.

        Args:
            image: (H, W) or (H, W, 3), uint8 or uint16.

        Returns:
            The corners found, refined to a fraction of a pixel.
        """
        return self.judge(self.find(image))

    def find(self, image: Image) -> CornerFinds:
        """All that one image shows, good enough or not.

        Args:
            image: (H, W) or (H, W, 3), uint8 or uint16.
        """
        grey, in_bytes = levels(image)
        faces: dict[int, FaceCorners] = {}
        markers = [np.zeros((0, 4, 2))]
        for places, search in self._searches:
            found, quads = search.find(grey, in_bytes)
            markers.append(quads)
            for place, (ids, pixels) in zip(places, found, strict=True):
                pitch = self._body.faces[place].board.pitch_mm
                blur = float("nan")
                if len(ids):
                    blur = edge_spread(grey, pixels, self._flat[place][ids], pitch)
                faces[place] = FaceCorners(ids, pixels, blur)
        ends, end_pixels = np.zeros(0, np.int64), np.zeros((0, 2))
        if self._bar is not None:
            ends, end_pixels = self._bar.find(grey, in_bytes, np.concatenate(markers))
        return CornerFinds(tuple(faces[place] for place in sorted(faces)), ends, end_pixels)

    def judge(self, finds: CornerFinds) -> CornerView:
        """Which of the corners found may be used.

        A face that shows too little, or is blurred, is left out; when none remains the view is
        refused for the reason of the face that came nearest, with all its corners.
        """
        reasons = [self._refusal(place, face) for place, face in enumerate(finds.faces)]
        good = [place for place, reason in enumerate(reasons) if not reason]
        taken = good or list(range(len(reasons)))
        ids = [finds.faces[place].ids + self._body.corner_range(place).start for place in taken]
        pixels = [finds.faces[place].pixels for place in taken]
        refusal = "" if good else max(reasons, key=_REFUSALS.index)
        blurs = [finds.faces[place].blur_px for place in taken if reasons[place] in ("", BLURRED)]
        return CornerView(
            np.concatenate(ids), np.concatenate(pixels), max(blurs, default=float("nan")), refusal
        )

    def _refusal(self, place: int, face: FaceCorners) -> str:
        board = self._body.faces[place].board
        if not len(face.ids):
            return NO_BOARD
        if len(face.ids) < self._limits.min_corners:
            return FEW_CORNERS
        line = _TAG_LINE * board.tag_mm if isinstance(board, AprilGrid) else _LINE * board.square_mm
        flat = self._flat[place][face.ids]
        across = np.linalg.svd(flat - flat.mean(axis=0), compute_uv=False)[1]
        if float(across) / float(np.sqrt(len(face.ids))) < line:
            return ONE_LINE
        return "" if face.blur_px <= self._limits.max_blur_px else BLURRED


def detect_corners(
    image: Image, board: Board | AprilGrid | BoardBody, limits: CornerLimits | None = None
) -> CornerView:
    """Corners of a board in one image; for many images make one `CornerDetector`."""
    return CornerDetector(board, limits).detect(image)


def edge_spread(grey: Floats32, pixels: Floats, flat: Floats, square_mm: float) -> float:
    """Width of the board's edges at its corners: defocus and motion blur, along the worse axis.

    Each corner is crossed by two edges. Along either board axis the steepest slope of brightness of
    an edge of contrast D and Gaussian spread s is D / (s sqrt(2 pi)).

    Args:
        grey: (H, W) brightness, any scale.
        pixels: (N, 2) corners, px.
        flat: (N, 2) the same corners on the board, mm.
        square_mm: side of a square.

    Returns:
        The median over corners of the wider spread, px; infinity where there is no contrast.
    """
    affine, _, _, _ = np.linalg.lstsq(
        np.concatenate([flat, np.ones((len(flat), 1))], axis=1), pixels, rcond=None
    )
    lengths = np.linalg.norm(affine[:2], axis=1)
    axes = affine[:2] / np.maximum(lengths, 1e-9)[:, None]
    reach = int(np.clip(0.3 * lengths.min() * square_mm, 3, 16))
    spreads = []
    for x, y in np.round(pixels[:: max(1, len(pixels) // _BLUR_PATCHES)]).astype(int).tolist():
        patch = grey[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
        if min(patch.shape) < 5:
            continue
        low, high = np.percentile(patch, [5, 95])
        down, across = np.gradient(patch.astype(np.float64))
        slopes = [np.percentile(np.abs(axis[0] * across + axis[1] * down), 95) for axis in axes]
        spreads.append((high - low) / (np.sqrt(2 * np.pi) * max(min(slopes), 1e-9)))
    return float(np.median(spreads)) if spreads else float("inf")
