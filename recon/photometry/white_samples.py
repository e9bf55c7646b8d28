"""Reading the white of a calibration board: how bright each device saw it, far from any ink.

A matt white place is equally bright from all sides, so what the devices that see it at one instant
read differs by their lenses and gains alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Image, Ints, check_shape
from capture.camera import Camera, CameraArray
from capture.pose import Pose
from capture.progress import Progress, silent
from recon.board.body import BoardBody
from recon.board.corners import BoardTake
from recon.images import NEAR_WHITE, brightest, mono, white
from recon.photometry.board_spots import BoardSpots, ink_spots, white_spots
from recon.photometry.light_samples import LightSamples

_ROUNDING_PX = 0.75  # a place read is rounded to a pixel, whose own width counts as well
_LEAST_READ_PX = 1.0  # radius of what is left of a white place in the image
_UNEVEN = 0.3  # a pixel darker than the others by this share is ink, an edge or a hard shadow
_FLOOR = 0.002  # of the log: paper, print, and what noise averages down to
_RING = ((0.0, 1), (0.45, 8), (0.8, 14), (1.0, 18))  # (radius, places) read in a disc of radius 1


@dataclass(frozen=True, eq=False, kw_only=True)
class SampleLimits:
    """Which white places are good enough to read.

    Attributes:
        edge_px: nothing is read nearer to ink than this in the image.
        max_tilt_deg: views flatter than this to the board's normal are left out.
        least_level: darker values, as a part of the range, are left out.
    """

    edge_px: float = 2.5
    max_tilt_deg: float = 60.0
    least_level: float = 0.02


@dataclass(frozen=True, eq=False, kw_only=True)
class WhiteReadings:
    """What a board take says of the devices.

    Attributes:
        samples: the readings of white.
        left_out: by reason, how many places of each device (C,) were not used.
        ink_ratio: (C,) median brightness of black ink over that of white; NaN when unknown.
        darkest: (C,) the lowest value, as a part of the range, that a device showed in numbers.
    """

    samples: LightSamples
    left_out: dict[str, Ints]
    ink_ratio: Floats
    darkest: Floats


def sample_whites(
    take: BoardTake,
    body: BoardBody,
    cameras: CameraArray,
    views: Sequence[tuple[int, Pose, Sequence[str]]],
    *,
    black: Floats | None = None,
    limits: SampleLimits | None = None,
    progress: Progress = silent,
) -> WhiteReadings:
    """Read the white places of a board in every view of it.

    Args:
        take: the board take.
        body: the board in it.
        cameras: one a device, in the take's order.
        views: (frame, world_from_board, devices that see it there), mm.
        black: (C,) black level as a part of the range; 0 when left out.
        limits: which places to read.
        progress: told after each frame.
    """
    limits = limits or SampleLimits()
    names = take.device_names
    black = np.zeros(len(names)) if black is None else black
    check_shape(black=(black, f"{len(names)}"))
    whites, inks = white_spots(body), ink_spots(body)
    table: list[Floats] = []
    left_out = {key: np.zeros(len(names), np.int64) for key in ("clipped", "uneven", "dark")}
    ratios: list[list[float]] = [[] for _ in names]
    darkest = np.full(len(names), np.inf)
    for done, (frame, world_from_board, seen) in enumerate(views, start=1):
        for name in seen:
            device = names.index(name)
            image = take.image(name, frame)
            view = _View(cameras[device], world_from_board, image, float(black[device]))
            darkest[device] = min(darkest[device], view.darkest)
            read = view.read(whites, limits)
            good = ~(read.clipped | read.uneven | read.dark)
            for key in left_out:
                left_out[key][device] += int(getattr(read, key).sum())
            ink = view.read(inks, limits)
            if good.any() and len(ink.value):
                ratios[device].append(float(np.median(ink.value) / np.median(read.value[good])))
            light = (done - 1) * len(whites) + read.spot
            batch = np.full(len(light), (done - 1) * len(names) + device)
            columns = (np.full(len(light), device), *read.pixels.T, read.value, read.sigma)
            table.append(np.column_stack([*columns, light, batch])[good])
        progress(done, len(views), "white")
    rows = np.concatenate(table) if table else np.zeros((0, 7))
    samples = LightSamples(
        device_names=tuple(names), sizes=tuple(take.size(name) for name in names),
        device=rows[:, 0].astype(np.int64), pixels=rows[:, 1:3], value=rows[:, 3],
        sigma=rows[:, 4], light=rows[:, 5].astype(np.int64), batch=rows[:, 6].astype(np.int64),
        sloped=np.zeros(len(rows), dtype=np.bool_),
    )  # fmt: skip
    ratio = np.array([float(np.median(r)) if r else np.nan for r in ratios])
    return WhiteReadings(samples=samples, left_out=left_out, ink_ratio=ratio, darkest=darkest)


@dataclass(frozen=True, eq=False)
class _Reading:
    """What one view shows of the spots that lie well inside its image."""

    spot: Ints
    pixels: Floats
    value: Floats
    sigma: Floats
    clipped: Bools
    uneven: Bools
    dark: Bools


class _View:
    """One image of a board whose place is known."""

    def __init__(self, camera: Camera, world_from_board: Pose, image: Image, black: float) -> None:
        self.camera, self.place = camera, world_from_board
        self.grey = mono(image) - np.float32(black)
        top = brightest(image)
        self.clipped = top >= NEAR_WHITE * white(top)
        self.darkest = float(np.percentile(self.grey[::3, ::3], 0.5)) + black

    def read(self, spots: BoardSpots, limits: SampleLimits) -> _Reading:
        """Read every spot that faces the device and is wide enough in its image."""
        middle = self.place.apply(spots.places)
        turn = self.place.rotation
        across, down = spots.across @ turn.T, spots.down @ turn.T
        steps = 0.05 * spots.radius_mm[:, None]
        at = self.camera.project(middle)
        along = np.stack(
            [self.camera.project(middle + steps * axis) - at for axis in (across, down)], axis=-1
        ) / steps[:, :, None]  # fmt: skip
        px_per_mm = _smallest_stretch(along)
        towards = self.camera.centre - middle
        facing = -(np.cross(across, down) * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
        inner = spots.radius_mm - (limits.edge_px + _ROUNDING_PX) / px_per_mm
        good = facing > np.cos(np.radians(limits.max_tilt_deg))
        good &= inner * px_per_mm >= _LEAST_READ_PX
        disc = _disc_places()
        places = (
            middle[:, None]
            + inner[:, None, None] * (disc[:, :1] * across[:, None] + disc[:, 1:] * down[:, None])
        )  # fmt: skip
        pixels = self.camera.project(places.reshape(-1, 3)).reshape(len(spots), len(disc), 2)
        margin = 1.0
        far = np.array([self.camera.width - 1.0, self.camera.height - 1.0]) - margin
        good &= ((pixels >= margin) & (pixels <= far)).all(axis=(1, 2))  # NaN is not
        spot = np.flatnonzero(good)
        nearest = np.rint(pixels[spot]).astype(np.int64)
        values = self.grey[nearest[:, :, 1], nearest[:, :, 0]].astype(np.float64)
        mean, middle_value = values.mean(axis=1), np.median(values, axis=1)
        area = np.pi * (inner * px_per_mm)[spot] ** 2
        noise = values.std(axis=1) / np.sqrt(np.minimum(area, len(disc)))
        level = np.maximum(mean, 1e-9)
        return _Reading(
            spot=spot,
            pixels=nearest.mean(axis=1),
            value=level,
            sigma=np.hypot(_FLOOR, noise / level),
            clipped=np.asarray(self.clipped[nearest[:, :, 1], nearest[:, :, 0]].any(axis=1)),
            uneven=values.min(axis=1) < (1.0 - _UNEVEN) * middle_value,
            dark=mean < limits.least_level,
        )


def _disc_places() -> Floats:
    """Places (K, 2) spread over a disc of radius 1."""
    rings = []
    for radius, count in _RING:
        angle = 2.0 * np.pi * (np.arange(count) + 0.5) / count
        rings.append(radius * np.column_stack([np.cos(angle), np.sin(angle)]))
    return np.concatenate(rings)


def _smallest_stretch(slope: Floats) -> Floats:
    """Smallest singular value (S,) of matrices (S, 2, 2); 0 where they hold NaN."""
    trace = (slope**2).sum(axis=(1, 2))
    determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
    inner = np.sqrt(np.maximum(trace**2 - 4.0 * determinant**2, 0.0))
    least: Floats = np.nan_to_num(np.sqrt(np.maximum(0.5 * (trace - inner), 0.0)), nan=0.0)
    return least + 1e-12
