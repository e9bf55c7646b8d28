"""An analytic head with 68 landmarks and a skin of noise, and pictures of it."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats, Floats32
from capture.camera import Camera, CameraArray
from recon.mesh import Mesh
from tests.track.face_scene import TEMPLATE, head
from tools.bench.neutral_scene import arc_cameras
from track.face_landmarks import LANDMARK_NAMES
from track.landmark_map import LandmarkMap, vertex_map
from track.raster import Rasterizer

COLUMNS, ROWS = 96, 80


def face() -> Mesh:
    return head(TEMPLATE, COLUMNS, ROWS)


def face_map(mesh: Mesh) -> LandmarkMap:
    """The vertices nearest to where the layout's landmarks would be on that head."""
    places = [(yaw, -0.85 + 0.7 * abs(yaw)) for yaw in np.linspace(-1.2, 1.2, 17)]
    places += [(yaw, 0.42) for yaw in (-0.65, -0.53, -0.42, -0.3, -0.2, 0.2, 0.3, 0.42, 0.53, 0.65)]
    places += [(0.0, pitch) for pitch in (0.2, 0.1, 0.02, -0.06)]
    places += [(yaw, -0.2) for yaw in (-0.18, -0.09, 0.0, 0.09, 0.18)]
    for middle in (-0.42, 0.42):
        places += [
            (middle + x, 0.22 + y)
            for x, y in (
                (-0.17, 0),
                (-0.06, 0.08),
                (0.06, 0.08),
                (0.17, 0),
                (0.06, -0.08),
                (-0.06, -0.08),
            )
        ]
    ring = np.linspace(np.pi, -np.pi, 13)[:-1]
    places += [(0.3 * np.cos(a), -0.49 + 0.11 * np.sin(a)) for a in ring]
    places += [
        (0.24 * np.cos(a), -0.49 + 0.03 * np.sin(a))
        for a in ring[::3].tolist() + [-0.8, 0.8, 2.0, -2.0]
    ]
    yaw, pitch = np.array(places).T
    direction = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    round_ = mesh.vertices / [TEMPLATE.width, TEMPLATE.height, TEMPLATE.depth]
    round_ = round_ / np.linalg.norm(round_, axis=1, keepdims=True)
    nearest = np.argmax(round_ @ direction, axis=0)
    return vertex_map(dict(zip(LANDMARK_NAMES, nearest.tolist(), strict=True)), mesh.triangles)


def face_cameras(count: int = 4) -> CameraArray:
    whole = arc_cameras(np.array([0.0, 0.0, 40.0]), count=16)
    chosen = [whole[k] for k in np.linspace(3, 12, count).astype(int)]
    return CameraArray(tuple(chosen))


def photograph(camera: Camera, mesh: Mesh, vertices: Floats, skin: Floats) -> Floats32:
    """A mono picture of a posed mesh whose vertices have grey values `skin` (V,)."""
    drawn = Rasterizer(mesh.triangles, len(vertices)).render(camera, vertices)
    corners = mesh.triangles[np.maximum(drawn.triangle, 0)]
    grey = np.einsum("hwk,hwk->hw", drawn.barycentric, skin[corners])
    return np.where(drawn.triangle >= 0, grey, 0.08).astype(np.float32)


def noisy_skin(mesh: Mesh, where: LandmarkMap, seed: int = 0) -> Floats:
    """Grey values (V,): smooth noise, and dark where landmarks are, as features of a face are."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0.0, 0.12, (40, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, 40)
    grey = 0.5 + 0.05 * np.sin(mesh.vertices @ waves.T + phase).sum(axis=1) / np.sqrt(5.0)
    points = where.surface.points(mesh.vertices)[17:]
    away = np.linalg.norm(mesh.vertices[:, None] - points, axis=2).min(axis=1)
    return np.clip(grey - 0.3 * np.exp(-((away / 4.0) ** 2)), 0.02, 1.0)
