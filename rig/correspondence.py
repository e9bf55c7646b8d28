"""Correspondence between two face meshes of different topology."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from capture.arrays import Bools, Floats, Ints, check_shape
from capture.errors import SolveError
from capture.progress import Progress, silent
from recon.mesh import Mesh, vertex_normals
from rig.correspondence_fit import FitSettings, Labelled, MeshFit
from rig.gradient import components
from rig.sided_search import SidedSurface
from rig.slits import Slit, find_slits, match_slits
from rig.torn_edges import Bindings, TornEdges
from track.placement import Placer, Viewpoint, place_by_landmarks
from track.rigid import Similarity, fit_similarity
from track.surface_match import MatchSurface, border_vertices
from track.visibility import around, count_views

_BOUND_MM = 5.0  # from a vertex to the fitted template, above which it is not bound
_BORDER_MM = 1.0  # the same where it meets the template's open border: beyond is no template
_COSINE = 0.25  # least cosine between the two normals
_NORMAL_MM = 5.0  # what a unit of normal difference counts in the last search
_SAMPLES = 300  # vertices of a component that tell whether two are the same
_LIKE = (3.0, 0.15)  # mm, and share of the smaller one's box: how near the same component is
_SHARE = 0.5  # of a component's samples that must meet the other


@dataclass(frozen=True, eq=False, kw_only=True)
class Correspondence:
    """For each vertex of a mesh (U), a place on a template's surface (V vertices).

    Attributes:
        corners: (U, 3) vertices of the template's triangle.
        barycentric: (U, 3) where in it.
        bound: (U,) whether the vertex has a place; the two above mean nothing where it has none.
        distance_mm: (U,) from the vertex to its place on the fitted template; NaN where unbound.
        mesh_from_template: the similarity between the two.
        slits: the mesh's own slits.
        torn: edges of the mesh whose ends are bound to places far apart along the template.
        torn_before: how many there were before those were bound anew.
        template_count: V.
        missing: (V,) vertices of the template whose component the mesh lacks.
    """

    corners: Ints
    barycentric: Floats
    bound: Bools
    distance_mm: Floats
    mesh_from_template: Similarity
    slits: tuple[Slit, ...]
    torn: int
    torn_before: int
    template_count: int
    missing: Bools

    def rows(self) -> sparse.csr_array:
        """The map as a sparse matrix (U, V); rows of unbound vertices are empty."""
        weights = np.where(self.bound[:, None], self.barycentric, 0.0)
        row = np.repeat(np.arange(len(self.bound)), 3)
        table = sparse.csr_array(
            (weights.ravel(), (row, self.corners.ravel())),
            shape=(len(self.bound), self.template_count),
        )
        table.eliminate_zeros()
        return table


def correspond(
    template: Mesh,
    mesh: Mesh,
    settings: FitSettings | None = None,
    *,
    landmarks: Ints | None = None,
    progress: Progress = silent,
) -> Correspondence:
    """Find for each vertex of a mesh its place on a template of other topology.

    The template is placed on the mesh by a similarity (search and trimmed ICP, or three landmarks
    or more), components and slits of both are matched, the template is registered non-rigidly to
    the mesh, and each vertex of the mesh is bound to the fitted template's nearest point that has a
    like normal, belongs to the same component, and is not beyond a slit. Edges that are torn by
    these bindings are mended (`rig.torn_edges`).

    Args:
        template: a face, mm, anywhere.
        mesh: a face, mm.
        settings: of the registration.
        landmarks: (N, 2) vertices of the template and of the mesh that belong together.
        progress: told after each step.

    Raises:
        SolveError: when the one cannot be placed on the other.
    """
    marks = np.zeros((0, 2), dtype=np.int64) if landmarks is None else landmarks
    check_shape(template=(template.vertices, "V 3"), mesh=(mesh.vertices, "U 3"))
    check_shape(landmarks=(marks, "N 2"))
    chosen = settings or FitSettings()
    progress(0, chosen.steps, "place")
    outer = _outer(template), _outer(mesh)
    motion = _placed(template, mesh, outer[1], marks)
    moving, fixed = _labelled(template.with_vertices(motion.apply(template.vertices)), mesh, outer)
    fitted = MeshFit(moving, fixed).run(
        chosen.schedule(), (marks[:, 0], mesh.vertices[marks[:, 1]]), progress=progress
    )
    lying = replace(moving, vertices=fitted)
    bindings = _bound(lying, fixed)
    edges = TornEdges((fitted, template.triangles), (mesh.vertices, mesh.triangles))
    before = int(edges.find(bindings).sum())
    bindings = edges.repaired(bindings, _BOUND_MM)
    places = np.einsum("uk,ukx->ux", bindings.barycentric, fitted[bindings.corners])
    distance = np.linalg.norm(mesh.vertices - places, axis=1)
    return Correspondence(
        corners=bindings.corners,
        barycentric=bindings.barycentric,
        bound=bindings.bound,
        distance_mm=np.where(bindings.bound, distance, np.nan),
        mesh_from_template=_refitted(template, mesh, bindings),
        slits=tuple(find_slits(mesh.vertices, mesh.triangles)),
        torn=int(edges.find(bindings).sum()),
        torn_before=before,
        template_count=len(template.vertices),
        missing=moving.labels[:, 0] < 0,
    )


def _outer(mesh: Mesh) -> Bools:
    """Which vertices are seen from around."""
    return np.asarray(count_views(mesh.vertices, mesh.triangles, around(mesh.vertices)) > 0)


def _placed(template: Mesh, mesh: Mesh, outer: Bools, marks: Ints) -> Similarity:
    """Where the template goes, by landmarks where there are enough."""
    if len(marks) >= 3:
        return place_by_landmarks(template.vertices[marks[:, 0]], mesh.vertices[marks[:, 1]])
    skin = mesh.triangles[outer[mesh.triangles].all(axis=1)]
    view = Viewpoint(
        eyes=around(mesh.vertices), forward=np.array([0.0, 0.0, 1.0]), up=np.array([0.0, 1.0, 0.0])
    )
    try:
        placer = Placer((template.vertices, template.triangles), (mesh.vertices, skin), view)
        return placer.search().world_from_template
    except SolveError as error:
        raise SolveError(
            "template: no place of it overlaps the mesh; turn the mesh upright (+Y up, looking "
            "along +Z), or give --landmarks with three pairs or more"
        ) from error


def _refitted(template: Mesh, mesh: Mesh, bindings: Bindings) -> Similarity:
    """The similarity between all bound vertices and their places."""
    places = np.einsum("uk,ukx->ux", bindings.barycentric, template.vertices[bindings.corners])
    bound = bindings.bound
    if int(bound.sum()) < 3:
        raise SolveError(f"template: {int(bound.sum())} vertices of the mesh lie on it")
    return fit_similarity(places[bound], mesh.vertices[bound], with_scale=True)


def _labelled(template: Mesh, mesh: Mesh, outer: tuple[Bools, Bools]) -> tuple[Labelled, Labelled]:
    """Both meshes with the labels of matched components and sides of matched slits."""
    own = components(template.triangles, len(template.vertices))
    other = components(mesh.triangles, len(mesh.vertices))
    partner = _partners(template, own, mesh, other)
    slits = match_slits(
        find_slits(template.vertices, template.triangles), find_slits(mesh.vertices, mesh.triangles)
    )
    there = np.array([partner.get(int(label), -1) for label in other], dtype=np.int64)
    here = np.where(np.isin(own, list(partner.values())), own, -1)
    labels = [
        np.stack([first, *(slit.side for slit in sides)], axis=1)
        for first, sides in (
            (here, [pair[0] for pair in slits]),
            (there, [pair[1] for pair in slits]),
        )
    ]
    return (
        Labelled(
            vertices=template.vertices, triangles=template.triangles, labels=labels[0],
            outer=outer[0], slits=tuple(pair[0] for pair in slits),
        ),
        Labelled(
            vertices=mesh.vertices, triangles=mesh.triangles, labels=labels[1],
            outer=outer[1], slits=tuple(pair[1] for pair in slits),
        ),
    )  # fmt: skip


def _partners(template: Mesh, own: Ints, mesh: Mesh, other: Ints) -> dict[int, int]:
    """The template's component for each component of the mesh that has one."""
    ours, theirs = _parts(template, own), _parts(mesh, other)
    out = {}
    for label, part in theirs.items():
        best, score = -1, 0.0
        for candidate, source in ours.items():
            shares = _overlap(part, source), _overlap(source, part)
            if max(shares) >= _SHARE and sum(shares) > score:
                best, score = candidate, sum(shares)
        if best >= 0:
            out[label] = best
    return out


