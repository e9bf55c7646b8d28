"""Names of regions of a face, found from the tip of the nose and the size of faces.

They serve sentences such as "lower lip: few views agree". No landmarks, labels or topology are
needed: faces of grown people differ by millimetres here, and names need no more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Ints, check_shape

# Places beside the tip of the nose, world axes (+X the actor's left, +Y up, +Z forward), mm:
# rounded from two faces drawn from ICT-FaceKit's identity model, checked on its 68 landmarks.
_MIDDLE = {
    "forehead": ((0.0, 90.0, -32.0), (35.0, 85.0, -40.0), (-35.0, 85.0, -40.0)),
    "nose": ((0.0, 3.0, -6.0), (0.0, 35.0, -24.0), (14.0, -8.0, -24.0), (-14.0, -8.0, -24.0)),
    "upper lip": ((0.0, -29.0, -17.0), (13.0, -31.0, -22.0), (-13.0, -31.0, -22.0)),
    "lower lip": ((0.0, -44.0, -19.0), (13.0, -42.0, -23.0), (-13.0, -42.0, -23.0)),
    "chin": ((0.0, -66.0, -22.0), (20.0, -63.0, -32.0), (-20.0, -63.0, -32.0)),
    "neck": ((0.0, -110.0, -70.0), (40.0, -105.0, -90.0), (-40.0, -105.0, -90.0)),
}
_SIDED = {
    "brow": ((42.0, 57.0, -38.0), (22.0, 58.0, -27.0)),
    "lids": ((32.0, 35.0, -38.0), (32.0, 28.0, -41.0)),
    "cheek": ((45.0, 0.0, -45.0), (35.0, -18.0, -37.0), (58.0, 5.0, -65.0)),
    "mouth corner": ((26.0, -38.0, -32.0),),
    "jaw": ((58.0, -50.0, -70.0), (40.0, -55.0, -48.0)),
    "temple": ((68.0, 60.0, -80.0),),
    "ear": ((80.0, 15.0, -105.0),),
}
_BESIDE = ("head", "neck", "ear", "temple")
_FAR_MM = 45.0  # beyond this from every place it is the head


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceRegions:
    """Regions of a mesh.

    Attributes:
        names: of the regions.
        of_vertex: (V,) int64 which of them each vertex belongs to.
    """

    names: tuple[str, ...]
    of_vertex: Ints

    @property
    def face(self) -> Bools:
        """Which vertices (V,) belong to the face: not to head, neck, ears or temples."""
        beside = [k for k, name in enumerate(self.names) if name.split()[-1] in _BESIDE]
        face: Bools = ~np.isin(self.of_vertex, beside)
        return face

    def worst(self, values: Floats, among: Bools, share: float = 0.25) -> list[tuple[str, float]]:
        """Regions by their upper quartile of values (V,) among some vertices, the worst first.

        Args:
            values: (V,) the larger the worse.
            among: (V,) the vertices that count.
            share: of a region's vertices above the number that is told of it.
        """
        check_shape(values=(values, "V"), among=(among, "V"), of_vertex=(self.of_vertex, "V"))
        told = []
        for index, name in enumerate(self.names):
            own = values[among & (self.of_vertex == index)]
            if len(own):
                told.append((name, float(np.quantile(own, 1.0 - share))))
        return sorted(told, key=lambda entry: -entry[1])


def face_regions(neutral: Floats, seen: Bools) -> FaceRegions:
    """Name the regions of a face by their place beside the tip of the nose.

    Args:
        neutral: (V, 3) world mm, +Y up, the face looking along +Z, about upright.
        seen: (V,) the skin that views see: the tip of the nose is its foremost vertex.

    Returns:
        Regions; all of the mesh is "head" where nothing is seen.
    """
    check_shape(neutral=(neutral, "V 3"), seen=(seen, "V"))
    names = [*_MIDDLE]
    places = [np.array(spots) for spots in _MIDDLE.values()]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        names += [f"{side} {name}" for name in _SIDED]
        places += [np.array(spots) * [sign, 1.0, 1.0] for spots in _SIDED.values()]
    names.append("head")
    if not seen.any():
        return FaceRegions(names=tuple(names), of_vertex=np.full(len(neutral), len(names) - 1))
    candidates = np.flatnonzero(seen)
    tip = neutral[candidates[neutral[candidates, 2].argmax()]]
    away = neutral - tip
    distance = np.stack(
        [np.linalg.norm(away[:, None] - spots[None], axis=2).min(axis=1) for spots in places]
    )
    nearest = distance.argmin(axis=0)
    nearest[distance.min(axis=0) > _FAR_MM] = len(names) - 1
    return FaceRegions(names=tuple(names), of_vertex=nearest.astype(np.int64))
