"""Slits of a face mesh, such as mouth and eyes: their two sides, and vertices that meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from capture.arrays import Bools, Floats, Ints, Ints32, check_shape
from capture.errors import ShapeError
from recon.mesh import vertex_normals
from track.openings import Opening, find_openings
from track.opposed import nearer_seeds

_REACH = 0.5  # of a slit's width: how far along the surface a side reaches from its rim
_TOUCHING_MM = 6.0  # along the surface: how far sides reach beyond the vertices that touch
_CONTACT_MM = 1.5  # vertices that face each other and are no further apart touch
_ALONG_MM = 5.0  # unless they are nearer than this along the mesh: then it is a crease
_FACING = -0.1  # cosine of the normals of two vertices that face each other
_CHUNK = 256  # sources of one search along the mesh
_FEWEST = 10  # pairs of touching vertices that make two sides
_LEVEL = 0.3  # of the eyes' distance: how much higher one may be than the other


@dataclass(frozen=True, eq=False, kw_only=True)
class Slit:
    """Two sides of skin that meet, or nearly do.

    Attributes:
        side: (V,) 1 on one side, -1 on the other, 0 on neither.
        opening: corners and rims where the slit is a hole of the mesh, `first` belonging to side 1;
            None where skin touches without a hole near by.
        centre: (3,) the middle, mm.
        across: (3,) from the middle of side -1 to that of side 1, mm.
        width_mm: from corner to corner, or of the box around both sides.
    """

    side: Ints
    opening: Opening | None
    centre: Floats
    across: Floats
    width_mm: float

    def turned(self) -> Slit:
        """The same slit with its sides exchanged."""
        opening = self.opening
        if opening is not None:
            opening = Opening(corners=opening.corners, first=opening.second, second=opening.first)
        return replace(self, side=-self.side, opening=opening, across=-self.across)


def edge_lengths(vertices: Floats, triangles: Ints32) -> sparse.csr_array:
    """The edges of a mesh as a graph: (V, V) symmetric, mm; an edge of no length counts 1e-9."""
    check_shape(vertices=(vertices, "V 3"), triangles=(triangles, "T 3"))
    ends = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
    ends = np.unique(ends, axis=0)
    length = np.maximum(np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1), 1e-9)
    half = sparse.csr_array((length, (ends[:, 0], ends[:, 1])), shape=(len(vertices),) * 2)
    return sparse.csr_array(half + half.T)


def polygon_edges(polygons: Ints32) -> set[frozenset[int]]:
    """The edges of polygons (P, 4), -1 padding a triangle, without the quads' diagonals."""
    following = np.where(polygons[:, 3:] < 0, polygons[:, [1, 2, 0, 0]], polygons[:, [1, 2, 3, 0]])
    ends = np.where(polygons < 0, polygons[:, :1], polygons)
    return {
        frozenset(edge)
        for edge in zip(ends.ravel().tolist(), following.ravel().tolist(), strict=True)
    }


def find_slits(vertices: Floats, triangles: Ints32) -> list[Slit]:
    """Find mouth, eyes and the like: holes with two corners, then skin that touches elsewhere.

    A side of a hole is the skin nearer to its rim than to the opposite one, along the mesh, up to
    half the hole's width. A side of touching skin is a connected patch of vertices in contact with
    another such patch, and 6 mm around it.

    Args:
        vertices: (V, 3) mm, of the neutral.
        triangles: (T, 3).
    """
    graph = edge_lengths(vertices, triangles)
    found = []
    taken = np.zeros(len(vertices), dtype=np.bool_)
    for opening in find_openings(vertices, triangles):
        ends = vertices[opening.corners]
        reach = _REACH * float(np.linalg.norm(ends[0] - ends[1]))
        side = nearer_seeds((opening.first, opening.second), reach, graph)
        if (side == 1).any() and (side == -1).any():
            taken |= side != 0
            found.append(_slit(vertices, side, opening))
    for seeds in _touching(_contacts(vertices, triangles, graph, ~taken), graph):
        side = nearer_seeds(seeds, _TOUCHING_MM, graph)
        if (side == 1).any() and (side == -1).any():
            found.append(_slit(vertices, side, None))
    return found


