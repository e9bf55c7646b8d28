"""A textured, bumpy patch that bends and turns before a few cameras: the tracker's small truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from capture.arrays import Floats, Floats32, Ints32
from capture.camera import Camera, CameraArray
from capture.camera_file import write_cameras
from capture.pose import Pose
from recon.mesh import Mesh
from recon.surface import Scan, write_ply
from tests.synthetic import looking_at
from track.raster import Rasterizer


def patch_mesh(side: int = 18) -> Mesh:
    """A quad grid over 90 x 90 mm with a nose and waves, facing +Z."""
    y, x = np.mgrid[side:-1:-1, 0 : side + 1] * (90.0 / side) - 45.0
    z = 12.0 * np.exp(-(x**2 + y**2) / 300.0) - 0.006 * (x**2 + y**2) + np.sin(x / 7.0)
    corner = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    quads = np.stack([corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:], corner[:-1, :-1]], -1)
    return Mesh(np.stack([x, y, z], -1).reshape(-1, 3), quads.reshape(-1, 4).astype(np.int32))


def patch_array(count: int = 4, size: int = 200) -> CameraArray:
    """Cameras 300 mm away, spread over 60 degrees, at two heights."""
    cameras = []
    for c in range(count):
        angle = np.radians(60.0) * (c / max(count - 1, 1) - 0.5)
        centre = 300.0 * np.array([np.sin(angle), 0.15 * (-1) ** c, np.cos(angle)])
        cameras.append(
            Camera(
                name=f"cam{c:02d}",
                width=size,
                height=size,
                fx=2.6 * size,
                fy=2.6 * size,
                cx=size / 2 + 0.3,
                cy=size / 2 - 0.7,
                distortion=np.array([-0.12, 0.1, 1e-4, -2e-4, 0.0]),
                camera_from_world=looking_at(centre, np.zeros(3)),
            )
        )
    return CameraArray(tuple(cameras))


def patch_motion(rest: Floats, amount: float) -> Floats:
    """The patch bent, stretched and turned; `amount` 0 is rest."""
    x, y = rest[:, 0], rest[:, 1]
    bent = rest.copy()
    bent[:, 2] += amount * 3.0 * np.exp(-((x - 15) ** 2 + (y + 10) ** 2) / 200.0)
    bent[:, 0] += amount * 1.5 * np.exp(-((x + 15) ** 2 + y**2) / 250.0)
    turn = Pose.from_rotation_vector(amount * np.array([0.04, 0.06, 0.02]), np.zeros(3))
    return turn.apply(bent) + amount * np.array([1.5, -1.0, 2.0])


def skin(points: Floats, seed: int = 3) -> Floats:
    """A grey texture 0..1 of rest-space points (N, 3): waves of 3 to 12 mm in all directions."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0.0, 1.0, (60, 3))
    waves *= (2 * np.pi / rng.uniform(3.0, 12.0, 60) / np.linalg.norm(waves, axis=1))[:, None]
    total = np.cos(points @ waves.T + rng.uniform(0, 6.28, 60)).sum(axis=1)
    grey: Floats = 0.5 + 0.3 * np.tanh(total / 6.0)
    return grey


def picture(camera: Camera, mesh: Mesh, vertices: Floats, gain: float = 1.0) -> Floats32:
    """The patch with vertices (V, 3), textured at rest, on grey 0.2; float32 0..1."""
    buffers = _raster(mesh.triangles, len(vertices)).render(camera, vertices)
    image = np.full((camera.height, camera.width), 0.2)
    y, x = np.nonzero(buffers.triangle >= 0)
    corners = mesh.vertices[mesh.triangles[buffers.triangle[y, x]]]
    weights = buffers.barycentric[y, x].astype(np.float64)
    image[y, x] = skin(np.einsum("nk,nkx->nx", weights, corners))
    return (gain * image).astype(np.float32)


def write_patch_visit(
    folder: Path, amounts: list[float], seed: int = 0, cameras: CameraArray | None = None
) -> tuple[Mesh, Floats]:
    """A visiting take of the patch, with noise of 1.5 DN; returns the mesh and truth (F, V, 3)."""
    mesh = patch_mesh()
    truth = np.stack([patch_motion(mesh.vertices, amount) for amount in amounts])
    write_visit(folder, mesh, truth, seed, cameras)
    return mesh, truth


def write_visit(
    folder: Path, mesh: Mesh, truth: Floats, seed: int = 0, cameras: CameraArray | None = None
) -> None:
    """A visiting take of a textured mesh that moves as `truth` (F, V, 3), with noise of 1.5 DN."""
    rng = np.random.default_rng(seed)
    cameras = cameras or patch_array()
    write_cameras(folder / "cameras.json", cameras)
    for camera in cameras:
        (folder / camera.name).mkdir()
        for f, vertices in enumerate(truth):
            grey = 235.0 * picture(camera, mesh, vertices, gain=1.0 - 0.05 * (f % 2))
            noisy = np.clip(np.rint(grey + rng.normal(0, 1.5, grey.shape)), 0, 255)
            cv2.imwrite(str(folder / camera.name / f"{f:04d}.png"), noisy.astype(np.uint8))


def slit_mesh(side: int = 18, half_columns: int = 5) -> tuple[Mesh, Floats]:
    """The patch cut along the middle of its middle row, as closed lips are.

    Returns:
        The mesh, and (V,) 1 for vertices below the cut's line (its lower lip included), else 0.
    """
    mesh = patch_mesh(side)
    middle = side // 2
    columns = np.arange(middle - half_columns + 1, middle + half_columns)
    lip = middle * (side + 1) + columns
    twin = np.arange(len(mesh.vertices)).astype(np.int32)
    twin[lip] = len(mesh.vertices) + np.arange(len(lip))
    quads = mesh.polygons.copy()
    under = mesh.vertices[quads].mean(axis=1)[:, 1] < mesh.vertices[lip[0], 1]
    quads[under] = twin[quads[under]]
    below = mesh.vertices[:, 1] < mesh.vertices[lip[0], 1] - 1e-6
    vertices = np.concatenate([mesh.vertices, mesh.vertices[lip]])
    return Mesh(vertices, quads), np.concatenate([below, np.ones(len(lip))]).astype(float)


def write_patch_scan(take: Path, frame: int, mesh: Mesh, vertices: Floats, seed: int = 0) -> Path:
    """A scan of the patch with vertices (V, 3) at a frame of a take, with noise of 0.05 mm."""
    noise = np.random.default_rng(seed).normal(0.0, 0.05, vertices.shape)
    path = take / "products" / "recon" / f"frame_{frame:04d}.ply"
    path.parent.mkdir(parents=True, exist_ok=True)
    moved = mesh.with_vertices(vertices + noise)
    scan = Scan(
        vertices=moved.vertices.astype(np.float32),
        triangles=moved.triangles,
        normals=moved.normals().astype(np.float32),
        confidence=np.ones(len(vertices), np.float32),
    )
    write_ply(path, scan)
    return path


def _raster(triangles: Ints32, count: int) -> Rasterizer:
    return Rasterizer(triangles, count)
