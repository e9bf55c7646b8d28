"""An analytic head whose vertices correspond over identities: truth for registrations."""

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, Ints32
from recon.mesh import Mesh


@dataclass(frozen=True, kw_only=True)
class Identity:
    """Sizes of a head, mm."""

    width: float = 75.0
    height: float = 105.0
    depth: float = 88.0
    nose: float = 24.0
    nose_up: float = 0.0
    eyes: float = 11.0
    lips: float = 6.0
    chin: float = 9.0


def head(identity: Identity, columns: int = 72, rows: int = 56) -> Mesh:
    """A closed-round head of quads, open at the neck, looking along +Z, +Y up, in mm."""
    yaw = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    pitch = np.linspace(-1.05, 1.5, rows)
    u, v = np.meshgrid(yaw, pitch)
    direction = np.stack([np.sin(u) * np.cos(v), np.sin(v), np.cos(u) * np.cos(v)], axis=-1)
    surface = direction * [identity.width, identity.height, identity.depth]
    features = (
        (0.0, -0.05 + identity.nose_up, identity.nose, 0.16, 0.22),
        (0.42, 0.22, -identity.eyes, 0.17, 0.13),
        (-0.42, 0.22, -identity.eyes, 0.17, 0.13),
        (0.42, 0.42, 5.0, 0.30, 0.10),
        (-0.42, 0.42, 5.0, 0.30, 0.10),
        (0.0, -0.42, identity.lips, 0.28, 0.06),
        (0.0, -0.56, identity.lips, 0.24, 0.06),
        (0.0, -0.85, identity.chin, 0.25, 0.14),
        (1.6, 0.05, 12.0, 0.12, 0.20),
        (-1.6, 0.05, 12.0, 0.12, 0.20),
    )
    for yaw_at, pitch_at, size, yaw_width, pitch_width in features:
        away = ((u - yaw_at) / yaw_width) ** 2 + ((v - pitch_at) / pitch_width) ** 2
        surface = surface + (size * np.exp(-0.5 * away))[..., None] * direction
    index = np.arange(rows * columns).reshape(rows, columns)
    right = np.roll(index, -1, axis=1)
    quads = np.stack([index[:-1], right[:-1], right[1:], index[1:]], axis=-1).reshape(-1, 4)
    return Mesh(surface.reshape(-1, 3), quads.astype(np.int32))


def finer(identity: Identity) -> tuple[Floats, Ints32]:
    """The same head sampled densely: (vertices, triangles)."""
    mesh = head(identity, 216, 168)
    return mesh.vertices, mesh.triangles


TEMPLATE = Identity()
ACTOR = Identity(
    width=80.0, height=101.0, depth=91.0, nose=29.0, nose_up=0.03, eyes=9.0, lips=7.0, chin=13.0
)


def face_vertices(template: Mesh) -> Ints32:
    """Vertices of the template's face: in front and not on the neck's rim."""
    vertices = template.vertices
    front = (vertices[:, 2] > 25.0) & (vertices[:, 1] > -80.0) & (vertices[:, 1] < 75.0)
    return np.flatnonzero(front).astype(np.int32)
