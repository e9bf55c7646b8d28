"""From the images of one instant to depth views: the rectified pairs of an array, each matched."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from capture.arrays import Floats, Floats32, Image
from capture.camera import CameraArray
from capture.errors import CameraError, SettingsError
from recon.disparity import DisparityMap, DisparitySettings, Reason, match_pair, pyramid
from recon.fusion import DepthView
from recon.images import mono
from recon.pairs import PairSettings, StereoPair, scene_centre, select_pairs
from recon.rectify import Rectification, rectification, resample, spline_coefficients

_SEARCH_PX = 240  # longest side of the crop in the wide search
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
        for name in ("depth_mm", "extent_mm"):
            if not 1.0 <= getattr(self, name) <= 1e5:
                raise SettingsError(f"{name}: expected 1..100000, found {getattr(self, name)}")


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
    workers: int = 1,
) -> list[PairDepth]:
    """Match every pair of an array at one instant.

    Args:
        cameras: the cameras that have an image.
        images: by camera name, (H, W) or (H, W, 3), of any depth.
        settings: see there.
        workers: threads; the result does not depend on it.

    Returns:
        One entry a pair, in the order of `select_pairs`.

    Raises:
        CameraError: when no pair can be formed, or an image has another size than its camera.
    """
    centre, pairs = stereo_pairs(cameras, settings)
    used = sorted({index for pair in pairs for index in (pair.left, pair.right)})
    with ThreadPoolExecutor(max_workers=max(workers, 1)) as pool:
        planes = pool.map(lambda index: _plane(cameras, images, index), used)
        coefficients = dict(zip(used, planes, strict=True))

        def one(pair: StereoPair) -> PairDepth:
            return _match(cameras, coefficients, pair, centre, settings)

        return list(pool.map(one, pairs))


def _plane(cameras: CameraArray, images: Mapping[str, Image], index: int) -> Floats32:
    camera = cameras[index]
    grey = mono(images[camera.name])
    if grey.shape != (camera.height, camera.width):
        raise CameraError(
            f"{camera.name}: the camera is {camera.width} x {camera.height} px, "
            f"its image {grey.shape[1]} x {grey.shape[0]}"
        )
    return spline_coefficients(grey)


def _match(
    cameras: CameraArray,
    coefficients: Mapping[int, Floats32],
    pair: StereoPair,
    centre: Floats,
    settings: StereoSettings,
) -> PairDepth:
    """Search wide at low resolution, crop to what was found, match the crop."""
    geometry = rectification(cameras[pair.left], cameras[pair.right], centre, settings.extent_mm)
    views = (coefficients[pair.left], coefficients[pair.right])
    wide = _rectified(geometry, *views)
    depth = float(geometry.rotation[2] @ (centre - geometry.left.centre))
    reach = min(settings.depth_mm, 0.8 * depth)
    low, high = geometry.disparity(np.array([depth + reach, depth - reach])).tolist()
    found = _search(wide, (low, high), settings)
    if found is None:
        return PairDepth(pair, None, 0.0, {Reason.NO_SEED.name: int(wide[0].size)})
    column, row, width, height, limits = found
    crop = geometry.cropped(column, row, width, height)
    left, right = (view[row : row + height, column : column + width] for view in wide)
    result = match_pair(
        np.ascontiguousarray(left), np.ascontiguousarray(right), limits, settings.matching
    )
    return _packaged(pair, crop, result)


def _packaged(pair: StereoPair, crop: Rectification, result: DisparityMap) -> PairDepth:
    counts = np.bincount(result.reason.ravel(), minlength=len(Reason))
    reasons = {reason.name: int(counts[reason]) for reason in Reason}
    if counts[Reason.KEPT] == 0:
        return PairDepth(pair, None, 0.0, reasons)
    return PairDepth(
        pair, DepthView(crop, result.disparity, result.sigma_px), result.coverage, reasons
    )


def _rectified(
    geometry: Rectification, left: Floats32, right: Floats32
) -> tuple[Floats32, Floats32]:
    views = []
    for side, coefficients in (("left", left), ("right", right)):
        values, inside = resample(coefficients, *geometry.maps(side))
        values[~inside] = np.nan
        views.append(values)
    return views[0], views[1]


def _search(
    wide: tuple[Floats32, Floats32], limits: tuple[float, float], settings: StereoSettings
) -> tuple[int, int, int, int, tuple[float, float]] | None:
    """Window (column, row, width, height) in both views, and the disparities found there."""
    levels = pyramid(*wide, _SEARCH_PX)
    factor = 2 ** (len(levels) - 1)
    small = (limits[0] / factor, limits[1] / factor)
    matching = replace(
        settings.matching, seed_px=_SEARCH_PX, iterations=3, growth=1, fragment_px=40, edge_px=0
    )
    coarse = match_pair(*levels[-1], small, matching).disparity
    known = np.isfinite(coarse)
    if known.sum() < 30:
        return None
    values = coarse[known]
    low, high = np.percentile(values, [0.2, 99.8]).tolist()
    margin = _MARGIN * (small[1] - small[0])
    low, high = max(low - margin, small[0]), min(high + margin, small[1])
    rows, columns = np.nonzero(known & (coarse >= low) & (coarse <= high))
    pad = int(np.ceil(_MARGIN * max(coarse.shape)))
    landed = columns - coarse[rows, columns]
    box = np.array(
        [
            min(columns.min(), landed.min()) - pad,
            rows.min() - pad,
            max(columns.max(), landed.max()) + pad + 1,
            rows.max() + pad + 1,
        ]
    )
    height, width = wide[0].shape
    x0, y0, x1, y1 = np.clip(np.rint(box * factor), 0, [width, height, width, height]).astype(int)
    return int(x0), int(y0), int(x1 - x0), int(y1 - y0), (low * factor, high * factor)
