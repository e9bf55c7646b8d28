"""Training pictures of one actor: his own skin under made-up expressions, with perfect labels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats
from capture.camera import Camera
from capture.pose import Pose
from recon.mesh import Mesh
from track.appearance import ActorSkin
from track.face_landmarks import LANDMARK_NAMES
from track.landmark_box import FaceBox, shades
from track.landmark_dlib import Gray
from track.landmark_map import LandmarkMap
from track.raster import RasterBuffers

_OFTEN = {"jaw_open": (0.6, 1.3), "jawOpen": (0.6, 1.3), "blink": (0.35, 1.0),
          "eyeBlink": (0.35, 1.0), "smile": (0.3, 1.2), "mouthSmile": (0.3, 1.2)}  # fmt: skip
_SIDES = ("_right", "_left", "_R", "_L", "Right", "Left")
_OPPOSED = ("mouth", "jaw")  # to the left and to the right cancel each other
_BOTH = 0.7  # of the moments in which a pair moves, both sides move alike
_HIDDEN_MM = 7.0  # a landmark this far behind what its pixel shows is not to be seen in the view


@dataclass(frozen=True, kw_only=True)
class Jitter:
    """How far training strays from the neutral; one standard deviation each.

    Attributes:
        turn_deg: of the head, about each axis.
        shift_mm: of the head, along each axis.
        box: of the box's middle and size, as a share of it.
        gain: of the light, as a share.
    """

    turn_deg: float = 5.0
    shift_mm: float = 8.0
    box: float = 0.05
    gain: float = 0.10


@dataclass(frozen=True, eq=False, kw_only=True)
class Act:
    """One made-up moment of the actor.

    Attributes:
        vertices: (V, 3) world mm.
        head: (4, 4) head from the neutral.
    """

    vertices: Floats
    head: Floats


@dataclass(frozen=True, eq=False, kw_only=True)
class Sheet:
    """Training pictures of one view.

    Attributes:
        images: N of (H, W) uint8.
        boxes: (N, 4) px.
        points: (N, K, 2) px.
    """

    images: list[Gray]
    boxes: Floats
    points: Floats


def made_up_acts(
    mesh: Mesh, shapes: Mapping[str, Floats], count: int, jitter: Jitter, seed: int
) -> list[Act]:
    """The neutral, then moments of a few mixed expressions and a head that turns.

    Args:
        mesh: the neutral, world mm.
        shapes: displacements (V, 3) by name.
        count: how many.
        jitter: of the head.
        seed: of all that is drawn.
    """
    rng = np.random.default_rng(seed)
    pairs = _pairs(shapes)
    middle = mesh.vertices.mean(axis=0)
    out = [Act(vertices=mesh.vertices, head=np.eye(4))]
    while len(out) < count:
        moved = mesh.vertices.copy()
        for name, weight in _mixed(pairs, rng).items():
            moved += weight * shapes[name]
        turn = Pose.from_rotation_vector(
            np.radians(jitter.turn_deg) * rng.normal(size=3), np.zeros(3)
        ).rotation
        head = np.eye(4)
        head[:3, :3] = turn
        head[:3, 3] = middle - turn @ middle + jitter.shift_mm * rng.normal(size=3)
        out.append(Act(vertices=moved @ turn.T + head[:3, 3], head=head))
    return out


def _pairs(names: Iterable[str]) -> dict[str, list[str]]:
    """Expressions by their name without a side: two sides, or one alone."""
    out: dict[str, list[str]] = {}
    for name in sorted(names):
        side = next((side for side in _SIDES if name.endswith(side)), "")
        stem = name.removesuffix(side)
        out.setdefault(name if stem in _OPPOSED else stem, []).append(name)
    return out


def _mixed(pairs: Mapping[str, list[str]], rng: np.random.Generator) -> dict[str, float]:
    """Weights of some expressions: those that move far more often than the rest."""
    stems = list(pairs)
    some = rng.choice(stems, min(int(rng.integers(0, 4)), len(stems)), replace=False).tolist()
    sizes = {stem: float(rng.uniform(0.2, 1.0)) for stem in some}
    for stem, (share, most) in _OFTEN.items():
        if stem in pairs and rng.uniform() < share:
            sizes[stem] = float(rng.uniform(0.0, most))
    out: dict[str, float] = {}
    for stem, size in sizes.items():
        alike = rng.uniform() < _BOTH
        parts = np.ones(len(pairs[stem])) if alike else rng.uniform(0.0, 1.0, len(pairs[stem]))
        out.update(zip(pairs[stem], (size * parts).tolist(), strict=True))
    return out


def view_landmarks(
    where: LandmarkMap, vertices: Floats, camera: Camera, buffers: RasterBuffers
) -> tuple[str, ...]:
    """Which of the 68 a view can tell: not behind the face, and on the image."""
    points = where.surface.points(vertices)
    near = np.rint(np.nan_to_num(camera.project(points), nan=-1.0)).astype(np.int64)
    inside = (near >= 0).all(axis=1) & (near[:, 0] < camera.width) & (near[:, 1] < camera.height)
    column, row = np.where(inside[:, None], near, 0).T
    behind = camera.depths(points) - buffers.depth[row, column]
    seen: Bools = inside & ~(behind > _HIDDEN_MM)
    return tuple(
        name
        for name, shown in zip(where.names, seen, strict=True)
        if shown and name in LANDMARK_NAMES
    )


def training_sheet(
    skin: ActorSkin,
    camera: Camera,
    acts: Sequence[Act],
    neutral_points: Floats,
    where: LandmarkMap,
    jitter: Jitter,
    seed: int,
) -> Sheet:
    """Draw every act as one view would see it, cut to a box that is a little off.

    Args:
        skin: the actor's.
        camera: the view.
        acts: what he does.
        neutral_points: (K, 3) the view's landmarks on the neutral, world mm.
        where: the same landmarks on the mesh.
        jitter: of box and light.
        seed: of all that is drawn.
    """
    rng = np.random.default_rng(seed)
    images, points = [], []
    for act in acts:
        posed = camera.project(neutral_points @ act.head[:3, :3].T + act.head[:3, 3])
        lens = FaceBox.around(posed).off(jitter.box, rng).lens(camera)
        inside = rng.uniform(0.1, 1.2, (16, 16)).astype(np.float32)  # teeth, tongue, or the dark
        picture = skin.draw(camera.name, lens, act.vertices, act.head, inside).image
        light = 1.0 + jitter.gain * rng.normal()
        slope = np.linspace(-1.0, 1.0, lens.width, dtype=np.float32)
        picture = picture * np.float32(light) * (1.0 + np.float32(0.1 * rng.normal()) * slope)
        picture = picture + rng.normal(0.0, 0.006, picture.shape).astype(np.float32)
        images.append(shades(picture))
        points.append(lens.project(where.surface.points(act.vertices)))
    boxes = np.tile(FaceBox.inner(), (len(acts), 1))
    return Sheet(images=images, boxes=boxes, points=np.array(points))
