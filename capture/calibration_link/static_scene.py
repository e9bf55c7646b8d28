"""Whether a device still looks where it looked on calibration day, told from what stands still.

Small square tiles of a picture are laid over the same places of another: the mean phase slope of
their cross spectrum is a shift, which is followed with sub-pixel sampling until none is left. Tiles
that show the actor, nothing, or something new are outvoted: a motion of the device displaces all
static tiles alike, but for a small turn and scale.

References:
    Foroosh, Zerubia and Berthod 2002, Extension of phase correlation to subpixel registration;
    Stone, Orchard, Chang and Martucci 2001, A fast direct Fourier-based algorithm for subpixel
    registration of images: the weighted plane through the phases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Bools, Floats, Image, Ints, check_shape

PICTURE_PX = 512  # the longer side of a kept picture
_TILE = 48
_STEP = 32
_BAND = 0.25  # cycles a pixel: above, noise and aliasing rule
_ALIKE = 0.5  # correlation of two tiles that show the same
_LEAST_TILES = 4
_ROUNDS = 6
_MIDDLE = (0.30, 0.36)  # half axes of the actor's ellipse, of width and height
_FLOOR_PX = 0.03  # of the picture: a single tile is not known better
_COMMON_PX = 0.015  # of the picture: what binning and sampling displace all tiles alike, measured


@dataclass(frozen=True)
class Motion:
    """How far a device has moved, seen in its image. NaN: not known.

    Attributes:
        shift_px: (right, down) by which the static scene is displaced at the middle of the image,
            full-size pixels.
        size_px: its length.
        turn_mdeg: about the line of sight, thousandths of a degree; positive: what was on the
            right is now lower.
        growth_ppm: of the picture, parts in a million.
        sigma_px: standard deviation of the shift, by the scatter of the tiles.
        tiles: how many agree, of `tried`.
        tried: tiles with anything to see in both pictures.
    """

    shift_px: tuple[float, float]
    size_px: float
    turn_mdeg: float
    growth_ppm: float
    sigma_px: float
    tiles: int
    tried: int

    @property
    def known(self) -> bool:
        """Whether enough tiles agree."""
        return bool(np.isfinite(self.size_px))


def small_picture(image: Image) -> Floats:
    """A mono picture of at most 512 px a side: means of square blocks, 0 to 1.

    Args:
        image: (H, W) or (H, W, 3), uint8 or uint16.
    """
    factor = binning(image)
    height, width = image.shape[0] // factor, image.shape[1] // factor
    cut = image[: height * factor, : width * factor]
    whole = np.iinfo(image.dtype).max if image.dtype.kind == "u" else 1.0
    sums = np.zeros((height, width), np.float64)
    for row in range(factor):
        for column in range(factor):
            part = cut[row::factor, column::factor]
            sums += part if part.ndim == 2 else part.mean(axis=2)
    return sums / (factor * factor * whole)


def binning(image: Image) -> int:
    """How many pixels of an image make one of its small picture, along a side."""
    longer = int(max(image.shape[:2]))
    return max(1, -(-longer // PICTURE_PX))


def middle_mask(shape: tuple[int, int]) -> Bools:
    """(H, W) where the actor sits: an ellipse in the middle, open to the lower edge."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    across = (x / max(shape[1] - 1, 1) - 0.5) / _MIDDLE[0]
    down = np.minimum(y / max(shape[0] - 1, 1) - 0.5, 0.0) / _MIDDLE[1]
    return np.asarray(across**2 + down**2 <= 1.0)


def measure_motion(
    reference: Floats, fresh: Floats, *, factor: int = 1, ignore: Bools | None = None
) -> Motion:
    """Measure how the static scene is displaced from one small picture to another.

    Gain, brightness and noise do not matter, nor whatever moves in front of less than about half of
    the tiles.

    Args:
        reference: (H, W) of calibration day.
        fresh: (H, W) of now.
        factor: full-size pixels in one of these, along a side.
        ignore: (H, W) where not to look; None: where the actor sits.

    Raises:
        ShapeError: when the pictures differ in size.
    """
    check_shape(reference=(reference, "H W"), fresh=(fresh, "H W"))
    hidden = middle_mask(reference.shape) if ignore is None else ignore
    corners = _corners(reference, hidden)
    if len(corners) < _LEAST_TILES:
        return _unknown(0)
    shifts, alike = _follow(reference, fresh, corners)
    good = alike >= _ALIKE
    tried = len(corners)
    if good.sum() < _LEAST_TILES:
        return _unknown(tried)
    centres = corners[good][:, ::-1] + (_TILE - 1) / 2.0
    middle = (np.array(reference.shape[::-1]) - 1) / 2.0
    return _agreed(centres - middle, shifts[good], factor, tried)


