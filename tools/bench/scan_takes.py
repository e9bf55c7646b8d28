"""A visiting take of a photographed head, with truth: skin without made-up pores to hold on to.

    python -m tools.bench.scan_takes OUT --shared ../shared [--size 1024] [--seed 5] [--relief 1]

The head is Lee Perry-Smith's scan (CC BY 3.0) under its photographed texture in linear light, half
a millimetre a texel, and its normal map, which shades but moves no surface (`--relief 0` leaves it
out: skin that is harder still), lit by four lights; sixteen cameras of its own with distortion,
gains, a point spread of 0.6 px and noise of 1.6 grey levels. OUT gets cameras.json,
`<camera>/0000.png` and truth.npz, so that score_scan.py works on it as on any rendered take. The
facets of the scan are the true surface: only the shading is smooth.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.archive import read_archive, write_archive
from capture.arrays import Floats, Floats32, Ints, Ints32
from capture.camera import Camera, CameraArray
from capture.camera_file import write_cameras
from capture.errors import TakeError, WorkError
from capture.pose import Pose
from recon.mesh import vertex_normals
from track.raster import Rasterizer

_MM_PER_UNIT = 52.0  # chin to crown 234 mm
_ORIGIN = np.array([-0.08, 1.2, 1.3])  # middle of the face, units of the scan
_REGION = ((-np.inf, np.inf), (-0.55, 3.2), (0.65, np.inf))  # chin to hairline, before the ears
_OVER = 2  # samples a pixel along each axis
_HALVINGS = 2  # of the drawn triangles, so that the lens is nearly projective within each
_YAWS_DEG = (-62.0, -45.0, -27.0, -9.0, 9.0, 27.0, 45.0, 62.0)
_PITCHES_DEG = ((14.0, -6.0), (22.0, 2.0))
_RADIUS_MM, _FOCAL_SIZES, _AIM_MM = 620.0, 2.25, np.array([0.0, 0.0, -10.0])
_PSF_PX, _NOISE_DN, _SHOT_DN, _WHITE_DN = 0.6, 1.6, 0.012, 350.0
_GROUND, _AMBIENT, _VIGNETTE = 0.07, 0.22, 0.08
_LIGHTS = np.array([[0.5, 0.6, 0.9], [-0.8, 0.1, 0.6], [0.0, -0.5, 0.9], [0.9, 0.0, 0.2]])
_POWERS = np.array([0.62, 0.35, 0.22, 0.2])
_GLOSS, _SHARPNESS = 0.05, 18.0
_Z = np.array([0.0, 0.0, 1.0])
_CHUNK = 1 << 14  # samples shaded at once
_REMAP_WIDTH = 256  # and texels looked up side by side


@dataclass(frozen=True, eq=False)
class Head:
    """A textured head in world space: mm, +Y up, the face along +Z, its middle at the origin.

    Attributes:
        vertices: (V, 3) float64 mm; those along texture seams are there more than once.
        normals: (V, 3) float64 unit, one a place, so that shading shows no seam.
        uv: (V, 2) float64, row 0 of the texture at v = 1.
        triangles: (T, 3) int32.
        texture: (H, W) float32 albedo 0..1.
        slopes: (H, W, 2) float32 of the normal along u and v, of the skin's relief.
    """

    vertices: Floats
    normals: Floats
    uv: Floats
    triangles: Ints32
    texture: Floats32
    slopes: Floats32

    def surface(self) -> tuple[Floats, Ints32]:
        """Places (V', 3), each once, and triangles (T', 3) between three of them."""
        return _weld(self.vertices, self.triangles)

    def halved(self) -> Head:
        """The same facets in four pieces each, by the middles of their sides."""
        sides = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, inverse = np.unique(sides, axis=0, return_inverse=True)
        ab, bc, ca = (inverse.reshape(-1, 3) + len(self.vertices)).T
        a, b, c = self.triangles.T
        quarters = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]

        def extended(values: Floats) -> Floats:
            return np.concatenate([values, values[edges].mean(axis=1)])

        return Head(
            extended(self.vertices), extended(self.normals), extended(self.uv),
            np.concatenate([np.stack(q, axis=1) for q in quarters]).astype(np.int32),
            self.texture, self.slopes,
        )  # fmt: skip

    def tangents(self) -> tuple[Floats, Floats]:
        """Unit directions (V, 3) in which u and v grow."""
        edges = np.diff(self.vertices[self.triangles], axis=1)
        steps = np.diff(self.uv[self.triangles], axis=1)
        turned = np.stack([steps[:, 1, 1], -steps[:, 0, 1], -steps[:, 1, 0], steps[:, 0, 0]], 1)
        sign = np.sign(turned[:, 0] * turned[:, 3] - turned[:, 1] * turned[:, 2])[:, None, None]
        along = sign * np.einsum("tij,tjx->tix", turned.reshape(-1, 2, 2), edges)
        total = np.zeros((len(self.vertices), 2, 3))
        for corner in range(3):
            np.add.at(total, self.triangles[:, corner], along)
        total /= np.maximum(np.linalg.norm(total, axis=2, keepdims=True), 1e-12)
        return total[:, 0], total[:, 1]


def load_head(folder: Path, relief: float = 1.0) -> Head:
    """Read the scan and its texture, and bring them to millimetres.

    Args:
        folder: of the scan.
        relief: strength of its normal map; 1 is the map as it is.

    Raises:
        ShapeError: when the archive is not what it should be.
        TakeError: when the texture is not there.
    """
    arrays = read_archive(folder / "LeePerrySmith.npz", ["V", "F", "T"])
    colour = _picture(folder / "color.jpg", cv2.IMREAD_GRAYSCALE)
    vertices = (arrays["V"].astype(np.float64) - _ORIGIN) * _MM_PER_UNIT
    triangles = arrays["F"].astype(np.int32)
    places, place = np.unique(vertices, axis=0, return_inverse=True)
    place = place.reshape(-1)
    normals = np.nan_to_num(vertex_normals(places, place[triangles].astype(np.int32)))[place]
    stored = colour.astype(np.float32) / np.float32(255.0)
    texture = np.where(stored > 0.04045, ((stored + 0.055) / 1.055) ** 2.4, stored / 12.92)
    bumps = _picture(folder / "normal.jpg", cv2.IMREAD_COLOR)
    slopes = relief * (bumps[:, :, :0:-1].astype(np.float32) / 127.5 - 1.0)  # stored B G R
    return Head(
        vertices, normals, arrays["T"].astype(np.float64), triangles,
        texture.astype(np.float32), slopes.astype(np.float32),
    )  # fmt: skip


def face_region(vertices: Floats) -> Ints:
    """Indices of the places (V, 3), world mm, on the face: chin to hairline, before the ears."""
    units = vertices / _MM_PER_UNIT + _ORIGIN
    inside = np.ones(len(units), np.bool_)
    for axis, (low, high) in enumerate(_REGION):
        inside &= (units[:, axis] > low) & (units[:, axis] < high)
    return np.flatnonzero(inside)


def studio(size: int, seed: int) -> CameraArray:
    """Sixteen cameras in two rows on an arc of +-62 degrees, none quite like another."""
    rng = np.random.default_rng([seed, 1])
    cameras: list[Camera] = []
    for column, yaw in enumerate(_YAWS_DEG):
        for pitch in _PITCHES_DEG[column % 2]:
            turn, rise = np.radians(rng.normal([yaw, pitch], 0.8))
            outward = np.array(
                [np.sin(turn) * np.cos(rise), np.sin(rise), np.cos(turn) * np.cos(rise)]
            )
            place = rng.normal(_RADIUS_MM, 6.0) * outward
            forward = _AIM_MM + rng.normal(0.0, 3.0, 3) - place
            forward /= np.linalg.norm(forward)
            right = np.cross(forward, [0.0, 1.0, 0.0])
            right /= np.linalg.norm(right)
            roll = Pose.from_rotation_vector(rng.normal(0.0, 0.02) * _Z, np.zeros(3))
            rotation = roll.rotation @ np.stack([right, np.cross(forward, right), forward])
            focal = _FOCAL_SIZES * size * (1.0 + rng.normal(0.0, 0.004))
            cx, cy = (size - 1) / 2 + rng.normal(0.0, 0.004 * size, 2)
            bend = rng.normal([-0.12, 0.15, 0.0, 0.0, 0.0], [0.01, 0.02, 2e-4, 2e-4, 0.0])
            cameras.append(
                Camera(
                    name=f"cam{len(cameras):02d}", width=size, height=size, fx=focal, fy=focal,
                    cx=float(cx), cy=float(cy), distortion=bend,
                    camera_from_world=Pose(rotation, -rotation @ place),
                )
            )  # fmt: skip
    return CameraArray(tuple(cameras))


def photographs(
    head: Head, cameras: CameraArray, seed: int, frame: int = 0
) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """The 8-bit picture (H, W) of each camera, by name: its own gain, the frame's own noise."""
    lights = _LIGHTS + np.random.default_rng([seed, 2]).normal(0.0, 0.12, _LIGHTS.shape)
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    fine = head
    for _ in range(_HALVINGS):
        fine = fine.halved()
    raster = Rasterizer(fine.triangles, len(fine.vertices))
    attributes = _attributes(fine)
    for index, camera in enumerate(cameras):
        rng = np.random.default_rng([seed, 3, index])
        gain = float(rng.normal(1.0, 0.03))
        if frame > 0:
            rng = np.random.default_rng([seed, 3, index, frame])
        light = _light((fine, attributes), raster, _enlarged(camera), lights)
        yield camera.name, _exposed(light, gain, rng)


