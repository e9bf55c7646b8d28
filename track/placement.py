"""Coarse placement: the similarity that lays a template onto a scan, from any start."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from capture.arrays import Bools, Floats, Ints32
from capture.errors import SolveError
from recon.mesh import vertex_normals
from track.rigid import Similarity, fit_similarity
from track.surface_match import Matches, MatchSurface, near_border
from track.visibility import around, count_views

_NORMAL_MM = 30.0  # a unit of normal difference in the search of the placement
_SCALES = (0.7, 1.4)
_BORDER_MM = 6.0
_ROUGH, _FINE = 2500, 40000  # vertices in the search trees
_SHIFTS_MM = (-45.0, 0.0, 45.0)
_TILTS = (-0.45, 0.0, 0.45)  # rad of yaw and pitch tried around the best


@dataclass(frozen=True, eq=False, kw_only=True)
class Viewpoint:
    """Where an array of cameras looks from: what is known before any face is found.

    Attributes:
        eyes: (C, 3) camera centres, world mm.
        forward: (3,) unit direction from the scan to the cameras' mean: where a face looks.
        up: (3,) unit direction, the cameras' mean up, square to forward.
    """

    eyes: Floats
    forward: Floats
    up: Floats


@dataclass(frozen=True, eq=False, kw_only=True)
class Placement:
    """A similarity and how well it fits.

    Attributes:
        world_from_template: where the template goes.
        score_mm: mean distance in position and normal over the overlap, over the overlap's share.
    """

    world_from_template: Similarity
    score_mm: float


class Placer:
    """Holds a template and a scan, thinned, and aligns the one with the other."""

    def __init__(
        self, template: tuple[Floats, Ints32], scan: tuple[Floats, Ints32], view: Viewpoint
    ) -> None:
        """Take (vertices, triangles) of the template and of the scan, mm."""
        self._view = view
        outer = count_views(*template, around(template[0])) > 0
        every = np.ones(len(scan[0]), dtype=np.bool_)
        self._surfaces = {
            size: (_searchable(*template, outer, size), _searchable(*scan, every, size))
            for size in (_ROUGH, _FINE)
        }
        self._template_at = _oriented(*template, outer)
        self._scan_at = _oriented(*scan, every)

    def search(self, hint: Similarity | None = None) -> Placement:
        """Try the given place and all upright and turned ones; return the best, refined.

        Args:
            hint: another place to try, where landmarks were detected say.

        Raises:
            SolveError: when no start overlaps the scan.
        """
        starts = [Similarity(rotation=np.eye(3), translation=np.zeros(3)), *self._starts()]
        first = self._best([self.refine(start, 0, 150) for start in starts], 24)
        rough = self._best([self.refine(p.world_from_template, 4, 250) for p in first], 6)
        tilted = [self._tilt(rough[0], yaw, pitch) for yaw, pitch in product(_TILTS, _TILTS)]
        rough += [self.refine(start, 6, 250) for start in tilted]
        if hint is not None:
            rough.append(self.refine(hint, 6, 250))
        fine = self._best([self.refine(p.world_from_template, 10, 600) for p in rough], 2)
        final = [self.refine(p.world_from_template, 25, 2500) for p in fine]
        return self._best(final, 1)[0]

    def refine(self, start: Similarity, iterations: int, count: int) -> Placement:
        """Trimmed point-to-plane ICP, both ways, with scale, on `count` points each way.

        References:
            Chen and Medioni 1992; the rejection of border matches after Turk and Levoy 1994.
        """
        motion = start
        score = np.inf
        for iteration in range(iterations + 1):
            source, target, normal, score = self._pairs(motion, count)
            if len(source) < 30:
                return Placement(world_from_template=motion, score_mm=np.inf)
            if iteration < iterations:
                motion = _plane_step(source, target, normal).after(motion)
                if not _SCALES[0] < motion.scale < _SCALES[1]:
                    motion = _rescaled(motion, source.mean(axis=0))
        return Placement(world_from_template=motion, score_mm=score)

    def _pairs(self, motion: Similarity, count: int) -> tuple[Floats, Floats, Floats, float]:
        """Matched template points, scan points and normals, world mm; and the score."""
        template, scan = self._surfaces[_ROUGH if count < 2000 else _FINE]
        turn = motion.rotation
        points, normals = (part[:count] for part in self._template_at)
        there = motion.apply(points)
        out = scan.match(there, normals @ turn.T)
        scan_points, scan_normals = (part[:count] for part in self._scan_at)
        inside = (scan_points - motion.translation) @ turn / motion.scale
        back = template.match(inside, scan_normals @ turn)
        share_out, keep_out, cost_out = _judge(out, 1.0)
        share_back, keep_back, cost_back = _judge(back, motion.scale)
        source = np.concatenate([there[keep_out], motion.apply(back.points[keep_back])])
        target = np.concatenate([out.points[keep_out], scan_points[keep_back]])
        normal = np.concatenate([out.normals[keep_out], scan_normals[keep_back]])
        overlap = max(share_out, share_back)
        score = float(np.concatenate([cost_out, cost_back]).mean()) if len(source) else np.inf
        return source, target, normal, score / max(overlap, 1e-3)

    def _best(self, placements: list[Placement], count: int) -> list[Placement]:
        found = [placement for placement in placements if np.isfinite(placement.score_mm)]
        if not found:
            raise SolveError(
                "neutral: no place of the template overlaps the scan; move the template roughly "
                "onto the actor, or give --landmarks with three vertices or more"
            )
        return sorted(found, key=self._preference)[:count]

    def _preference(self, placement: Placement) -> float:
        """The score, a little worse for a template whose +Y and +Z are not the actor's."""
        turn = placement.world_from_template.rotation
        odd = 2.0 - turn[:, 1] @ self._view.up - turn[:, 2] @ self._view.forward
        return float(placement.score_mm * (1.0 + 0.05 * odd))

    def _starts(self) -> list[Similarity]:
        """Every right-angled turn of the template's axes against the view's, and some heights."""
        right = np.cross(self._view.up, self._view.forward)
        world = np.stack([right, self._view.up, self._view.forward], axis=1)
        local = self._template_at[0]
        target = _front_point(self._scan_at[0] @ world)
        starts = []
        for turn in _right_angles():
            source = _front_point(local @ turn.T)
            for shift in _SHIFTS_MM:
                offset = target - source + [0.0, shift, 0.0]
                starts.append(Similarity(rotation=world @ turn, translation=world @ offset))
        return starts

    def _tilt(self, placement: Placement, yaw: float, pitch: float) -> Similarity:
        """The placement turned about the middle of the scan's front."""
        right = np.cross(self._view.up, self._view.forward)
        turn = _axis_turn(self._view.up, yaw) @ _axis_turn(right, pitch)
        pivot = np.median(self._scan_at[0], axis=0) - 60.0 * self._view.forward
        about = Similarity(rotation=turn, translation=pivot - turn @ pivot)
        return about.after(placement.world_from_template)


