"""Expressions made of landmarks alone, for actors whose template has none.

Each is a displacement of some landmarks, spread over the mesh by its Laplacian: the lips part
because nothing joins them along the mesh, and lids close over what is behind them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, Ints32
from capture.errors import TakeError
from recon.mesh import Mesh
from track.face_landmarks import LANDMARK_NAMES
from track.landmark_map import LandmarkMap
from track.laplacian import Constraints, LaplacianDeformer, Stiffness
from track.surface_samples import SurfaceSamples

_EYES_MM = 62.0  # between the eyes of the face that the numbers below are meant for
_HINGE_MM = (0.0, -15.0, -78.0)  # of the jaw, from the middle between the eyes
_JAW_RAD = 0.30
_STILL_MM = 150.0  # skin this far from the middle of the face stays
_NEEDED = ("lids_right_0", "lids_right_3", "lids_left_0", "lids_left_3", "lip_outer_0",
           "lip_outer_6")  # fmt: skip
_UPPER = [49, 50, 51, 52, 53, 61, 62, 63]
_LOWER = [55, 56, 57, 58, 59, 65, 66, 67]
_CORNERS = [48, 54, 60, 64]


@dataclass(frozen=True, eq=False, kw_only=True)
class HeadFrame:
    """Axes of a face.

    Attributes:
        middle: (3,) between the eyes, world mm.
        axes: (3, 3) columns: to the actor's left, up, forward.
        scale: how much larger than the usual face.
    """

    middle: Floats
    axes: Floats
    scale: float


def head_frame(points: Floats) -> HeadFrame:
    """The axes of a face from its 68 landmarks (68, 3), NaN where unknown.

    Raises:
        TakeError: naming the landmarks that it needs.
    """
    needed = points[[LANDMARK_NAMES.index(name) for name in _NEEDED]]
    if not np.isfinite(needed).all():
        raise TakeError(f"landmark map: expressions need {', '.join(_NEEDED)} on the mesh")
    right, left, mouth = needed[:2].mean(axis=0), needed[2:4].mean(axis=0), needed[4:].mean(axis=0)
    across = left - right
    width = float(np.linalg.norm(across))
    across = across / width
    up = 0.5 * (right + left) - mouth
    up -= across * (up @ across)
    up /= np.linalg.norm(up)
    axes = np.stack([across, up, np.cross(across, up)], axis=1)
    return HeadFrame(middle=0.5 * (right + left), axes=axes, scale=width / _EYES_MM)


def landmark_shapes(mesh: Mesh, where: LandmarkMap) -> dict[str, Floats]:
    """Generic expressions of a face: by name, the displacement of each vertex (V, 3), mm.

    Args:
        mesh: the neutral.
        where: its landmarks.

    Raises:
        TakeError: when lids or lips are not among the landmarks.
    """
    known = [name for name in where.names if name in LANDMARK_NAMES]
    chosen = where.select(known)
    index = np.array([LANDMARK_NAMES.index(name) for name in known])
    points = np.full((len(LANDMARK_NAMES), 3), np.nan)
    points[index] = chosen.surface.points(mesh.vertices)
    frame = head_frame(points)
    local = (points - frame.middle) @ frame.axes / frame.scale
    spread = _Spread(mesh, chosen.surface, frame)
    return {name: spread.over(moves[index]) for name, moves in _moves(local).items()}


class _Spread:
    """Displacements of landmarks spread over a mesh, whose rim and back stay."""

    def __init__(self, mesh: Mesh, surface: SurfaceSamples, frame: HeadFrame) -> None:
        self._mesh, self._surface, self._frame = mesh, surface, frame
        away = np.linalg.norm(mesh.vertices - frame.middle, axis=1)
        used = np.unique(mesh.triangles)
        still = used[away[used] > _STILL_MM * frame.scale]
        self._still: Ints32 = still[:: max(1, len(still) // 200)].astype(np.int32)
        self._deformer = LaplacianDeformer(
            mesh.vertices, mesh.triangles, Stiffness(bending_mm=5.0, membrane_mm=1.0)
        )

    def over(self, moves: Floats) -> Floats:
        """Displacements (V, 3) world mm of the vertices, from those of the landmarks (N, 3)."""
        frame, vertices = self._frame, self._mesh.vertices
        known = np.isfinite(moves).all(axis=1)
        surface = self._surface.select(np.flatnonzero(known).astype(np.int32))
        targets = surface.points(vertices) + frame.scale * moves[known] @ frame.axes.T
        fixed = np.repeat(self._still[:, None], 3, axis=1)
        count = len(self._still) + len(surface)
        constraints = Constraints(
            corners=np.concatenate([surface.corners, fixed]),
            barycentric=np.concatenate(
                [surface.barycentric, np.tile([1.0, 0.0, 0.0], (len(fixed), 1))]
            ),
            targets=np.concatenate([targets, vertices[self._still]]),
            weights=np.ones(count),
        )
        solved = self._deformer.solve(
            constraints, start=vertices, data_weight=10.0, rotation_iterations=1
        )
        return solved - vertices


def _moves(local: Floats) -> dict[str, Floats]:
    """By name, displacements (68, 3) in face axes, mm of the usual face; 0 holds a landmark."""
    out: dict[str, Floats] = {"jaw_open": _jaw(local)}

    def add(name: str, moves: dict[int, tuple[float, float, float]]) -> None:
        table = np.zeros_like(local)
        table[0:17] = np.nan  # the jaw goes where the skin takes it
        for landmark, move in moves.items():
            table[landmark] = move
        out[name] = table

    for side, sign in (("right", -1.0), ("left", 1.0)):
        corner, inner, beside = (48, 60, (49, 59)) if side == "right" else (54, 64, (53, 55))
        lids = 36 if side == "right" else 42
        brow = [17, 18, 19, 20, 21] if side == "right" else [26, 25, 24, 23, 22]  # from outside
        pull = {corner: 1.0, inner: 0.9, beside[0]: 0.5, beside[1]: 0.5}
        add(f"smile_{side}", {k: (sign * 10.0 * w, 8.0 * w, -7.0 * w) for k, w in pull.items()})
        add(f"frown_{side}", {k: (sign * 2.0 * w, -6.0 * w, -2.0 * w) for k, w in pull.items()})
        gap = [local[lids + 5] - local[lids + 1], local[lids + 4] - local[lids + 2]]
        close = {lids + 1 + k: tuple(gap[k].tolist()) for k in range(2)}
        add(f"blink_{side}", {k: (m[0], m[1], m[2]) for k, m in close.items()})
        add(f"wide_{side}", {lids + 1 + k: (0.0, 2.0, 0.0) for k in range(2)})
        add(f"squint_{side}", {lids + 4 + k: (0.0, 2.0, 0.0) for k in range(2)})
        add(f"brow_outer_{side}", {b: (0.0, 8.0 - 2.0 * k, 0.0) for k, b in enumerate(brow)})
        add(f"brow_down_{side}", {b: (-sign * 2.0, -1.0 - 1.2 * k, 0.0)
                                  for k, b in enumerate(brow)})  # fmt: skip
        nostril = (31, 32) if side == "right" else (35, 34)
        raised = (49, 50, 61) if side == "right" else (53, 52, 63)
        add(f"sneer_{side}", {nostril[0]: (0.0, 3.0, 0.0), nostril[1]: (0.0, 1.5, 0.0),
                              **dict.fromkeys(raised, (0.0, 4.0, 0.5))})  # fmt: skip
    add("brow_inner", {b: (0.0, h, 0.0) for b, h in ((19, 3.0), (20, 6.0), (21, 8.0), (22, 8.0),
                                                     (23, 6.0), (24, 3.0))})  # fmt: skip
    lips = list(range(48, 68))
    add("pucker", {k: (-0.35 * local[k, 0], 0.0, 5.0) for k in lips})
    add("stretch", {k: (0.25 * local[k, 0], -1.0, -2.0) for k in lips})
    add("mouth_left", dict.fromkeys(lips, (6.0, 0.0, 0.0)))
    add("mouth_right", dict.fromkeys(lips, (-6.0, 0.0, 0.0)))
    add("lower_down", dict.fromkeys(_LOWER, (0.0, -5.0, 0.0)))
    add("upper_up", dict.fromkeys(_UPPER, (0.0, 4.0, 0.0)))
    return out


def _jaw(local: Floats) -> Floats:
    """The jaw turned about its hinge, as a velocity of that angle; corners of the mouth by 0.4."""
    share = np.zeros(len(local))
    share[_LOWER] = 1.0
    share[_CORNERS] = 0.4
    share[3:14] = [0.3, 0.7, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.7, 0.3]
    arm = local - np.array(_HINGE_MM)
    turn = _JAW_RAD * np.stack([0.0 * arm[:, 0], -arm[:, 2], arm[:, 1]], axis=1)
    moves: Floats = share[:, None] * turn
    return moves