def _corners(reference: Floats, hidden: Bools) -> Ints:
    """(N, 2) upper left corners, (row, column), of tiles that show something static."""
    height, width = reference.shape
    kept, detail = [], []
    for row in range(0, height - _TILE + 1, _STEP):
        for column in range(0, width - _TILE + 1, _STEP):
            place = np.s_[row : row + _TILE, column : column + _TILE]
            if hidden[place].mean() > 0.25:
                continue
            tile = reference[place]
            steps = np.abs(np.diff(tile, axis=0)).mean(), np.abs(np.diff(tile, axis=1)).mean()
            kept.append((row, column))
            detail.append(float(tile.std()) if min(steps) > 0 else 0.0)
    corners = np.array(kept, np.int64).reshape(-1, 2)
    levels = np.array(detail)
    return corners[levels > 0.004]  # one grey level of 256: less is noise


def _follow(reference: Floats, fresh: Floats, corners: Ints) -> tuple[Floats, Floats]:
    """(N, 2) shift (x, y) of each tile, and (N,) how well it then correlates."""
    window = np.hanning(_TILE + 2)[1:-1]
    window = window[:, None] * window[None, :]
    tiles = _sampled(reference, corners, np.zeros((len(corners), 2)))
    spectra = np.fft.fft2(_flat(tiles) * window)
    first = np.fft.fft2(_flat(_sampled(fresh, corners, np.zeros((len(corners), 2)))) * window)
    shifts = _whole_shift(spectra, first)
    for turn in range(_ROUNDS):
        moved = _sampled(fresh, corners, shifts)
        cross = np.fft.fft2(_flat(moved) * window) * np.conj(spectra)
        shifts = shifts + (_peak(cross) if turn == 0 else np.clip(_phase_slope(cross), -0.75, 0.75))
    moved = _flat(_sampled(fresh, corners, shifts))
    still = _flat(tiles)
    norm = np.sqrt((moved**2).sum(axis=(1, 2)) * (still**2).sum(axis=(1, 2)))
    alike = (moved * still).sum(axis=(1, 2)) / np.maximum(norm, 1e-12)
    return shifts, alike


def _whole_shift(before: NDArray[np.complex128], after: NDArray[np.complex128]) -> Floats:
    """(N, 2) the whole-pixel shift on which most tiles agree, by their summed correlation."""
    cross = after * np.conj(before)
    cross /= np.maximum(np.abs(cross), 1e-12)
    summed = np.fft.ifft2(cross).real.sum(axis=0, keepdims=True)
    return np.repeat(_top(summed), len(before), axis=0)


def _peak(cross: NDArray[np.complex128]) -> Floats:
    """(N, 2) whole-pixel shift of each tile by phase correlation, at most a few pixels."""
    whitened = cross / np.maximum(np.abs(cross), 1e-12)
    found = _top(np.fft.ifft2(whitened).real)
    return np.where(np.abs(found).max(axis=1, keepdims=True) <= 3, found, 0.0)


def _top(surfaces: Floats) -> Floats:
    place = surfaces.reshape(len(surfaces), -1).argmax(axis=1)
    rows, columns = np.unravel_index(place, surfaces.shape[1:])
    found = np.stack([columns, rows], axis=1).astype(np.float64)
    return np.where(found > _TILE / 2, found - _TILE, found)


def _phase_slope(cross: NDArray[np.complex128]) -> Floats:
    """(N, 2) the shift whose plane fits the phases, each weighted by its power."""
    f = np.fft.fftfreq(_TILE)
    fy, fx = np.meshgrid(f, f, indexing="ij")
    band = (np.hypot(fx, fy) <= _BAND) & (np.hypot(fx, fy) > 0)
    part = cross[:, band]
    weight = np.abs(part)
    phase = np.angle(part)
    x, y = -2 * np.pi * fx[band], -2 * np.pi * fy[band]
    xx, xy, yy = weight @ (x * x), weight @ (x * y), weight @ (y * y)
    bx, by = (weight * phase) @ x, (weight * phase) @ y
    det = np.maximum(xx * yy - xy * xy, 1e-30)
    return np.stack([(yy * bx - xy * by) / det, (xx * by - xy * bx) / det], axis=1)


