"""A mesh carried to a frame by sparse features alone: a start for the flow, from far away."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import csgraph

from capture.arrays import Bools, Floats, Floats32, check_shape
from track.features import (
    FeatureReference,
    FeatureRound,
    detect_features,
    match_features,
)
from track.features_bind import at_vertices
from track.features_detect import Keypoints
from track.laplacian import Constraints, LaplacianDeformer, Stiffness, vertex_areas
from track.surface_model import SurfaceModel

_FEWEST = 12  # patches from which the mesh is moved
_LOST = 0.1  # confidence below which a vertex tells nothing
_MOST_LOST = 0.7  # share of such skin around a vertex of a region that is lost
_AVERAGING = 3  # edges that "around" reaches
_ROTATIONS = 2  # updates of the local frames in each solve


class FeatureFollower:
    """Carries a mesh to frames of a take by the iteration of matching and registration.

    Args:
        surface: what is tracked.
        reference: keypoints of the frame it is matched to.
        rounds: see `track.features.feature_rounds`.

    References:
        Ma et al. 2016, section 2.1, "Sparse Robust Image Features".
    """

    def __init__(
        self, surface: SurfaceModel, reference: FeatureReference, rounds: Sequence[FeatureRound]
    ) -> None:
        self._surface, self._reference, self._rounds = surface, reference, tuple(rounds)
        self._deformers = {
            mm: LaplacianDeformer(surface.neutral, surface.triangles, Stiffness(bending_mm=mm))
            for mm in sorted({one.bending_mm for one in self._rounds})
        }

    def follow(
        self,
        start: Floats,
        images: Mapping[str, Floats32],
        *,
        wanted: Bools | None = None,
        held: Bools | None = None,
    ) -> Floats:
        """The mesh in a frame, to a millimetre or two where features were found.

        Args:
            start: (V, 3) the mesh's estimate, world mm.
            images: the frame's, float32 mono.
            wanted: (V,) vertices around which features are looked for: the time goes with the
                area of the images that these need. None: all.
            held: (V,) vertices that are known to be right and stay. None: none.

        Returns:
            (V, 3) world mm; the start itself when too few features agree.
        """
        found: dict[int, Mapping[str, Keypoints]] = {}
        fixed = np.zeros(len(start), np.bool_) if held is None else held
        check_shape(start=(start, "V 3"), held=(fixed, "V"))
        vertices = start
        for one in self._rounds:
            skin = self._surface.skin(vertices)
            if one.level not in found:
                found[one.level] = detect_features(self._reference, images, skin, one, wanted)
            sightings = match_features(self._reference, found[one.level], skin, one)
            parts = [
                _free(sightings.constraints(vertices, skin, self._reference.cameras), fixed),
                self._held(fixed, start, one),
            ]
            if np.count_nonzero(parts[0].weights) < _FEWEST:
                break
            vertices = self._deformers[one.bending_mm].solve(
                Constraints.joined(parts), start=vertices, rotation_iterations=_ROTATIONS
            )
        return vertices

    def _held(self, fixed: Bools, start: Floats, round_: FeatureRound) -> Constraints:
        """The centres of held patches, which lie as densely as the others, stay at the start."""
        centres, _ = self._reference.patches(round_.spacing_mm)
        own = at_vertices(centres[fixed[centres]], self._surface.triangles)
        return Constraints(
            corners=own.corners,
            barycentric=own.barycentric,
            targets=own.points(start),
            weights=np.ones(len(own)),
        )


def _free(seen: Constraints, fixed: Bools) -> Constraints:
    """The constraints of points that are not on held vertices (V,)."""
    rows = np.arange(len(seen.weights))
    own = seen.corners[rows, seen.barycentric.argmax(axis=1)]
    return replace(seen, weights=np.where(fixed[own], 0.0, seen.weights))


def lost_skin(
    surface: SurfaceModel, confidence: Floats, seen: Floats, least_mm2: float = 1500.0
) -> Bools:
    """Find the regions that a frame's registration lost: when there are any, features are needed.

    Single vertices are lost in every frame, at lids and lips and under the chin; skin that moved
    farther than the flow searches is lost by the hand's breadth.

    Args:
        surface: what is tracked.
        confidence: (V,) 0..1 of the frame.
        seen: (V,) 0..1 of the reference: 1 where two views see the skin.
        least_mm2: area from which a region counts.

    Returns:
        (V,) the vertices of such regions; none when nothing is lost.
    """
    check_shape(confidence=(confidence, "V"), seen=(seen, "V"))
    area = vertex_areas(surface.neutral, surface.triangles)
    visible = seen >= 1.0
    weight = np.where(visible, area, 0.0)
    mixed = weight * (confidence < _LOST)
    for _ in range(_AVERAGING):
        weight, mixed = surface.near @ weight, surface.near @ mixed
    own = np.flatnonzero(visible & (mixed > _MOST_LOST * weight))
    _, region = csgraph.connected_components(surface.near[own][:, own], directed=False)
    size = np.bincount(region, area[own], minlength=1)
    lost = np.zeros(len(confidence), np.bool_)
    lost[own[size[region] >= least_mm2]] = True
    return lost
