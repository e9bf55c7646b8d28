"""Points of the surface and the pixels where the views of one frame show them.

Landmarks, sparse features, pins and curves all come to this: a place on the mesh and where it is
seen. Registration triangulates them like the flow of its own samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, Ints32, check_shape
from capture.camera import Camera
from track.laplacian import Constraints
from track.lift import Lifted, Observations, merged, triangulate
from track.surface_samples import SurfaceSamples

_PRIOR_MM = 30.0  # how far a sighting may carry the surface; not at all along one view


@dataclass(frozen=True, eq=False, kw_only=True)
class Sightings:
    """P points of the surface, seen L times in the views of one frame.

    Attributes:
        surface: the P points.
        cameras: names of the views.
        point: (L,) int32 which of the P points is seen.
        view: (L,) int32 by which of the cameras.
        pixel: (L, 2) where, px of the full image, integers at pixel centres.
        information: (L, 3) xx, xy, yy of the inverse covariance of the pixel, px^-2; a curve's
            sighting has none along the curve.
        scale_px: the residual at which a sighting has lost three quarters of its weight.
        accuracy_px: rounds of registration whose pixels are finer than this do without; 0: all use
            them.
        weight: of a point against a good sample of the flow.
    """

    surface: SurfaceSamples
    cameras: tuple[str, ...]
    point: Ints32
    view: Ints32
    pixel: Floats
    information: Floats
    scale_px: float
    accuracy_px: float
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_shape(
            point=(self.point, "L"),
            view=(self.view, "L"),
            pixel=(self.pixel, "L 2"),
            information=(self.information, "L 3"),
        )

    def lifted(self, vertices: Floats, cameras: Mapping[str, Camera]) -> Lifted:
        """Triangulate the points where the sightings put them.

        Args:
            vertices: (V, 3) the mesh's estimate, world mm.
            cameras: the full-resolution cameras, by name; sightings of others are left out.

        Returns:
            Motions of the P points from the estimate.
        """
        points = self.surface.points(vertices)
        parts = []
        for index, name in enumerate(self.cameras):
            own = np.flatnonzero(self.view == index)
            if name not in cameras or len(own) == 0:
                continue
            camera, which = cameras[name], self.point[own]
            parts.append(
                Observations(
                    sample=which,
                    offset=self.pixel[own] - camera.project(points[which]),
                    jacobian=camera.project_jacobian(points[which]),
                    information=self.information[own],
                )
            )
        return triangulate(merged(parts), len(self.surface), self.scale_px, _PRIOR_MM)

    def constraints(
        self, vertices: Floats, skin: Floats, cameras: Mapping[str, Camera]
    ) -> Constraints:
        """Where the points should go, of the mesh that lies under the skin (V, 3) they are on.

        Args:
            vertices: (V, 3) the mesh's estimate, world mm.
            skin: (V, 3) the skin over it, which the views show.
            cameras: the full-resolution cameras, by name.
        """
        lifted = self.lifted(skin, cameras)
        return Constraints(
            corners=self.surface.corners,
            barycentric=self.surface.barycentric,
            targets=self.surface.points(vertices) + lifted.motion,
            weights=np.where(lifted.views > 0, self.weight, 0.0),
        )