@dataclass(frozen=True, eq=False, kw_only=True)
class _Part:
    """One component: some of its points and normals, its box, and its surface."""

    points: Floats
    normals: Floats
    low: Floats
    high: Floats
    surface: MatchSurface


def _parts(mesh: Mesh, labels: Ints) -> dict[int, _Part]:
    normals = mesh.normals()
    out = {}
    used = labels[mesh.triangles[:, 0]]
    for label in np.unique(used).tolist():
        triangles = np.ascontiguousarray(mesh.triangles[used == label])
        ids = np.flatnonzero((labels == label) & np.isfinite(normals[:, 0]))
        if len(ids) == 0:
            continue
        rng = np.random.default_rng(0)
        some = np.sort(rng.choice(ids, min(_SAMPLES, len(ids)), replace=False))
        out[label] = _Part(
            points=mesh.vertices[some],
            normals=normals[some],
            low=mesh.vertices[ids].min(axis=0),
            high=mesh.vertices[ids].max(axis=0),
            surface=MatchSurface(mesh.vertices, triangles, normal_mm=5.0),
        )
    return out


def _overlap(part: _Part, onto: _Part) -> float:
    """The share of a part's points that lie near another one and look the same way."""
    size = min(float(np.linalg.norm(one.high - one.low)) for one in (part, onto))
    near_mm = max(_LIKE[0], _LIKE[1] * size)
    if (part.low > onto.high + near_mm).any() or (onto.low > part.high + near_mm).any():
        return 0.0
    met = onto.surface.match(part.points, part.normals)
    return float(((met.distance_mm < near_mm) & (met.cosine > _COSINE)).mean())


