"""ChArUco corners of one image, and of a whole board take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from capture.arrays import Floats, Floats32, Image, Ints
from capture.progress import Progress, silent
from recon.board import Board
from recon.images import mono
from recon.observations import BoardObservations

NO_BOARD = "no board"
FEW_CORNERS = "few corners"
ONE_LINE = "corners on one line"
BLURRED = "blurred"
LOST = "lost frame"
STILL = "board had not moved"
SPARE = "more poses than needed"
USED = "used"
_LINE = 0.5  # corners must spread by this much of a square across their main direction
_BLUR_PATCHES = 16


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
        min_corners: fewer corners than this are refused.
        max_blur_px: a wider edge (standard deviation of its spread, px) is refused.
        still_px: a frame where no corner moved by more than this since the last is left out.
        max_poses: of more board poses than this, so many are used, evenly spread over the take.
    """

    min_corners: int = 6
    max_blur_px: float = 3.0
    still_px: float = 0.5
    max_poses: int = 60


@dataclass(frozen=True, eq=False)
class CornerView:
    """What one image shows of the board.

    Attributes:
        ids: (N,) corner ids, ascending.
        pixels: (N, 2) (column, row), px, centre of the first pixel at 0.
        blur_px: standard deviation of the spread of the board's edges; NaN when there is no board.
        refusal: why the view must not be used, or "".
    """

    ids: Ints
    pixels: Floats
    blur_px: float
    refusal: str


class CornerDetector:
    """Finds the corners of one board in images of 8 to 16 bits, mono or colour."""

    def __init__(self, board: Board, limits: CornerLimits | None = None) -> None:
        self._board = board
        self._limits = limits or CornerLimits()
        self._flat = board.corners_mm()[:, :2]
        markers = cv2.aruco.DetectorParameters()
        markers.adaptiveThreshWinSizeMin = 13
        markers.cornerRefinementMinAccuracy = 1e-3  # the default of 0.1 px stops too early
        markers.cornerRefinementMaxIterations = 100
        self._detector = cv2.aruco.CharucoDetector(
            board.pattern(), cv2.aruco.CharucoParameters(), markers
        )

    def detect(self, image: Image) -> CornerView:
        """Corners of the board in one image, with the reason when they must not be used.

        Args:
            image: (H, W) or (H, W, 3), uint8 or uint16.

        Returns:
            The corners found, refined to a fraction of a pixel.

        References:
            Garrido-Jurado et al. 2014 (markers); Foerstner and Guelch 1987 (sub-pixel saddles).
        """
        grey = mono(image)
        bright = float(np.percentile(grey[::3, ::3], 99.5))
        grey = np.clip(grey * np.float32(255.0 / max(bright, 1e-6)), 0, 255).astype(np.float32)
        corners, ids, _, _ = self._detector.detectBoard(np.round(grey).astype(np.uint8))
        if ids is None or len(ids) == 0:
            return CornerView(np.zeros(0, np.int64), np.zeros((0, 2)), float("nan"), NO_BOARD)
        order = np.argsort(np.ravel(ids), kind="stable")
        found = np.ravel(ids)[order].astype(np.int64)
        pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)[order]
        blur, refusal = float("nan"), ""
        if len(found) < self._limits.min_corners:
            refusal = FEW_CORNERS
        elif self._spread(found) < _LINE * self._board.square_mm:
            refusal = ONE_LINE
        else:
            blur = edge_spread(grey, pixels, self._flat[found], self._board.square_mm)
            refusal = BLURRED if not blur <= self._limits.max_blur_px else ""
        return CornerView(found, pixels, blur, refusal)

    def _spread(self, ids: Ints) -> float:
        flat = self._flat[ids] - self._flat[ids].mean(axis=0)
        return float(np.linalg.svd(flat, compute_uv=False)[1]) / float(np.sqrt(len(ids)))


def detect_corners(image: Image, board: Board, limits: CornerLimits | None = None) -> CornerView:
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


def observe_board(
    take: BoardTake, board: Board, limits: CornerLimits, *, progress: Progress = silent
) -> tuple[BoardObservations, dict[str, dict[str, int]]]:
    """Find the board in every image of a take.

    Args:
        take: the board take.
        board: the board waved in it.
        limits: which views to refuse.
        progress: told after each frame.

    Returns:
        The sightings of all usable views, poses being the frames in which any device has one; and,
        by device, how many frames were used or refused for each reason.
    """
    detector = CornerDetector(board, limits)
    tally: dict[str, dict[str, int]] = {name: {} for name in take.device_names}
    poses: list[tuple[int, dict[str, CornerView]]] = []
    for done, frame in enumerate(take.frames, start=1):
        views: dict[str, CornerView] = {}
        for name in take.device_names:
            reason = LOST
            if take.present(name, frame):
                view = detector.detect(take.image(name, frame))
                reason = view.refusal or USED
                if not view.refusal:
                    views[name] = view
            tally[name][reason] = tally[name].get(reason, 0) + 1
        if views and poses and _still(poses[-1][1], views, limits.still_px):
            _move(tally, views, STILL)
        elif views:
            poses.append((frame, views))
        progress(done, len(take.frames), "corners")
    chosen = poses
    if len(poses) > limits.max_poses:
        places = np.linspace(0, len(poses) - 1, limits.max_poses).round().astype(int).tolist()
        chosen = [poses[place] for place in places]
        for _, spare in (pose for place, pose in enumerate(poses) if place not in set(places)):
            _move(tally, spare, SPARE)
    return _collect(take, chosen), tally


def _move(tally: dict[str, dict[str, int]], views: Mapping[str, CornerView], reason: str) -> None:
    """Count these used views under another reason."""
    for name in views:
        tally[name][USED] -= 1
        tally[name][reason] = tally[name].get(reason, 0) + 1


def _still(
    before: Mapping[str, CornerView], now: Mapping[str, CornerView], still_px: float
) -> bool:
    """Whether the devices that saw the board twice saw it at the same place."""
    shared = 0
    for name in before.keys() & now.keys():
        _, first, second = np.intersect1d(before[name].ids, now[name].ids, return_indices=True)
        if len(first):
            shared += 1
            moved = np.linalg.norm(before[name].pixels[first] - now[name].pixels[second], axis=1)
            if float(np.median(moved)) > still_px:
                return False
    return shared > 0


def _collect(
    take: BoardTake, poses: Sequence[tuple[int, Mapping[str, CornerView]]]
) -> BoardObservations:
    device, pose, corner, pixels = [], [], [], [np.zeros((0, 2))]
    for place, (_, views) in enumerate(poses):
        for index, name in enumerate(take.device_names):
            if name in views:
                count = len(views[name].ids)
                device += [index] * count
                pose += [place] * count
                corner += views[name].ids.tolist()
                pixels.append(views[name].pixels)
    return BoardObservations(
        device_names=tuple(take.device_names),
        sizes=tuple(take.size(name) for name in take.device_names),
        frames=tuple(frame for frame, _ in poses),
        device=np.array(device, dtype=np.int64),
        pose=np.array(pose, dtype=np.int64),
        corner=np.array(corner, dtype=np.int64),
        pixels=np.concatenate(pixels),
    )
