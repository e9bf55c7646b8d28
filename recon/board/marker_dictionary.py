"""Marker dictionaries of OpenCV: which there are, what a board uses of one, what they draw.

A marker is a square of cells: a black border of `border_bits` cells about the bits of its id.
"""

from __future__ import annotations

import re

import cv2
import numpy as np

from capture.arrays import Bools
from capture.names import known_hint

_DICTIONARY = "DICT_"
_COUNTED = re.compile(r"(DICT_\dX\d)_\d+")


def dictionary_names() -> list[str]:
    """Names of the dictionaries that cv2.aruco offers."""
    return sorted(name for name in dir(cv2.aruco) if name.startswith(_DICTIONARY))


def dictionary_family(name: str) -> str:
    """What the dictionaries that share markers have in common.

    DICT_5X5_50, _100, _250 and _1000 draw the same marker for the same id, as do the two spellings
    of an AprilTag family; markers of two families never read as one another.
    """
    counted = _COUNTED.fullmatch(name)
    return counted[1] if counted else name.upper()


def dictionary_problems(name: str, ids: range, what: str) -> list[str]:
    """Why a dictionary cannot give these markers, one line each; nothing when it can.

    Args:
        name: as in cv2.aruco, "DICT_5X5_1000".
        ids: the markers that are needed.
        what: what needs them, plural: "12 x 9 squares".
    """
    known = dictionary_names()
    if name not in known:
        hint = known_hint(name.upper(), known)
        return [f"dictionary: no marker dictionary is called {name!r}; {hint}"]
    have = len(_whole(name).bytesList)
    if ids.stop <= have:
        return []
    if ids.stop == ids.start + 1:
        return [f"dictionary: {what} need marker {ids.start}, {name} has 0 to {have - 1}"]
    since = f" from id {ids.start} on" if ids.start else ""
    return [
        f"dictionary: {what} need {ids.stop - ids.start} markers{since}, {name} has {have}; "
        f"take a larger dictionary"
    ]


def cut_dictionary(name: str, ids: range) -> cv2.aruco.Dictionary:
    """The dictionary of these markers alone: its marker 0 is `ids.start` of the whole one.

    Comparing with the markers of one board alone makes detection ten times faster, and keeps the
    markers of other boards out.
    """
    whole = _whole(name)
    return cv2.aruco.Dictionary(
        whole.bytesList[ids.start : ids.stop], whole.markerSize, whole.maxCorrectionBits
    )


def marker_cells(name: str, marker: int, border_bits: int) -> Bools:
    """The cells of a marker as OpenCV draws it upright, True for black, border included.

    Args:
        name: the dictionary.
        marker: id of the marker in it.
        border_bits: width of the black border, cells.

    Returns:
        (S, S) with S = bits in a row + 2 border_bits; row 0 is the top.
    """
    whole = _whole(name)
    side = whole.markerSize
    white = cv2.aruco.Dictionary.getBitsFromByteList(
        whole.bytesList[marker : marker + 1], side
    ).reshape(side, side)
    cells: Bools = np.pad(white == 0, border_bits, constant_values=True)
    return cells


def _whole(name: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