def write_take(out: Path, head: Head, cameras: CameraArray, seed: int) -> None:
    """Write a visiting take of one frame, and its truth.

    Raises:
        WorkError: when a picture cannot be written.
    """
    for name, picture in photographs(head, cameras, seed):
        (out / name).mkdir(parents=True, exist_ok=True)
        if not cv2.imwrite(str(out / name / "0000.png"), picture):
            raise WorkError(f"{out / name / '0000.png'}: cannot be written")
    write_cameras(out / "cameras.json", cameras)
    vertices, triangles = head.surface()
    write_archive(
        out / "truth.npz",
        {
            "vertices": vertices[None].astype(np.float32),
            "faces": triangles,
            "face_region": face_region(vertices),
        },
    )


def main() -> None:
    """Render one take."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--shared", type=Path, required=True, help="folder with data/")
    parser.add_argument("--size", type=int, default=1024, help="of the square images, px")
    parser.add_argument("--seed", type=int, default=5, help="of cameras, lights, gains and noise")
    parser.add_argument("--relief", type=float, default=1.0, help="strength of the normal map")
    arguments = parser.parse_args()
    head = load_head(arguments.shared / "data" / "lee-perry-smith", arguments.relief)
    write_take(arguments.out, head, studio(arguments.size, arguments.seed), arguments.seed)


def _picture(path: Path, flags: int) -> NDArray[np.uint8]:
    found = cv2.imread(str(path), flags)
    if found is None:
        raise TakeError(f"{path}: no such picture")
    return np.asarray(found, dtype=np.uint8)


def _weld(vertices: Floats, triangles: Ints32) -> tuple[Floats, Ints32]:
    places, place = np.unique(vertices, axis=0, return_inverse=True)
    joined = place.reshape(-1)[triangles].astype(np.int32)
    whole = (joined != np.roll(joined, 1, axis=1)).all(axis=1)
    return places, joined[whole]


def _enlarged(camera: Camera) -> Camera:
    """The camera that takes `_OVER` x `_OVER` samples of every pixel, evenly about its centre."""
    shift = (_OVER - 1) / 2
    return Camera(
        name=camera.name, width=_OVER * camera.width, height=_OVER * camera.height,
        fx=_OVER * camera.fx, fy=_OVER * camera.fy,
        cx=_OVER * camera.cx + shift, cy=_OVER * camera.cy + shift,
        distortion=camera.distortion, camera_from_world=camera.camera_from_world,
    )  # fmt: skip


def _light(
    shown: tuple[Head, Floats32], raster: Rasterizer, camera: Camera, lights: Floats
) -> Floats32:
    """What falls on the sensor (H, W), 1 at full white, of a head and its vertices' attributes."""
    head, attributes = shown
    seen = raster.render(camera, head.vertices)
    out = np.full(seen.triangle.size, np.float32(_GROUND))
    covered = np.flatnonzero(seen.triangle.ravel() >= 0)
    triangles, barycentric = seen.triangle.ravel(), seen.barycentric.reshape(-1, 3)
    eye = camera.centre.astype(np.float32)[:, None]
    for start in range(0, len(covered), _CHUNK):
        at = covered[start : start + _CHUNK]
        a, b, c = head.triangles[triangles[at]].T
        wa, wb, wc = np.ascontiguousarray(barycentric[at].T)
        mixed = wa * attributes[:, a] + wb * attributes[:, b] + wc * attributes[:, c]
        uv, places, normals = mixed[:2], mixed[2:5], mixed[5:8]
        albedo = _texels(head.texture, uv)
        for axis in range(2):
            slope = _texels(head.slopes[:, :, axis], uv)
            normals = normals + slope * mixed[8 + 3 * axis : 11 + 3 * axis]
        out[at] = _shade(albedo, normals, eye - places, lights.astype(np.float32))
    return out.reshape(seen.triangle.shape)


