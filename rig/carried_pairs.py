"""Lid and lip pairs of a template, found again on a mesh of other topology."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from capture.arrays import Floats, Ints, Ints32
from recon.mesh import Mesh
from rig.correspondence import Correspondence
from rig.slits import Slit, edge_lengths, pair_loops, polygon_edges
from rig.template import Template

_NEAR = 0.5  # of a run's length: a hole whose middle is further away is another one


def carry_pairs(
    template: Template, pairs: Ints, mesh: Mesh, correspondence: Correspondence
) -> Ints:
    """Find pairs (N, 2) of a template again on a mesh: (M, 2), upper first, by arc length.

    Pairs that follow one another along the template make a run: an eye, a mouth. Where the mesh has
    a hole there, its rims are paired. Elsewhere the run's two lines are walked along the mesh's
    edges, each on its own side of the slit.
    """
    places = _places(template, correspondence)
    up = correspondence.mesh_from_template.rotation[:, 1]
    slits = [slit if slit.across @ up >= 0.0 else slit.turned() for slit in correspondence.slits]
    found = []
    for run in runs(template.polygons, pairs):
        middle = template.neutral[run].mean(axis=(0, 1))
        length = float(
            np.linalg.norm(template.neutral[run[-1]] - template.neutral[run[0]], axis=1)[0]
        )
        slit = _nearest(slits, places, correspondence.bound, middle, _NEAR * length)
        if slit is not None and slit.opening is not None:
            lines = [slit.opening.first, slit.opening.second]
            if _backwards(template.neutral, run, mesh.vertices, lines[0], correspondence):
                lines = [line[::-1] for line in lines]
        else:
            lines = [
                _walked(template, run[:, column], mesh, (places, correspondence.bound), slit, sign)
                for column, sign in ((0, 1), (1, -1))
            ]
        if min(map(len, lines)) > 0:
            found.append(pair_loops(lines[0], lines[1], mesh.vertices))
    return np.concatenate([np.zeros((0, 2), dtype=np.int64), *found])


def runs(polygons: Ints32, pairs: Ints) -> list[Ints]:
    """Pairs (N, 2) cut where one pair and the next are not neighbours on both sides."""
    if len(pairs) == 0:
        return []
    edges = polygon_edges(polygons)
    cuts = [
        n + 1
        for n, (here, there) in enumerate(zip(pairs[:-1].tolist(), pairs[1:].tolist(), strict=True))
        if not all(p == q or frozenset((p, q)) in edges for p, q in zip(here, there, strict=True))
    ]
    return np.split(pairs, cuts)


def _places(template: Template, correspondence: Correspondence) -> Floats:
    """Where each vertex of the mesh lies on the template's neutral (U, 3), mm."""
    corners = template.neutral[correspondence.corners]
    places: Floats = np.einsum("uk,ukx->ux", correspondence.barycentric, corners)
    return places


def _nearest(
    slits: list[Slit], places: Floats, bound: np.ndarray, middle: Floats, reach_mm: float
) -> Slit | None:
    """The slit whose sides' middle, on the template, is nearest to a point, within reach."""
    best, least = None, reach_mm
    for slit in slits:
        around = (slit.side != 0) & bound
        if slit.opening is not None:
            rim = slit.opening.rim
            around = np.isin(np.arange(len(bound)), rim) & bound if bound[rim].any() else around
        if around.any():
            apart = float(np.linalg.norm(places[around].mean(axis=0) - middle))
            if apart < least:
                best, least = slit, apart
    return best


def _backwards(
    neutral: Floats, run: Ints, vertices: Floats, line: Ints, correspondence: Correspondence
) -> bool:
    """Whether a line of the mesh runs against the template's run."""
    turn = correspondence.mesh_from_template.rotation
    along = turn @ (neutral[run[-1]].mean(axis=0) - neutral[run[0]].mean(axis=0))
    return bool((vertices[line[-1]] - vertices[line[0]]) @ along < 0.0)


def _walked(
    template: Template,
    line: Ints,
    mesh: Mesh,
    placed: tuple[Floats, np.ndarray],
    slit: Slit | None,
    sign: int,
) -> Ints:
    """Vertices of the mesh along a line of the template's vertices, neighbours in a row."""
    places, bound = placed
    allowed = bound if slit is None else bound & (slit.side == sign)
    if slit is None:
        normals = template.mesh.normals(), mesh.normals()
        mean = np.nan_to_num(normals[0][line]).mean(axis=0)
        allowed = bound & (np.nan_to_num(normals[1]) @ mean > 0.0)
    ids = np.flatnonzero(allowed)
    if len(ids) == 0:
        return ids
    _, nearest = cKDTree(places[ids]).query(template.neutral[line])
    stops = ids[nearest]
    graph = edge_lengths(mesh.vertices, mesh.triangles)
    return _path(sparse.csr_array(graph), stops)


def _path(graph: sparse.csr_array, stops: Ints) -> Ints:
    """A walk along edges through the stops, without the same vertex twice."""
    path = [int(stops[0])]
    for start, end in zip(stops[:-1].tolist(), stops[1:].tolist(), strict=True):
        if start == end or end in path:
            continue
        _, before = csgraph.dijkstra(graph, indices=[path[-1]], return_predecessors=True)
        if before[0, end] < 0:
            continue
        leg = [end]
        while leg[-1] != path[-1]:
            leg.append(int(before[0, leg[-1]]))
        path += [vertex for vertex in leg[-2::-1] if vertex not in path]
    return np.array(path, dtype=np.int64)
