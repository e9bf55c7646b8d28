"""The camera model: the only projection and the only distortion in the program.

Camera space is OpenCV's: +X right, +Y down, +Z forward, millimetres. Pixel centres lie at integers.
Distortion is Brown-Conrady with k1 k2 p1 p2 k3, in OpenCV's order and sign.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, check_shape
from capture.errors import CameraError
from capture.pose import Pose

_UNDISTORT_STEPS = 50
_UNDISTORT_TOLERANCE = 1e-13  # normalised units: about 1e-9 px


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """One calibrated projection.

    Attributes:
        name: unique in its array.
        width: image columns, px.
        height: image rows, px.
        fx: focal length along columns, px.
        fy: focal length along rows, px.
        cx: principal point column, px, centre of the first pixel at 0.
        cy: principal point row, px.
        distortion: (5,) k1 k2 p1 p2 k3.
        camera_from_world: rigid motion from world to camera space, mm.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Floats
    camera_from_world: Pose

    def __post_init__(self) -> None:
        distortion = np.array(self.distortion, dtype=np.float64)
        check_shape(distortion=(distortion, "5"))
        numbers = np.array([self.fx, self.fy, self.cx, self.cy, *distortion])
        if not np.isfinite(numbers).all():
            raise CameraError(f"{self.name}: expected finite intrinsics, found {numbers.tolist()}")
        if self.fx <= 0 or self.fy <= 0:
            raise CameraError(
                f"{self.name}: focal lengths must be above 0 px, found {self.fx}, {self.fy}"
            )
        if self.width < 1 or self.height < 1:
            raise CameraError(
                f"{self.name}: size must be at least 1 x 1 px, found {self.width} x {self.height}"
            )
        distortion.flags.writeable = False
        object.__setattr__(self, "distortion", distortion)

    @property
    def matrix(self) -> Floats:
        """The (3, 3) intrinsic matrix K, px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def centre(self) -> Floats:
        """The projection centre (3,), world mm."""
        return self.camera_from_world.inverse().translation

    def project(self, points: Floats) -> Floats:
        """Project world points to pixels.

        Args:
            points: (N, 3) world, mm; NaN gives NaN.

        Returns:
            (N, 2) pixels (column, row); NaN where the point is not in front of the camera.
        """
        check_shape(points=(points, "N 3"))
        local = self.camera_from_world.apply(points)
        depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
        bent = self.distort(local[:, :2] / depth[:, None])
        return bent * [self.fx, self.fy] + [self.cx, self.cy]

    def project_jacobian(self, points: Floats) -> Floats:
        """Derivative of `project` by the world point.

        Args:
            points: (N, 3) world, mm.

        Returns:
            (N, 2, 3) px per mm; NaN where the point is not in front of the camera.
        """
        check_shape(points=(points, "N 3"))
        local = self.camera_from_world.apply(points)
        depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
        flat = local[:, :2] / depth[:, None]
        by_local = np.zeros((len(points), 2, 3))
        by_local[:, 0, 0] = by_local[:, 1, 1] = 1.0 / depth
        by_local[:, :, 2] = -flat / depth[:, None]
        by_flat = self.distort_jacobian(flat) * np.array([self.fx, self.fy])[None, :, None]
        chained: Floats = by_flat @ by_local @ self.camera_from_world.rotation
        return chained

    def distort(self, flat: Floats) -> Floats:
        """Bend ideal normalised image points (N, 2), x = X/Z, into distorted normalised ones.

        References:
            Brown 1971; OpenCV calib3d, "Detailed Description", the first five coefficients.
        """
        check_shape(flat=(flat, "N 2"))
        k1, k2, p1, p2, k3 = self.distortion
        x, y = flat[:, 0], flat[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=1,
        )

    def distort_jacobian(self, flat: Floats) -> Floats:
        """Derivative (N, 2, 2) of `distort` by the ideal normalised point (N, 2)."""
        check_shape(flat=(flat, "N 2"))
        k1, k2, p1, p2, k3 = self.distortion
        x, y = flat[:, 0], flat[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))  # d radial / d x = slope x
        out = np.empty((len(flat), 2, 2))
        out[:, 0, 0] = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        out[:, 0, 1] = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        out[:, 1, 0] = out[:, 0, 1]
        out[:, 1, 1] = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        return out

    def undistort(self, pixels: Floats) -> Floats:
        """Ideal normalised image points of distorted pixels, by damped Newton steps.

        Args:
            pixels: (N, 2) (column, row), px; NaN gives NaN.

        Returns:
            (N, 2) normalised x = X/Z, y = Y/Z; NaN where no ideal point maps to the pixel within
            1e-7 px-per-focal, which only happens beyond the fold of a strong barrel distortion.
        """
        check_shape(pixels=(pixels, "N 2"))
        target = (np.asarray(pixels, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        flat = target.copy()
        for _ in range(_UNDISTORT_STEPS):
            miss = self.distort(flat) - target
            size = np.abs(miss).max(axis=1)
            if not np.nanmax(size, initial=0.0) > _UNDISTORT_TOLERANCE:
                break
            slope = self.distort_jacobian(flat)
            determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
            determinant = np.where(np.abs(determinant) < 1e-3, 1e-3, determinant)
            step = (
                np.stack(
                    [
                        slope[:, 1, 1] * miss[:, 0] - slope[:, 0, 1] * miss[:, 1],
                        slope[:, 0, 0] * miss[:, 1] - slope[:, 1, 0] * miss[:, 0],
                    ],
                    axis=1,
                )
                / determinant[:, None]
            )
            length = np.linalg.norm(step, axis=1, keepdims=True)
            flat = flat - step * np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))
        lost = ~(np.abs(self.distort(flat) - target).max(axis=1) < 1e-10)
        flat[lost] = np.nan
        return flat

    def unproject(self, pixels: Floats, depth: Floats) -> Floats:
        """World points of pixels at a known depth: the inverse of `project`.

        Args:
            pixels: (N, 2) (column, row), px.
            depth: (N,) camera-space Z, mm; NaN gives NaN.

        Returns:
            (N, 3) world, mm.
        """
        check_shape(pixels=(pixels, "N 2"), depth=(depth, "N"))
        flat = self.undistort(pixels)
        local = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) * np.asarray(depth)[:, None]
        return self.camera_from_world.inverse().apply(local)

    def rays(self, pixels: Floats) -> Floats:
        """Unit directions (N, 3) in world space from the centre through pixels (N, 2)."""
        flat = self.undistort(pixels)
        local = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        turned: Floats = local @ self.camera_from_world.rotation
        return turned

    def depths(self, points: Floats) -> Floats:
        """Camera-space Z (N,) of world points (N, 3), mm; negative behind the camera."""
        check_shape(points=(points, "N 3"))
        return self.camera_from_world.apply(points)[:, 2]

    def contains(self, pixels: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Whether pixels (N, 2) lie on the image, borders at -0.5 and size - 0.5; NaN does not."""
        check_shape(pixels=(pixels, "N 2"))
        x, y = pixels[:, 0], pixels[:, 1]
        inside: np.ndarray[tuple[int], np.dtype[np.bool_]] = (
            (x >= -0.5) & (x <= self.width - 0.5) & (y >= -0.5) & (y <= self.height - 0.5)
        )
        return inside

    def posed(self, camera_from_world: Pose) -> Camera:
        """The same lens at another place."""
        return Camera(
            name=self.name, width=self.width, height=self.height, fx=self.fx, fy=self.fy,
            cx=self.cx, cy=self.cy, distortion=self.distortion, camera_from_world=camera_from_world,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class CameraArray:
    """The calibrated cameras of one array, in a fixed order with unique names."""

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        names = [camera.name for camera in self.cameras]
        double = sorted({name for name in names if names.count(name) > 1})
        if double:
            raise CameraError(f"camera names must be unique, found twice: {', '.join(double)}")

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, index: int) -> Camera:
        return self.cameras[index]

    @property
    def names(self) -> tuple[str, ...]:
        """Camera names, in order."""
        return tuple(camera.name for camera in self.cameras)

    def by_name(self, name: str) -> Camera:
        """The camera called `name`.

        Raises:
            CameraError: naming the cameras there are.
        """
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise CameraError(f"no camera {name!r} in this array; it has {', '.join(self.names)}")

    def project(self, points: Floats) -> Floats:
        """Pixels (C, N, 2) of world points (N, 3); NaN behind a camera."""
        return np.stack([camera.project(points) for camera in self.cameras])