def place_by_landmarks(template: Floats, positions: Floats) -> Similarity:
    """The similarity that lays landmark vertices (N, 3) onto their positions (N, 3), mm.

    Raises:
        SolveError: when there are fewer than three, or they lie on a line.
    """
    if len(template) < 3:
        raise SolveError(f"landmarks: a placement needs 3 or more, found {len(template)}")
    return fit_similarity(template, positions, with_scale=True)


def _searchable(vertices: Floats, triangles: Ints32, usable: Bools, tree_size: int) -> MatchSurface:
    """A surface whose points near an open border are not to be used."""
    inner = usable & ~near_border(vertices, triangles, _BORDER_MM)
    return MatchSurface(
        vertices, triangles, normal_mm=_NORMAL_MM, usable=inner, tree_size=tree_size
    )


def _oriented(vertices: Floats, triangles: Ints32, usable: Bools) -> tuple[Floats, Floats]:
    """Usable points and their normals in a shuffled, fixed order."""
    normals = vertex_normals(vertices, triangles)
    kept = np.flatnonzero(usable & np.isfinite(normals[:, 0]))
    order = np.random.default_rng(0).permutation(kept)
    return vertices[order], normals[order]


def _judge(matches: Matches, scale: float) -> tuple[float, Bools, Floats]:
    """Share of matches off the borders, which of them to keep (the best 80 %), their costs."""
    good = matches.usable & (matches.cosine > 0.3)
    apart = np.sqrt(np.maximum(2.0 - 2.0 * matches.cosine, 0.0))
    cost = np.hypot(scale * matches.distance_mm, _NORMAL_MM * apart)
    if not good.any():
        return 0.0, good, cost[good]
    keep = good & (cost <= np.quantile(cost[good], 0.8))
    return float(good.mean()), keep, np.asarray(cost[keep])


def _plane_step(source: Floats, target: Floats, normal: Floats) -> Similarity:
    """One Gauss-Newton step of point-to-plane alignment with scale, about the sources' middle."""
    middle = source.mean(axis=0)
    local = source - middle
    rows = np.concatenate(
        [
            np.cross(local, normal),
            normal,
            np.einsum("nx,nx->n", local, normal)[:, None],
        ],
        axis=1,
    )
    residual = np.einsum("nx,nx->n", target - source, normal)
    spread = np.median(np.abs(residual)) * 1.4826 + 0.05
    weight = 1.0 / (1.0 + (residual / (2.0 * spread)) ** 2)
    size = float(np.sqrt((local**2).sum(axis=1).mean()))
    damp = 1e-4 * len(source) * np.diag([size**2] * 3 + [1.0] * 3 + [10.0 * size**2])
    step = np.linalg.solve(rows.T @ (weight[:, None] * rows) + damp, rows.T @ (weight * residual))
    angle = float(np.linalg.norm(step[:3]))
    turn = _axis_turn(step[:3] / max(angle, 1e-12), min(angle, 0.35))
    scale = float(np.clip(1.0 + step[6], 0.9, 1.1))
    return Similarity(
        rotation=turn, translation=middle + step[3:6] - scale * turn @ middle, scale=scale
    )


def _rescaled(motion: Similarity, pivot: Floats) -> Similarity:
    """The motion with its scale brought back into the allowed range, `pivot` kept in place."""
    factor = float(np.clip(motion.scale, *_SCALES)) / motion.scale
    shrink = Similarity(rotation=np.eye(3), translation=(1.0 - factor) * pivot, scale=factor)
    return shrink.after(motion)


def _front_point(local: Floats) -> Floats:
    """The middle across and upward, and the front, of points in view axes."""
    low, high = np.quantile(local, [0.02, 0.98], axis=0)
    return np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), high[2]])


def _right_angles() -> list[Floats]:
    """The 24 rotations that permute the axes, the identity first."""
    found = []
    for order in permutations(range(3)):
        for signs in product([1.0, -1.0], repeat=3):
            turn = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(turn) > 0:
                found.append(turn)
    return found


def _axis_turn(axis: Floats, angle: float) -> Floats:
    """Rodrigues' rotation about a unit axis."""
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn: Floats = np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k
    return turn
