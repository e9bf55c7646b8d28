"""Non-rigid registration of a placed template to a scan, coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape
from capture.errors import SolveError
from capture.progress import Progress, silent
from recon.mesh import vertex_normals
from recon.surface import Scan
from track.contact import Contacts, find_contacts
from track.landmark_file import Landmarks
from track.laplacian import Constraints, LaplacianDeformer, Stiffness
from track.surface_match import Matches, MatchSurface, near_border
from track.visibility import count_views

_BORDER_MM = 3.0  # the last millimetres of a scan belong to its noise
_CONTACT = 2.0  # weight of a touching vertex against a match of full trust
_FEWEST = 50  # matches without which a step says nothing


@dataclass(frozen=True, kw_only=True)
class Step:
    """One step of the registration.

    Attributes:
        bending_mm: stiffness length of the step's displacement.
        reach_mm: matches further away are dropped.
        angle_rad: and those whose normals differ by more.
        normal_mm: what a unit of normal difference counts in the search.
        landmark_share: weight of all landmarks together against all matches together.
    """

    bending_mm: float
    reach_mm: float
    angle_rad: float
    normal_mm: float
    landmark_share: float = 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit:
    """A template laid onto a scan.

    Attributes:
        vertices: (V, 3) world mm.
        residual_mm: (V,) distance of each matched vertex to the scan; NaN where unmatched.
        seen: (V,) whether any camera sees the vertex.
    """

    vertices: Floats
    residual_mm: Floats
    seen: Bools


class NonrigidFit:
    """Registers one template to one scan.

    Each step meets, for every vertex that a camera sees, the scan's point nearest in position and
    normal, and solves Ma et al.'s Eq. 1 with the step's stiffness. The stiffness holds against the
    previous step's shape, so that the total deformation is not resisted and only has to be smooth
    step by step. What no camera sees, and what has no scan, follows by the Laplacian. Vertices that
    touch in the template, as closed lips do, are kept touching.

    References:
        Ma et al. 2016, Sec. 2.2. Amberg et al. 2007, "Optimal step nonrigid ICP algorithms for
        surface registration", for the annealed stiffness and the rejection of border matches.
    """

    def __init__(self, triangles: Ints32, scan: Scan, eyes: Floats) -> None:
        """Take the template's triangles (T, 3), the scan and the camera centres (C, 3), mm."""
        check_shape(triangles=(triangles, "T 3"), eyes=(eyes, "C 3"))
        self._triangles = triangles
        self._scan = scan.vertices.astype(np.float64)
        self._scan_triangles = scan.triangles
        self._confidence = np.maximum(scan.confidence.astype(np.float64), 0.05)
        self._inner = ~near_border(self._scan, scan.triangles, _BORDER_MM)
        self._eyes = eyes

    def run(
        self,
        start: Floats,
        steps: Sequence[Step],
        landmarks: Landmarks | None = None,
        *,
        progress: Progress = silent,
    ) -> Fit:
        """Deform the placed template, vertices (V, 3) mm, step by step.

        Raises:
            SolveError: when too little of the template meets the scan.
        """
        vertices = start
        contacts = find_contacts(start, self._triangles)
        seen = count_views(vertices, self._triangles, self._eyes) > 0
        for index, step in enumerate(steps):
            if index == len(steps) // 2:
                seen = count_views(vertices, self._triangles, self._eyes) > 0
            constraints = self._constraints(vertices, seen, step)
            constraints = _with_contacts(constraints, contacts, vertices)
            constraints = _with_landmarks(constraints, landmarks, step.landmark_share)
            deformer = LaplacianDeformer(
                vertices, self._triangles, Stiffness(bending_mm=step.bending_mm)
            )
            vertices = deformer.solve(constraints, start=vertices, rotation_iterations=1)
            progress(index + 1, len(steps), "register")
        seen = count_views(vertices, self._triangles, self._eyes) > 0
        return Fit(
            vertices=vertices, residual_mm=self._residual(vertices, seen, steps[-1]), seen=seen
        )

    def _constraints(self, vertices: Floats, seen: Bools, step: Step) -> Constraints:
        asked, matches, weights = self._match(vertices, seen, step)
        kept = weights > 0.0
        count = int(kept.sum())
        if count < _FEWEST:
            raise SolveError(
                f"neutral: {count} of {len(asked)} vertices that cameras see meet the scan within "
                f"{step.reach_mm:.0f} mm; is frame 0 this actor's neutral? Otherwise place the "
                "template by --landmarks"
            )
        return _vertex_constraints(asked[kept], matches.points[kept], weights[kept])

    def _match(self, vertices: Floats, seen: Bools, step: Step) -> tuple[Ints32, Matches, Floats]:
        """Seen vertices, what they meet, and how much each match weighs (0: dropped)."""
        normals = vertex_normals(vertices, self._triangles)
        asked = np.flatnonzero(seen).astype(np.int32)
        surface = MatchSurface(
            self._scan, self._scan_triangles, normal_mm=step.normal_mm, usable=self._inner
        )
        matches = surface.match(vertices[asked], normals[asked])
        good = matches.usable & (matches.distance_mm < step.reach_mm)
        good &= matches.cosine > np.cos(step.angle_rad)
        trust = np.einsum("nk,nk->n", matches.barycentric, self._confidence[matches.corners])
        return asked, matches, np.where(good, trust * np.maximum(matches.cosine, 0.0) ** 2, 0.0)

    def _residual(self, vertices: Floats, seen: Bools, step: Step) -> Floats:
        asked, matches, weights = self._match(vertices, seen, step)
        residual = np.full(len(vertices), np.nan)
        kept = weights > 0.0
        residual[asked[kept]] = matches.distance_mm[kept]
        return residual


def _vertex_constraints(vertices: Ints | Ints32, targets: Floats, weights: Floats) -> Constraints:
    return Constraints(
        corners=np.repeat(vertices[:, None], 3, axis=1).astype(np.int64),
        barycentric=np.tile([1.0, 0.0, 0.0], (len(vertices), 1)),
        targets=targets,
        weights=weights,
    )


def _with_contacts(constraints: Constraints, contacts: Contacts, vertices: Floats) -> Constraints:
    """What touched in the template is drawn together about its middle, wherever that is."""
    return _joined(
        constraints,
        contacts.pairs.ravel(),
        contacts.targets(vertices).reshape(-1, 3),
        np.full(2 * len(contacts.pairs), _CONTACT),
    )


def _with_landmarks(
    constraints: Constraints, landmarks: Landmarks | None, share: float
) -> Constraints:
    """Marks weigh `share` of all else together."""
    if landmarks is None or share <= 0.0:
        return constraints
    count = len(landmarks.vertices)
    weight = share * float(constraints.weights.sum()) / count
    return _joined(constraints, landmarks.vertices, landmarks.positions, np.full(count, weight))


def _joined(
    constraints: Constraints, vertices: Ints, targets: Floats, weights: Floats
) -> Constraints:
    """More vertex constraints; weights are brought to a mean of 1, as the stiffness expects."""
    more = _vertex_constraints(vertices, targets, weights)
    every = np.concatenate([constraints.weights, more.weights])
    return Constraints(
        corners=np.concatenate([constraints.corners, more.corners]).astype(np.int64),
        barycentric=np.concatenate([constraints.barycentric, more.barycentric]),
        targets=np.concatenate([constraints.targets, more.targets]),
        weights=every / every.mean(),
    )
