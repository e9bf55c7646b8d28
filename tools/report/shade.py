"""Shaded pictures of meshes: a three-light studio over the rasterizer's triangle ids."""

from __future__ import annotations

import cv2
import numpy as np

from capture.arrays import Bools, Floats, Floats32, check_shape
from capture.camera import Camera
from capture.pose import Pose
from recon.mesh import Mesh, vertex_normals
from tools.report.picture import Pixels
from track.raster import Rasterizer

_SKIN = np.array([0.80, 0.74, 0.70], np.float32)
_BACKGROUND = 1.0
_OVERSAMPLE = 2
_FAR = 12.0  # distance of the studio camera in mesh radii: nearly orthographic
# directions to the lights in camera space (+X right, +Y down, +Z forward), and their strengths
_LIGHTS = (((-0.55, -0.65, -0.6), 0.62), ((0.75, -0.1, -0.55), 0.30), ((0.2, 0.9, -0.2), 0.10))
_AMBIENT = 0.16
_TURNED = 0.2  # of a normal's depth component: beyond it the mesh is seen from its inside
_INSIDE = 0.35  # how bright the inside is, as through an eye's opening to the back of the head
_HALFWAY = np.array([-0.3, -0.36, -1.0])  # between the key light and the camera


class Studio:
    """Renders one topology, again and again.

    Args:
        mesh: gives the topology; its vertices are the default.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._rasterizer = Rasterizer(mesh.triangles, len(mesh.vertices))
        self._of: Floats | None = None  # whose normals are kept: one mesh is often drawn many times
        self._normals: Floats32 = np.zeros((0, 3), np.float32)

    def portrait(self, vertices: Floats, camera: Camera, colours: Floats | None = None) -> Pixels:
        """The shaded mesh on white.

        Args:
            vertices: (V, 3), mm.
            camera: from where.
            colours: (V, 3) in 0..1, or the colour of clay.

        Returns:
            (H, W, 3) RGB.
        """
        return self.over(None, vertices, camera, colours)

    def over(
        self, plate: Pixels | None, vertices: Floats, camera: Camera, colours: Floats | None = None
    ) -> Pixels:
        """The shaded mesh over a plate (H, W, 3) of that camera, or over white."""
        check_shape(mesh=(self.mesh.vertices, "V 3"), vertices=(vertices, "V 3"))
        fine = enlarged(camera, _OVERSAMPLE)
        lit, seen = self._lit(vertices, fine, colours, hollow=plate is not None)
        canvas = np.full((fine.height, fine.width, 3), _BACKGROUND, np.float32)
        if plate is not None:
            size = (fine.width, fine.height)
            canvas = cv2.resize(plate, size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
            canvas /= 255.0
        canvas[seen] = lit[seen]
        small = cv2.resize(canvas, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        shown: Pixels = np.clip(np.rint(255.0 * small), 0, 255).astype(np.uint8)
        return shown

    def visible(self, vertices: Floats, camera: Camera, slack_mm: float = 1.5) -> Bools:
        """Which vertices (V,) the camera sees, with the mesh itself in the way.

        A vertex is compared with the farthest surface within a pixel of it, because on steep
        skin the nearest pixel centre alone may lie well in front of it.
        """
        depth = np.nan_to_num(self._rasterizer.render(camera, vertices).depth, nan=0.0)
        farthest = np.asarray(cv2.dilate(depth, np.ones((3, 3), np.uint8)))
        pixels, own = camera.project(vertices), camera.depths(vertices)
        inside = camera.contains(pixels)
        column, row = np.rint(np.where(inside[:, None], pixels, 0.0)).astype(int).T
        near = farthest[np.minimum(row, camera.height - 1), np.minimum(column, camera.width - 1)]
        seen: Bools = inside & (own <= near + slack_mm)
        return seen

    def _lit(
        self, vertices: Floats, camera: Camera, colours: Floats | None, hollow: bool
    ) -> tuple[Floats32, Bools]:
        """The lit picture and where it is drawn; a hollow mesh is not drawn on its inside."""
        buffers = self._rasterizer.render(camera, vertices)
        seen: Bools = buffers.triangle >= 0
        corners = self.mesh.triangles[buffers.triangle[seen]]
        share = buffers.barycentric[seen]
        if self._of is not vertices:  # callers draw an array, they do not change it in between
            self._of = vertices
            normals = vertex_normals(vertices, self.mesh.triangles)
            self._normals = np.nan_to_num(normals).astype(np.float32)
        local = np.einsum("nk,nkc->nc", share, self._normals[corners])
        local = local @ camera.camera_from_world.rotation.T.astype(np.float32)
        local /= np.sqrt(np.maximum((local**2).sum(axis=1, keepdims=True), 1e-18))
        if np.median(local[:, 2]) > 0.0:
            local *= -1.0  # polygons wound the other way
        inside = local[:, 2] > _TURNED
        local[local[:, 2] > 0] *= -1.0  # both sides are lit
        albedo = (
            _SKIN
            if colours is None
            else np.einsum("nk,nkc->nc", share, colours.astype(np.float32)[corners])
        )
        light = np.full(len(local), _AMBIENT, np.float32)
        for direction, strength in _LIGHTS:
            unit = (np.array(direction) / np.linalg.norm(direction)).astype(np.float32)
            light += strength * np.maximum(local @ unit, 0.0)
        half = (_HALFWAY / np.linalg.norm(_HALFWAY)).astype(np.float32)
        facing = np.maximum(local @ half, 0.0) ** 8
        shine = 0.10 * facing * facing * facing
        picture = np.zeros((camera.height, camera.width, 3), np.float32)
        shade = (albedo * light[:, None] + shine[:, None]) ** (1 / 1.35)
        shade[inside] *= _INSIDE
        picture[seen] = np.clip(shade, 0.0, 1.0)
        outside = seen.copy()
        outside[seen] = ~inside
        return picture, outside if hollow else seen


def studio_camera(vertices: Floats, yaw: float, size: int, pitch: float = 0.0) -> Camera:
    """A far camera that frames the vertices (V, 3), turned about the face.

    Args:
        vertices: (V, 3) mm; the face looks along +Z.
        yaw: radians; positive walks to +X, the face's own left side.
        size: width and height, px.
        pitch: radians; positive walks up.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centre = 0.5 * (low + high)
    away = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    forward = -away
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    radius = 0.5 * float(np.linalg.norm(high - low))
    local = (vertices - centre) @ rotation.T
    half = 1.05 * float(np.abs(local[:, :2]).max())
    eye = centre + _FAR * radius * away
    focal = 0.5 * size * (_FAR * radius - radius) / half
    middle = 0.5 * (size - 1)
    return Camera(
        name="studio", width=size, height=size, fx=focal, fy=focal, cx=middle, cy=middle,
        distortion=np.zeros(5), camera_from_world=Pose(rotation, -rotation @ eye),
    )  # fmt: skip


def enlarged(camera: Camera, factor: float) -> Camera:
    """The same view at `factor` times the size in px; pixel centres stay at integers."""
    return Camera(
        name=camera.name,
        width=round(camera.width * factor),
        height=round(camera.height * factor),
        fx=camera.fx * factor,
        fy=camera.fy * factor,
        cx=(camera.cx + 0.5) * factor - 0.5,
        cy=(camera.cy + 0.5) * factor - 0.5,
        distortion=camera.distortion,
        camera_from_world=camera.camera_from_world,
    )


def cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """The part of a camera's image that begins at (left, top), width by height px."""
    return Camera(
        name=camera.name, width=width, height=height, fx=camera.fx, fy=camera.fy,
        cx=camera.cx - left, cy=camera.cy - top,
        distortion=camera.distortion, camera_from_world=camera.camera_from_world,
    )  # fmt: skip