def _sampled(picture: Floats, corners: Ints, shifts: Floats) -> Floats:
    """(N, T, T) tiles at shifted places, by cubic convolution (Keys 1981); edges repeat."""
    height, width = picture.shape
    whole = np.floor(shifts).astype(np.int64)
    reach = np.arange(-1, _TILE + 2)
    rows = np.clip((corners[:, 0] + whole[:, 1])[:, None] + reach, 0, height - 1)
    columns = np.clip((corners[:, 1] + whole[:, 0])[:, None] + reach, 0, width - 1)
    patches = picture[rows[:, :, None], columns[:, None, :]]
    wx, wy = (_cubic(part)[:, :, None, None] for part in (shifts - whole).T)
    across = np.zeros((len(corners), _TILE + 3, _TILE))
    for k in range(4):
        across += wx[:, k] * patches[:, :, k : k + _TILE]
    out = np.zeros((len(corners), _TILE, _TILE))
    for k in range(4):
        out += wy[:, k] * across[:, k : k + _TILE]
    return out


def _cubic(t: Floats) -> Floats:
    """(N, 4) weights of the samples at -1, 0, 1 and 2 for places (N,) between 0 and 1."""
    weights = (
        -0.5 * t + t * t - 0.5 * t**3,
        1.0 - 2.5 * t * t + 1.5 * t**3,
        0.5 * t + 2.0 * t * t - 1.5 * t**3,
        -0.5 * t * t + 0.5 * t**3,
    )
    return np.stack(weights, axis=1)


def _flat(tiles: Floats) -> Floats:
    """Tiles without their mean level."""
    return np.asarray(tiles - tiles.mean(axis=(1, 2), keepdims=True))


def _agreed(places: Floats, shifts: Floats, factor: int, tried: int) -> Motion:
    """The small similarity on which most tiles agree."""
    near = np.linalg.norm(shifts[:, None] - shifts[None], axis=2) <= 0.35
    seed = int(near.sum(axis=1).argmax())
    inside = near[seed]
    solved = np.zeros(4)
    sigma = 0.0
    for _ in range(5):
        if inside.sum() < _LEAST_TILES:
            return _unknown(tried)
        solved, cov = _similarity(places[inside], shifts[inside])
        away = np.linalg.norm(shifts - _displaced(places, solved), axis=1)
        scatter = 1.4826 * float(np.median(away[inside]))
        inside = away <= max(3 * scatter, 3 * _FLOOR_PX)
        sigma = float(np.hypot(np.sqrt(cov) * max(scatter, _FLOOR_PX), _COMMON_PX))
    x, y = factor * solved[0], factor * solved[1]
    return Motion(
        (float(x), float(y)), float(np.hypot(x, y)), float(np.degrees(solved[3]) * 1000.0),
        float(solved[2] * 1e6), factor * sigma, int(inside.sum()), tried,
    )  # fmt: skip


def _similarity(places: Floats, shifts: Floats) -> tuple[Floats, float]:
    """(tx, ty, growth, turn) by least squares, and the variance factor of the shift."""
    x, y = places[:, 0], places[:, 1]
    one, nil = np.ones_like(x), np.zeros_like(x)
    system = np.concatenate(
        [np.stack([one, nil, x, -y], axis=1), np.stack([nil, one, y, x], axis=1)]
    )
    wanted = np.concatenate([shifts[:, 0], shifts[:, 1]])
    solved = np.linalg.lstsq(system, wanted, rcond=None)[0]
    inverse = np.linalg.pinv(system.T @ system)
    return solved, float(inverse[0, 0] + inverse[1, 1]) / 2.0


def _displaced(places: Floats, solved: Floats) -> Floats:
    x, y = places[:, 0], places[:, 1]
    tx, ty, growth, turn = solved
    return np.stack([tx + growth * x - turn * y, ty + growth * y + turn * x], axis=1)


def _unknown(tried: int) -> Motion:
    nan = float("nan")
    return Motion((nan, nan), nan, nan, nan, nan, 0, tried)