def match_slits(first: Sequence[Slit], second: Sequence[Slit]) -> list[tuple[Slit, Slit]]:
    """Slits of one mesh and those of another, in the same place, that are the same.

    Two belong together when each is the other's nearest, no further than half the wider one's
    width, and when their sides lie in like directions; the second one is turned where need be, so
    that side 1 of both is the same.
    """
    if not first or not second:
        return []
    apart = np.linalg.norm(
        np.array([slit.centre for slit in first])[:, None] - [slit.centre for slit in second],
        axis=2,
    )
    out = []
    for row, own in enumerate(first):
        column = int(apart[row].argmin())
        other = second[column]
        size = float(np.linalg.norm(own.across) * np.linalg.norm(other.across))
        cosine = float(own.across @ other.across) / max(size, 1e-12)
        mutual = int(apart[:, column].argmin()) == row
        if (
            mutual
            and apart[row, column] < 0.5 * max(own.width_mm, other.width_mm)
            and abs(cosine) > 0.5
        ):
            out.append((own, other if cosine > 0.0 else other.turned()))
    return out


def pair_loops(upper: Ints, lower: Ints, vertices: Floats) -> Ints:
    """Pair two rims of a slit by arc length: (N, 2), every vertex of both in one pair or more.

    Both run in the same direction. Each step goes on along the rim whose next vertex comes first,
    as shares of the whole lengths, or along both where they come together; so neighbours in the
    list are neighbours on both rims, as `rig.transfer.virtual_triangles` asks.

    Args:
        upper: (A,) vertex ids in order along the upper rim.
        lower: (B,) vertex ids in order along the lower rim.
        vertices: (V, 3) mm.

    Raises:
        ShapeError: when a rim is empty.

    References:
        Saito 2013, "Smooth contact-aware facial blendshapes transfer", section 3 (virtual mesh).
    """
    check_shape(upper=(upper, "A"), lower=(lower, "B"), vertices=(vertices, "V 3"))
    if len(upper) == 0 or len(lower) == 0:
        raise ShapeError(f"rims to pair: {len(upper)} vertices above, {len(lower)} below; none fit")
    along = _shares(vertices[upper]), _shares(vertices[lower])
    i = j = 0
    pairs = [(int(upper[0]), int(lower[0]))]
    while i + 1 < len(upper) or j + 1 < len(lower):
        steps = [(i + 1, j + 1), (i + 1, j), (i, j + 1)]
        allowed = [(a, b) for a, b in steps if a < len(upper) and b < len(lower)]
        i, j = min(allowed, key=lambda at: abs(along[0][at[0]] - along[1][at[1]]))
        pairs.append((int(upper[i]), int(lower[j])))
    return np.array(pairs, dtype=np.int64)


def annotate_pairs(
    vertices: Floats, triangles: Ints32, slits: Sequence[Slit] | None = None
) -> tuple[Ints, Ints]:
    """Lid pairs (N, 2) and lip pairs (M, 2), upper vertex first, of a face with holes for them.

    The face is upright (+Y up, looking along +Z). Eyes are two holes at like heights with the mouth
    below and between them, all three in one connected piece of the mesh. A face without such holes
    has no pairs: both arrays are empty.

    Args:
        vertices: (V, 3) mm, of the neutral.
        triangles: (T, 3).
        slits: what `find_slits` found of them, where that was asked already.
    """
    found = find_slits(vertices, triangles) if slits is None else slits
    holes = [slit for slit in found if slit.opening is not None]
    _, piece = csgraph.connected_components(edge_lengths(vertices, triangles), directed=False)
    for mouth in sorted(holes, key=lambda slit: float(slit.centre[1])):
        own = piece[_corner(mouth)]
        above = [slit for slit in holes if slit.centre[1] > mouth.centre[1]]
        above = [slit for slit in above if piece[_corner(slit)] == own]
        for left, right in combinations(above, 2):
            x = left.centre[0] - mouth.centre[0], right.centre[0] - mouth.centre[0]
            apart = abs(x[0] - x[1])
            level = abs(left.centre[1] - right.centre[1]) < _LEVEL * apart
            if level and x[0] * x[1] < 0.0 and abs(x[0] + x[1]) < _LEVEL * apart:
                lids = [_upper_first(vertices, slit) for slit in (left, right)]
                return np.concatenate(lids), _upper_first(vertices, mouth)
    none = np.zeros((0, 2), dtype=np.int64)
    return none, none