def _bound(lying: Labelled, fixed: Labelled) -> Bindings:
    """The place of each vertex of the fixed mesh on the one that lies on it."""
    normals = vertex_normals(fixed.vertices, fixed.triangles)
    asked = np.flatnonzero(np.isfinite(normals[:, 0]) & (fixed.labels[:, 0] >= 0))
    met = SidedSurface(lying.triangles, lying.labels).match(
        lying.vertices,
        (fixed.vertices[asked], normals[asked], fixed.labels[asked]),
        normal_mm=_NORMAL_MM,
        reach_mm=2.0 * _BOUND_MM,
    )
    on_rim = border_vertices(fixed.triangles, len(fixed.vertices))[asked]
    limit = np.where(met.on_border & ~on_rim, _BORDER_MM, _BOUND_MM)
    good = (met.distance_mm < limit) & (met.cosine > _COSINE)
    corners = np.zeros((len(fixed.vertices), 3), dtype=np.int64)
    barycentric = np.tile([1.0, 0.0, 0.0], (len(fixed.vertices), 1))
    bound = np.zeros(len(fixed.vertices), dtype=np.bool_)
    corners[asked], barycentric[asked], bound[asked] = met.corners, met.barycentric, good
    return Bindings(corners=corners, barycentric=barycentric, bound=bound)
