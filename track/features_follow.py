"""A mesh carried to a frame by sparse features alone: a start for the flow, from far away."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from capture.arrays import Bools, Floats, Floats32
from track.features import FeatureReference, FeatureRound, detect_features, match_features
from track.features_detect import Keypoints
from track.laplacian import LaplacianDeformer, Stiffness
from track.surface_model import SurfaceModel

_FEWEST = 12  # patches from which the mesh is moved


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
        self, start: Floats, images: Mapping[str, Floats32], wanted: Bools | None = None
    ) -> Floats:
        """The mesh (V, 3) in a frame, to a millimetre or two where features were found.

        Args:
            start: (V, 3) the mesh's estimate, world mm.
            images: the frame's, float32 mono.
            wanted: (V,) vertices around which features are wanted; None: everywhere.

        Returns:
            World mm; the start itself when too few features agree.
        """
        found: dict[int, Mapping[str, Keypoints]] = {}
        vertices = start
        for one in self._rounds:
            skin = self._surface.skin(vertices)
            if one.level not in found:
                found[one.level] = detect_features(self._reference, images, skin, one, wanted)
            sightings = match_features(self._reference, found[one.level], skin, one)
            if len(sightings.surface) < _FEWEST:
                break
            vertices = self._deformers[one.bending_mm].solve(
                sightings.constraints(vertices, skin, self._reference.cameras),
                start=vertices,
                rotation_iterations=2,
            )
        return vertices
