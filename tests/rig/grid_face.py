"""A 400-vertex grid that stands for a face, six shapes that overlap, and performances of it."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats, Ints32
from capture.pose import Pose
from rig.template import Template
from track.performance import Performance

NAMES = ("jawOpen", "mouthSmile_L", "mouthSmile_R", "browInnerUp", "cheekPuff", "still")
_CENTRES_MM = ((0, -60), (-45, -30), (45, -30), (0, 70), (0, -10))
_RADII_MM = (45.0, 40.0, 40.0, 50.0, 55.0)


def grid_polygons(side: int) -> Ints32:
    row, column = np.divmod(np.arange((side - 1) ** 2), side - 1)
    corner = row * side + column
    return np.stack([corner, corner + 1, corner + side + 1, corner + side], axis=1).astype(np.int32)


def grid_template(side: int = 20) -> Template:
    """A bulged sheet of 200 x 220 mm; the last shape moves nothing."""
    y, x = np.meshgrid(np.linspace(-110, 110, side), np.linspace(-100, 100, side), indexing="ij")
    flat = np.stack([x.ravel(), y.ravel()], axis=1)
    depth = 80.0 - 0.004 * (flat**2).sum(axis=1)
    neutral = np.column_stack([flat, depth])
    directions = np.array([[0, -9, -3], [-4, 5, 2], [4, 5, 2], [0, 6, 2], [0, 0, 5]], dtype=float)
    deltas = np.zeros((len(NAMES), side * side, 3))
    for k, (centre, radius) in enumerate(zip(_CENTRES_MM, _RADII_MM, strict=True)):
        distance = np.linalg.norm(flat - np.array(centre), axis=1) / radius
        deltas[k] = np.clip(1.0 - distance**2, 0.0, None)[:, None] ** 2 * directions[k]
    return Template(
        neutral=neutral, deltas=deltas, names=NAMES, polygons=grid_polygons(side),
        rigid_vertices=np.arange(3 * side)[::-1] + side * (side - 3),
    )  # fmt: skip


def smooth_field(points: Floats, amplitude_mm: float, rng: np.random.Generator) -> Floats:
    """A smooth random vector field (V, 3) with the given root mean square length."""
    centres = points[rng.choice(len(points), 12, replace=False)]
    near = np.exp(-((points[:, None] - centres) ** 2).sum(axis=2) / (2 * 40.0**2))
    field = near @ rng.normal(size=(12, 3))
    return amplitude_mm * field / np.sqrt((field**2).sum(axis=1).mean())


def random_motions(count: int, rng: np.random.Generator) -> Floats:
    return np.array(
        [
            Pose.from_rotation_vector(rng.normal(0, 0.08, 3), rng.normal(0, 5, 3)).matrix()
            for _ in range(count)
        ]
    )


def perform(neutral: Floats, deltas: Floats, weights: Floats, motions: Floats) -> Floats:
    """World vertices (F, V, 3) of every frame, mm."""
    posed = neutral + np.tensordot(weights, deltas, axes=1)
    return posed @ motions[:, :3, :3].transpose(0, 2, 1) + motions[:, None, :3, 3]


def performance_of(
    vertices: Floats, polygons: Ints32, confidence: Floats | None = None
) -> Performance:
    frames = len(vertices)
    sure = np.ones(vertices.shape[:2]) if confidence is None else confidence
    return Performance(
        vertices=vertices.astype(np.float32),
        confidence=sure.astype(np.float32),
        polygons=polygons,
        frames=np.arange(frames, dtype=np.int64),
        head_from_neutral=np.tile(np.eye(4), (frames, 1, 1)),
        reference=np.full(frames, -1, dtype=np.int64),
    )
