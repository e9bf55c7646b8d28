"""Disparity of one rectified pair: a semi-global seed at low resolution, refined level by level."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from capture.arrays import Bools, Floats32, check_shape
from capture.errors import SettingsError
from capture.settings import check_ranges
from recon.images import noise_sigma
from recon.refine import Refined, Refiner, grow, spline_rows, warp_rows

_SIGMA_WANTED_PX = 0.12  # typical deviation that windows are widened for
_GROW_NCC = 0.4  # correlation from which a refined pixel lends its disparity to its neighbours


class Reason(IntEnum):
    """Why a pixel has no disparity."""

    KEPT = 0
    OUTSIDE = 1  # not on both recorded images
    NO_SEED = 2  # no unique, left-right consistent match at low resolution
    NO_TEXTURE = 3  # contrast not above the noise
    LOW_CORRELATION = 4  # the windows do not look alike
    UNCERTAIN = 5  # predicted deviation too large
    LEFT_RIGHT = 6  # the right view's own match disagrees
    FRAGMENT = 7  # part of a patch too small to trust
    EDGE = 8  # on the border of the matched area, where windows reach beyond the surface
    HIGHLIGHT = 9  # too bright to tell how bright, here or where it lies in the right view


_RANGES: dict[str, tuple[float, float]] = {
    "seed_px": (64, 4096),
    "seed_block": (1, 21),
    "radius": (1, 20),
    "iterations": (1, 200),
    "smoothness": (0.0, 1e3),
    "ncc_min": (0.0, 0.99),
    "contrast_min": (0.0, 100.0),
    "sigma_max_px": (1e-3, 10.0),
    "growth": (1, 20),
    "growth_px": (0, 50),
    "left_right_px": (0.01, 100.0),
    "fragment_px": (0, 10**7),
    "edge_px": (0, 50),
    "jump_px": (0.0, 1e3),
}


@dataclass(frozen=True, kw_only=True)
class SeedShape:
    """What the seed takes the scene for; the defaults are skin: smooth, nowhere unique.

    Attributes:
        step_cost: of a disparity that changes by one between neighbours, OpenCV's P1 / block^2.
        jump_cost: of one that changes by more, P2 / block^2.
        uniqueness: by how many percent the best match must beat the second best.
        flat_px: deviation of the window in which views are normalised.
        flat_floor: least contrast that is normalised in full, of the white.
    """

    step_cost: int = 8
    jump_cost: int = 32
    uniqueness: int = 5
    flat_px: float = 6.0
    flat_floor: float = 0.0

    def __post_init__(self) -> None:
        check_ranges(
            "seed", self, step_cost=(1, 1000), jump_cost=(1, 1000), uniqueness=(0, 100),
            flat_px=(1.0, 100.0), flat_floor=(0.0, 1.0),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class DisparitySettings:
    """How a pair is matched.

    Attributes:
        seed_px: the seed is matched at the first halving at which the crop is at most this long.
        seed_block: block size of semi-global matching, odd, px.
        radius: of the refinement window, px; up to twice that where skin shows little.
        iterations: refinement steps of the last round at each level; earlier rounds take half.
        smoothness: weight of the smooth surface against a match known to 0.1 px.
        ncc_min: least correlation of the windows.
        contrast_min: least standard deviation in the window, in units of the noise.
        sigma_max_px: largest predicted deviation of the disparity.
        growth: rounds of refining and growing at the seed's level; one less at finer ones.
        growth_px: how far the known disparities grow before each round, px.
        left_right_px: largest disagreement with the right view's own disparity.
        fragment_px: patches smaller than this many pixels are dropped.
        edge_px: width of the border of the matched area that is dropped.
        seed: what the seed takes the scene for.
        jump_px: where the seed changes by more within a window there is a step between surfaces:
            a seed made at full resolution is kept there as it is; 0 looks for none.
    """

    seed_px: int = 480
    seed_block: int = 5
    radius: int = 3
    iterations: int = 5
    smoothness: float = 20.0
    ncc_min: float = 0.5
    contrast_min: float = 1.5
    sigma_max_px: float = 0.25
    growth: int = 3
    growth_px: int = 3
    left_right_px: float = 1.0
    fragment_px: int = 200
    edge_px: int = 2
    seed: SeedShape = field(default_factory=SeedShape)
    jump_px: float = 0.0

    def __post_init__(self) -> None:
        check_ranges("matching", self, **_RANGES)
        if self.seed_block % 2 == 0:
            raise SettingsError(f"seed_block: expected an odd number, found {self.seed_block}")


@dataclass(frozen=True, eq=False)
class DisparityMap:
    """Disparity of the left view of a rectified pair.

    Attributes:
        disparity: (H, W) float32 px; NaN where rejected.
        ncc: (H, W) float32 correlation of the windows; NaN where undefined.
        sigma_px: (H, W) float32 predicted deviation, px; NaN where undefined.
        reason: (H, W) uint8 of `Reason`; 0 where a disparity is kept.
    """

    disparity: Floats32
    ncc: Floats32
    sigma_px: Floats32
    reason: NDArray[np.uint8]

    @property
    def coverage(self) -> float:
        """Share of the crop that has a disparity."""
        return float(np.isfinite(self.disparity).mean())


def seed_disparity(
    left: Floats32,
    right: Floats32,
    limits_px: tuple[float, float],
    block: int,
    shape: SeedShape | None = None,
) -> Floats32:
    """Disparity by semi-global matching over a given range, left-right checked, unique.

    Args:
        left: (H, W); NaN off the image.
        right: (H, W); NaN off the image.
        limits_px: least and greatest disparity.
        block: block size, odd.
        shape: what the scene is like; None is skin.

    Returns:
        (H, W) float32 px; NaN where there is no unique, consistent match.

    References:
        Hirschmueller, Stereo processing by semiglobal matching and mutual information, PAMI 2008;
        OpenCV's StereoSGBM, MODE_HH (eight paths), on locally normalised 8-bit views.
    """
    check_shape(left=(left, "H W"), right=(right, "H W"))
    shape = shape or SeedShape()
    low = int(np.floor(limits_px[0])) - 1
    count = int(np.ceil((limits_px[1] + 1 - low) / 16.0)) * 16
    pad_left, pad_right = max(low + count, 0), max(-low, 0)
    views = [
        cv2.copyMakeBorder(
            _flat_8bit(v, shape), 0, 0, pad_left, pad_right, cv2.BORDER_CONSTANT, value=128
        )
        for v in (left, right)
    ]
    matcher = cv2.StereoSGBM.create(
        minDisparity=low,
        numDisparities=count,
        blockSize=block,
        P1=shape.step_cost * block * block,
        P2=shape.jump_cost * block * block,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=shape.uniqueness,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    raw = matcher.compute(views[0], views[1])[:, pad_left : pad_left + left.shape[1]]
    found = np.where(raw < low * 16, np.float32(np.nan), raw.astype(np.float32) / 16.0)
    found[np.isnan(left)] = np.nan
    return np.ascontiguousarray(found, dtype=np.float32)


def seed_near(
    left: Floats32, right: Floats32, expected: Floats32, reach_px: float, block: int
) -> Floats32:
    """Disparity by semi-global matching near an expected one, instead of over a whole range.

    The right view is drawn as the expectation predicts it, so that what is left to find is small
    and windows follow the surface expected.

    Args:
        left: (H, W); NaN off the image.
        right: (H, W); NaN off the image.
        expected: (H, W) disparity expected; NaN where nothing is, and nothing will be found.
        reach_px: how far from it the disparity may lie.
        block: block size, odd.

    Returns:
        (H, W) float32 px; NaN where there is no unique, consistent match.
    """
    check_shape(left=(left, "H W"), right=(right, "H W"), expected=(expected, "H W"))
    drawn = warp_rows(spline_rows(right), right, expected)
    offset = seed_disparity(left, drawn, (-reach_px, reach_px), block)
    # left(u) is like drawn(u - r), which is right(u - r - expected(u - r))
    columns = np.arange(left.shape[1], dtype=np.float32)[None] - offset
    known = np.isfinite(columns)
    whole = np.clip(np.where(known, np.rint(columns), 0), 0, left.shape[1] - 1).astype(np.int64)
    found: Floats32 = offset + np.take_along_axis(expected, whole, axis=1)
    return found


def match_pair(
    left: Floats32,
    right: Floats32,
    limits_px: tuple[float, float],
    settings: DisparitySettings,
    *,
    seeded: Callable[[Floats32, Floats32, int], Floats32] | None = None,
) -> DisparityMap:
    """Disparity of a rectified pair at full resolution.

    Args:
        left: (H, W) reference view; NaN off the image, inf where it is too bright to tell.
        right: (H, W) other view, likewise.
        limits_px: range of disparities searched by the seed.
        settings: see there.
        seeded: gives the seed (h, w) of the two views at so many halvings, where something better
            is known than the range; None searches the range.

    Returns:
        Disparity, its confidence, and a reason for each pixel that has none.
    """
    bright = (np.isposinf(left), np.isposinf(right))
    left, right = _without(left, bright[0]), _without(right, bright[1])
    levels = pyramid(left, right, settings.seed_px)
    factor = 2 ** (len(levels) - 1)
    if seeded is None:
        limits = (limits_px[0] / factor, limits_px[1] / factor)
        seed = seed_disparity(*levels[-1], limits, settings.seed_block, settings.seed)
    else:
        seed = seeded(*levels[-1], len(levels) - 1)
    refined = _climb(levels, seed, settings)
    if settings.jump_px > 0 and len(levels) == 1:
        refined = _stepped(seed, refined, settings)
    mirrored = _right_view(refined, settings)
    return _judge(left, bright, refined, mirrored, settings)


def _without(view: Floats32, mask: Bools) -> Floats32:
    return np.where(mask, np.float32(np.nan), view) if mask.any() else view


def pyramid(left: Floats32, right: Floats32, size_px: int) -> list[tuple[Floats32, Floats32]]:
    """Both views, halved until the longer side is at most `size_px`; full resolution first."""
    levels = [(left, right)]
    while max(levels[-1][0].shape) > size_px:
        levels.append((halve(levels[-1][0]), halve(levels[-1][1])))
    return levels


def _climb(
    levels: list[tuple[Floats32, Floats32]], seed: Floats32, settings: DisparitySettings
) -> Refined:
    """Refine the seed at its own level and at every finer one, growing it over slanted skin."""
    start = seed
    refined = Refined(seed, np.full_like(seed, np.nan), np.full_like(seed, np.nan))
    for index in range(len(levels) - 1, -1, -1):
        refiner = Refiner(*levels[index])
        radius = settings.radius
        rounds = settings.growth if index == len(levels) - 1 else settings.growth - 1
        for turn in range(max(rounds, 1)):
            refined = refiner.refine(
                grow(start, settings.growth_px),
                radius=radius,
                iterations=settings.iterations if turn == rounds - 1 else settings.iterations // 2,
                smoothness=settings.smoothness,
            )
            radius = _fitting_radius(refined, settings)
            start = np.where(refined.ncc > _GROW_NCC, refined.disparity, np.float32(np.nan))
        if index > 0:
            start = _double(start, levels[index - 1][0].shape)
    return refined


def _fitting_radius(refined: Refined, settings: DisparitySettings) -> int:
    """The window's radius for as much certainty as can be had: wider on skin that shows little."""
    found = refined.sigma_px[refined.ncc > _GROW_NCC]
    if len(found) == 0:
        return settings.radius
    wider = settings.radius * float(np.nanmedian(found)) / _SIGMA_WANTED_PX
    return int(np.clip(round(wider), settings.radius, 2 * settings.radius))


