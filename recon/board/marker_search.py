"""Where the corners of one flat board, and the ends of a scale bar, are in an image."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from capture.arrays import Bools, Floats, Floats32, Image, Ints
from recon.board.april_grid import AprilGrid
from recon.board.body import FlatBoard, ScaleBar
from recon.board.charuco import Board
from recon.board.marker_dictionary import cut_dictionary, dictionary_family
from recon.images import mono

_BRIGHT = 99.5  # percentile of brightness that becomes 255
_PLATEAU = 64  # places in the order of brightness by which numpy's percentile may be off
_STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-3)
_GAP_SHARE = 0.35  # of a black square: half the window that refines its corner
_FIRST_SHARE = 0.5  # the same at first: a blurred tag's corner may be found some pixels off
_WINDOW_PX = (2, 8)
_SYMMETRY = 0.6  # correlation of a crossing's surroundings with themselves turned by half a turn
_BAR_SHARE = 0.15  # of a marker's side: half the window that refines its corner

Quads = tuple[Ints, Floats]


def levels(image: Image) -> tuple[Floats32, Image]:
    """Brightness (H, W) of an image, so that its brightest half percent is 255: exact, and 8 bits.

    Args:
        image: (H, W) or (H, W, 3), uint8 or uint16.
    """
    bright = _bright_byte(image)
    if bright is None:
        grey = mono(image)
        table_scale = _scale(float(np.percentile(grey[::3, ::3], _BRIGHT)))
        grey = np.clip(grey * table_scale, 0, 255).astype(np.float32)
        return grey, np.round(grey).astype(np.uint8)
    shades = mono(np.arange(256, dtype=np.uint8)[None])
    shades = np.clip(shades * _scale(float(shades[0, bright])), 0, 255).astype(np.float32)
    exact: Floats32 = np.asarray(cv2.LUT(image, shades), dtype=np.float32)
    return exact, np.asarray(cv2.LUT(image, np.round(shades).astype(np.uint8)), dtype=np.uint8)


def _scale(bright: float) -> np.float32:
    return np.float32(255.0 / max(bright, 1e-6))


def _bright_byte(image: Image) -> int | None:
    """The level that `_BRIGHT` falls on, when it falls well inside one level of an 8-bit image."""
    if image.dtype != np.uint8 or image.ndim != 2 or image.size == 0:
        return None
    sample = np.ascontiguousarray(image[::3, ::3])
    below = np.cumsum(cv2.calcHist([sample], [0], None, [256], [0, 256]).ravel().astype(np.int64))
    place = int(_BRIGHT / 100.0 * (sample.size - 1))
    first, last = np.searchsorted(below, [place - _PLATEAU, place + _PLATEAU + 1], side="right")
    return int(first) if first == last < 256 else None


class FaceSearch:
    """Finds the markers of flat boards of one kind and dictionary, and from them their corners."""

    def __init__(self, boards: Sequence[FlatBoard]) -> None:
        """Prepare the search for boards that share markers' looks: see `alike`."""
        self._boards = tuple(boards)
        self._charuco: dict[int, cv2.aruco.CharucoDetector] = {}
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMinAccuracy = 1e-3  # the default of 0.1 px stops too early
        settings.cornerRefinementMaxIterations = 100
        first = boards[0]
        if isinstance(first, AprilGrid):
            # Black squares touch the tags: small windows and a strict threshold keep them apart.
            settings.adaptiveThreshWinSizeMin = 5
            settings.adaptiveThreshWinSizeMax = 25
            settings.adaptiveThreshConstant = 25
            settings.markerBorderBits = first.border_bits
        else:
            settings.adaptiveThreshWinSizeMin = 13
        for place, board in enumerate(boards):
            if isinstance(board, Board):
                self._charuco[place] = cv2.aruco.CharucoDetector(
                    board.pattern(), cv2.aruco.CharucoParameters(), settings
                )
        ids = [board.marker_ids for board in boards]
        self._ids = range(min(i.start for i in ids), max(i.stop for i in ids))
        self._detector = cv2.aruco.ArucoDetector(
            cut_dictionary(first.dictionary, self._ids), settings
        )

    @staticmethod
    def alike(board: FlatBoard) -> tuple[str, str, int]:
        """What boards must share to be searched for together."""
        border = board.border_bits if isinstance(board, AprilGrid) else 1
        return board.kind, dictionary_family(board.dictionary), border

    def find(self, grey: Floats32, bytes_: Image) -> tuple[list[Quads], Floats]:
        """Corners of each board in one image, as `levels` gives it.

        Args:
            grey: (H, W) brightness 0..255.
            bytes_: (H, W) the same, 8 bits.

        Returns:
            For each board the ids (N,) of the corners found, ascending, and their pixels (N, 2);
            and the corners (K, 4, 2) of all markers that were read, px.

        References:
            Garrido-Jurado et al. 2014 (markers); Foerstner and Guelch 1987 (sub-pixel saddles).
        """
        quads, ids, _ = self._detector.detectMarkers(bytes_)
        markers = np.zeros(0, np.int64) if ids is None else np.ravel(ids).astype(np.int64)
        found = []
        for place, board in enumerate(self._boards):
            own = markers + self._ids.start - board.marker_ids.start
            mine = np.flatnonzero((own >= 0) & (own < len(board.marker_ids)))
            kept = [quads[index] for index in mine.tolist()]
            if not kept:
                found.append((np.zeros(0, np.int64), np.zeros((0, 2))))
            elif place in self._charuco:
                found.append(_saddles(self._charuco[place], bytes_, kept, own[mine]))
            elif isinstance(board, AprilGrid):
                found.append(_tag_corners(board, grey, kept, own[mine]))
        flat = np.asarray(quads, dtype=np.float64).reshape(-1, 4, 2)
        return found, flat


