"""A frame whose mesh is known, as what other frames are matched against."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Floats32, Ints
from capture.camera import Camera
from track.pyramid import camera_at_level, image_pyramid
from track.reference import ReferenceLevel, reference_level, visible_samples
from track.surface_model import SurfaceModel


@dataclass(frozen=True, kw_only=True)
class ReferenceWindows:
    """How references are cut.

    Attributes:
        levels: of the pyramids.
        half: windows have 2 half + 1 px a side at the finest level.
        half_coarse: the same at the other levels.
        min_cosine: least cosine between normal and view of a sample that is used.
    """

    levels: int
    half: int
    half_coarse: int
    min_cosine: float


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceReference:
    """What each view showed of the surface in one frame.

    Attributes:
        frame: the frame; -1 for the neutral.
        views: the levels of each view, finest first, by device name.
        seen: (N,) how many views see each sample.
    """

    frame: int
    views: Mapping[str, tuple[ReferenceLevel, ...]]
    seen: Ints


def face_reference(
    surface: SurfaceModel,
    placed: tuple[int, Floats],
    cameras: Mapping[str, Camera],
    images: Mapping[str, Floats32],
    windows: ReferenceWindows,
    pool: ThreadPoolExecutor,
    only: Bools | None = None,
) -> FaceReference:
    """Build the reference that a frame makes.

    Args:
        surface: the tracked surface.
        placed: the frame's number (-1 the neutral) and its mesh (V, 3), world mm.
        cameras: of the views, by device name.
        images: the frame's images, float32 mono, of the views that have one.
        windows: how it is cut.
        pool: threads; the levels of a view are built side by side.
        only: (N,) which samples are wanted; None: all. A view that sees none of them is left out.
    """
    frame, vertices = placed
    skin = surface.skin(vertices)
    facing = surface.normals(vertices)
    points = surface.samples.points(skin)
    views: dict[str, tuple[ReferenceLevel, ...]] = {}
    seen = np.zeros(len(surface.samples), np.int64)
    for name, image in images.items():
        lenses = [camera_at_level(cameras[name], level) for level in range(windows.levels)]
        finest = surface.raster.render(lenses[0], skin)
        chosen = visible_samples(
            surface.samples, skin, facing, cameras[name], finest, windows.min_cosine
        )
        if only is not None:
            chosen = chosen[only[chosen]]
        if len(chosen) == 0 and only is not None:
            continue
        pieces = (surface.triangles, surface.samples.triangle[chosen], surface.rings)
        drawn = [finest, *(surface.raster.render(lens, skin) for lens in lenses[1:])]
        pixels = [lens.project(points[chosen]) for lens in lenses]
        halves = [windows.half] + [windows.half_coarse] * (windows.levels - 1)
        pyramid = image_pyramid(image, windows.levels)
        count = range(windows.levels)
        views[name] = tuple(
            pool.map(
                reference_level, lenses, pyramid, drawn, pixels, [chosen for _ in count],
                [pieces for _ in count], halves,
            )
        )  # fmt: skip
        seen[chosen] += 1
    return FaceReference(frame=frame, views=views, seen=seen)
