"""The actor's expressions: one delta for every name of Apple's list, but for the tongue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats
from tools.actor.field import Field
from tools.actor.identity import Identity
from tools.actor.lattice import Lattice
from tools.actor.lids import lid_shapes
from tools.actor.lumps import wave
from tools.actor.mouth_shapes import jaw_shapes, mouth_shapes, move_jaw
from tools.actor.sculpt import Sculpture
from tools.actor.upper_face import upper_face_shapes

_GAZE = {"Down": (0.0, -0.42), "Up": (0.0, 0.38), "In": (-0.45, 0.0), "Out": (0.45, 0.0)}
_EXACT = ("eyeBlink", "eyeLook", "eyeSquint", "eyeWide")  # lids must meet: not made personal
_TIED = {"mouthClose": "jawOpen"}  # the corrective must fit the shape it corrects


@dataclass(frozen=True, eq=False)
class Shapes:
    """Expressions of one identity.

    Attributes:
        names: (B,) Apple's names, sorted.
        deltas: (B, V, 3) mm at weight 1.
        gains: (B,) how strongly this actor makes each shape; 1 for the artist's.
        gaze: (2, B, 2) of the right and left eye, radians at weight 1: turn to +X, turn up.
    """

    names: tuple[str, ...]
    deltas: Floats
    gains: Floats
    gaze: Floats

    def jaw_deltas(self, points: Floats) -> Floats:
        """(B, N, 3) mm: what each shape does to points (N, 3) that are fixed to the jaw bone."""
        moves = np.zeros((len(self.names), len(points), 3))
        for index, name in enumerate(self.names):
            if name.startswith("jaw"):
                moves[index] = self.gains[index] * (move_jaw(name, points) - points)
        return moves


def make_shapes(lattice: Lattice, sculpture: Sculpture, who: Identity) -> Shapes:
    """Make every expression; a seeded identity makes them in its own way.

    Args:
        lattice: the topology.
        sculpture: the neutral.
        who: the identity; the generic one keeps the artist's shapes as they are.
    """
    field = Field(lattice, sculpture, who)
    made = upper_face_shapes(field) | lid_shapes(field)
    jaw = jaw_shapes(field)
    made |= jaw | mouth_shapes(field, jaw["jawOpen"])
    names = tuple(sorted(made))
    deltas = np.stack([made[name] for name in names])
    gains = np.ones(len(names))
    if not who.generic:
        random = np.random.default_rng([abs(who.seed), 41])
        drawn = dict(zip(names, random.uniform(0.75, 1.25, len(names)), strict=True))
        for index, name in enumerate(names):
            if name.startswith(_EXACT):
                continue
            source = _TIED.get(name, name)
            gains[index] = drawn[source]
            own = wave(sculpture.vertices, 7919 * abs(who.seed) + names.index(source), 110.0)
            deltas[index] *= (gains[index] * (1.0 + 0.1 * np.clip(own, -2, 2)))[:, None]
    return Shapes(names, deltas, gains, _gaze(names))


def _gaze(names: tuple[str, ...]) -> Floats:
    gaze = np.zeros((2, len(names), 2))
    for eye, side, outward in ((0, "Right", -1.0), (1, "Left", 1.0)):
        for way, (turn, lift) in _GAZE.items():
            gaze[eye, names.index(f"eyeLook{way}{side}")] = [turn * outward, lift]
    return gaze
