"""Keypoints of an image: SIFT with thresholds that are found, not given; RootSIFT descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.arrays import Floats, Floats32, check_shape
from capture.errors import ShapeError

_LAYERS = 3
_SIGMA = 1.2  # not 1.6: a quarter more keypoints, as many of them right, in less time
_EDGES = (10.0, 20.0, 40.0)  # Lowe's threshold first; looser ones where it leaves too few
_BRIGHT = 99.5  # percentile of the skin that becomes _WHITE
_WHITE = 230.0
_MARGIN_PX = 24  # around a region: the descriptors' and the scale space's reach

Region = NDArray[np.uint8]


@dataclass(frozen=True, eq=False, kw_only=True)
class Keypoints:
    """K keypoints of one image, by row, column, size and angle.

    Attributes:
        pixel: (K, 2) px, integers at pixel centres.
        size: (K,) diameter, px.
        angle: (K,) radians, from the column axis towards the row axis.
        response: (K,) contrast of the extremum, 0..1.
        descriptor: (K, 128) float32, RootSIFT: unit length, their Euclidean distance is 0..sqrt 2.
    """

    pixel: Floats
    size: Floats
    angle: Floats
    response: Floats
    descriptor: Floats32

    def __post_init__(self) -> None:
        check_shape(
            pixel=(self.pixel, "K 2"),
            size=(self.size, "K"),
            angle=(self.angle, "K"),
            response=(self.response, "K"),
            descriptor=(self.descriptor, "K 128"),
        )

    def __len__(self) -> int:
        return len(self.size)

    def select(self, chosen: NDArray[Any]) -> Keypoints:
        """The keypoints of some indices, or of a mask."""
        return Keypoints(
            pixel=self.pixel[chosen],
            size=self.size[chosen],
            angle=self.angle[chosen],
            response=self.response[chosen],
            descriptor=self.descriptor[chosen],
        )

    def scaled(self, factor: float) -> Keypoints:
        """The same keypoints in an image with `factor` times as many pixels a side."""
        return Keypoints(
            pixel=self.pixel * factor,
            size=self.size * factor,
            angle=self.angle,
            response=self.response,
            descriptor=self.descriptor,
        )


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """What an extremum must be to become a keypoint.

    Attributes:
        peak: least contrast, of the image's range, in the units of `Keypoints.response`.
        edge: largest ratio of principal curvatures.
        gain: grey values of the 8-bit image per unit of the image: skin fills its range.
    """

    peak: float
    edge: float
    gain: float


def skin_gain(image: Floats32, skin: Region) -> float:
    """What brings the skin of an image (H, W) to 8 bits without losing its dark or bright end."""
    values = image[skin > 0]
    bright = float(np.percentile(values, _BRIGHT)) if len(values) else 1.0
    return _WHITE / max(bright, 1e-3)


def detect(image: Floats32, region: Region, thresholds: Thresholds) -> Keypoints:
    """SIFT keypoints of a region of an image, with RootSIFT descriptors.

    Only the region's bounding box is looked at, so the time goes with its area.

    Args:
        image: (H, W) float32 mono.
        region: (H, W) uint8, not 0 where keypoints are wanted.
        thresholds: as `find_thresholds` gives them.

    References:
        Lowe 2004, "Distinctive image features from scale-invariant keypoints"; Arandjelovic and
        Zisserman 2012, "Three things everyone should know to improve object retrieval", 2.1.
    """
    check_shape(image=(image, "H W"), region=(region, "H W"))
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    if len(rows) == 0:
        return _keypoints([], None, (0, 0))
    top, left = max(0, rows[0] - _MARGIN_PX), max(0, columns[0] - _MARGIN_PX)
    part = np.s_[top : rows[-1] + 1 + _MARGIN_PX, left : columns[-1] + 1 + _MARGIN_PX]
    grey = cv2.convertScaleAbs(image[part], alpha=thresholds.gain)
    found, descriptor = _sift(thresholds).detectAndCompute(grey, np.ascontiguousarray(region[part]))
    return _keypoints(list(found), descriptor, (left, top))


def find_thresholds(image: Floats32, region: Region, wanted: int) -> tuple[Thresholds, Keypoints]:
    """Find the peak and edge thresholds that leave a wanted number of keypoints.

    The peak threshold is the response of the keypoint that is just wanted, among all that there
    are; where there are too few, edges are let in step by step.

    Args:
        image: (H, W) float32 mono.
        region: (H, W) uint8, not 0 on the skin.
        wanted: how many; fewer are returned where the skin has no more.

    Returns:
        The thresholds and the keypoints that pass them.

    References:
        Ma et al. 2016, section 2.1: "The peak and edge threshold are selected to obtain more than
        10k features per view."
    """
    if wanted < 1:
        raise ShapeError(f"wanted: expected at least 1, found {wanted}")
    gain = skin_gain(image, region)
    for edge in _EDGES:
        found = detect(image, region, Thresholds(peak=0.0, edge=edge, gain=gain))
        if len(found) >= wanted:
            break
    peak = 0.0
    if len(found) > wanted:
        peak = float(np.sort(found.response)[-wanted])
        found = found.select(found.response >= peak)
    return Thresholds(peak=peak, edge=edge, gain=gain), found


def _sift(thresholds: Thresholds) -> Any:
    return cv2.SIFT.create(
        nfeatures=0,
        nOctaveLayers=_LAYERS,
        contrastThreshold=thresholds.peak * _LAYERS,  # OpenCV divides it by the layers again
        edgeThreshold=thresholds.edge,
        sigma=_SIGMA,
        enable_precise_upscale=True,
    )


def _keypoints(found: list[Any], descriptor: Any, corner: tuple[int, int]) -> Keypoints:
    """Arrays of OpenCV's objects, in an order that does not depend on how they were found."""
    rows = np.array([(*k.pt, k.size, k.angle, k.response) for k in found], np.float64)
    rows = rows.reshape(-1, 5)
    root = np.zeros((0, 128), np.float32)
    if len(found):
        total = np.maximum(descriptor.sum(axis=1, keepdims=True), np.float32(1e-6))
        root = np.sqrt(descriptor / total, dtype=np.float32)
    order = np.lexsort((rows[:, 3], rows[:, 2], rows[:, 0], rows[:, 1]))
    rows = rows[order]
    return Keypoints(
        pixel=rows[:, :2] + corner,
        size=rows[:, 2],
        angle=np.radians(rows[:, 3]),
        response=rows[:, 4],
        descriptor=np.ascontiguousarray(root[order]),
    )
