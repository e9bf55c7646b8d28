"""Instances of the rig benchmarks: templates of the shared models and of our actor, and frames.

Everything is millimetres and drawn by seed: the same arguments give the same arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from capture.archive import read_archive
from capture.arrays import Bools, Floats, Ints, Ints32
from recon.mesh import Mesh
from rig.evidence import Evidence
from rig.template import Template, text_names
from tools.actor.model import build_actor
from tools.make_template import ict_template

NARROW_VERTICES = 6706  # of ICT's face without cheeks and ears
_MM_PER_M = 1000.0
_SIDED = ("browInnerUp", "cheekPuff")  # ICT has them left and right, Apple's list has not
_NOT_APPLES = ("PupilDilate", "cheekRaiser")
_BELOW_EYES_MM = 10.0  # height of ICT's face between mouth and eyes
_FACING = -0.3  # cosine between the normals of skin that touches
_RINGS = 6  # edges: nearer along the skin is a crease, not a slit


@dataclass(frozen=True, eq=False)
class UpdateInstance:
    """One blendshape update with known weights.

    Attributes:
        name: what it is called in the tables.
        template: neutral and shapes, mm; its shapes are the targets D*.
        support: (B, V) where each shape may move.
        evidence: frames with noise.
    """

    name: str
    template: Template
    support: Bools
    evidence: Evidence

    @property
    def targets(self) -> Floats:
        """(B, V, 3) the template's shapes inside the support, mm."""
        inside: Floats = np.where(self.support[:, :, None], self.template.deltas, 0.0)
        return inside

    @property
    def scalars(self) -> int:
        """Unknown coordinates, those of the neutral's column included."""
        return 3 * (int(self.support.sum()) + int(self.support.shape[1]))


def arkit_template(shared: Path) -> Template:
    """The 1,220-vertex face with Apple's 51 shapes, metres turned into millimetres."""
    arrays = read_archive(
        shared / "data" / "arkit" / "said_arkit_reference51.npz",
        ("neutral", "deltas", "names", "tri"),
        optional=("vt",),
    )
    return Template(
        neutral=arrays["neutral"].astype(np.float64) * _MM_PER_M,
        deltas=arrays["deltas"].astype(np.float64) * _MM_PER_M,
        names=text_names(arrays["names"]),
        polygons=np.pad(arrays["tri"].astype(np.int32), ((0, 0), (0, 1)), constant_values=-1),
    )


def ict_path(shared: Path) -> Path:
    """The archive of ICT's light model."""
    return shared / "data" / "ict" / "ict_light.npz"


def ict_apple_template(shared: Path, vertices: int = NARROW_VERTICES) -> Template:
    """ICT's face with Apple's 51 shapes: halves joined where Apple knows one shape."""
    whole = ict_template(ict_path(shared), vertices)
    joined: dict[str, Floats] = {}
    for name, delta in zip(whole.names, whole.deltas, strict=True):
        if not name.startswith(_NOT_APPLES):
            key = next((sided for sided in _SIDED if name.startswith(sided)), name)
            joined[key] = joined.get(key, np.zeros_like(delta)) + delta
    template = replace(whole, deltas=np.stack(list(joined.values())), names=tuple(joined))
    shut = whole.neutral + joined["eyeBlink_L"] + joined["eyeBlink_R"]
    lids = touching_pairs(template, shut, 1.0)
    lips = touching_pairs(template, whole.neutral, 1.0)
    lids = lids[(whole.neutral[lids, 1] > _BELOW_EYES_MM).all(axis=1)]
    lips = lips[(whole.neutral[lips, 1] < _BELOW_EYES_MM).all(axis=1)]
    return replace(template, lid_pairs=lids, lip_pairs=lips)


def actor_template(seed: int | None = None) -> Template:
    """The face of our own actor, outer skin alone; None for the artist's generic head.

    Every actor has the vertices of the generic head's face, in one order.
    """
    model = build_actor(seed)
    inside = np.zeros(len(model.neutral.vertices), dtype=bool)
    inside[build_actor(None).face_region] = True
    whole = model.neutral.polygons
    kept = whole[inside[whole].all(axis=1) & (whole >= 0).all(axis=1)]
    ids = np.unique(kept)
    number = np.full(len(inside), -1, dtype=np.int64)
    number[ids] = np.arange(len(ids))
    lids, lips = number[model.lid_pairs], number[model.lip_pairs]
    rigid = number[model.rigid_vertices]
    return Template(
        neutral=model.neutral.vertices[ids],
        deltas=model.deltas[:, ids],
        names=model.names,
        polygons=number[kept].astype(np.int32),
        rigid_vertices=rigid[rigid >= 0],
        lid_pairs=lids[(lids >= 0).all(axis=1)],
        lip_pairs=lips[(lips >= 0).all(axis=1)],
    )


