"""Non-rigid registration of one face mesh to another of other topology, side by side of slits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape
from capture.errors import SolveError
from capture.progress import Progress, silent
from capture.settings import check_ranges
from recon.mesh import vertex_normals
from rig.sided_search import SidedSurface
from rig.slits import Slit
from track.laplacian import Constraints, LaplacianDeformer, Stiffness
from track.nonrigid import Step
from track.surface_match import border_vertices

_FEWEST = 20  # matches without which a step says nothing
_RIM_MM = 6.0  # a rim further than this from the other mesh's rim is cut at another place
_PER_MM = 2.0  # points set along a rim for each mm


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """How one mesh is registered to another; first and last run geometrically over the steps.

    Attributes:
        steps: how many solves.
        bending_first_mm: stiffness length at first: shorter waves of a step are smoothed away.
        bending_last_mm: stiffness length at last.
        reach_first_mm: matches further than this are dropped, at first.
        reach_last_mm: the same, at last.
        angle_deg: matches whose normals differ by more are dropped.
        normal_first_mm: what a unit of normal difference counts in the search, at first.
        normal_last_mm: the same, at last.
        landmark_first_share: weight of all landmarks against all matches, at first.
        landmark_last_share: the same, at last.
    """

    steps: int = 16
    bending_first_mm: float = 80.0
    bending_last_mm: float = 2.5
    reach_first_mm: float = 25.0
    reach_last_mm: float = 4.0
    angle_deg: float = 60.0
    normal_first_mm: float = 40.0
    normal_last_mm: float = 6.0
    landmark_first_share: float = 1.0
    landmark_last_share: float = 0.02

    def __post_init__(self) -> None:
        check_ranges(
            "template", self, steps=(2, 200),
            bending_first_mm=(0.1, 1000.0), bending_last_mm=(0.1, 1000.0),
            reach_first_mm=(0.5, 200.0), reach_last_mm=(0.5, 200.0), angle_deg=(5.0, 89.0),
            normal_first_mm=(0.01, 500.0), normal_last_mm=(0.01, 500.0),
            landmark_first_share=(1e-6, 100.0), landmark_last_share=(1e-6, 100.0),
        )  # fmt: skip

    def schedule(self) -> list[Step]:
        """The steps, each pair mixed geometrically from first to last."""

        def mix(first: float, last: float, share: float) -> float:
            return float(first * (last / first) ** share)

        return [
            Step(
                bending_mm=mix(self.bending_first_mm, self.bending_last_mm, share),
                reach_mm=mix(self.reach_first_mm, self.reach_last_mm, share),
                angle_rad=float(np.radians(self.angle_deg)),
                normal_mm=mix(self.normal_first_mm, self.normal_last_mm, share),
                landmark_share=mix(self.landmark_first_share, self.landmark_last_share, share),
            )
            for share in np.linspace(0.0, 1.0, self.steps)
        ]


@dataclass(frozen=True, eq=False, kw_only=True)
class Labelled:
    """A mesh whose vertices tell what they may meet.

    Attributes:
        vertices: (V, 3) mm.
        triangles: (T, 3).
        labels: (V, 1 + S) a component's number, -1 for one without a partner, then the side of each
            matched slit, see `rig.sided_search`.
        outer: (V,) seen from around the head.
        slits: S matched slits, in the same order and with the same sides on both meshes.
    """

    vertices: Floats
    triangles: Ints32
    labels: Ints
    outer: Bools
    slits: tuple[Slit, ...]


class MeshFit:
    """Deforms one mesh until it lies on another.

    Each step meets, for every vertex, the other mesh's point nearest in position and normal among
    those of its component and not beyond a slit, and solves for the vertices with the step's
    stiffness against the previous step's shape. A match on an open border counts for vertices of a
    border only. In the first half only skin seen from around takes part. Rims of matched slits
    meet each other, and their corners are landmarks that fade.

    References:
        Amberg et al. 2007, "Optimal step nonrigid ICP algorithms for surface registration".
        Ma et al. 2016, Sec. 2.2, for the stiffness (`track.laplacian`).
    """

    def __init__(self, moving: Labelled, fixed: Labelled) -> None:
        check_shape(moving=(moving.labels, "V L"), fixed=(fixed.labels, "U L"))
        self._moving, self._fixed = moving, fixed
        self._surface = SidedSurface(fixed.triangles, fixed.labels)
        self._border = border_vertices(moving.triangles, len(moving.vertices))
        self._used = np.unique(moving.triangles[moving.labels[moving.triangles[:, 0], 0] >= 0])

    def run(
        self,
        steps: Sequence[Step],
        landmarks: tuple[Ints, Floats],
        *,
        progress: Progress = silent,
    ) -> Floats:
        """Deform; (V, 3) mm.

        Args:
            steps: see `FitSettings.schedule`.
            landmarks: vertices (N,) of the moving mesh and where they belong (N, 3), mm.
            progress: told after each step.

        Raises:
            SolveError: when too little of one mesh meets the other.
        """
        vertices = self._moving.vertices
        corners = self._corners()
        marks = tuple(
            np.concatenate([given, own]) for given, own in zip(landmarks, corners, strict=True)
        )
        for index, step in enumerate(steps):
            outer = index < len(steps) // 2
            ids, targets, weights = self._matches(vertices, step, outer=outer)
            rims = self._rims(vertices, min(step.reach_mm, _RIM_MM))
            parts = [(ids, targets, weights), (*rims, np.ones(len(rims[0])))]
            if len(marks[0]):
                share = step.landmark_share * float(weights.sum()) / len(marks[0])
                parts.append((marks[0], marks[1], np.full(len(marks[0]), share)))
            deformer = LaplacianDeformer(
                vertices, self._moving.triangles, Stiffness(bending_mm=step.bending_mm)
            )
            vertices = deformer.solve(_constraints(parts), start=vertices, rotation_iterations=1)
            progress(index + 1, len(steps), "register")
        return vertices

    def _matches(self, vertices: Floats, step: Step, *, outer: bool) -> tuple[Ints, Floats, Floats]:
        """Vertices that meet the other mesh, where, and how much each counts."""
        normals = vertex_normals(vertices, self._moving.triangles)
        alive = np.isfinite(normals[self._used, 0])
        if outer:
            alive &= self._moving.outer[self._used]
        asked = self._used[alive]
        met = self._surface.match(
            self._fixed.vertices,
            (vertices[asked], normals[asked], self._moving.labels[asked]),
            normal_mm=step.normal_mm,
            reach_mm=step.reach_mm,
            usable=self._fixed.outer if outer else None,
        )
        good = (met.distance_mm < step.reach_mm) & (met.cosine > np.cos(step.angle_rad))
        good &= ~met.on_border | self._border[asked]
        if int(good.sum()) < _FEWEST:
            raise SolveError(
                f"template: {int(good.sum())} of {len(asked)} vertices meet the mesh within "
                f"{step.reach_mm:.0f} mm; is it a face? Otherwise place it by --landmarks"
            )
        return asked[good], met.points[good], np.maximum(met.cosine[good], 0.0) ** 2

    def _corners(self) -> tuple[Ints, Floats]:
        """Corners of holes as landmarks."""
        ids, targets = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
        for own, other in zip(self._moving.slits, self._fixed.slits, strict=True):
            if own.opening is None or other.opening is None:
                continue
            here = self._moving.vertices[own.opening.corners]
            there = self._fixed.vertices[other.opening.corners]
            straight, crossed = (
                float(np.linalg.norm(here - ends, axis=1).sum()) for ends in (there, there[::-1])
            )
            ids.append(own.opening.corners)
            targets.append(there if straight <= crossed else there[::-1])
        return np.concatenate(ids), np.concatenate(targets)

    def _rims(self, vertices: Floats, reach_mm: float) -> tuple[Ints, Floats]:
        """Vertices on rims of holes and the nearest points of the other mesh's same rim."""
        ids, targets = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
        for own, other in zip(self._moving.slits, self._fixed.slits, strict=True):
            if own.opening is None or other.opening is None:
                continue
            for rim, opposite in (
                (own.opening.first, other.opening.first),
                (own.opening.second, other.opening.second),
            ):
                ends = other.opening.corners
                line = np.concatenate([ends[:1], opposite, ends[1:]])
                points = _along(self._fixed.vertices[line])
                apart, nearest = cKDTree(points).query(vertices[rim])
                kept = np.flatnonzero(apart < reach_mm)
                ids.append(rim[kept])
                targets.append(points[np.asarray(nearest)[kept]])
        return np.concatenate(ids), np.concatenate(targets)


def _along(line: Floats) -> Floats:
    """Points set closely along a line (N, 3), its own among them."""
    out = [line[:1]]
    for start, end in pairwise(line):
        count = 1 + int(_PER_MM * float(np.linalg.norm(end - start)))
        share = np.arange(1, count + 1)[:, None] / count
        out.append(start + share * (end - start))
    return np.concatenate(out)


def _constraints(parts: Sequence[tuple[Ints, Floats, Floats]]) -> Constraints:
    """Vertices, where they should go and weights, brought to a mean of 1."""
    ids, targets, weights = (np.concatenate([part[n] for part in parts]) for n in range(3))
    return Constraints(
        corners=np.repeat(ids[:, None], 3, axis=1).astype(np.int64),
        barycentric=np.tile([1.0, 0.0, 0.0], (len(ids), 1)),
        targets=targets,
        weights=weights / weights.mean(),
    )
