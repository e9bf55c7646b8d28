"""Sparse features: SIFT of a frame matched to the reference where the mesh's motion expects it.

They find skin that moved farther than the flow searches. Matching and registration are iterated
(`feature_rounds`): strict descriptors in a wide region first, lenient ones in a narrow region last,
while the mesh is let go. Each keypoint of the reference is bound to the surface once. A match says
how far the surface is from where the mesh has it; the matches of one patch of skin, from all
views, are handed on as sightings of the patch's middle, so that views are triangulated together
although no two of them have the same keypoints.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np

from capture.arrays import Bools, Floats, Floats32, Ints, Ints32, check_shape
from capture.camera import Camera
from capture.errors import SettingsError
from capture.settings import check_ranges
from track.features_bind import at_vertices, bind_pixels, inner_skin, surface_patches
from track.features_detect import Keypoints, Region, Thresholds, detect, find_thresholds
from track.features_match import (
    STRETCH,
    Expected,
    MatchGates,
    agreeing,
    gathered,
    match_keypoints,
)
from track.pyramid import camera_at_level, image_pyramid
from track.raster import Rasterizer
from track.sightings import Sightings
from track.surface_samples import SurfaceSamples

_FULL_SKIN_PX = 300_000  # of skin, from which a view must have all the keypoints wanted
_BLOCK_PX = 8  # regions of search are drawn this coarsely
_FOLDED = 0.05  # share of its area that skin keeps in the frame below which it is turned away
_NOISE_PX = 0.3  # of a keypoint's place, px of the level,
_BLUR = 0.05  # and per px of its size
_SETTLED_PX = 1.0  # px of the level: rounds of registration with finer pixels do without features
_SLACK_PX = 1.5  # of the level: motions of matches beside each other may differ by it
_SLACK_MM = 0.5  # the same of patches
_PATCH_VOTES = (8, 2)
_MIN_VIEWS = 2
_SURE_MM = 2.0  # deviation of a patch's place that its views leave
_SCALE = 0.08  # of the region: what a patch that stretches leaves between its views


@dataclass(frozen=True, kw_only=True)
class FeatureSettings:
    """Settings of the sparse features.

    Attributes:
        keypoints: wanted in each view of the reference at its full size; thresholds are found for
            it. Views with fewer than 300000 px of skin have fewer, in proportion.
        min_cosine: least cosine between the skin's normal and the view.
        margin_px: keypoints of the reference keep this distance from silhouettes.
        neighbours: how many of the nearest matches a match is compared with.
        agreeing: how many of them must move like it.
    """

    keypoints: int = 10_000
    min_cosine: float = 0.3
    margin_px: int = 3
    neighbours: int = 10
    agreeing: int = 3

    def __post_init__(self) -> None:
        check_ranges(
            "features", self, keypoints=(100, 1_000_000), min_cosine=(0.05, 0.95),
            margin_px=(0, 50), neighbours=(1, 100), agreeing=(0, 100),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class FeatureRound:
    """One round of matching and registration.

    Attributes:
        level: pyramid level of the frame's keypoints, 0 the finest.
        radius_mm: of the region around the expected place.
        gates: what a match must pass.
        spacing_mm: between the patches that matches are gathered in.
        bending_mm: stiffness of the registration after it.
    """

    level: int
    radius_mm: float
    gates: MatchGates
    spacing_mm: float
    bending_mm: float

    def __post_init__(self) -> None:
        if self.level < 0 or not self.radius_mm > 0 or not self.spacing_mm > 0:
            raise SettingsError(
                "feature round: expected level >= 0, radius_mm > 0 and spacing_mm > 0, found "
                f"{self.level}, {self.radius_mm} and {self.spacing_mm}"
            )


def feature_rounds(
    level: int, radius_mm: float = 30.0, rounds: int = 2
) -> tuple[FeatureRound, ...]:
    """The rounds of a frame: the region shrinks, descriptors may differ more, the mesh is let go.

    Args:
        level: pyramid level of the frame's keypoints.
        radius_mm: how far skin may be from where the mesh has it at first.
        rounds: how many, at least 1.

    References:
        Ma et al. 2016, section 2.1. Their growing "regularization coefficient" is the lambda of
        their Eq. 1, a factor on the matches: the mesh is less and less stiff.
    """
    if rounds < 1:
        raise SettingsError(f"rounds: expected at least 1, found {rounds}")
    return tuple(
        FeatureRound(
            level=level,
            radius_mm=radius_mm * 0.4**k,
            gates=MatchGates(
                distance=min(0.53 + 0.03 * k, 0.6),
                ratio=0.85,
                octaves=0.8,
                turn=max(1 - 0.3 * k, 0.5),
            ),
            spacing_mm=max(6.0 - k, 3.0),
            bending_mm=max(8.0 - 2.0 * k, 3.0),
        )
        for k in range(rounds)
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class BoundKeypoints:
    """Keypoints of a view of the reference, and the skin that they lie on.

    Attributes:
        keypoints: M, in the view's full-size pixels.
        surface: the M points of the mesh.
        thresholds: that they were detected with; a frame's are detected with the same.
    """

    keypoints: Keypoints
    surface: SurfaceSamples
    thresholds: Thresholds


class FeatureReference:
    """Keypoints of the reference's views, bound to the mesh; found when they are first asked for.

    Args:
        vertices: (V, 3) the skin at the reference, world mm.
        triangles: (T, 3).
        cameras: of the views, full size, by name.
        images: the reference images, float32 mono, of the views that have one.
        settings: see `FeatureSettings`.
    """

    def __init__(
        self,
        vertices: Floats,
        triangles: Ints32,
        cameras: Mapping[str, Camera],
        images: Mapping[str, Floats32],
        settings: FeatureSettings | None = None,
    ) -> None:
        check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
        self.settings = settings or FeatureSettings()
        self.vertices, self.triangles = vertices, triangles
        self.cameras = {name: cameras[name] for name in images}
        self.pool = ThreadPoolExecutor(os.cpu_count() or 1)  # SIFT and the kernels free the GIL
        self._images = dict(images)
        self._raster = Rasterizer(triangles, len(vertices))
        self._bound: dict[int, dict[str, BoundKeypoints]] = {}
        self._patches: dict[float, tuple[Ints32, Ints]] = {}
        ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        self._edges = np.unique(np.sort(ends, axis=1), axis=0)

    def bound(self, level: int) -> Mapping[str, BoundKeypoints]:
        """The views' keypoints at a pyramid level, by name."""
        if level not in self._bound:
            made = list(self.pool.map(lambda name: self._bind(name, level), self.cameras))
            self._bound[level] = dict(zip(self.cameras, made, strict=True))
        return self._bound[level]

    def patches(self, spacing_mm: float) -> tuple[Ints32, Ints]:
        """Patches of the skin: centres (P,), vertex indices, and the patch (V,) of each vertex."""
        if spacing_mm not in self._patches:
            self._patches[spacing_mm] = surface_patches(self.vertices, self.triangles, spacing_mm)
        return self._patches[spacing_mm]

    def slopes(self, name: str, vertices: Floats) -> Floats:
        """Derivative (V, 2, 2) of the motion field of a view, least squares over each vertex' ring.

        Args:
            name: of the view.
            vertices: (V, 3) the mesh in the frame, world mm.
        """
        camera = self.cameras[name]
        first, second = self._edges.T
        before, after = (
            (pixels[second] - pixels[first])
            for pixels in (camera.project(self.vertices), camera.project(vertices))
        )
        both = (after[:, :, None] * before[:, None, :], before[:, :, None] * before[:, None, :])
        products = np.concatenate(both, axis=1).reshape(-1, 8)
        sums: Floats = np.stack(
            [
                np.bincount(self._edges.ravel(), np.repeat(column, 2), minlength=len(vertices))
                for column in products.T
            ],
            axis=1,
        )
        cross, own = sums[:, :4].reshape(-1, 2, 2), sums[:, 4:].reshape(-1, 2, 2)
        area = own[:, 0, 0] * own[:, 1, 1] - own[:, 0, 1] ** 2
        inverse = np.empty_like(own)
        inverse[:, 0, 0], inverse[:, 1, 1] = own[:, 1, 1], own[:, 0, 0]
        inverse[:, 0, 1] = inverse[:, 1, 0] = -own[:, 0, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes: Floats = cross @ (inverse / area[:, None, None])
        return slopes

    def _bind(self, name: str, level: int) -> BoundKeypoints:
        settings, mesh = self.settings, (self.vertices, self.triangles)
        camera = camera_at_level(self.cameras[name], level)
        image = image_pyramid(self._images[name], level + 1)[level]
        buffers = self._raster.render(camera, self.vertices)
        skin = inner_skin(camera, buffers, mesh, settings.min_cosine, settings.margin_px)
        share = min(1.0, int(skin.sum()) / _FULL_SKIN_PX)
        wanted = round(1.02 * settings.keypoints * share)  # some meet no triangle, at its rims
        thresholds, found = find_thresholds(image, skin, max(1, wanted))
        surface = bind_pixels(found.pixel, camera, buffers, mesh)
        hit = np.flatnonzero(surface.triangle >= 0).astype(np.int32)
        return BoundKeypoints(
            keypoints=found.select(hit).scaled(2.0**level),
            surface=surface.select(hit),
            thresholds=thresholds,
        )


def detect_features(
    reference: FeatureReference,
    images: Mapping[str, Floats32],
    vertices: Floats,
    round_: FeatureRound,
    wanted: Bools | None = None,
) -> dict[str, Keypoints]:
    """Detect a frame's keypoints where the mesh may be; once a frame and level.

    Args:
        reference: of the views.
        images: the frame's, float32 mono; views without a reference are not used.
        vertices: (V, 3) the mesh's estimate, world mm.
        round_: of it the level and the region count.
        wanted: (V,) vertices around which features are wanted; None: everywhere. The time goes
            with the area.

    Returns:
        Keypoints in full-size pixels, by view.
    """
    level = round_.level
    bound = reference.bound(level)

    def found(name: str) -> Keypoints:
        image = image_pyramid(images[name], level + 1)[level]
        surface = bound[name].surface
        own = surface if wanted is None else surface.select(_around(surface, wanted))
        camera = camera_at_level(reference.cameras[name], level)
        expected = camera.project(own.points(vertices))
        radius = round_.radius_mm * _px_per_mm(camera, own.points(vertices))
        region = _region(expected, float(np.nanmax(radius, initial=0.0)), image.shape)
        return detect(image, region, bound[name].thresholds).scaled(2.0**level)

    names = [name for name in reference.cameras if name in images]
    return dict(zip(names, reference.pool.map(found, names), strict=True))


def match_features(
    reference: FeatureReference,
    frame: Mapping[str, Keypoints],
    vertices: Floats,
    round_: FeatureRound,
) -> Sightings:
    """Match the reference's keypoints to a frame's around where the mesh puts them.

    Args:
        reference: of the views.
        frame: the frame's keypoints, by view, from `detect_features`.
        vertices: (V, 3) the mesh's estimate, world mm.
        round_: region, gates and patches.

    Returns:
        Sightings of the patches that were matched.
    """
    centres, patch = reference.patches(round_.spacing_mm)
    names = tuple(frame)
    middle = vertices[centres]

    def seen(name: str) -> tuple[Ints, Floats, Floats]:
        own, motion, precision = _matched(reference, name, frame[name], vertices, round_)
        camera = reference.cameras[name]
        slack = _SLACK_PX + STRETCH * round_.spacing_mm * float(_px_per_mm(camera, middle).mean())
        point, moved, weight = gathered(patch[own], motion, precision, slack)
        return point, camera.project(middle[point]) + moved, weight

    parts = list(reference.pool.map(seen, names))
    point = np.concatenate([np.zeros(0, np.int64), *(point for point, _, _ in parts)])
    pixel = np.concatenate([np.zeros((0, 2)), *(pixel for _, pixel, _ in parts)])
    weight = np.concatenate([np.zeros(0), *(weight for _, _, weight in parts)])
    sizes = [_px_per_mm(reference.cameras[name], middle).mean() for name in names]
    radius_px = round_.radius_mm * float(np.mean(sizes)) if sizes else 0.0
    everything = Sightings(
        surface=at_vertices(centres, reference.triangles),
        cameras=names,
        point=point.astype(np.int32),
        view=np.repeat(np.arange(len(names), dtype=np.int32), [len(part[0]) for part in parts]),
        pixel=pixel,
        information=np.column_stack([weight, np.zeros(len(weight)), weight]),
        scale_px=max(2.0**round_.level, _SCALE * radius_px),
        accuracy_px=_SETTLED_PX * 2.0**round_.level,
    )
    return _checked(everything, vertices, reference)


def _checked(sightings: Sightings, vertices: Floats, reference: FeatureReference) -> Sightings:
    """The sightings that views agree on, of patches that move as some of those around them do."""
    lifted = sightings.lifted(vertices, reference.cameras)
    told = lifted.information > _SURE_MM**-2.0
    kept = np.flatnonzero((lifted.views >= _MIN_VIEWS) & told)
    places = sightings.surface.points(reference.vertices)[kept]
    agreed = np.zeros(len(told), np.bool_)
    agreed[kept] = agreeing(places, lifted.motion[kept], _SLACK_MM, _PATCH_VOTES)
    return _only(sightings, agreed)


def _only(sightings: Sightings, kept: Bools) -> Sightings:
    """The sightings of some of the points (P,)."""
    own = kept[sightings.point]
    place = (np.cumsum(kept) - 1).astype(np.int32)
    return replace(
        sightings,
        surface=sightings.surface.select(np.flatnonzero(kept).astype(np.int32)),
        point=place[sightings.point[own]],
        view=sightings.view[own],
        pixel=sightings.pixel[own],
        information=sightings.information[own],
    )


def _matched(
    reference: FeatureReference,
    name: str,
    frame: Keypoints,
    vertices: Floats,
    round_: FeatureRound,
) -> tuple[Ints, Floats, Floats]:
    """One view's matches: the vertex nearest to each, how far it moved, px, and its precision."""
    bound, camera = reference.bound(round_.level)[name], reference.cameras[name]
    points = bound.surface.points(vertices)
    rows = np.arange(len(bound.surface))
    nearest = bound.surface.corners[rows, bound.surface.barycentric.argmax(axis=1)]
    slope = reference.slopes(name, vertices)[nearest]
    area = np.linalg.det(slope)
    seen = np.where(np.nan_to_num(area) > _FOLDED, area, np.nan)
    expected = Expected(
        pixel=np.where(np.isfinite(seen)[:, None], camera.project(points), np.nan),
        radius=round_.radius_mm * _px_per_mm(camera, points),
        size=bound.keypoints.size * np.sqrt(seen),
        angle=bound.keypoints.angle
        + np.arctan2(slope[:, 1, 0] - slope[:, 0, 1], slope[:, 0, 0] + slope[:, 1, 1]),
    )
    found = match_keypoints(bound.keypoints, expected, frame, round_.gates)
    own = np.flatnonzero(found >= 0)
    motion = frame.pixel[found[own]] - expected.pixel[own]
    settings = reference.settings
    voted = agreeing(
        bound.keypoints.pixel[own],
        motion,
        _SLACK_PX * 2.0**round_.level,
        (settings.neighbours, settings.agreeing),
    )
    own, motion = own[voted], motion[voted]
    deviation = _NOISE_PX * 2.0**round_.level + _BLUR * bound.keypoints.size[own]
    return nearest[own].astype(np.int64), motion, deviation**-2.0


def _px_per_mm(camera: Camera, points: Floats) -> Floats:
    """How many px a mm spans at points (N, 3); NaN behind the camera."""
    depths = camera.depths(points)
    size: Floats = camera.fx / np.where(depths > 0, depths, np.nan)
    return size


def _around(surface: SurfaceSamples, wanted: Bools) -> Ints32:
    """The points of a surface that touch wanted vertices (V,)."""
    return np.flatnonzero(wanted[surface.corners].any(axis=1)).astype(np.int32)


def _region(expected: Floats, radius: float, shape: tuple[int, ...]) -> Region:
    """The pixels (H, W) within about `radius` of any expected place."""
    height, width = shape
    rows, columns = -(-height // _BLOCK_PX), -(-width // _BLOCK_PX)
    blocks = np.zeros((rows, columns), np.uint8)
    place = np.floor(np.nan_to_num(expected, nan=-1.0) / _BLOCK_PX).astype(np.int64)
    inside = (place >= 0).all(axis=1) & (place[:, 0] < columns) & (place[:, 1] < rows)
    blocks[place[inside, 1], place[inside, 0]] = 1
    reach = 2 * (int(radius / _BLOCK_PX) + 1) + 1
    blocks = np.asarray(cv2.dilate(blocks, np.ones((reach, reach), np.uint8)), np.uint8)
    whole = blocks.repeat(_BLOCK_PX, axis=0).repeat(_BLOCK_PX, axis=1)
    return np.ascontiguousarray(whole[:height, :width])