def _stepped(seed: Floats32, refined: Refined, settings: DisparitySettings) -> Refined:
    """The refined map where the seed is smooth and they agree, the seed itself elsewhere."""
    size = 2 * settings.radius + 3
    lowest = np.where(np.isfinite(seed), seed, np.float32(-1e6))
    window = np.ones((size, size), np.uint8)
    smooth = cv2.dilate(lowest, window) - cv2.erode(lowest, window) < settings.jump_px
    smooth &= np.abs(refined.disparity - seed) < 1.0
    smooth &= (refined.ncc > settings.ncc_min) & (refined.sigma_px < settings.sigma_max_px)
    return Refined(
        np.where(smooth, refined.disparity, seed),
        np.where(smooth, refined.ncc, np.float32(settings.ncc_min)),
        np.where(smooth, refined.sigma_px, np.float32(settings.sigma_max_px)),
    )


def _right_view(refined: Refined, settings: DisparitySettings) -> Floats32:
    """The disparity seen by the right view: the nearest surface landing on each pixel."""
    good = refined.ncc > settings.ncc_min
    return _nearest_landing(refined.disparity, good)  # type: ignore[no-any-return]


@numba.njit(cache=True, nogil=True)
def _nearest_landing(disparity: Floats32, good: Bools) -> Floats32:  # pragma: no cover - compiled
    """The greatest disparity landing on each right pixel; -inf where none does."""
    height, width = disparity.shape
    out = np.full((height, width), np.float32(-np.inf))
    for i in range(height):
        for j in range(width):
            d = disparity[i, j]
            if not good[i, j] or np.isnan(d):
                continue
            target = int(np.rint(j - d))
            if 0 <= target < width and d > out[i, target]:
                out[i, target] = d
    return out


