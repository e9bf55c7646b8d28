"""The simulated actor as data: neutral skin, deltas, parts, the vertices that mean something."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from capture.arrays import Floats, Ints, Ints32, check_shape
from capture.errors import SettingsError
from capture.pose import Pose
from recon.mesh import Mesh
from tools.actor.identity import Identity, make_identity
from tools.actor.landmarks import find_landmarks, rigid_vertices
from tools.actor.lattice import Lattice, make_lattice
from tools.actor.parts import ActorPart, eyeball, teeth
from tools.actor.sculpt import Sculpture, sculpt
from tools.actor.shapes import Shapes, make_shapes
from tools.actor.skin import Paint, paint_skin


@dataclass(frozen=True, eq=False)
class PosedActor:
    """The actor at one instant, world mm.

    Attributes:
        skin: (V, 3) in the order of the model's neutral.
        parts: (Vp, 3) of each part, in the model's order.
        weights: (B,) that posed it.
        head: world_from_head.
    """

    skin: Floats
    parts: tuple[Floats, ...]
    weights: Floats
    head: Pose

    @cached_property
    def surface(self) -> Floats:
        """(Vs, 3) the skin followed by every part."""
        return np.concatenate([self.skin, *self.parts])


@dataclass(frozen=True, eq=False)
class ActorModel:
    """One actor.

    Attributes:
        neutral: the skin at rest, quads and uv, head space mm; lips closed, eyes open.
        deltas: (B, V, 3) float64, mm at weight 1.
        names: (B,) Apple's names of the shapes.
        parts: eyeballs and teeth.
        rigid_vertices: (n,) ids that expressions hardly move.
        lid_pairs: (n, 2) ids of upper and lower lid edge that meet when the eyes are shut.
        lip_pairs: (n, 2) ids of upper and lower lip edge that meet when the mouth is shut.
        landmarks68: (68,) ids in the order of dlib's 68-point model.
        face_region: ids of the skin of the face that scores use.
        identity: the proportions.
        paint: what the skin looks like.
        rest_normals: (V, 3) of the neutral.
    """

    neutral: Mesh
    deltas: Floats
    names: tuple[str, ...]
    parts: tuple[ActorPart, ...]
    rigid_vertices: Ints
    lid_pairs: Ints
    lip_pairs: Ints
    landmarks68: Ints
    face_region: Ints
    identity: Identity
    paint: Paint
    rest_normals: Floats

    @cached_property
    def surface_triangles(self) -> Ints32:
        """(T, 3) of the skin followed by every part, indices into `PosedActor.surface`."""
        blocks, start = [self.neutral.triangles], len(self.neutral.vertices)
        for part in self.parts:
            blocks.append(part.mesh.triangles + np.int32(start))
            start += len(part.mesh.vertices)
        return np.concatenate(blocks)

    def pose(self, weights: Floats, head: Pose) -> PosedActor:
        """Deform the actor by weights and carry it by the head's motion.

        Args:
            weights: (B,) one for each name, usually 0..1.
            head: world_from_head.

        Raises:
            ShapeError: when there is not one weight for each name.
        """
        weights = np.asarray(weights, dtype=np.float64)
        check_shape(deltas=(self.deltas, "B V 3"), weights=(weights, "B"))
        active = np.flatnonzero(weights)
        skin = self.neutral.vertices + np.tensordot(weights[active], self.deltas[active], 1)
        moved = []
        for part in self.parts:
            points = part.mesh.vertices + np.tensordot(weights[active], part.deltas[active], 1)
            turn, lift = weights @ part.gaze
            rotation = Pose.from_rotation_vector(np.array([-lift, turn, 0.0]), np.zeros(3))
            moved.append(head.apply(rotation.apply(points - part.centre) + part.centre))
        return PosedActor(head.apply(skin), tuple(moved), weights, head)

    def weights(self, **amplitudes: float) -> Floats:
        """(B,) weights from amplitudes by name; a shape without left and right sets both sides.

        Raises:
            SettingsError: naming the shapes there are.
        """
        return named_weights(self.names, amplitudes)


@lru_cache(maxsize=6)
def build_actor(seed: int | None) -> ActorModel:
    """Build one actor: proportions, skin, shapes, eyes and teeth.

    Args:
        seed: of the identity; None for the artist's generic head with the artist's shapes.
    """
    lattice, who = make_lattice(), make_identity(seed)
    sculpture = sculpt(lattice, who)
    neutral = Mesh(sculpture.vertices, lattice.polygons, lattice.uv)
    normals = neutral.normals()
    shapes = make_shapes(lattice, sculpture, who)
    return ActorModel(
        neutral=neutral,
        deltas=shapes.deltas,
        names=shapes.names,
        parts=_parts(sculpture, shapes),
        rigid_vertices=rigid_vertices(lattice, sculpture.vertices, shapes.deltas),
        lid_pairs=np.concatenate([eye.pairs for eye in lattice.eyes]),
        lip_pairs=lattice.mouth.pairs,
        landmarks68=find_landmarks(lattice, sculpture, who),
        face_region=_face_region(lattice, sculpture),
        identity=who,
        paint=paint_skin(lattice, sculpture, normals, who),
        rest_normals=normals,
    )


def _parts(sculpture: Sculpture, shapes: Shapes) -> tuple[ActorPart, ...]:
    count = len(shapes.names)
    parts = []
    for name, ball, gaze in zip(
        ("eye_right", "eye_left"), sculpture.balls, shapes.gaze, strict=True
    ):
        mesh, local = eyeball(ball)
        still = np.zeros((count, len(local), 3))
        parts.append(ActorPart(name, "eye", mesh, local, ball, still, gaze))
    for upper in (True, False):
        mesh, local = teeth(sculpture.stomion, upper=upper)
        moves = np.zeros((count, len(local), 3)) if upper else shapes.jaw_deltas(mesh.vertices)
        name = "teeth_upper" if upper else "teeth_lower"
        centre, gaze = mesh.vertices.mean(axis=0), np.zeros((count, 2))
        parts.append(ActorPart(name, "teeth", mesh, local, centre, moves, gaze))
    return tuple(parts)


def _face_region(lattice: Lattice, sculpture: Sculpture) -> Ints:
    """Ids of the outer skin of the face: front of the ears, hairline to under the chin."""
    _, y, z = sculpture.vertices.T
    inside = (lattice.ring == 0) & (z > 8.0) & (y < 66.0) & (y > -112.0) & (lattice.row < 93)
    return np.flatnonzero(inside).astype(np.int64)


def named_weights(names: tuple[str, ...], amplitudes: dict[str, float]) -> Floats:
    """(B,) weights from amplitudes by name; `eyeBlink` sets eyeBlinkLeft and eyeBlinkRight.

    Raises:
        SettingsError: naming the shapes there are.
    """
    weights = np.zeros(len(names))
    for name, amplitude in amplitudes.items():
        hits = [
            k for k, known in enumerate(names) if known in (name, name + "Left", name + "Right")
        ]
        if not hits:
            raise SettingsError(f"no shape {name!r}; the actor has {', '.join(names)}")
        weights[hits] = amplitude
    return weights
