"""Ready-made ways to merge the depth maps of pairs: TSDF of Open3D, `stereo_fusion` of COLMAP.

Opponents in `bench_fusion`, and nothing else: the product calls neither. Both take one depth map a
pair, in the pinhole view that the pair was rectified to, so that a camera that is the reference of
several pairs stands there several times; COLMAP, which knows one depth map an image, is told that
each pair is an image of its own that overlaps with all others.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pycolmap

from capture.arrays import Floats, Floats32
from capture.errors import SolveError
from recon.fusion import DepthView, Points, lift
from recon.surface import Scan

_BLOCKS = 8192  # at first; the grid grows
_BLOCK = 16  # voxels along a side
_FAR_MM = 1e5
_GREY = 128
# Where the two want the centre of the first pixel, found on a slanted plane (tests/tools): Open3D's
# grid cuts positions down to pixels, so its centres are at 0.5; COLMAP's fusion, unlike the rest of
# COLMAP, has them at integers, as we have.
_OPEN3D_HALF_PX = 0.5


@dataclass(frozen=True, kw_only=True)
class TsdfSettings:
    """How depth maps are averaged in a grid of signed distances.

    Attributes:
        voxel_px: side of a voxel, pixel footprints.
        truncation_voxels: distances beyond so many voxels say nothing.
        pairs: the surface is drawn where at least so many pairs have been averaged.
    """

    voxel_px: float = 1.6
    truncation_voxels: float = 3.0
    pairs: int = 1


@dataclass(frozen=True, kw_only=True)
class ColmapSettings:
    """When COLMAP merges pixels of several depth maps; the defaults are its own.

    Attributes:
        pixels: of which a point must be merged at least.
        reprojection_px: how far from the first one they may project.
        depth_share: by how much of the depth they may differ from it.
        normal_deg: by how much their normals may.
    """

    pixels: int = 5
    reprojection_px: float = 2.0
    depth_share: float = 0.01
    normal_deg: float = 10.0


def depth_image(view: DepthView) -> Floats32:
    """Depth (H, W), mm along the axis of the rectified reference view; 0 where unknown."""
    depth = view.geometry.depth(view.disparity.astype(np.float64))
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0.0).astype(np.float32)


def footprint_mm(views: Sequence[DepthView]) -> float:
    """Size of a pixel on the surface, mm: the median over views of their medians."""
    sizes = []
    for view in views:
        depth = depth_image(view)
        if depth.any():
            sizes.append(float(np.median(depth[depth > 0])) / view.geometry.focal_px)
    return float(np.median(sizes))


def tsdf_scan(views: Sequence[DepthView], settings: TsdfSettings) -> Scan:
    """Surface where the mean truncated signed distance of all depth maps is 0.

    Raises:
        SolveError: when there is no such surface.

    References:
        Curless and Levoy, A volumetric method for building complex models from range images,
        SIGGRAPH 1996; Open3D's VoxelBlockGrid.
    """
    tensor, real = o3d.core.Tensor.from_numpy, o3d.core.float32
    one = o3d.core.SizeVector([1])
    voxel_mm = settings.voxel_px * footprint_mm(views)
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (real, real), (one, one), voxel_mm, _BLOCK, _BLOCKS
    )
    for view in views:
        depth = o3d.t.geometry.Image(tensor(depth_image(view)))
        lens, place = tensor(_lens(view, _OPEN3D_HALF_PX)), tensor(_camera_from_world(view))
        limits = (1.0, _FAR_MM, settings.truncation_voxels)  # units of depth in a millimetre first
        near = grid.compute_unique_block_coordinates(depth, lens, place, *limits)
        grid.integrate(near, depth, lens, place, *limits)
    try:
        mesh = grid.extract_triangle_mesh(settings.pairs - 0.5)  # it wants more than that
    except RuntimeError as error:  # it fails on an empty mesh
        raise SolveError(f"no surface where {settings.pairs} pairs have a depth") from error
    vertices = mesh.vertex.positions.numpy().astype(np.float32)
    return Scan(
        vertices,
        mesh.triangle.indices.numpy().astype(np.int32),
        mesh.vertex.normals.numpy().astype(np.float32),
        np.ones(len(vertices), np.float32),
    )


def colmap_fusion(
    views: Sequence[DepthView], settings: ColmapSettings, spacing_mm: float, *, workers: int = 1
) -> Points:
    """Oriented points of COLMAP's `stereo_fusion`, run in a dense workspace of its own.

    Args:
        views: one or more.
        settings: see there.
        spacing_mm: of the points, for who draws a surface through them: COLMAP thins by
            `reprojection_px` in the images, not by a grid.
        workers: threads; with several the order of the points varies.

    Returns:
        The points; each has the support that was asked for at least, and full confidence.

    Raises:
        SolveError: when COLMAP fails or merges nothing.
    """
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = settings.pixels
    options.max_reproj_error = settings.reprojection_px
    options.max_depth_error = settings.depth_share
    options.max_normal_error = settings.normal_deg
    options.check_num_images = len(views)
    options.num_threads = workers
    with tempfile.TemporaryDirectory() as folder, _quiet():
        workspace, out = Path(folder) / "dense", Path(folder) / "fused.ply"
        write_workspace(workspace, views)
        pycolmap.stereo_fusion(
            out, workspace, input_type="geometric", options=options, output_type="ply"
        )
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            cloud = o3d.io.read_point_cloud(out)
    positions = np.asarray(cloud.points).astype(np.float32)
    if len(positions) == 0:
        raise SolveError(f"COLMAP merged no {settings.pixels} pixels of {len(views)} depth maps")
    return Points(
        positions,
        np.asarray(cloud.normals).astype(np.float32),
        np.ones(len(positions), np.float32),
        np.full(len(positions), settings.pixels, np.int32),
        spacing_mm,
        (np.nan, np.nan),
    )


def write_workspace(folder: Path, views: Sequence[DepthView]) -> None:
    """Write a dense workspace of COLMAP: model, grey images, depth and normal maps.

    Pixels without a normal get no depth. One point that every image is said to see makes all of
    them neighbours. World and depth are in millimetres.

    Args:
        folder: to make.
        views: each becomes an image `000.png` and so on.

    Raises:
        SolveError: when COLMAP refuses the model.
    """
    stereo = folder / "stereo"
    for part in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps"):
        (folder / part).mkdir(parents=True)
    model, track = pycolmap.Reconstruction(), pycolmap.Track()
    names = [f"{index:03d}.png" for index in range(len(views))]
    with _quiet():
        for number, (name, view) in enumerate(zip(names, views, strict=True), start=1):
            lens, place = _lens(view, 0.0), _camera_from_world(view)
            height, width = view.disparity.shape
            camera = pycolmap.Camera(
                model="PINHOLE", width=width, height=height, camera_id=number,
                params=[lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2]],
            )  # fmt: skip
            image = pycolmap.Image(
                name=name, camera_id=number, image_id=number, keypoints=np.zeros((1, 2))
            )
            model.add_camera_with_trivial_rig(camera)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(place[:3]))
            track.add_element(number, 0)
        model.add_point3D_with_id(1, pycolmap.Point3D(xyz=np.zeros(3), track=track))
        model.write_binary(str(folder / "sparse"))
    for name, view in zip(names, views, strict=True):
        depth, normals = _maps(view)
        cv2.imwrite(str(folder / "images" / name), np.full(depth.shape, _GREY, np.uint8))
        _write_map(stereo / "depth_maps" / f"{name}.geometric.bin", depth[None])
        _write_map(stereo / "normal_maps" / f"{name}.geometric.bin", normals)
    listed = "".join(f"{name}\n" for name in names)
    (stereo / "fusion.cfg").write_text(listed, encoding="utf-8")
    sources = "".join(f"{name}\n__all__\n" for name in names)
    (stereo / "patch-match.cfg").write_text(sources, encoding="utf-8")


def _maps(view: DepthView) -> tuple[Floats32, Floats32]:
    """Depth (H, W) and normals (3, H, W) in the axes of the rectified view, 0 where unknown."""
    depth = depth_image(view)
    _, world, _ = lift(view)
    normals = np.zeros((3, *depth.shape), np.float32)
    known = np.isfinite(view.disparity)
    normals[:, known] = np.asarray(view.geometry.rotation, np.float32) @ world.T
    ragged = ~np.isfinite(normals).all(axis=0)
    depth[ragged] = 0.0
    normals[:, ragged] = 0.0
    return depth, normals


def _write_map(path: Path, planes: Floats32) -> None:
    """Write planes (K, H, W) as COLMAP keeps them: sizes in text, then plane after plane.

    pycolmap's own `NormalMap.from_array` (4.2) interleaves them, which its fusion misreads.
    """
    count, height, width = planes.shape
    header = f"{width}&{height}&{count}&".encode("ascii")
    path.write_bytes(header + np.ascontiguousarray(planes, dtype="<f4").tobytes())


def _lens(view: DepthView, half_px: float) -> Floats:
    """The (3, 3) matrix of the rectified view, with pixel centres moved by `half_px`."""
    geometry = view.geometry
    focal = geometry.focal_px
    return np.array(
        [
            [focal, 0.0, geometry.left_column + half_px],
            [0.0, focal, geometry.row + half_px],
            [0.0, 0.0, 1.0],
        ]
    )


def _camera_from_world(view: DepthView) -> Floats:
    """The (4, 4) motion to the axes of the rectified view."""
    matrix = np.eye(4)
    matrix[:3, :3] = view.geometry.rotation
    matrix[:3, 3] = -view.geometry.rotation @ view.geometry.left.centre
    return matrix


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep COLMAP's log off the terminal, and name its failures as ours."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    try:
        yield
    except (ValueError, RuntimeError, IndexError, KeyError) as error:
        raise SolveError(f"COLMAP's depth fusion: {error}") from error
    finally:
        pycolmap.logging.minloglevel = level
