"""The length of the scale bar as the calibrated array measures it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats
from capture.camera import CameraArray
from recon.board.sightings import BarSightings
from recon.calibration.geometry import triangulate

_NORMAL_MAD = 1.4826
_NEAR_PX = 2.0  # of a 1000 px image: an end that misses its images by more was misread
_LEAST_FRAMES = 3


@dataclass(frozen=True, kw_only=True)
class BarLength:
    """A scale bar measured by the array.

    Attributes:
        length_mm: its calibrated length.
        measured_mm: median over the frames of what the array measures; NaN when it was not seen.
        sigma_mm: standard deviation of that median, from the scatter over the frames.
        frames: in how many frames both ends were seen by two devices or more.
    """

    length_mm: float
    measured_mm: float
    sigma_mm: float
    frames: int

    @property
    def ratio(self) -> float:
        """Measured over calibrated length."""
        return self.measured_mm / self.length_mm


def measure_bar(cameras: CameraArray, bar: BarSightings, length_mm: float) -> BarLength:
    """Measure the scale bar in every frame in which two devices or more see both ends.

    Args:
        cameras: the calibrated array.
        bar: sightings of its two markers.
        length_mm: its calibrated length between the centres of the markers.
    """
    lengths = []
    for frame in np.unique(bar.frame):
        ends = [_end(cameras, bar, int(frame), end) for end in (0, 1)]
        if np.isfinite(ends).all():
            lengths.append(float(np.linalg.norm(ends[0] - ends[1])))
    if not lengths:
        return BarLength(length_mm=length_mm, measured_mm=np.nan, sigma_mm=np.nan, frames=0)
    middle = float(np.median(lengths))
    scatter = _NORMAL_MAD * float(np.median(np.abs(np.array(lengths) - middle)))
    few = len(lengths) < _LEAST_FRAMES
    return BarLength(
        length_mm=length_mm, measured_mm=middle,
        sigma_mm=float("nan") if few else 1.25 * scatter / float(np.sqrt(len(lengths))),
        frames=len(lengths),
    )  # fmt: skip


def _end(cameras: CameraArray, bar: BarSightings, frame: int, end: int) -> Floats:
    """One end (3,) of the bar, world mm; NaN when fewer than two devices agree on it."""
    rows = np.flatnonzero((bar.frame == frame) & (bar.end == end))
    used = [index for index in range(len(cameras)) if (bar.device[rows] == index).any()]
    while len(used) >= 2:
        array = CameraArray(tuple(cameras[index] for index in used))
        places = [bar.pixels[rows[bar.device[rows] == index]][:1] for index in used]
        point = triangulate(array, places, [np.ones(1, dtype=np.bool_)] * len(used))
        misses = [
            float(np.nan_to_num(np.linalg.norm(camera.project(point) - place), nan=1e9))
            / max(camera.width, camera.height)
            for camera, place in zip(array, places, strict=True)
        ]
        worst = int(np.argmax(misses))
        if misses[worst] <= _NEAR_PX / 1000.0:
            return np.asarray(point[0], dtype=np.float64)
        used.pop(worst)
    return np.full(3, np.nan)
