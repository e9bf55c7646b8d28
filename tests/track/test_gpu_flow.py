"""Dense flow by compute shaders against the processor's, on every OpenGL: llvmpipe too."""

import gc
import math
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from capture.arrays import Bools, Floats, Floats32
from capture.camera import Camera
from capture.errors import SettingsError, WorkError
from recon.mesh import Mesh
from tests.synthetic import small_array
from tests.track.moving_patch import patch_array, patch_motion, picture, skin, slit_mesh
from track.flow import ALIGNED, FlowMatches
from track.flow_backend import CpuFlow, make_flow
from track.gpu_context import current_context
from track.gpu_flow import GpuFlow
from track.guide import GuidedView
from track.raster import Rasterizer
from track.reference import ReferenceLevel, facing_normals, reference_level, visible_samples
from track.surface_samples import sample_surface, vertex_rings

SIZE = 110
# Single precision in another order: where a step ends or a tie is broken may differ, and such
# samples may be off by what the last step would have changed.
CLOSE_PX, CLOSE_SHARE, CLOSE_NCC, CLOSE_GREY = 1e-3, 0.999, 1e-4, 1e-5
UNLIKE_SHARE = 1e-3  # of samples that lie on a threshold: no texture, half a window, 0.85


@pytest.fixture(scope="module")
def gpu() -> GpuFlow:
    try:
        return GpuFlow()
    except WorkError as error:
        pytest.skip(f"no compute shaders here: {error}")


def _texture(size: int, shift: Floats, seed: int) -> Floats32:
    y, x = np.mgrid[0:size, 0:size].astype(float)
    points = 0.6 * np.column_stack([x.ravel() - shift[0], y.ravel() - shift[1], 0.0 * x.ravel()])
    noise = np.random.default_rng(seed).normal(0.0, 1.5 / 255, (size, size))
    grey = skin(points, seed).reshape(size, size) + noise
    contrast = np.geomspace(0.005, 1.0, size)  # from nothing to all, over the columns
    return (0.5 + contrast * (grey - 0.5)).astype(np.float32)


def _rough_level(half: int, seed: int, size: int = SIZE) -> ReferenceLevel:
    """Samples all over an image, to its very edge, with windows that pieces of surface cut."""
    rng = np.random.default_rng(seed)
    image = _texture(size, np.zeros(2), seed)
    image[: size // 6] = 0.5
    rows, columns = np.gradient(image)
    centres = rng.integers(0, size, (500, 2)).astype(np.int32)
    side = 2 * half + 1
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1) - half
    places = centres[:, None, None] + grid
    windows = ((places >= 0) & (places < size)).all(axis=-1)
    normals, offsets = rng.normal(0, 1, (500, 2)), rng.uniform(0, half, (500, 1, 1))
    cut = np.einsum("jix,nx->nji", grid, normals) > offsets
    windows[::2] &= ~cut[::2]
    return ReferenceLevel(
        camera=small_array()[0], image=image,
        gradient=np.stack([columns, rows]).astype(np.float32),
        triangle=np.zeros((size, size), np.int32),
        barycentric=np.zeros((size, size, 3), np.float32),
        samples=np.arange(500, dtype=np.int32), centres=centres,
        windows=windows.astype(np.uint8),
    )  # fmt: skip


