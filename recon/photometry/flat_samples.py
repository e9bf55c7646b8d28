"""Reading takes of an evenly lit field, and of darkness with the lens capped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Floats32, Image
from capture.errors import TakeError, raise_all
from capture.progress import Progress, silent
from capture.take import Take
from recon.images import NEAR_WHITE, brightest, mono, white
from recon.photometry.light_samples import LightSamples
from recon.photometry.model import RANGES

_BLOCKS = 40  # along the longer side
_MOST_FRAMES = 24  # of one take: the noise is long gone
_MOST_BLOCKS = 4 * _BLOCKS**2  # of one device, more than there ever are
_CLIPPED_SHARE = 1e-3  # of a block: a block that lost its brightest pixels reads too dark
_FLOOR = 0.002  # of the log: no field is more even
_DARKEST = 0.02  # part of the range below which a field is not bright enough to say anything
_NOT_DARK = 0.1  # part of the range above which a lens was not capped
_HOT = 10.0  # robust standard deviations above which a pixel of a dark frame is broken
_LEAK = 0.004  # part of the range
_HELD_BACK = 0.2  # share of pixels at 0 from which the true black lies below what can be shown


@dataclass(frozen=True, eq=False, kw_only=True)
class FlatReadings:
    """What a flat field take says of the devices.

    Attributes:
        samples: one reading a block and frame.
        clipped: (C,) share of the blocks of each device that were clipped.
        dark: (C,) share of the blocks that were too dark.
        exposure_slope: (C,) how the log of the brightness grows with the log of the exposure, 1 for
            a linear device; NaN where the exposure is not known or did not vary.
        darkest: (C,) the lowest value that a device showed in numbers, as a part of the range.
    """

    samples: LightSamples
    clipped: Floats
    dark: Floats
    exposure_slope: Floats
    darkest: Floats


@dataclass(frozen=True, kw_only=True)
class DarkLevel:
    """What one device shows without light.

    Attributes:
        black_dn: mean, in the image's own numbers, broken pixels left out.
        at_zero: share of the pixels that are 0; many of them hide a black below 0.
        spread_dn: standard deviation over blocks of the image: light that leaks in.
        range_dn: the largest number of its pixel type.
    """

    black_dn: float
    at_zero: float
    spread_dn: float
    range_dn: int

    @property
    def held_back(self) -> bool:
        """Whether the true black lies below the smallest number."""
        return self.at_zero > _HELD_BACK

    @property
    def uneven(self) -> bool:
        """Whether some of the image was less dark than the rest."""
        return self.spread_dn > _LEAK * self.range_dn


def sample_flats(
    take: Take,
    names: tuple[str, ...],
    *,
    black: Floats,
    same_light: bool = False,
    slope: bool = False,
    progress: Progress = silent,
) -> FlatReadings:
    """Read every device's view of an evenly lit field, in blocks.

    Args:
        take: the flat field take.
        names: (C) devices to read, all of the take.
        black: (C,) black level as a part of the range.
        same_light: whether all devices look at the same light in a frame.
        slope: whether the light may have a slope over the image.
        progress: told after each frame.
    """
    frames = _spread(take.frames)
    table: list[Floats] = []
    counts = np.zeros((len(names), 3))
    levels: list[list[tuple[float, float]]] = [[] for _ in names]
    darkest = np.full(len(names), np.inf)
    for place, frame in enumerate(frames):
        for device, name in enumerate(names):
            if not take.present(name, frame):
                continue
            shot = take.frame(name, frame)
            mean, noise, pixels, clipped = _blocks(shot.image)
            darkest[device] = min(darkest[device], float(mean.min()))
            value = mean - black[device]
            dim = ~clipped & (value < _DARKEST)
            good = ~clipped & ~dim
            counts[device] += (len(value), clipped.sum(), dim.sum())
            light = place if same_light else place * len(names) + device
            rows = np.empty((int(good.sum()), 7))
            rows[:, 0], rows[:, 1:3], rows[:, 3] = device, pixels[good], value[good]
            rows[:, 4] = np.hypot(_FLOOR, noise[good] / value[good])
            rows[:, 5], rows[:, 6] = light, device * _MOST_BLOCKS + np.flatnonzero(good)
            table.append(rows)
            if good.all() and shot.header.exposure_us > 0:
                levels[device].append(
                    (float(np.log(shot.header.exposure_us)), float(np.log(value[good]).mean()))
                )
        progress(place + 1, len(frames), "flat field")
    rows = np.concatenate(table) if table else np.zeros((0, 7))
    _, batch = np.unique(rows[:, 6], return_inverse=True)
    samples = LightSamples(
        device_names=names, sizes=tuple(take.size(name) for name in names),
        device=rows[:, 0].astype(np.int64), pixels=rows[:, 1:3], value=rows[:, 3],
        sigma=rows[:, 4], light=rows[:, 5].astype(np.int64), batch=batch.ravel().astype(np.int64),
        sloped=np.full(len(rows), slope),
    )  # fmt: skip
    total = np.maximum(counts[:, 0], 1.0)
    return FlatReadings(
        samples=samples, clipped=counts[:, 1] / total, dark=counts[:, 2] / total,
        exposure_slope=np.array([_slope(told) for told in levels]), darkest=darkest,
    )  # fmt: skip


def dark_levels(
    take: Take, names: tuple[str, ...], *, progress: Progress = silent
) -> dict[str, DarkLevel]:
    """The black level of each device from frames taken with its lens capped.

    Args:
        take: the dark take.
        names: devices to read, all of the take.
        progress: told after each device.

    Raises:
        TakeError: naming every device whose frames are lost or not dark.
    """
    out: dict[str, DarkLevel] = {}
    problems = []
    for done, name in enumerate(names, start=1):
        there = _spread(tuple(f for f in take.frames if take.present(name, f)))
        images = [take.image(name, frame) for frame in there]
        if not images:
            problems.append(f"{name}: every dark frame was lost; take them again")
            continue
        top = RANGES[images[0].dtype.name]
        stack = np.stack([mono(image) for image in images])
        mean: Floats = stack.mean(axis=0, dtype=np.float64) * top
        middle = float(np.median(mean))
        if middle > _NOT_DARK * top:
            problems.append(
                f"{name}: dark frames show {middle:.4g} of {top}, not darkness; cap the lens"
            )
            continue
        off = np.abs(mean - middle)
        sigma = max(1.4826 * float(np.median(off)), 1e-3 * top)
        good = off <= _HOT * sigma
        blocks, _, _, _ = _blocks(np.where(good, mean, middle) / top)
        out[name] = DarkLevel(
            black_dn=float(mean[good].mean()),
            at_zero=float(np.mean([(brightest(image) == 0).mean() for image in images])),
            spread_dn=float(blocks.std() * top),
            range_dn=top,
        )
        progress(done, len(names), "dark frames")
    raise_all(str(take.folder), problems, TakeError)
    return out


def _spread(frames: tuple[int, ...]) -> tuple[int, ...]:
    if len(frames) <= _MOST_FRAMES:
        return frames
    places = np.linspace(0, len(frames) - 1, _MOST_FRAMES).round().astype(int).tolist()
    return tuple(frames[place] for place in places)


def _blocks(image: Image) -> tuple[Floats, Floats, Floats, Bools]:
    """Means (B,), their noise (B,), middles (B, 2) px, and whether each block is clipped."""
    grey = mono(image)
    side = max(1, round(max(grey.shape) / _BLOCKS))
    top = brightest(image)
    lost = (top >= NEAR_WHITE * white(top)).astype(np.float32)
    cells = _cells(grey, side)
    mean = cells.mean(axis=1, dtype=np.float64)
    # a slope of the light inside a block is no noise: neighbours' differences see through it
    step = np.diff(cells, axis=1)
    noise = np.sqrt(0.5 * (step**2).mean(axis=1, dtype=np.float64)) / side if side > 1 else 0 * mean
    rows, columns = grey.shape[0] // side, grey.shape[1] // side
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    middles = np.stack([x, y], axis=-1).reshape(-1, 2) * float(side) + 0.5 * (side - 1)
    return mean, noise, middles, _cells(lost, side).mean(axis=1) > _CLIPPED_SHARE


def _cells(plane: Floats32, side: int) -> Floats32:
    """The pixels (B, side * side) of square blocks of a plane, what is left over cut off."""
    rows, columns = plane.shape[0] // side, plane.shape[1] // side
    cut = plane[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return cut.transpose(0, 2, 1, 3).reshape(rows * columns, side * side)


def _slope(told: list[tuple[float, float]]) -> float:
    """Slope of log brightness over log exposure; NaN when exposures vary by less than a half."""
    table = np.array(told).reshape(-1, 2)
    if len(table) < 2 or np.ptp(table[:, 0]) < np.log(1.5):
        return float("nan")
    away = table - table.mean(axis=0)
    return float((away[:, 0] @ away[:, 1]) / (away[:, 0] @ away[:, 0]))