def patch_template(side: int, shapes: int, seed: int = 1) -> Template:
    """A bulged sheet of side x side vertices with overlapping local shapes: needs no model."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.linspace(-110, 110, side), np.linspace(-100, 100, side), indexing="ij")
    neutral = np.column_stack([x.ravel(), y.ravel(), 80 - 0.004 * (x**2 + y**2).ravel()])
    centres = neutral[rng.choice(len(neutral), shapes), :2]
    apart = np.linalg.norm(neutral[None, :, :2] - centres[:, None], axis=2) / 75.0
    deltas = (np.clip(1 - apart**2, 0, None) ** 2)[:, :, None] * rng.normal(0, 4, (shapes, 1, 3))
    row, column = np.divmod(np.arange((side - 1) ** 2), side - 1)
    corner = row * side + column
    quads = np.stack([corner, corner + 1, corner + side + 1, corner + side], axis=1)
    names = tuple(f"shape{k:02d}" for k in range(shapes))
    return Template(neutral=neutral, deltas=deltas, names=names, polygons=quads.astype(np.int32))


def some_shapes(template: Template, count: int, seed: int) -> Template:
    """The same template with `count` of its shapes, drawn by seed, in their order."""
    drawn = np.random.default_rng(seed).permutation(len(template.names))[:count]
    chosen = np.sort(drawn)
    names = tuple(template.names[k] for k in chosen)
    return replace(template, deltas=template.deltas[chosen], names=names)


def update_instance(
    name: str, template: Template, support: Bools, poses: int = 63, seed: int = 0
) -> UpdateInstance:
    """Frames of an actor who makes every shape with his own strength, 0.2 mm of noise on them."""
    rng = np.random.default_rng(seed)
    weights = expression_weights(len(template.names), poses, rng)
    gains = rng.uniform(0.8, 1.2, len(template.names))
    inside = np.where(support[:, :, None], template.deltas, 0.0)
    offsets = np.tensordot(weights * gains, inside, axes=1)
    offsets += rng.normal(0.0, 0.2, offsets.shape)
    return UpdateInstance(
        name, template, support, Evidence(offsets, np.ones(offsets.shape[:2]), weights)
    )


def expression_weights(shapes: int, poses: int, rng: np.random.Generator) -> Floats:
    """Weights (poses, shapes): one to six shapes a pose, and every shape once above 0.75."""
    weights = np.zeros((poses, shapes))
    for row in weights:
        chosen = rng.choice(shapes, min(int(rng.integers(1, 7)), shapes), replace=False)
        row[chosen] = rng.uniform(0.25, 1.0, len(chosen))
    for shape in np.flatnonzero(weights.max(axis=0) < 0.6):
        weights[rng.integers(poses), shape] = rng.uniform(0.75, 1.0)
    return weights


def weight_curves(shapes: int, frames: int, active: int, rng: np.random.Generator) -> Floats:
    """Smooth curves (frames, shapes) in 0..1 with about `active` shapes above 0 at a time."""
    weights = np.zeros((frames, shapes))
    pulse_frames = 24
    pulses = max(1, round(active * frames / (0.9 * pulse_frames)))
    bump = np.sin(np.linspace(0.0, np.pi, pulse_frames)) ** 2
    for _ in range(pulses):
        begin, shape = rng.integers(-pulse_frames + 1, frames), rng.integers(shapes)
        span = np.arange(pulse_frames) + begin
        inside = (span >= 0) & (span < frames)
        seen = weights[span[inside], shape]
        weights[span[inside], shape] = np.maximum(seen, rng.uniform(0.3, 1.0) * bump[inside])
    return weights


def touching_pairs(template: Template, pose: Floats, reach_mm: float) -> Ints:
    """Vertices (n, 2), upper and lower, that touch across a slit in a pose (V, 3); from -X to +X.

    Nearest first, each vertex once: within reach, facing each other, and more than six edges apart
    along the skin.
    """
    normals = Mesh(pose, template.polygons).normals()
    pairs = cKDTree(pose).query_pairs(reach_mm, output_type="ndarray")
    facing = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1) < _FACING
    pairs = pairs[facing]
    near = _within_rings(template.polygons, len(pose), _RINGS)
    pairs = pairs[np.asarray(near[pairs[:, 0], pairs[:, 1]]).ravel() == 0.0]
    apart = np.linalg.norm(pose[pairs[:, 0]] - pose[pairs[:, 1]], axis=1)
    used: set[int] = set()
    kept = []
    for a, b in pairs[np.lexsort((pairs[:, 1], pairs[:, 0], apart))].tolist():
        if not used & {a, b}:
            used |= {a, b}
            kept.append((a, b))
    found = np.array(kept, dtype=np.int64).reshape(-1, 2)
    height = template.neutral[found, 1]
    found = np.where((height[:, 0] < height[:, 1])[:, None], found[:, ::-1], found)
    ordered: Ints = found[np.argsort(template.neutral[found, 0].sum(axis=1), kind="stable")]
    return ordered


def _within_rings(polygons: Ints32, count: int, rings: int) -> sparse.csr_array:
    following = np.where(polygons[:, 3:] < 0, polygons[:, [1, 2, 0, 0]], polygons[:, [1, 2, 3, 0]])
    ends = np.where(polygons < 0, polygons[:, :1], polygons)
    ones = np.ones(ends.size)
    edges = sparse.coo_array((ones, (ends.ravel(), following.ravel())), shape=(count, count))
    near = sparse.csr_array(edges + edges.T + sparse.eye_array(count))
    reached = near
    for _ in range(rings - 1):
        reached = sparse.csr_array(reached @ near)
        reached.data[:] = 1.0
    return reached