def _saddles(
    detector: cv2.aruco.CharucoDetector, bytes_: Image, quads: list[Image], ids: Ints
) -> Quads:
    corners, found, _, _ = detector.detectBoard(
        bytes_, markerCorners=quads, markerIds=ids.astype(np.int32)[:, None]
    )
    if found is None or len(found) == 0:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    order = np.argsort(np.ravel(found), kind="stable")
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)[order]
    return np.ravel(found)[order].astype(np.int64), pixels


def _tag_corners(grid: AprilGrid, grey: Floats32, quads: list[Image], tags: Ints) -> Quads:
    """Corners of the tags, each refined as the saddle where it meets the black square."""
    alone = np.flatnonzero(np.bincount(tags, minlength=1)[tags] == 1)
    alone = alone[np.argsort(tags[alone], kind="stable")]
    ids, pixels = [], []
    for index in alone.tolist():
        start = np.asarray(quads[index], dtype=np.float32).reshape(4, 2)
        side = np.linalg.norm(start - np.roll(start, -1, axis=0), axis=1).min()
        gap = side * grid.gap_mm / grid.tag_mm
        near = _refined(grey, start, int(np.clip(_FIRST_SHARE * gap, *_WINDOW_PX)))
        half = int(np.clip(_GAP_SHARE * gap, *_WINDOW_PX))
        fine = _refined(grey, near.astype(np.float32), half)
        good = (np.linalg.norm(fine - start, axis=1) <= 0.5 * gap) & _are_crossings(
            grey, fine, half
        )
        ids += (4 * int(tags[index]) + np.flatnonzero(good)).tolist()
        pixels += fine[good].tolist()
    return np.array(ids, dtype=np.int64), np.array(pixels, dtype=np.float64).reshape(-1, 2)


def _are_crossings(grey: Floats32, pixels: Floats, half: int) -> Bools:
    """Whether black and white cross there (N,): edges and plain corners look otherwise upside down.

    Args:
        grey: (H, W) brightness.
        pixels: (N, 2) px.
        half: how far around them to look, px.
    """
    side = 2 * half + 1
    good = np.zeros(len(pixels), dtype=np.bool_)
    for index, pixel in enumerate(pixels.tolist()):
        patch = cv2.getRectSubPix(grey, (side, side), pixel).astype(np.float64)
        patch -= patch.mean()
        power = float((patch**2).sum())
        good[index] = power > 0 and float((patch * patch[::-1, ::-1]).sum()) > _SYMMETRY * power
    return good


class BarSearch:
    """Finds the two markers of a scale bar; only markers without any wrong bit count."""

    def __init__(self, bar: ScaleBar) -> None:
        ends = [cut_dictionary(bar.dictionary, range(m, m + 1)) for m in bar.markers]
        both = cv2.aruco.Dictionary(
            np.concatenate([end.bytesList for end in ends]), ends[0].markerSize, 0
        )
        settings = cv2.aruco.DetectorParameters()
        settings.errorCorrectionRate = 0.0  # two markers of few bits are soon found by chance
        self._detector = cv2.aruco.ArucoDetector(both, settings)

    def find(self, grey: Floats32, bytes_: Image, boards: Floats) -> Quads:
        """The centres of the bar's markers in one image, as `levels` gives it.

        Args:
            grey: (H, W) brightness 0..255.
            bytes_: (H, W) the same, 8 bits.
            boards: (K, 4, 2) corners of the boards' own markers, px: a square that was read as one
                of these is none of the bar's.

        Returns:
            Which ends (E,) of the bar were found, ascending, and where (E, 2) their centres are,
            px: the crossing of a marker's diagonals, which perspective keeps. An end that is seen
            twice is left out.
        """
        quads, ids, _ = self._detector.detectMarkers(bytes_)
        ends: dict[int, list[Floats]] = {}
        for quad, end in zip(quads, [] if ids is None else np.ravel(ids).tolist(), strict=True):
            start = np.asarray(quad, dtype=np.float32).reshape(4, 2)
            side = float(np.linalg.norm(start - np.roll(start, -1, axis=0), axis=1).min())
            middle = start.mean(axis=0)
            if len(boards) and (
                np.linalg.norm(boards.mean(axis=1) - middle, axis=1).min() < 0.5 * side
            ):
                continue
            fine = _refined(grey, start, int(np.clip(_BAR_SHARE * side, *_WINDOW_PX)))
            ends.setdefault(int(end), []).append(_crossing(fine))
        once = sorted(end for end, places in ends.items() if len(places) == 1)
        pixels = np.array([ends[end][0] for end in once], dtype=np.float64).reshape(-1, 2)
        return np.array(once, dtype=np.int64), pixels


def _refined(grey: Floats32, start: Floats32, half: int) -> Floats:
    fine = cv2.cornerSubPix(grey, start.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), _STOP)
    return np.asarray(fine, dtype=np.float64).reshape(-1, 2)


def _crossing(quad: Floats) -> Floats:
    """Where the diagonals of a quad (4, 2) meet."""
    along, other = quad[2] - quad[0], quad[3] - quad[1]
    t, _ = np.linalg.solve(np.stack([along, -other], axis=1), quad[1] - quad[0])
    meeting: Floats = quad[0] + t * along
    return meeting
