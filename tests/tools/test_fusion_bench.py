"""The ready-made ways to merge depth maps, on exact maps of a slanted plane with a lie in one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from capture.errors import SolveError
from recon.fusion import DepthView, FusionSettings, fuse
from recon.rectify import Rectification, rectification
from recon.scan import ReconSettings
from tests.synthetic_stereo import ring
from tools.bench.bench_fusion import alike, as_triangles, together
from tools.bench.cost import measured
from tools.bench.fusion_opponents import (
    ColmapSettings,
    TsdfSettings,
    colmap_fusion,
    depth_image,
    footprint_mm,
    tsdf_scan,
    write_workspace,
)

ARRAY = ring((-20.0, -7.0, 7.0, 20.0), (-8.0, 8.0), size=120)
PAIRS = ((0, 1), (1, 2), (2, 3), (4, 5), (5, 6), (6, 7), (0, 4), (3, 7))
NORMAL = np.array([0.35, 0.45, 0.82]) / np.linalg.norm([0.35, 0.45, 0.82])
LIE = np.s_[20:36, 20:36]
HOLE = np.s_[40:48, 40:48]


def flat(geometry: Rectification) -> np.ndarray:
    """Disparity of the plane through the origin with the normal above."""
    columns, rows = np.meshgrid(np.arange(geometry.width), np.arange(geometry.height))
    u, v = columns - geometry.left_column, rows - geometry.row
    rays = np.stack([u, v, np.full(u.shape, geometry.focal_px)], axis=-1) / geometry.focal_px
    depth = -(geometry.left.centre @ NORMAL) / (rays @ geometry.rotation @ NORMAL)
    return geometry.disparity(depth)


def views() -> list[DepthView]:
    made = []
    for index, (left, right) in enumerate(PAIRS):
        geometry = rectification(ARRAY[left], ARRAY[right], np.zeros(3), 60.0)
        disparity = flat(geometry).astype(np.float32)
        disparity[HOLE] = np.nan
        if index == 1:
            disparity[LIE] += 8.0
        made.append(DepthView(geometry, disparity, np.full_like(disparity, 0.05)))
    return made


def off_plane(points: np.ndarray) -> np.ndarray:
    return np.asarray(points.astype(np.float64) @ NORMAL)


def test_a_depth_image_lies_on_the_plane_and_is_0_in_holes() -> None:
    view = views()[0]
    depth, geometry = depth_image(view), view.geometry
    assert (depth[HOLE] == 0).all()
    rows, columns = np.nonzero(depth)
    u, v = columns - geometry.left_column, rows - geometry.row
    local = np.stack([u, v, np.full(len(u), geometry.focal_px)], axis=1) / geometry.focal_px
    world = (local * depth[rows, columns, None]) @ geometry.rotation + geometry.left.centre
    assert np.abs(off_plane(world)).max() < 2e-3
    assert footprint_mm(views()) == pytest.approx(1.74, abs=0.05)


def test_a_tsdf_of_exact_maps_is_the_plane_to_a_twentieth_of_a_pixel() -> None:
    made = views()
    scan = tsdf_scan(made, TsdfSettings(pairs=4))
    off = off_plane(scan.vertices)
    assert len(off) > 1000
    # Half a pixel beside its place, the mean of a slanted plane would be off by 0.3 mm.
    assert abs(float(np.mean(off))) < 0.05 * footprint_mm(made)
    assert float(np.median(np.abs(off))) < 0.1 * footprint_mm(made)
    assert float(np.median(scan.normals @ NORMAL)) > 0.99
    a, b, c = (scan.vertices[scan.triangles[:, k]].astype(np.float64) for k in range(3))
    assert float(np.median(np.cross(b - a, c - a) @ NORMAL)) > 0


def test_a_tsdf_asks_for_as_many_pairs_as_told() -> None:
    alone = views()[:1]
    assert len(tsdf_scan(alone, TsdfSettings(pairs=1)).triangles) > 500
    with pytest.raises(SolveError, match="no surface where 2 pairs"):
        tsdf_scan(alone, TsdfSettings(pairs=2))


def test_stereo_fusion_puts_single_pixels_where_they_are() -> None:
    made = [view for index, view in enumerate(views()) if index != 1]
    points = colmap_fusion(made, ColmapSettings(pixels=1, reprojection_px=0.0), 2.0)
    assert len(points) > 0.9 * sum(int((depth_image(view) > 0).sum()) for view in made)
    off = off_plane(points.positions)
    # Half a pixel beside its place, they would be off by up to 0.5 mm.
    assert float(np.median(np.abs(off))) < 2e-3
    assert float(np.median(points.normals @ NORMAL)) > 0.9999


def test_stereo_fusion_merges_pixels_and_drops_the_lie() -> None:
    made = views()
    points = colmap_fusion(made, ColmapSettings(), 2.0)
    assert len(points) > 500
    off = off_plane(points.positions)
    assert np.abs(off).max() < 2.0 * footprint_mm(made)
    assert abs(float(np.mean(off))) < 0.05 * footprint_mm(made)
    with pytest.raises(SolveError, match="merged no 999 pixels"):
        colmap_fusion(made, ColmapSettings(pixels=999), 2.0)


def test_the_workspace_is_what_colmap_reads(tmp_path: Path) -> None:
    made = views()[:3]
    write_workspace(tmp_path / "dense", made)
    model = pycolmap.Reconstruction(str(tmp_path / "dense" / "sparse"))
    assert sorted(image.name for image in model.images.values()) == [
        "000.png", "001.png", "002.png",
    ]  # fmt: skip
    held = pycolmap.DepthMap()
    held.read(tmp_path / "dense" / "stereo" / "depth_maps" / "001.png.geometric.bin")
    kept = held.to_array()
    expected = depth_image(made[1])
    assert kept.shape == expected.shape
    assert (kept[kept > 0] == expected[kept > 0]).all()
    assert (kept > 0).mean() > 0.9 * (expected > 0).mean()
    data = (tmp_path / "dense/stereo/normal_maps/001.png.geometric.bin").read_bytes()
    height, width = expected.shape
    header = f"{width}&{height}&3&".encode("ascii")
    assert data.startswith(header)
    normals = np.frombuffer(data[len(header) :], "<f4").reshape(3, height, width)
    world = normals[:, kept > 0].T @ made[1].geometry.rotation
    assert float(np.median(world @ NORMAL)) > 0.9999


def test_settings_alike_allow_the_depth_that_a_share_of_a_pixel_is() -> None:
    made = views()
    settings = ReconSettings(agree_px=0.5, agreeing=3)
    found = alike(made, settings)
    assert found.pixels == 4
    geometry = made[0].geometry
    depth = float(np.median(geometry.depth(made[0].disparity[np.isfinite(made[0].disparity)])))
    nearer = float(geometry.depth(geometry.disparity(np.array(depth)) + 0.5))
    assert found.depth_share == pytest.approx((depth - nearer) / depth, rel=0.3)


def test_points_become_triangles_in_their_places() -> None:
    points = fuse(views(), FusionSettings())
    scan = as_triangles(points)
    assert len(scan.triangles) == len(points)
    middle = scan.vertices[scan.triangles].mean(axis=1)
    assert np.abs(middle - points.positions).max() < 2e-3


def test_cost_counts_processor_and_memory() -> None:
    def work() -> int:
        block = np.ones(40 << 17)  # 40 MiB
        return int(sum(float(block[k :: 1 << 12].sum()) for k in range(64)))

    value, cost = measured(work)
    assert value > 0
    assert 20 <= cost["own_mib"] <= 80
    assert 0 <= cost["cpu_s"] < 10
    both = together(cost, {"wall_s": 1.0, "cpu_s": 2.0, "peak_mib": 1, "own_mib": 999})
    assert both["cpu_s"] == pytest.approx(cost["cpu_s"] + 2.0)
    assert both["own_mib"] == 999
    assert both["peak_mib"] == cost["peak_mib"]
