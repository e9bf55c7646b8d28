"""Made-up scans of known surfaces, with noise, holes and borders, and templates out of place."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats, Ints, Ints32
from capture.camera import Camera, CameraArray
from capture.pose import Pose
from recon.mesh import Mesh, vertex_normals
from recon.surface import Scan
from track.rigid import Similarity
from track.visibility import count_views

_HOLE_MM = 6.0


def arc_cameras(centre: Floats, *, count: int = 16, radius_mm: float = 620.0) -> CameraArray:
    """Cameras on an arc of +-62 degrees in two rows before a face at `centre` looking along +Z."""
    cameras = []
    for index in range(count):
        yaw = np.radians(-62.0 + 124.0 * index / max(count - 1, 1))
        pitch = np.radians(18.0 if index % 2 else -4.0)
        outward = np.array(
            [np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)]
        )
        forward = -outward
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward])
        pose = Pose(turn, -turn @ (centre + radius_mm * outward))
        cameras.append(
            Camera(
                name=f"cam{index:02d}", width=640, height=640, fx=1440.0, fy=1440.0, cx=319.5,
                cy=319.5, distortion=np.zeros(5), camera_from_world=pose,
            )
        )  # fmt: skip
    return CameraArray(tuple(cameras))


def scan_of(
    surface: tuple[Floats, Ints32],
    cameras: CameraArray,
    *,
    noise_mm: float = 0.0,
    holes: int = 3,
    seed: int = 0,
) -> Scan:
    """What a stereo stage might give of a surface: what two cameras see, noisy, with holes.

    Args:
        surface: (vertices (V, 3) mm, triangles (T, 3)).
        cameras: who looks.
        noise_mm: standard deviation along the normal.
        holes: how many round holes are cut.
        seed: of noise and holes.
    """
    vertices, triangles = _halved(*surface)
    normals = np.nan_to_num(vertex_normals(vertices, triangles))
    eyes = np.array([camera.centre for camera in cameras])
    kept = count_views(vertices, triangles, eyes) >= 2
    rng = np.random.default_rng(seed)
    for centre in rng.choice(np.flatnonzero(kept), holes, replace=False):
        kept &= np.linalg.norm(vertices - vertices[centre], axis=1) > _HOLE_MM
    noisy = vertices + normals * rng.normal(0.0, noise_mm, (len(vertices), 1))
    faces = triangles[kept[triangles].all(axis=1)]
    used, compact = np.unique(faces, return_inverse=True)
    faces = compact.reshape(-1, 3).astype(np.int32)
    return Scan(
        noisy[used].astype(np.float32),
        faces,
        vertex_normals(noisy[used], faces).astype(np.float32),
        np.ones(len(used), np.float32),
    )


def misplaced(template: Mesh, seed: int, *, angle_deg: float = 20.0) -> Mesh:
    """The template turned by an angle about a random axis, moved by centimetres, scaled by 5 %."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis *= np.radians(angle_deg) / np.linalg.norm(axis)
    motion = Similarity(
        rotation=Pose.from_rotation_vector(axis, np.zeros(3)).rotation,
        translation=rng.normal(0.0, 40.0, 3),
        scale=float(rng.choice([0.95, 1.05])),
    )
    return template.with_vertices(motion.apply(template.vertices))


def _halved(vertices: Floats, triangles: Ints32) -> tuple[Floats, Ints32]:
    """Each triangle in four, by the middles of its sides."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(sides, axis=0, return_inverse=True)
    middle: Ints = (inverse.reshape(-1, 3) + len(vertices)).astype(np.int64)
    a, b, c = triangles.astype(np.int64).T
    ab, bc, ca = middle.T
    quarters = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    faces = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
    return np.concatenate([vertices, vertices[edges].mean(axis=1)]), faces.astype(np.int32)
