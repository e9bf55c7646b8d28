"""Testbeds with truth: an artist's template, the hidden rig of one actor, and his performances.

The template and the actor's shapes mean the same and are not the same: the actor makes each with
another strength, turned a little, and with something of his own added. Two beds: our own actor,
which needs no other data, and ICT's model. The recipe is that of `make_rig_case.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capture.archive import read_archive
from capture.arrays import Floats
from capture.pose import Pose
from rig.evidence import Evidence
from rig.template import Template
from tools.bench.rig_instances import (
    NARROW_VERTICES,
    actor_template,
    expression_weights,
    ict_apple_template,
    ict_path,
    some_shapes,
)
from track.performance import Performance

BEDS = ("actor", "ict")
_STILL = ("eyeLook", "mouthClose", "PupilDilate")  # move little skin, or mean two things
_MM_PER_CM = 10.0
_CENTRES = 60  # of the bumps that make a smooth field


@dataclass(frozen=True, eq=False)
class HiddenRig:
    """What the artist has, and what the actor is.

    Attributes:
        template: generic neutral and shapes, mm.
        neutral: (V, 3) the actor's, in the template's place and axes, mm.
        deltas: (B, V, 3) the actor's own shapes, mm.
    """

    template: Template
    neutral: Floats
    deltas: Floats

    def pose(self, weights: Floats) -> Floats:
        """Faces (F, V, 3), mm, of weights (F, B), the head at rest."""
        posed: Floats = self.neutral + np.tensordot(weights, self.deltas, axes=1)
        return posed


@dataclass(frozen=True, eq=False)
class Filming:
    """A performance, and what really happened in it.

    Attributes:
        performance: as the tracker would write it; frame 0 is an imperfect neutral.
        weights: (F, B).
        rotations: (F, 3, 3) of the head.
        noise_mm: root mean square tracking error of a vertex: no honest fit is much below it.
    """

    performance: Performance
    weights: Floats
    rotations: Floats
    noise_mm: float


def hidden_rig(bed: str, seed: int, shapes: int, shared: Path | None = None) -> HiddenRig:
    """One actor of a bed.

    Args:
        bed: "actor" or "ict".
        seed: of the actor, and of which shapes there are.
        shapes: how many; fewer where the bed has no more.
        shared: the folder with data/ict, for "ict".
    """
    rng = np.random.default_rng([seed, BEDS.index(bed)])
    if bed == "actor":
        generic, own = actor_template(), actor_template(seed)
        neutral, strengths = own.neutral, (1.0, 1.0)  # the model draws its own strengths
    else:
        generic = own = ict_apple_template(shared or Path("../shared"))
        amounts = rng.normal(0.0, 0.8, 100) * np.exp(-np.arange(100) / 25)
        modes = read_archive(ict_path(shared or Path("../shared")), ("identity",), _ICT_REST)
        identity = modes["identity"][:, :NARROW_VERTICES].astype(np.float64)
        neutral = generic.neutral + _MM_PER_CM * np.tensordot(amounts, identity, axes=1)
        strengths = (0.65, 1.35)
    acting = _acting(generic)
    chosen = some_shapes(acting, min(shapes, len(acting.names)), seed)
    deltas = own.deltas[[own.names.index(name) for name in chosen.names]]
    return HiddenRig(chosen, neutral, personal_shapes(generic.neutral, deltas, strengths, rng))


_ICT_REST = ("neutral", "expr", "expr_names", "quads", "tri", "vt")


def personal_shapes(
    neutral: Floats, deltas: Floats, strengths: tuple[float, float], rng: np.random.Generator
) -> Floats:
    """Shapes (B, V, 3) as one person makes them: stronger or weaker, turned, with bumps added."""
    personal = np.zeros_like(deltas)
    for k, delta in enumerate(deltas):
        size = np.linalg.norm(delta, axis=1)
        extent = float(size.max(initial=0.0))
        if extent <= 0.0:
            continue
        turn = np.eye(3) + rng.normal(0.0, 0.08, (3, 3))
        moved = size > 0.05 * extent
        bumps_mm = 0.22 * float(np.sqrt((size[moved] ** 2).mean()))
        share = (size / extent)[:, None]
        own = rng.uniform(*strengths) * delta @ turn.T
        own += share * smooth_field(neutral, 25.0, bumps_mm, rng)
        personal[k] = np.where(size[:, None] > 1e-3, own, 0.0)
    return personal


def smooth_field(
    points: Floats, reach_mm: float, rms_mm: float, rng: np.random.Generator
) -> Floats:
    """A smooth random vector field (V, 3) with the given root mean square length."""
    centres = points[rng.choice(len(points), _CENTRES, replace=False)]
    strength = rng.normal(0.0, 1.0, (_CENTRES, 3))
    square = ((points[:, None] - centres) ** 2).sum(axis=2)
    field = np.exp(square / (-2.0 * reach_mm**2)) @ strength
    scaled: Floats = rms_mm * field / np.sqrt((field**2).sum(axis=1).mean())
    return scaled


def known_poses(
    rig: HiddenRig, seed: int, white_mm: float = 0.2, smooth_mm: float = 0.5
) -> tuple[Evidence, Floats]:
    """Training poses, one a shape, with tracking error, and weights of 25 held-out expressions.

    Pose k has shape k strongly, and up to six others as expressions have them: nobody can make one
    shape alone.
    """
    rng = np.random.default_rng([seed, 7])
    shapes = len(rig.template.names)
    weights = expression_weights(shapes, shapes, rng)
    weights[np.arange(shapes), np.arange(shapes)] = rng.uniform(0.75, 1.0, shapes)
    offsets = rig.pose(weights) - rig.neutral
    for frame in offsets:
        frame += rng.normal(0.0, white_mm, frame.shape)
        frame += smooth_field(rig.template.neutral, 15.0, smooth_mm, rng)
    evidence = Evidence(offsets, np.ones(offsets.shape[:2]), weights)
    return evidence, expression_weights(shapes, 25, rng)


def film(
    rig: HiddenRig,
    seed: int,
    poses: int,
    white_mm: float = 0.1,
    smooth_mm: float = 0.3,
    resting: int = 0,
) -> Filming:
    """Expressions with head motion and tracking error; frame 0 is an imperfect neutral.

    Args:
        rig: the actor.
        seed: of everything random.
        poses: how many frames.
        white_mm: error of each coordinate of each vertex.
        smooth_mm: root mean square of the error that neighbours share.
        resting: how many of the last shapes the actor never makes.
    """
    rng = np.random.default_rng([seed, 11])
    shapes = len(rig.template.names) - resting
    weights = np.zeros((poses, shapes + resting))
    weights[1:, :shapes] = expression_weights(shapes, poses - 1, rng)
    weights[0, rng.choice(shapes, 3, replace=False)] = rng.uniform(0.03, 0.1, 3)
    faces = rig.pose(weights)
    rotations = np.tile(np.eye(3), (poses, 1, 1))
    for frame in range(poses):
        faces[frame] += rng.normal(0.0, white_mm, faces[frame].shape)
        faces[frame] += smooth_field(rig.template.neutral, 15.0, smooth_mm, rng)
        if frame:
            head = Pose.from_rotation_vector(rng.normal(0.0, 0.08, 3), rng.normal(0.0, 6.0, 3))
            faces[frame] = head.apply(faces[frame])
            rotations[frame] = head.matrix()[:3, :3]
    performance = Performance(
        vertices=faces.astype(np.float32),
        confidence=np.ones(faces.shape[:2], dtype=np.float32),
        polygons=rig.template.polygons,
        frames=np.arange(poses, dtype=np.int64),
        head_from_neutral=np.tile(np.eye(4), (poses, 1, 1)),
        reference=np.full(poses, -1, dtype=np.int64),
    )
    noise_mm = float(np.sqrt(3.0 * white_mm**2 + smooth_mm**2))
    return Filming(performance, weights, rotations, noise_mm)


def seeds_of(text: str) -> Iterator[int]:
    """Seeds from "101,102" or "101-104"."""
    for part in text.split(","):
        first, _, last = part.partition("-")
        yield from range(int(first), int(last or first) + 1)


def _acting(template: Template) -> Template:
    """The shapes that move more than 2 mm and mean one thing."""
    kept = [
        k for k, name in enumerate(template.names)
        if template.extents_mm[k] > 2.0 and not name.startswith(_STILL)
    ]  # fmt: skip
    names = tuple(template.names[k] for k in kept)
    return replace(template, deltas=template.deltas[kept], names=names)
