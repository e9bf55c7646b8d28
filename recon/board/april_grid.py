"""`AprilGrid`: a flat grid of AprilTags with black squares between them, as Kalibr prints it.

::

    [board]
    kind = "aprilgrid"        # tags_x x tags_y tags
    tags_x = 6
    tags_y = 6
    tag_mm = 24.0             # side of a tag, black border included
    gap_mm = 7.2              # between the sides of two tags: Kalibr's tagSpacing * tagSize
    layout = "kalibr"         # or "opencv"
    dictionary = "DICT_APRILTAG_36h11"
    border_bits = 2           # Kalibr prints 2, AprilTag 3 and OpenCV print 1
    first_id = 0

A black square of side `gap_mm` touches every corner of every tag, so that each corner is a crossing
of black and white like that of a chessboard: blur does not move it.

Board space is as that of `recon.board.charuco`: origin at the outer corner of the whole pattern
(of the black square at its top left), +X right, +Y down, +Z into the board. Kalibr's own space
starts at the bottom left tag, +Y up, +Z out of the board.

For detectors: cv2.aruco finds the tags (`marker_dictionary`, `markerBorderBits = border_bits`), but
its corners lie 1 to 4 px inside, because its threshold cuts the tags off the black squares, and its
own refinement, from there, often stays at them. Corners predicted from the homography of all tags
are within 1.5 px; cornerSubPix from those, in a window of 0.3 `pitch_mm`, is good to 0.03 px.

References:
    Kalibr, `kalibr_create_target_pdf` and `GridCalibrationTargetAprilgrid`: ids rise from the
    bottom left, row by row upward; a tag there is OpenCV's turned by half a turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from capture.arrays import Floats, Ints
from capture.errors import SettingsError, raise_all
from recon.board.marker_dictionary import cut_dictionary, dictionary_problems

KALIBR, OPENCV = "kalibr", "opencv"
_LAYOUTS = (KALIBR, OPENCV)
_WIDEST_BORDER = 8  # cells
_LEAST_GAP = 0.05  # of a tag: below it the ratio was written instead


@dataclass(frozen=True, kw_only=True)
class AprilGrid:
    """A flat grid of AprilTags as printed and measured.

    Attributes:
        tags_x: tags in a row.
        tags_y: tags in a column.
        tag_mm: measured side of a tag, black border included.
        gap_mm: measured gap between the sides of two neighbouring tags, which is also the side of
            the black squares at the crossings.
        kind: "aprilgrid".
        layout: "kalibr": ids rise from the bottom left, row by row upward, tags as Kalibr turns
            them; "opencv": ids rise from the top left, row by row downward, tags upright as OpenCV
            draws them.
        dictionary: name of the tag dictionary in cv2.aruco.
        border_bits: width of a tag's black border, cells.
        first_id: id of the first tag.
    """

    tags_x: int
    tags_y: int
    tag_mm: float
    gap_mm: float
    kind: str = "aprilgrid"
    layout: str = KALIBR
    dictionary: str = "DICT_APRILTAG_36h11"
    border_bits: int = 2
    first_id: int = 0

    def __post_init__(self) -> None:
        problems: list[str] = []
        if self.kind != "aprilgrid":
            problems.append(f'kind: expected "aprilgrid", found {self.kind!r}')
        for key, least in (("tags_x", 1), ("tags_y", 1), ("border_bits", 1), ("first_id", 0)):
            if getattr(self, key) < least:
                problems.append(f"{key}: at least {least}, found {getattr(self, key)}")
        for key in ("tag_mm", "gap_mm"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                problems.append(f"{key}: must be above 0 mm, found {value}")
        if self.border_bits > _WIDEST_BORDER:
            problems.append(f"border_bits: at most {_WIDEST_BORDER}, found {self.border_bits}")
        if 0 < self.gap_mm < _LEAST_GAP * self.tag_mm:
            problems.append(
                f"gap_mm: less than {_LEAST_GAP:g} of tag_mm = {self.tag_mm}, found {self.gap_mm}; "
                f"it is in mm, not Kalibr's ratio tagSpacing: {self.gap_mm * self.tag_mm:g} perhaps"
            )
        if self.gap_mm > self.tag_mm:
            problems.append(
                f"gap_mm: must not be above tag_mm = {self.tag_mm}, found {self.gap_mm}; "
                f"it is in mm, not Kalibr's ratio tagSpacing"
            )
        if self.layout not in _LAYOUTS:
            problems.append(f'layout: expected "kalibr" or "opencv", found {self.layout!r}')
        if not problems:
            what = f"{self.tags_x} x {self.tags_y} tags"
            problems += dictionary_problems(self.dictionary, self.marker_ids, what)
        raise_all("board", problems, SettingsError)

    @property
    def marker_ids(self) -> range:
        """Ids of the tags in their dictionary."""
        return range(self.first_id, self.first_id + self.tags_x * self.tags_y)

    @property
    def corner_count(self) -> int:
        """How many corners the board has: four a tag."""
        return 4 * self.tags_x * self.tags_y

    @property
    def pitch_mm(self) -> float:
        """Distance from a corner to the nearest other one."""
        return min(self.tag_mm, self.gap_mm)

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the printed pattern, outer black squares included."""
        step = self.tag_mm + self.gap_mm
        return self.tags_x * step + self.gap_mm, self.tags_y * step + self.gap_mm

    @property
    def half_turned(self) -> bool:
        """Whether the tags stand upside down compared with OpenCV's drawing of them."""
        return self.layout == KALIBR

    def corners_mm(self) -> Floats:
        """Nominal corners (N, 3), board space, mm: those of the first tag, the second, ...

        Corner 4 k + j is corner j, as OpenCV's detector counts them, of the tag with id
        first_id + k.
        """
        return self.markers()[1].reshape(-1, 3)

    def markers(self) -> tuple[Ints, Floats]:
        """Ids (K,) of the tags, and their corners (K, 4, 3) in OpenCV's order, board space, mm."""
        places = np.array([self.place(index) for index in range(self.tags_x * self.tags_y)])
        around = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64) * self.tag_mm
        if self.half_turned:
            around = np.roll(around, 2, axis=0)  # OpenCV's first corner lies at the bottom right
        corners = np.zeros((len(places), 4, 3))
        corners[:, :, :2] = places[:, None, :] + around
        return np.array(self.marker_ids, dtype=np.int64), corners

    def place(self, index: int) -> tuple[float, float]:
        """Top left corner of a tag, (x, y) in board space, mm.

        Args:
            index: its id less `first_id`.
        """
        row, column = divmod(index, self.tags_x)
        if self.layout == KALIBR:
            row = self.tags_y - 1 - row
        step = self.tag_mm + self.gap_mm
        return self.gap_mm + column * step, self.gap_mm + row * step

    def marker_dictionary(self) -> cv2.aruco.Dictionary:
        """OpenCV's dictionary of these tags alone: its marker k is the tag with id first_id + k.

        A detector needs `markerBorderBits = border_bits` besides.
        """
        return cut_dictionary(self.dictionary, self.marker_ids)
