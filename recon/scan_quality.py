"""Which device is to blame: what each camera of a scan says about itself, in numbers and words.

All is measured on the skin that was found: the points that pairs agree on are looked up in every
view that matched them, so that two devices are compared where they see the same pore.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from capture.arrays import Bools, Floats, Floats32, Image
from capture.camera import Camera, CameraArray
from recon.disparity import Reason
from recon.fusion import Points
from recon.images import NEAR_WHITE, bilinear, brightest, mono, white
from recon.row_offset import row_offset
from recon.stereo import PairDepth

_SAMPLES = 15_000  # points looked up, about
_SAME_PX = 2.5  # a pair farther than this from the consensus sees another surface there
_STRAYS = 1000  # matched pixels of a pair that are looked for in the scan, about
_CONFIRMED = 2.5  # spacings of points within which a matched pixel lies on the scan
_LEAST = 50  # points that a pair must share with the consensus to be counted
_FINE, _MIDDLE, _COARSE = 0.8, 1.6, 4.0  # px, scales between which sharpness is measured
_PLATEAU = 0.005  # share of the skin at its brightest value from which that is a limit
_CELLS = 56  # of the longer side of what a view sees of the skin
_TEXTURELESS = (Reason.OUTSIDE, Reason.NO_TEXTURE, Reason.HIGHLIGHT)
_CLOSE = 12  # holes in the skin up to a twelfth of the view are skin


@dataclass(frozen=True, kw_only=True)
class CameraQuality:
    """One camera in one scan; NaN where it shares too little with others to tell.

    Attributes:
        name: of the device.
        pairs: how many it is in.
        matched_share: of the textured pixels of its pairs, those matched.
        unconfirmed_share: of those matched, the ones with no surface of the scan near them.
        covered_share: of the skin it sees, that of which its pairs measured something.
        neighbours_share: the same of its partners' pairs with others.
        deviation_px: of its pairs from the consensus of all, along the rows and across them, median
            of their medians.
        deviation_mm: the part along the rows as depth.
        sharpness: of fine against coarse detail on the same skin, the middle camera's being 1.
        clipped_share: of the skin, at the greatest value the image holds.
        gain: brightness of the same skin, the middle camera's being 1.
    """

    name: str
    pairs: int
    matched_share: float
    neighbours_share: float
    unconfirmed_share: float
    covered_share: float
    deviation_px: float
    deviation_mm: float
    sharpness: float
    clipped_share: float
    gain: float


def camera_qualities(
    cameras: CameraArray,
    images: Mapping[str, Image],
    pairs: Sequence[PairDepth],
    points: Points,
) -> list[CameraQuality]:
    """Measure every camera of a scan against the others.

    Args:
        cameras: those that have an image, in the order the pairs count them.
        images: by camera name, of any depth.
        pairs: what each pair saw.
        points: what they agree on.
    """
    step = max(1, len(points) // _SAMPLES)
    world = points.positions[::step].astype(np.float64)
    planes = [_smoothed(images[camera.name]) for camera in cameras]
    shared = [_shared(pair, world, planes) for pair in pairs]
    seen = _seen_by(len(cameras), pairs, [entry.same for entry in shared])
    views = [
        _look(camera, images[camera.name], world, mask)
        for camera, mask in zip(cameras, seen, strict=True)
    ]
    stray = _unconfirmed(pairs, points)
    both = list(zip(pairs, shared, strict=True))
    gains = _balanced(pairs, [_brightness(pair, entry, views) for pair, entry in both], len(views))
    focus = _balanced(pairs, [_detail(pair, entry, views) for pair, entry in both], len(views))
    out = []
    for index, camera in enumerate(cameras):
        own = [k for k, pair in enumerate(pairs) if index in (pair.pair.left, pair.pair.right)]
        out.append(
            CameraQuality(
                name=camera.name,
                pairs=len(own),
                matched_share=matched_share([pairs[k] for k in own]),
                neighbours_share=_neighbours_share(index, pairs),
                unconfirmed_share=_median([stray[k] for k in own]),
                covered_share=views[index].covered,
                deviation_px=_median([shared[k].deviation_px for k in own]),
                deviation_mm=_median([abs(shared[k].offset_px) * shared[k].mm_per_px for k in own]),
                sharpness=float(np.exp(focus[index])),
                clipped_share=views[index].clipped,
                gain=float(np.exp(gains[index])),
            )
        )
    return out


@dataclass(frozen=True, eq=False)
class _Shared:
    """A pair at the sampled points: where it sees the same surface, and how far off it is."""

    same: Bools  # (N,)
    offset_px: float  # along the rows
    row_px: float  # across them
    mm_per_px: float

    @property
    def deviation_px(self) -> float:
        """How far off it is, in any direction."""
        return float(np.hypot(self.offset_px, np.nan_to_num(self.row_px)))


@dataclass(frozen=True, eq=False)
class _View:
    """A camera at the sampled points."""

    level: Floats  # (N,) brightness, NaN where the point is not seen
    fine: Floats  # (N,) detail of the finest scale
    coarse: Floats  # (N,) detail a few times coarser
    clipped: float
    covered: float


def _shared(pair: PairDepth, world: Floats, planes: Sequence[Floats32]) -> _Shared:
    nothing = _Shared(np.zeros(len(world), np.bool_), np.nan, np.nan, np.nan)
    if pair.view is None:
        return nothing
    geometry = pair.view.geometry
    local = (world - geometry.left.centre) @ geometry.rotation.T
    front = np.where(local[:, 2:] > 1.0, local, np.nan)
    column = front[:, 0] / front[:, 2] * geometry.focal_px + geometry.left_column
    row = front[:, 1] / front[:, 2] * geometry.focal_px + geometry.row
    found = bilinear(pair.view.disparity, column, row)
    offset = found - geometry.disparity(front[:, 2])
    same = np.abs(offset) < _SAME_PX
    if same.sum() < _LEAST:
        return nothing
    depth = float(np.median(front[same, 2]))
    mm_per_px = depth * depth / (geometry.focal_px * geometry.baseline_mm)
    row_px = row_offset(pair.view, planes[pair.pair.left], planes[pair.pair.right])
    return _Shared(same, float(np.median(offset[same])), row_px, mm_per_px)


def _smoothed(image: Image) -> Floats32:
    return np.asarray(cv2.GaussianBlur(mono(image), (0, 0), _FINE), dtype=np.float32)


def _seen_by(count: int, pairs: Sequence[PairDepth], same: Sequence[Bools]) -> list[Bools]:
    """Which points (N,) each camera shares with any pair."""
    size = len(same[0]) if same else 0
    seen = [np.zeros(size, np.bool_) for _ in range(count)]
    for pair, mask in zip(pairs, same, strict=True):
        seen[pair.pair.left] |= mask
        seen[pair.pair.right] |= mask
    return seen


def _look(camera: Camera, image: Image, world: Floats, seen: Bools) -> _View:
    """Brightness and detail of the points in one view."""
    pixels = np.full((len(world), 2), np.nan)
    pixels[seen] = camera.project(world[seen])
    pixels[~camera.contains(pixels)] = np.nan
    known = np.isfinite(pixels[:, 0])
    if known.sum() < _LEAST:
        nan = np.full(len(world), np.nan)
        return _View(nan, nan, nan, 0.0, 0.0)
    low = np.maximum(np.floor(np.nanmin(pixels, axis=0)).astype(int) - 16, 0)
    high = np.ceil(np.nanmax(pixels, axis=0)).astype(int) + 17
    part = image[low[1] : high[1], low[0] : high[0]]
    grey = mono(part)
    blurred = [cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (_FINE, _MIDDLE, _COARSE)]
    at = (pixels[:, 0] - low[0], pixels[:, 1] - low[1])
    clipped, covered = _skin_shares(part, pixels[known] - low)
    return _View(
        level=bilinear(blurred[1], *at),
        fine=bilinear(blurred[0] - blurred[1], *at),
        coarse=bilinear(blurred[1] - blurred[2], *at),
        clipped=clipped,
        covered=covered,
    )


def _skin_shares(part: Image, pixels: Floats) -> tuple[float, float]:
    """Of the skin around the points (N, 2), the share at the greatest value, and the share hit."""
    top = brightest(part)
    height, width = top.shape
    step = max(3, max(height, width) // _CELLS)
    mask = np.zeros((height // step + 1, width // step + 1), np.uint8)
    column, row = np.rint(pixels / step).astype(int).T
    mask[np.minimum(row, mask.shape[0] - 1), np.minimum(column, mask.shape[1] - 1)] = 1
    size = max(mask.shape) // _CLOSE * 2 + 1
    round_ = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    skin = cv2.morphologyEx(np.pad(mask, size), cv2.MORPH_CLOSE, round_)[size:-size, size:-size]
    whole = np.kron(skin, np.ones((step, step), np.uint8))[:height, :width] > 0
    values = top[whole]
    plateau = float((values == values.max()).mean())
    at_white = float((values >= NEAR_WHITE * white(top)).mean())
    covered = float(mask.sum() / max(int(skin.sum()), 1))
    return max(at_white, plateau if plateau > _PLATEAU else 0.0), covered


def _brightness(pair: PairDepth, shared: _Shared, views: Sequence[_View]) -> float:
    """Logarithm of how much brighter the left view is, on the same skin."""
    left, right = views[pair.pair.left].level, views[pair.pair.right].level
    good = shared.same & (left > 1e-4) & (right > 1e-4)
    if good.sum() < _LEAST:
        return float("nan")
    return float(np.median(np.log(left[good] / right[good])))


def _detail(pair: PairDepth, shared: _Shared, views: Sequence[_View]) -> float:
    """Logarithm of how much sharper the left view is, on the same skin."""
    left, right = views[pair.pair.left], views[pair.pair.right]
    good = shared.same & np.isfinite(left.fine) & np.isfinite(right.fine)
    if good.sum() < _LEAST:
        return float("nan")
    ratios = [_typical(view.fine[good]) / _typical(view.coarse[good]) for view in (left, right)]
    return float(np.log(ratios[0] / ratios[1]))


def _typical(values: Floats) -> float:
    return float(np.median(np.abs(values))) + 1e-9


def _balanced(pairs: Sequence[PairDepth], differences: Sequence[float], count: int) -> Floats:
    """A value a camera (C,) from differences (left minus right) of pairs, the middle one 0.

    Least absolute differences by reweighted least squares, so that one bad pair does not bend the
    others; NaN for a camera of no known pair.
    """
    known = [k for k, value in enumerate(differences) if np.isfinite(value)]
    out = np.full(count, np.nan)
    if not known:
        return out
    system = np.zeros((len(known), count))
    target = np.array([differences[k] for k in known])
    for row, k in enumerate(known):
        system[row, pairs[k].pair.left], system[row, pairs[k].pair.right] = 1.0, -1.0
    used = np.abs(system).sum(axis=0) > 0
    weight = np.ones(len(known))
    solved = np.zeros(count)
    for _ in range(20):
        rows = np.concatenate([system * weight[:, None], 1e-6 * np.eye(count)])
        solved = np.linalg.lstsq(rows, np.concatenate([target * weight, np.zeros(count)]))[0]
        weight = 1.0 / np.sqrt(np.maximum(np.abs(system @ solved - target), 1e-3))
    out[used] = solved[used] - np.median(solved[used])
    return out


def matched_share(pairs: Sequence[PairDepth]) -> float:
    """Of the pixels of all pairs that show texture, the share that was matched; NaN of none."""
    counts = {reason: sum(pair.reasons.get(reason.name, 0) for pair in pairs) for reason in Reason}
    textured = sum(counts.values()) - sum(counts[reason] for reason in _TEXTURELESS)
    return counts[Reason.KEPT] / textured if textured else float("nan")


def _neighbours_share(index: int, pairs: Sequence[PairDepth]) -> float:
    """Matched share of the pairs that a camera's partners form with others."""
    ends = [{pair.pair.left, pair.pair.right} for pair in pairs]
    partners = set().union(*(end for end in ends if index in end)) - {index}
    return matched_share(
        [pair for pair, end in zip(pairs, ends, strict=True) if index not in end and end & partners]
    )


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else float("nan")


def _unconfirmed(pairs: Sequence[PairDepth], points: Points) -> list[float]:
    """Of each pair's matched pixels, the share with no point of the scan within a few spacings."""
    tree = cKDTree(points.positions[::2], balanced_tree=False, compact_nodes=False)
    reach = _CONFIRMED * points.spacing_mm
    out = []
    for pair in pairs:
        if pair.view is None:
            out.append(float("nan"))
            continue
        stride = max(1, int(np.sqrt(pair.view.disparity.size / (2 * _STRAYS))))
        rows, columns = np.nonzero(np.isfinite(pair.view.disparity[::stride, ::stride]))
        rows, columns = rows * stride, columns * stride
        values = pair.view.disparity[rows, columns].astype(np.float64)
        world = pair.view.geometry.triangulate(np.stack([columns, rows, values], axis=1))
        away = np.asarray(tree.query(world, distance_upper_bound=reach)[0])
        out.append(float(np.isinf(away).mean()))
    return out
