"""A textured ellipsoid before a few cameras, by exact ray casting: stereo with known truth."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats, Floats32
from capture.camera import Camera, CameraArray
from capture.pose import Pose

RADII_MM = np.array([60.0, 80.0, 70.0])
NOISE = 0.004  # standard deviation, of a white of 1


def ring(
    degrees: tuple[float, ...] = (-18.0, 0.0, 18.0),
    heights: tuple[float, ...] = (0.0,),
    *,
    size: int = 200,
    distance_mm: float = 600.0,
) -> CameraArray:
    """Cameras around the origin that look at it, strongly distorted, each a little different."""
    cameras = []
    for height in heights:
        for angle in degrees:
            a, e = np.radians(angle), np.radians(height)
            position = distance_mm * np.array(
                [np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)]
            )
            cameras.append(_camera(f"cam{len(cameras):02d}", position, size))
    return CameraArray(tuple(cameras))


def texture(points: Floats) -> Floats:
    """Grey 0.25..0.75 of surface points (N, 3): a fixed sum of waves 4 to 25 mm long."""
    generator = np.random.default_rng(5)
    value = np.zeros(len(points))
    for _ in range(60):
        length = np.exp(generator.uniform(np.log(4.0), np.log(25.0)))
        direction = generator.normal(size=3)
        direction *= 2 * np.pi / length / np.linalg.norm(direction)
        value += np.sin(points @ direction + generator.uniform(0, 2 * np.pi))
    return 0.5 + 0.25 * np.tanh(value / 6.0)


def draw(camera: Camera, *, seed: int = 0, gain: float = 1.0) -> Floats32:
    """The view (H, W) in 0..1: four rays a pixel, dark ground, noise."""
    total = np.zeros(camera.width * camera.height)
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    for dx, dy in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        points = hit(camera, pixels + [dx, dy])
        seen = np.isfinite(points[:, 0])
        value = np.full(len(points), 0.05)
        value[seen] = texture(points[seen])
        total += 0.25 * value
    noise = np.random.default_rng((seed, sum(camera.name.encode()))).normal(0, NOISE, total.shape)
    return (
        np.clip(gain * total + noise, 0, 1).reshape(camera.height, camera.width).astype(np.float32)
    )


def hit(camera: Camera, pixels: Floats) -> Floats:
    """Where rays through pixels (N, 2) meet the ellipsoid (N, 3), mm; NaN where they miss it."""
    rays = camera.rays(pixels) / RADII_MM
    origin = camera.centre / RADII_MM
    a = (rays * rays).sum(axis=1)
    b = rays @ origin
    c = float(origin @ origin) - 1.0
    inside = b * b - a * c
    t = (-b - np.sqrt(np.where(inside > 0, inside, np.nan))) / a
    return (origin + t[:, None] * rays) * RADII_MM


def distance(points: Floats) -> Floats:
    """Signed distance (N,), mm, of points near the ellipsoid, to first order."""
    scaled = points / RADII_MM
    level = np.linalg.norm(scaled, axis=1)
    slope = np.linalg.norm(scaled / RADII_MM, axis=1) / level
    return (level - 1.0) / slope


def _camera(name: str, position: Floats, size: int) -> Camera:
    generator = np.random.default_rng(sum(name.encode()))
    z = -position / np.linalg.norm(position)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(z, x), z])
    roll = Pose.from_rotation_vector(np.array([0.0, 0.0, generator.normal(0, 0.03)]), np.zeros(3))
    rotation = roll.rotation @ axes
    focal = 2.9 * size * (1 + generator.normal(0, 0.01))
    middle = (size - 1) / 2
    return Camera(
        name=name, width=size, height=size, fx=focal, fy=focal * 1.001,
        cx=middle + generator.normal(0, 1.5), cy=middle + generator.normal(0, 1.5),
        distortion=np.array([-0.15, 0.2, 3e-4, -4e-4, 0.0]),
        camera_from_world=Pose(rotation, -rotation @ position),
    )  # fmt: skip
