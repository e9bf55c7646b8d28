"""Which printed board a handful of markers lies on: told from their ids and places alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from capture.arrays import Floats, Ints
from recon.board.april_grid import OPENCV, AprilGrid
from recon.board.body import FlatBoard
from recon.board.marker_census import MarkerSet

_LEAST = 4  # markers that must fit, before anything is said of them
_SHARE = 0.6  # of the markers read, that a layout must explain
_FIT = 0.15  # of a marker's side: how far from its place a corner may be
_TRIALS = 60
_LEAST_COLUMNS, _WIDEST = 3, 24
_GAP = 1.3  # of a board of whose kind the file says nothing
_MOST = 28  # markers looked at


@dataclass(frozen=True)
class Layout:
    """How the markers of a board lie: row by row, ids rising.

    Attributes:
        kind: "charuco" or "aprilgrid".
        columns: squares, or tags, in a row.
        gap: distance of neighbouring squares, or tags, over the side of a marker.
        first_column: of a ChArUco board, the column of the first marker: 0 or 1.
        first_id: id of the first marker.
        turned: of an AprilGrid, whether it is Kalibr's: tags upside down, ids rising upward.
    """

    kind: str
    columns: int
    gap: float
    first_column: int = 0
    first_id: int = 0
    turned: bool = False

    @classmethod
    def of(cls, board: FlatBoard) -> Layout:
        """That of a board."""
        if isinstance(board, AprilGrid):
            gap = 1.0 + board.gap_mm / board.tag_mm
            return cls("aprilgrid", board.tags_x, gap, 0, board.first_id, board.layout != OPENCV)
        first = 0 if board.legacy and board.squares_y % 2 == 0 else 1
        gap = board.square_mm / board.marker_mm
        return cls("charuco", board.squares_x, gap, first, board.first_id)

    def places(self, ids: Ints) -> Floats:
        """Corners (K, 4, 2) of markers (K,), in sides of a marker, in OpenCV's order."""
        row, column = self.cells(ids)
        around = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64)
        if self.turned:
            row, around = -row, np.roll(around, 2, axis=0)
        corners: Floats = np.stack([column, row], axis=1)[:, None, :] * self.gap + around
        return corners

    def cells(self, ids: Ints) -> tuple[Ints, Ints]:
        """Row and column of markers (K,)."""
        order = ids - self.first_id
        if self.kind == "aprilgrid":
            return order // self.columns, order % self.columns
        row = 2 * (order // self.columns)
        within = order % self.columns
        in_first = (self.columns + 1 - self.first_column) // 2
        second = within >= in_first
        column = np.where(
            second,
            2 * (within - in_first) + 1 - self.first_column,
            2 * within + self.first_column,
        )
        return row + second, column


def fitting(markers: MarkerSet, layout: Layout) -> tuple[float, int]:
    """Which share, and how many, of the markers of an image lie where a layout says.

    Markers that were read by chance lie anywhere: a layout that explains less than most of them
    explains none. Of very many markers some are looked at.
    """
    known = np.flatnonzero(markers.ids >= layout.first_id)
    if len(known) < _LEAST:
        return 0.0, 0
    if len(known) > _MOST:
        known = known[np.linspace(0, len(known) - 1, _MOST).round().astype(np.int64)]
    corners = markers.corners[known]
    side = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    places = layout.places(markers.ids[known]).reshape(-1, 1, 2)
    _, inside = cv2.findHomography(
        places, corners.reshape(-1, 1, 2), cv2.RANSAC, _FIT * side, maxIters=_TRIALS
    )
    inliers = np.asarray(inside).reshape(-1)  # empty, or a lone None, when nothing fits
    if len(inliers) != 4 * len(known):
        return 0.0, 0
    count = int((inliers.reshape(-1, 4) == 1).all(axis=1).sum())
    share = count / len(known)
    return (share, count) if count >= _LEAST and share >= _SHARE else (0.0, 0)


def likely_layouts(boards: Sequence[FlatBoard], *, tags: bool) -> list[Layout]:
    """All layouts that a board may have whose file is wrong, the nearest to the file's first.

    Args:
        boards: as their file says.
        tags: whether AprilGrids are to be thought of.
    """
    own = [Layout.of(board) for board in boards]
    first = own[0]
    gap = {layout.kind: layout.gap for layout in reversed(own)}
    columns = sorted(range(_LEAST_COLUMNS, _WIDEST + 1), key=lambda n: abs(n - first.columns))
    others = []
    for start in sorted({0, first.first_id}):
        for count in columns:
            others += [
                Layout("charuco", count, gap.get("charuco", _GAP), column, start)
                for column in (1, 0)
            ]
            others += [
                Layout("aprilgrid", count, gap.get("aprilgrid", _GAP), 0, start, turned)
                for turned in ((True, False) if tags else ())
            ]
    return own + [layout for layout in others if layout not in own]