def _judge(
    left: Floats32,
    bright: tuple[Bools, Bools],
    refined: Refined,
    mirrored: Floats32,
    settings: DisparitySettings,
) -> DisparityMap:
    """Give every pixel its reason, the first test that it fails."""
    disparity = refined.disparity
    reason = np.zeros(disparity.shape, np.uint8)

    def fail(where: Bools, why: Reason) -> None:
        reason[(reason == 0) & where] = why

    noise = max(noise_sigma(np.nan_to_num(left)), 1e-5)
    columns = np.arange(disparity.shape[1], dtype=np.float32)[None] - disparity
    target = np.clip(np.nan_to_num(np.rint(columns)), 0, disparity.shape[1] - 1).astype(np.int64)
    fail(np.isnan(left) & ~bright[0], Reason.OUTSIDE)
    highlight = bright[0] | np.take_along_axis(bright[1], target, axis=1) & np.isfinite(disparity)
    failed = np.isnan(disparity) | ~(refined.ncc >= settings.ncc_min)
    fail(highlight & failed, Reason.HIGHLIGHT)
    fail(np.isnan(disparity), Reason.NO_SEED)
    fail(_local_deviation(left, settings.radius) < settings.contrast_min * noise, Reason.NO_TEXTURE)
    fail(~(refined.ncc >= settings.ncc_min), Reason.LOW_CORRELATION)
    fail(~(refined.sigma_px <= settings.sigma_max_px), Reason.UNCERTAIN)
    seen = np.take_along_axis(mirrored, target, axis=1)
    fail(seen - disparity > settings.left_right_px, Reason.LEFT_RIGHT)
    kept = np.where(reason == 0, disparity, np.float32(np.nan))
    fail(_fragments(kept, settings.fragment_px), Reason.FRAGMENT)
    size = 2 * settings.edge_px + 1
    inner = cv2.erode((reason == 0).astype(np.uint8), np.ones((size, size), np.uint8))
    fail(inner == 0, Reason.EDGE)
    kept = np.where(reason == 0, disparity, np.float32(np.nan))
    return DisparityMap(kept, refined.ncc, refined.sigma_px, reason)


