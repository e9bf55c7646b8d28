"""The patch as a subject of corrections, and one correction of every kind."""

from __future__ import annotations

import hashlib

import numpy as np

from tests.track.moving_patch import patch_array, patch_mesh
from track.corrections.checks import Subject
from track.corrections.entries import (
    Anchor,
    Correction,
    Curve,
    FrameExclusion,
    Pin,
    ViewExclusion,
)
from track.corrections.sidecar import LockedFrame

MESH = patch_mesh()
SUBJECT = Subject(
    frames=tuple(range(10)),
    cameras=patch_array(),
    vertex_count=len(MESH.vertices),
    triangles=MESH.triangles,
    topology=hashlib.sha256(MESH.polygons.tobytes()).hexdigest(),
)
TRIANGLE = tuple(MESH.triangles[7].tolist())
EVERY: tuple[Correction, ...] = (
    Pin(frame=2, corners=(100,), barycentric=(1.0,), pixels={"cam01": (40.25, 50.5)}),
    Pin(
        frame=2,
        corners=TRIANGLE,
        barycentric=(0.25, 0.25, 0.5),
        pixels={"cam03": (60.0, 70.0), "cam00": (61.0, 72.0)},
        weight=0.5,
    ),
    Curve(
        frame=3,
        camera="cam02",
        chain="upper lip",
        vertices=(40, 41, 42, 43),
        pixels=((10.0, 20.0), (30.0, 25.0), (50.0, 20.5)),
    ),
    ViewExclusion(camera="cam00", first=4, last=6),
    FrameExclusion(first=5, last=5),
    Anchor(frame=8),
)


def locked(seed: int) -> LockedFrame:
    """Vertices that no frame has."""
    rng = np.random.default_rng(seed)
    return LockedFrame(
        vertices=rng.normal(0, 30, MESH.vertices.shape).astype(np.float32),
        confidence=rng.uniform(0, 1, len(MESH.vertices)).astype(np.float32),
    )