def _attributes(head: Head) -> Floats32:
    """What is mixed over triangles, (14, V): uv, place, normal, the directions of u and of v."""
    columns = [head.uv, head.vertices, head.normals, *head.tangents()]
    return np.ascontiguousarray(np.concatenate(columns, axis=1).T, dtype=np.float32)


def _texels(texture: Floats32, uv: Floats32) -> Floats32:
    """Texture (N,) at uv (2, N), bicubic."""
    height, width = texture.shape
    count = uv.shape[1]
    rows = -(-count // _REMAP_WIDTH)  # remap is slow on narrow pictures
    at = np.zeros((2, rows * _REMAP_WIDTH), np.float32)
    at[:, :count] = uv[0] * width - 0.5, (1.0 - uv[1]) * height - 0.5
    columns, lines = at.reshape(2, rows, _REMAP_WIDTH)
    found = cv2.remap(texture, columns, lines, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    values: Floats32 = np.asarray(found, np.float32).reshape(-1)[:count]
    return values


def _shade(albedo: Floats32, normals: Floats32, towards: Floats32, lights: Floats32) -> Floats32:
    """Lambert with a little wrap, and a soft Blinn-Phong highlight; nothing casts a shadow.

    Albedo (N,), normals and directions to the eye (3, N), lights (L, 3).
    """
    normal = normals / np.maximum(_length(normals), np.float32(1e-9))
    eye = towards / _length(towards)
    total = np.float32(_AMBIENT) * albedo
    for light, power in zip(lights, _POWERS, strict=True):
        facing = (light @ normal + np.float32(0.15)) / np.float32(1.15)
        total += albedo * np.float32(power) * np.maximum(facing, np.float32(0.0))
        half = light[:, None] + eye
        half /= _length(half)
        x, y, z = normal * half
        shine = np.maximum(x + y + z, np.float32(0.0)) ** np.float32(_SHARPNESS)
        total += np.float32(_GLOSS * power * _SHARPNESS / 16.0) * shine
    return total


def _length(vectors: Floats32) -> Floats32:
    x, y, z = vectors
    length: Floats32 = np.sqrt(x * x + y * y + z * z)
    return length


def _exposed(light: Floats32, gain: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Blur, pixels' areas, vignette, gain, noise, 8 bits."""
    soft = cv2.GaussianBlur(light, (0, 0), _OVER * _PSF_PX)
    size = (light.shape[1] // _OVER, light.shape[0] // _OVER)
    pixels = cv2.resize(soft, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    rows, columns = (np.linspace(-1.0, 1.0, count) ** 2 for count in pixels.shape)
    signal = _WHITE_DN * gain * pixels * (1.0 - _VIGNETTE * (rows[:, None] + columns[None]))
    noise = rng.normal(size=signal.shape) * np.sqrt(_NOISE_DN**2 + _SHOT_DN * signal)
    return np.clip(np.rint(signal + noise), 0, 255).astype(np.uint8)


if __name__ == "__main__":
    main()