def _corner(slit: Slit) -> int:
    return -1 if slit.opening is None else int(slit.opening.corners[0])


def _upper_first(vertices: Floats, slit: Slit) -> Ints:
    upright = slit if slit.across[1] >= 0.0 else slit.turned()
    if upright.opening is None:
        return np.zeros((0, 2), dtype=np.int64)
    return pair_loops(upright.opening.first, upright.opening.second, vertices)


def _slit(vertices: Floats, side: Ints, opening: Opening | None) -> Slit:
    one, two = vertices[side == 1].mean(axis=0), vertices[side == -1].mean(axis=0)
    if opening is None:
        middle, width = 0.5 * (one + two), float(np.ptp(vertices[side != 0], axis=0).max())
    else:
        ends = vertices[opening.corners]
        middle, width = ends.mean(axis=0), float(np.linalg.norm(ends[0] - ends[1]))
    return Slit(side=side, opening=opening, centre=middle, across=one - two, width_mm=width)


def _contacts(vertices: Floats, triangles: Ints32, graph: sparse.csr_array, free: Bools) -> Ints:
    """Pairs (N, 2) of free vertices of one connected piece that touch, far apart along it.

    `track.contact` counts edges for that, which on coarse meshes misses most of a mouth.
    """
    normals = np.nan_to_num(vertex_normals(vertices, triangles))
    ids = np.flatnonzero(free)
    near = ids[cKDTree(vertices[ids]).query_pairs(_CONTACT_MM, output_type="ndarray")]
    facing = np.einsum("nx,nx->n", normals[near[:, 0]], normals[near[:, 1]]) < _FACING
    _, piece = csgraph.connected_components(graph, directed=False)
    near = near[facing & (piece[near[:, 0]] == piece[near[:, 1]])].astype(np.int64)
    sources, place = np.unique(near[:, 0], return_inverse=True)
    apart = np.zeros(len(near), dtype=np.bool_)
    for start in range(0, len(sources), _CHUNK):
        away = csgraph.dijkstra(graph, indices=sources[start : start + _CHUNK], limit=_ALONG_MM)
        own = np.flatnonzero((place >= start) & (place < start + _CHUNK))
        apart[own] = ~np.isfinite(away[place[own] - start, near[own, 1]])
    contacts: Ints = near[apart]
    return contacts


def _touching(pairs: Ints, graph: sparse.csr_array) -> list[tuple[Ints, Ints]]:
    """Patches of vertices that touch one another, two by two."""
    if len(pairs) == 0:
        return []
    used, place = np.unique(pairs, return_inverse=True)
    place = place.reshape(-1, 2)
    _, patch = csgraph.connected_components(graph[used][:, used], directed=False)
    joined = np.sort(patch[place], axis=1)
    kinds, which = np.unique(joined, axis=0, return_inverse=True)
    out = []
    for n, (a, b) in enumerate(kinds.tolist()):
        own = place[which.ravel() == n]
        if a == b or len(own) < _FEWEST:
            continue
        inside = np.unique(own)
        out.append((used[inside[patch[inside] == a]], used[inside[patch[inside] == b]]))
    return out


def _shares(points: Floats) -> Floats:
    """How far along a line (N, 3) each point lies, as a share of its length: 0 to 1."""
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()])
    shares: Floats = along / max(float(along[-1]), 1e-12)
    return shares