def _rough_view(seed: int, shift: tuple[float, float], size: int = SIZE) -> GuidedView:
    """A moved image with holes."""
    rng = np.random.default_rng(seed + 100)
    image = (0.9 * _texture(size, np.array(shift), seed) + 0.02).astype(np.float32)
    solid = np.ones((size, size), np.uint8)
    for x, y, width, height in rng.integers(5, size - 20, (6, 4)):
        solid[y : y + height // 6, x : x + width // 6] = 0
    place = np.zeros((size, size, 2), np.float32)
    return GuidedView(image=image, place=place, solid=solid)


def _unmatched(matches: FlowMatches) -> Bools:
    lost: Bools = np.isnan(matches.displacement).any(axis=1)
    return lost


def _compare(one: FlowMatches, other: FlowMatches) -> None:
    """Alike within the stated tolerance; and the lost ones are blank."""
    lost, other_lost = _unmatched(one), _unmatched(other)
    assert (lost != other_lost).mean() <= UNLIKE_SHARE
    both = ~lost & ~other_lost
    assert both.sum() > 50
    away = np.abs(one.displacement - other.displacement)[both].max(axis=1)
    assert (away <= CLOSE_PX).mean() >= CLOSE_SHARE
    near = np.abs(one.correlation - other.correlation)[both] <= CLOSE_NCC
    assert near.mean() >= CLOSE_SHARE
    np.testing.assert_allclose(one.information[both], other.information[both], rtol=1e-4, atol=1e-4)
    assert (other.correlation[other_lost] == -1.0).all()
    assert other.displacement.dtype == other.correlation.dtype == np.float64


@pytest.mark.parametrize(("half", "radius"), [(6, 0), (6, 3), (4, 9), (20, 2)])
def test_search_equals_the_processors(gpu: GpuFlow, half: int, radius: int) -> None:
    size = SIZE if half < 20 else 150
    level = _rough_level(half, seed=radius, size=size)
    view = _rough_view(radius, (1.8, -1.3), size)
    chosen = np.arange(len(level.samples)) % 5 > 0
    one, other = (flow.search(level, view, chosen, radius) for flow in (CpuFlow(), gpu))
    _compare(one, other)
    assert _unmatched(other)[~chosen].all()
    assert not other.information.any()
    if radius > 1:
        moved = np.abs(np.nan_to_num(other.displacement)).max(axis=1) > 0
        assert (other.correlation[moved] > ALIGNED).sum() > 20


def test_of_equal_matches_the_first_in_reading_order_wins(gpu: GpuFlow) -> None:
    rng = np.random.default_rng(0)
    stripes = np.tile(rng.uniform(0.2, 0.8, (SIZE, 4)), (1, SIZE // 4 + 1)).astype(np.float32)
    level = replace(_rough_level(6, 0), image=stripes[:, :SIZE].copy())
    solid, place = np.ones((SIZE, SIZE), np.uint8), np.zeros((SIZE, SIZE, 2), np.float32)
    view = GuidedView(image=stripes[:, 2 : SIZE + 2].copy(), place=place, solid=solid)
    every = np.ones(len(level.samples), bool)
    for flow in (CpuFlow(), gpu):
        found = flow.search(level, view, every, 3)
        matched = ~_unmatched(found) & (found.correlation > 0.999)
        assert matched.sum() > 50
        assert (found.displacement[matched] == [-2.0, 0.0]).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_refinement_equals_the_processors(gpu: GpuFlow, seed: int) -> None:
    level, view = _rough_level(6, seed), _rough_view(seed, (0.43, -0.71))
    start = np.random.default_rng(seed).uniform(-1.5, 1.5, (len(level.samples), 2))
    start[::7] = np.nan
    start[3::50] *= 40.0  # out of the image, or far from any match
    one, other = (flow.refine(level, view, start, 4) for flow in (CpuFlow(), gpu))
    _compare(one, other)
    assert _unmatched(other)[::7].all()
    good = other.correlation > 0.95
    assert good.sum() > 50
    assert np.median(np.abs(other.displacement[good] - [0.43, -0.71])) < 0.05  # px


def test_refinement_of_the_widest_windows_equals_the_processors(gpu: GpuFlow) -> None:
    level, view = _rough_level(20, 5, size=150), _rough_view(5, (0.2, 0.3), 150)
    start = np.zeros((len(level.samples), 2))
    _compare(CpuFlow().refine(level, view, start, 3), gpu.refine(level, view, start, 3))


def test_no_iterations_only_correlate(gpu: GpuFlow) -> None:
    level, view = _rough_level(4, 6), _rough_view(6, (0.2, 0.3))
    start = np.full((len(level.samples), 2), 0.25)
    one, other = (flow.refine(level, view, start, 0) for flow in (CpuFlow(), gpu))
    _compare(one, other)
    np.testing.assert_array_equal(other.displacement[~_unmatched(other)], 0.25)


def test_no_sample_no_match(gpu: GpuFlow) -> None:
    level, view = _rough_level(4, 6), _rough_view(6, (0.2, 0.3))
    none = np.zeros(len(level.samples), bool)
    found = gpu.search(level, view, none, 2)
    assert _unmatched(found).all()
    bare = replace(
        level, samples=level.samples[:0], centres=level.centres[:0], windows=level.windows[:0]
    )
    assert gpu.refine(bare, view, np.zeros((0, 2)), 2).displacement.shape == (0, 2)


Scene = tuple[Camera, Mesh, ReferenceLevel, Floats, Floats32, tuple[Floats32, float]]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A patch with a slit that parts, turned: reference, guide, image, depths of the guide."""
    mesh, below = slit_mesh()
    camera = patch_array()[0]
    down = 6.0 * below[:, None] * np.array([0.0, 1.0, 0.3])
    truth = patch_motion(mesh.vertices, 1.0) - down
    guide = patch_motion(mesh.vertices, 0.8) - 0.9 * down
    samples = sample_surface(mesh.vertices, mesh.triangles, 6.0)
    raster = Rasterizer(mesh.triangles, len(mesh.vertices))
    drawn = raster.render(camera, mesh.vertices)
    normals = facing_normals(mesh.vertices, mesh.triangles)
    chosen = visible_samples(samples, mesh.vertices, normals, camera, drawn, 0.35)
    surface = (
        mesh.triangles, samples.triangle[chosen], vertex_rings(mesh.triangles, len(guide), 3)
    )  # fmt: skip
    pixels = camera.project(samples.points(mesh.vertices)[chosen])
    still = picture(camera, mesh, mesh.vertices)
    level = reference_level(camera, still, drawn, pixels, chosen, surface, 6)
    depth = raster.render(camera, guide).depth[::2, ::2].copy()
    depth[60:75, 20:50] -= 20.0  # something before the skin
    return camera, mesh, level, guide, picture(camera, mesh, truth, 0.95), (depth, 2.0)


def _same_view(one: GuidedView, other: GuidedView, level: ReferenceLevel) -> None:
    unlike = one.solid != other.solid
    assert unlike.mean() <= UNLIKE_SHARE
    assert other.solid.dtype == np.uint8
    where = np.isnan(one.place)
    assert (where != np.isnan(other.place)).mean() <= UNLIKE_SHARE
    assert np.nanmax(np.abs(one.place - other.place)) < 1e-4  # px
    assert (np.abs(one.image - other.image) > CLOSE_GREY).mean() <= UNLIKE_SHARE
    off = level.triangle < 0
    np.testing.assert_array_equal(other.image[off], level.image[off])


@pytest.mark.parametrize("occluded", [False, True])
def test_the_warp_equals_the_processors(gpu: GpuFlow, scene: Scene, occluded: bool) -> None:
    _, mesh, level, guide, image, depths = scene
    before = depths if occluded else None
    one, other = (
        flow.warp(level, mesh.triangles, guide, image, before) for flow in (CpuFlow(), gpu)
    )
    _same_view(one, other, level)
    shown = np.isfinite(other.place[..., 0])
    assert shown.mean() > 0.3
    hidden = shown & (other.solid == 0)
    assert (hidden.sum() > 1500) == occluded


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_leaves_the_image_or_lies_behind_the_camera_is_not_shown(
    gpu: GpuFlow, scene: Scene, sign: float
) -> None:
    camera, mesh, level, guide, image, _ = scene
    far = guide + sign * np.array([35.0, 30.0, 0.0])
    far[::40] = camera.centre + 20.0 * (camera.centre - guide.mean(axis=0))
    far[7] = np.nan
    one, other = (flow.warp(level, mesh.triangles, far, image) for flow in (CpuFlow(), gpu))
    _same_view(one, other, level)
    assert 0.05 < np.isfinite(other.place[..., 0]).mean() < np.mean(level.triangle >= 0) - 0.05


def test_the_three_steps_in_a_row_equal_the_processors(gpu: GpuFlow, scene: Scene) -> None:
    _, mesh, level, guide, image, depths = scene
    every, found = np.ones(len(level.samples), bool), []
    for flow in (CpuFlow(), gpu):
        view = flow.warp(level, mesh.triangles, guide, image, depths)
        start = flow.search(level, view, every, 3).displacement
        found.append(flow.refine(level, view, start, 3))
    _compare(*found)
    assert (found[1].correlation > ALIGNED).mean() > 0.6


def test_threads_get_what_one_would_and_the_same_bytes_twice(gpu: GpuFlow, scene: Scene) -> None:
    _, mesh, level, guide, image, depths = scene
    starts = np.random.default_rng(0).uniform(-0.5, 0.5, (8, len(level.samples), 2))

    def measure(index: int) -> tuple[bytes, bytes, bytes]:
        moved = guide + 0.1 * index
        view = gpu.warp(level, mesh.triangles, moved, image, depths if index % 2 else None)
        found = gpu.refine(level, view, starts[index], 3)
        return view.image.tobytes(), view.place.tobytes(), found.displacement.tobytes()

    alone = [measure(index) for index in range(8)]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(measure, range(8))) == alone
    assert len(set(alone)) == 8


def test_levels_and_views_are_let_go(scene: Scene) -> None:
    _, mesh, level, guide, image, _ = scene
    mine = replace(level)
    flow = GpuFlow([mine])
    view = flow.warp(mine, mesh.triangles, guide, image)
    gone = weakref.ref(mine), weakref.ref(view)
    del mine, view
    gc.collect()
    assert [each() for each in gone] == [None, None]
    flow.warp(level, mesh.triangles, guide, image)


def test_a_view_serves_another_backend_too(gpu: GpuFlow, scene: Scene) -> None:
    _, mesh, level, guide, image, _ = scene
    view = gpu.warp(level, mesh.triangles, guide, image)
    start = np.zeros((len(level.samples), 2))
    own = gpu.refine(level, view, start, 3)
    second = GpuFlow().refine(level, view, start, 3)
    np.testing.assert_array_equal(second.displacement, own.displacement)
    _compare(CpuFlow().refine(level, view, start, 3), own)


def test_a_negative_radius_is_refused(gpu: GpuFlow) -> None:
    level, view = _rough_level(4, 6), _rough_view(6, (0.2, 0.3))
    with pytest.raises(SettingsError, match="radius_px: expected at least 0, found -1"):
        gpu.search(level, view, np.ones(len(level.samples), bool), -1)


def test_an_image_beyond_the_devices_buffers_is_refused(gpu: GpuFlow) -> None:
    with current_context() as context:
        most = int(context.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"])
    if not 0 < most <= 2**28:
        pytest.skip(f"the device takes {most} bytes in a buffer: too much to try")
    side = math.isqrt(most // 4) + 1
    huge = replace(_rough_level(4, 6), image=np.broadcast_to(np.float32(0.0), (side, side)))
    with pytest.raises(WorkError, match=r'takes \d+ MiB: use smaller images or flow = "cpu"'):
        gpu.search(huge, _rough_view(6, (0.2, 0.3)), np.ones(500, bool), 1)


def test_what_opengl_complains_of_is_told(gpu: GpuFlow) -> None:
    level, view = _rough_level(4, 6), _rough_view(6, (0.2, 0.3))
    with current_context() as context:
        context.buffer(reserve=4).bind_to_storage_buffer(10**6)
    start = np.zeros((len(level.samples), 2))
    with pytest.raises(WorkError, match=r"reports GL_INVALID_VALUE: use fewer or smaller images"):
        gpu.refine(level, view, start, 1)
    gpu.refine(level, view, start, 1)


def test_the_setting_chooses(gpu: GpuFlow) -> None:
    assert isinstance(make_flow("cpu"), CpuFlow)
    assert isinstance(make_flow("gpu"), type(gpu))
    with pytest.raises(SettingsError, match='flow: expected "cpu" or "gpu", found "tpu"'):
        make_flow("tpu")  # type: ignore[arg-type]