def _fragments(disparity: Floats32, size_px: int) -> Bools:
    """Pixels of connected patches, cut at jumps of two pixels, that are smaller than `size_px`."""
    known = np.isfinite(disparity)
    if not known.any() or size_px == 0:
        return np.zeros(disparity.shape, np.bool_)
    low = float(np.nanmin(disparity))
    fixed = np.where(known, np.clip((disparity - low) * 16 + 16, 0, 32000), 0).astype(np.int16)
    cv2.filterSpeckles(fixed, 0, size_px, 32)
    gone: Bools = known & (fixed == 0)
    return gone


def _flat_8bit(image: Floats32, shape: SeedShape) -> NDArray[np.uint8]:
    """Locally normalised 8-bit view: mean 128, a local deviation is 42 grey levels; NaN is 128."""
    known = np.isfinite(image)
    filled = np.where(known, image, np.float32(0.0))
    share = cv2.GaussianBlur(known.astype(np.float32), (0, 0), shape.flat_px) + np.float32(1e-6)
    mean = cv2.GaussianBlur(filled, (0, 0), shape.flat_px) / share
    centred = np.where(known, image - mean, np.float32(0.0))
    spread = np.sqrt(cv2.GaussianBlur(centred * centred, (0, 0), shape.flat_px) / share)
    floor = max(3.0 * max(noise_sigma(filled), 1e-4), shape.flat_floor)
    flat = 128.0 + 42.0 * centred / np.sqrt(spread * spread + np.float32(floor * floor))
    return np.clip(np.rint(flat), 0, 255).astype(np.uint8)


def _local_deviation(image: Floats32, radius: int) -> Floats32:
    """Standard deviation (H, W) in square windows, NaN pixels left out."""
    known = np.isfinite(image)
    level = np.float32(image[known].mean()) if known.any() else np.float32(0.0)
    filled = np.where(known, image - level, np.float32(0.0))
    size = (2 * radius + 1, 2 * radius + 1)
    share = np.maximum(cv2.boxFilter(known.astype(np.float32), cv2.CV_32F, size), 1e-6)
    mean = cv2.boxFilter(filled, cv2.CV_32F, size) / share
    square = cv2.boxFilter(filled * filled, cv2.CV_32F, size) / share
    deviation: Floats32 = np.sqrt(np.maximum(square - mean * mean, 0)).astype(np.float32)
    return deviation


def halve(image: Floats32) -> Floats32:
    """An image (H, W) at half resolution by the mean of 2 x 2; NaN where any of the four is."""
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    even = image[:height, :width]
    quarter = (even[0::2, 0::2] + even[0::2, 1::2] + even[1::2, 0::2] + even[1::2, 1::2]) * 0.25
    return np.ascontiguousarray(quarter, dtype=np.float32)


def _double(disparity: Floats32, shape: tuple[int, ...]) -> Floats32:
    """Twice the resolution and twice the values; NaN where the nearest coarse pixel is."""
    known = np.isfinite(disparity)
    size = (2 * disparity.shape[1], 2 * disparity.shape[0])
    filled = np.where(known, disparity, np.float32(0.0))
    value = cv2.resize(filled, size, interpolation=cv2.INTER_LINEAR)
    share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    fine = np.where(share > 0.5, 2.0 * value / np.maximum(share, 1e-6), np.float32(np.nan))
    out = np.full(shape, np.float32(np.nan))
    height, width = min(shape[0], size[1]), min(shape[1], size[0])
    out[:height, :width] = fine[:height, :width]
    return out
