"""From the images of one instant to depth views: the rectified pairs of an array, each matched."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from capture.arrays import Bools, Floats, Floats32, Image
from capture.camera import CameraArray
from capture.errors import CameraError, SettingsError
from capture.settings import check_ranges
from recon.disparity import (
    DisparityMap,
    DisparitySettings,
    Reason,
    halve,
    match_pair,
    seed_near,
)
from recon.fusion import DepthView
from recon.images import clipped, mono
from recon.pairs import PairSettings, StereoPair, scene_centre, select_pairs
from recon.prior import PriorMesh, prior_disparity
from recon.rectify import (
    Rectification,
    coarser,
    rectification,
    rectified,
    spline_coefficients,
)

_SEARCH_PX = 240  # longest side of the crop in the wide search
_LEAST_FOUND = 30  # pixels at low resolution, fewer of which are no face
_PRIOR_GROWTH = 2  # rounds of growing from a prior, which covers what it knows
_PRIOR_STEPS = 4  # of the last round from a prior; more change nothing that fusion keeps
_MARGIN = 0.06  # of the found disparities and of the crop, added on each side


@dataclass(frozen=True, kw_only=True)
class StereoSettings:
    """Where depth is looked for, and how pairs are chosen and matched.

    Attributes:
        centre_mm: the place of the face, world; None takes the meeting point of the optical axes.
        depth_mm: depths searched, on either side of the centre.
        extent_mm: radius around the centre that is looked at.
        pairs: choice of pairs.
        matching: of each pair.
    """

    centre_mm: tuple[float, float, float] | None = None
    depth_mm: float = 180.0
    extent_mm: float = 240.0
    pairs: PairSettings = field(default_factory=PairSettings)
    matching: DisparitySettings = field(default_factory=DisparitySettings)

    def __post_init__(self) -> None:
        if self.centre_mm is not None and not np.isfinite(self.centre_mm).all():
            raise SettingsError(f"centre_mm: expected three finite numbers, found {self.centre_mm}")
        check_ranges("stereo", self, depth_mm=(1.0, 1e5), extent_mm=(1.0, 1e5))


@dataclass(frozen=True, eq=False)
class PairDepth:
    """What one pair saw.

    Attributes:
        pair: its cameras.
        view: geometry and disparity, cropped to what was found; None where nothing was.
        coverage: share of the searched crop that has a disparity.
        reasons: pixels by the name of `Reason`.
    """

    pair: StereoPair
    view: DepthView | None
    coverage: float
    reasons: Mapping[str, int]


class _Plane(NamedTuple):
    """An image (H, W) as views are drawn from it, and where it is clipped."""

    coefficients: Floats32
    clipped: Bools | None


class _Found(NamedTuple):
    """What a pair shows at low resolution: disparity (H, W), NaN unknown, and its range, px."""

    coarse: Floats32
    low: float
    high: float


def stereo_pairs(
    cameras: CameraArray, settings: StereoSettings
) -> tuple[Floats, tuple[StereoPair, ...]]:
    """The scene centre (3,), world mm, and the pairs to match.

    Raises:
        CameraError: when the axes meet nowhere or no two cameras can be paired.
    """
    centre = scene_centre(cameras) if settings.centre_mm is None else np.array(settings.centre_mm)
    pairs = select_pairs(cameras, centre, settings.pairs)
    if not pairs:
        raise CameraError(
            f"no two of the {len(cameras)} cameras see the face under angles up to "
            f"{settings.pairs.angle_last_deg:g} degrees of each other; add cameras between them"
        )
    return centre, pairs


def match_views(
    cameras: CameraArray,
    images: Mapping[str, Image],
    settings: StereoSettings,
    *,
    prior: PriorMesh | None = None,
    workers: int = 1,
) -> list[PairDepth]:
    """Match every pair of an array at one instant.

    Args:
        cameras: the cameras that have an image.
        images: by camera name, (H, W) or (H, W, 3), of any depth.
        settings: see there.
        prior: where the surface is expected; only near it is looked, which is quicker.
        workers: threads; the result does not depend on it.

    Returns:
        One entry a pair, in the order of `select_pairs`.

    Raises:
        CameraError: when no pair can be formed, or an image has another size than its camera.
    """
    centre, pairs = stereo_pairs(cameras, settings)
    geometries = [_geometry(cameras, pair, centre, settings) for pair in pairs]
    halvings = [_search_halvings(geometry) for geometry in geometries]
    used: dict[int, set[int]] = {}
    for pair, level in zip(pairs, halvings, strict=True):
        for index in (pair.left, pair.right):
            used.setdefault(index, {0}).update({level} if prior is None else ())
    with ThreadPoolExecutor(max_workers=max(workers, 1)) as pool:
        planes = pool.map(lambda index: _planes(cameras, images, index, used[index]), used)
        coefficients = dict(zip(used, planes, strict=True))

        def one(task: tuple[StereoPair, Rectification, int]) -> PairDepth:
            pair, geometry, level = task
            left, right = coefficients[pair.left], coefficients[pair.right]
            halved = coarser(geometry.left, level), coarser(geometry.right, level)
            small = rectification(*halved, centre, settings.extent_mm)
            if prior is None:
                found = _search(small, (left[level], right[level]), centre, settings)
            else:
                found = _expected(small, prior)
            if found is None:
                pixels = geometry.width * geometry.height
                return PairDepth(pair, None, 0.0, {Reason.NO_SEED.name: pixels})
            crop = _window(geometry, small, found.coarse)
            limits = (found.low * 2.0**level, found.high * 2.0**level)
            views = (rectified(crop, "left", *left[0]), rectified(crop, "right", *right[0]))
            if prior is None:
                result = match_pair(*views, limits, settings.matching)
            else:
                near = replace(settings.matching, growth=_PRIOR_GROWTH, iterations=_PRIOR_STEPS)
                result = match_pair(*views, limits, near, seeded=_seeder(crop, prior, near))
            return _packaged(pair, crop, result)

        return list(pool.map(one, zip(pairs, geometries, halvings, strict=True)))


def _geometry(
    cameras: CameraArray, pair: StereoPair, centre: Floats, settings: StereoSettings
) -> Rectification:
    return rectification(cameras[pair.left], cameras[pair.right], centre, settings.extent_mm)


def _search_halvings(geometry: Rectification) -> int:
    """Halvings after which a pair is small enough for the wide search."""
    longest = max(geometry.width, geometry.height)
    return max(int(np.ceil(np.log2(longest / _SEARCH_PX))), 0)


def _planes(
    cameras: CameraArray, images: Mapping[str, Image], index: int, wanted: Set[int]
) -> dict[int, _Plane]:
    """Spline coefficients of an image, by how often it was halved before.

    The wide search through halved images does without the mask: specks would grow in it.
    """
    camera = cameras[index]
    image = images[camera.name]
    grey = mono(image)
    if grey.shape != (camera.height, camera.width):
        raise CameraError(
            f"{camera.name}: the camera is {camera.width} x {camera.height} px, "
            f"its image {grey.shape[1]} x {grey.shape[0]}"
        )
    out = {}
    for level in range(max(wanted) + 1):
        grey = halve(grey) if level else grey
        if level in wanted:
            mask = None if level else clipped(image)
            out[level] = _Plane(spline_coefficients(grey), mask)
    return out


def _packaged(pair: StereoPair, crop: Rectification, result: DisparityMap) -> PairDepth:
    counts = np.bincount(result.reason.ravel(), minlength=len(Reason))
    reasons = {reason.name: int(counts[reason]) for reason in Reason}
    if counts[Reason.KEPT] == 0:
        return PairDepth(pair, None, 0.0, reasons)
    return PairDepth(
        pair, DepthView(crop, result.disparity, result.sigma_px), result.coverage, reasons
    )


def _search(
    small: Rectification,
    planes: tuple[_Plane, _Plane],
    centre: Floats,
    settings: StereoSettings,
) -> _Found | None:
    """Look through the whole depth range at low resolution; None where too little is found."""
    depth = float(small.rotation[2] @ (centre - small.left.centre))
    reach = min(settings.depth_mm, 0.8 * depth)
    far, near = small.disparity(np.array([depth + reach, depth - reach])).tolist()
    matching = replace(
        settings.matching, seed_px=4096, iterations=3, growth=1, fragment_px=40, edge_px=0
    )
    views = (rectified(small, "left", *planes[0]), rectified(small, "right", *planes[1]))
    coarse = match_pair(*views, (far, near), matching).disparity
    known = np.isfinite(coarse)
    if known.sum() < _LEAST_FOUND:
        return None
    low, high = np.percentile(coarse[known], [0.2, 99.8]).tolist()
    margin = _MARGIN * (near - far)
    low, high = max(low - margin, far), min(high + margin, near)
    coarse[~(known & (coarse >= low) & (coarse <= high))] = np.nan
    return _Found(coarse, low, high)


def _expected(small: Rectification, prior: PriorMesh) -> _Found | None:
    """As `_search`, from where a prior mesh is seen."""
    coarse = prior_disparity(small, prior.vertices, prior.triangles)
    known = coarse[np.isfinite(coarse)]
    if len(known) < _LEAST_FOUND:
        return None
    low, high = float(known.min()), float(known.max())
    return _Found(coarse, low - _reach_px(small, low, prior), high + _reach_px(small, high, prior))


def _seeder(
    crop: Rectification, prior: PriorMesh, settings: DisparitySettings
) -> Callable[[Floats32, Floats32, int], Floats32]:
    """Seeds of a pair from a prior mesh."""

    def seed(left: Floats32, right: Floats32, level: int) -> Floats32:
        expected = prior_disparity(crop, prior.vertices, prior.triangles, level)
        known = expected[np.isfinite(expected)]
        if len(known) == 0:
            return expected
        scale = 2.0**level
        reach = _reach_px(crop, float(known.max()) * scale, prior) / scale
        return seed_near(left, right, expected, max(reach, 1.0), settings.seed_block)

    return seed


def _reach_px(geometry: Rectification, disparity: float, prior: PriorMesh) -> float:
    """How far the disparity may lie from one that a prior mesh gives."""
    depth = float(geometry.depth(np.array(disparity)))
    near = float(geometry.disparity(np.array(max(depth - prior.reach_mm, 0.5 * depth))))
    return near - disparity


def _window(geometry: Rectification, small: Rectification, coarse: Floats32) -> Rectification:
    """The geometry cropped to what was found at a lower resolution, in both views."""
    scale = geometry.focal_px / small.focal_px
    rows, columns = np.nonzero(np.isfinite(coarse))
    landed = columns - coarse[rows, columns].astype(np.float64)
    pad = np.ceil(_MARGIN * max(small.width, small.height))
    left = scale * (columns - small.left_column) + geometry.left_column
    right = scale * (landed - small.right_column) + geometry.right_column
    down = scale * (rows - small.row) + geometry.row
    margin = scale * (pad + 1)
    x0, x1 = min(left.min(), right.min()) - margin, max(left.max(), right.max()) + margin
    y0, y1 = down.min() - margin, down.max() + margin
    size = [geometry.width, geometry.height, geometry.width, geometry.height]
    x0, y0, x1, y1 = np.clip(np.rint([x0, y0, x1, y1]), 0, size).astype(int)
    return geometry.cropped(int(x0), int(y0), int(x1 - x0), int(y1 - y0))
