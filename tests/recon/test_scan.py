"""The stereo stage from images to mesh: truth recovered, same bytes, error texts."""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera import CameraArray
from capture.camera_file import write_cameras
from capture.errors import CameraError, SettingsError, SolveError, TakeError
from recon.depth_maps import depth_map, read_depth_maps
from recon.point_file import read_points
from recon.prior import PriorMeshes
from recon.scan import ReconSettings, load_scan, reconstruct, reconstruct_images
from recon.surface import SurfaceQuery
from recon.visiting import import_take
from tests.recon.test_prior import sphere
from tests.synthetic_stereo import RADII_MM, distance, draw, hit, ring

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
ARRAY = ring((-18.0, 0.0, 18.0), (-9.0, 9.0))
SMALL = ReconSettings(depth_mm=90.0, extent_mm=110.0)


@pytest.fixture(scope="module")
def images() -> dict[str, np.ndarray]:
    return {c.name: np.rint(65535 * draw(c)).astype(np.uint16) for c in ARRAY}


@pytest.fixture(scope="module")
def few(images) -> dict[str, np.ndarray]:
    return {name: images[name] for name in ("cam01", "cam02", "cam04", "cam05")}


@pytest.fixture(scope="module")
def result(images):
    return reconstruct_images(ARRAY, images, SMALL)


def test_the_ellipsoid_is_recovered(result):
    error = np.abs(distance(result.scan.vertices.astype(np.float64)))
    assert np.median(error) < 0.15  # mm; a pixel is 1.0 mm
    assert np.percentile(error, 95) < 0.6
    assert (error > 2.0).mean() < 0.005


def test_highlights_are_counted_and_leave_the_scan_right(few, result):
    assert result.report["reasons"]["HIGHLIGHT"] == 0
    glossy = {}
    for index, (name, image) in enumerate(few.items()):
        glossy[name] = image.copy()
        down, across = np.mgrid[: image.shape[0], : image.shape[1]]
        glossy[name][np.hypot(across - 95 - 4 * index, down - 100) < 9] = 65535
    found = reconstruct_images(ARRAY, glossy, SMALL)
    assert found.report["reasons"]["HIGHLIGHT"] > 500
    error = np.abs(distance(found.scan.vertices.astype(np.float64)))
    assert np.percentile(error, 99) < 1.0  # mm
    assert error.max() < 5.0


def test_the_mesh_covers_what_the_middle_view_faces(result):
    camera = ARRAY[1]
    u, v = np.meshgrid(np.arange(50, 150, 5.0), np.arange(50, 150, 5.0))
    points = hit(camera, np.stack([u.ravel(), v.ravel()], axis=1))
    points = points[np.isfinite(points[:, 0])]
    query = SurfaceQuery(result.scan.vertices, result.scan.triangles)
    assert (query.closest_points(points)[2] < 1.0).mean() > 0.97


def test_normals_point_out_and_confidence_is_a_share(result):
    outward = result.scan.vertices / np.array([60.0, 80.0, 70.0]) ** 2
    cosine = (outward * result.scan.normals).sum(axis=1) / np.linalg.norm(outward, axis=1)
    assert np.median(cosine) > 0.98
    assert 0 <= result.scan.confidence.min() <= result.scan.confidence.max() <= 1


def test_the_numbers_say_how_it_went(result):
    report = result.report
    assert report["points"] == len(result.points)
    assert 0 < report["agreement_median_mm"] < report["agreement_p95_mm"] < 2.0
    assert set(report["seconds"]) == {"match", "fuse", "quality", "mesh"}
    assert [row["name"] for row in report["cameras_report"]] == report["cameras"]
    assert len(report["pair_reasons"]) == len(report["pairs"])
    assert report["warnings"] == []
    assert report["rejected"] == dict(result.points.rejected)
    assert all(9 <= pair["angle_deg"] <= 27 for pair in report["pairs"])
    json.dumps(report)


def test_the_same_images_give_the_same_bytes_whatever_the_threads(images, result):
    again = reconstruct_images(
        ARRAY, images, ReconSettings(depth_mm=90.0, extent_mm=110.0, workers=1)
    )
    assert again.points.positions.tobytes() == result.points.positions.tobytes()
    assert again.scan.vertices.tobytes() == result.scan.vertices.tobytes()
    assert again.scan.triangles.tobytes() == result.scan.triangles.tobytes()


def test_gain_and_depth_of_the_devices_do_not_matter(images, result):
    other = {
        n: (i >> 8).astype(np.uint8) if k % 2 else i for k, (n, i) in enumerate(images.items())
    }
    scan = reconstruct_images(ARRAY, other, SMALL).scan
    assert np.median(np.abs(distance(scan.vertices.astype(np.float64)))) < 0.2


def test_devices_that_lost_a_frame_are_named(images, result):
    left = {name: image for name, image in images.items() if name not in ("cam00", "cam04")}
    found = reconstruct_images(ARRAY, left, SMALL)
    assert found.report["missing"] == ["cam00", "cam04"]
    assert found.report["warnings"][0].startswith("cam00, cam04: no image of this frame")
    assert len(found.points) < len(result.points)
    assert np.median(np.abs(distance(found.scan.vertices.astype(np.float64)))) < 0.2


def test_a_take_is_scanned_frame_by_frame_and_resumed(tmp_path, images):
    take = import_take(_visit(tmp_path, images), tmp_path / "take")
    told: list[tuple[int, int, str]] = []
    (path,) = reconstruct(take, [0], SMALL, progress=lambda *news: told.append(news))
    assert path == take.products / "recon" / "frame_0000.ply"
    assert told == [(1, 1, "recon")]
    first = path.read_bytes()
    stamp = path.stat().st_mtime_ns
    reconstruct(take, [0], SMALL)
    assert path.stat().st_mtime_ns == stamp
    scan = load_scan(path)
    assert np.median(np.abs(distance(scan.vertices.astype(np.float64)))) < 0.15
    report = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    assert report["missing"] == []
    path.unlink()
    reconstruct(take, [0], SMALL)
    assert path.read_bytes() == first


def test_errors_say_what_to_do(tmp_path, images):
    with pytest.raises(CameraError, match="at least 2 cameras, found 1"):
        reconstruct_images(ARRAY, {"cam00": images["cam00"]}, SMALL)
    with pytest.raises(CameraError, match="cam00: the camera is 200 x 200 px, its image 90 x 200"):
        reconstruct_images(ARRAY, {**images, "cam00": images["cam00"][:, :90]}, SMALL)
    flat = {name: np.full((200, 200), 9, np.uint8) for name in images}
    with pytest.raises(SolveError, match="nothing found"):
        reconstruct_images(ARRAY, flat, SMALL)
    far = CameraArray((ring((-40.0, 40.0))[0], ring((-40.0, 40.0))[1]))
    with pytest.raises(CameraError, match="add cameras between them"):
        reconstruct_images(far, {"cam00": images["cam00"], "cam01": images["cam01"]}, SMALL)
    with pytest.raises(SettingsError, match=r"recon\.workers"):
        ReconSettings(workers=-1)
    take = import_take(_visit(tmp_path, images), tmp_path / "take")
    with pytest.raises(TakeError, match=r"asked for frames \[3\]"):
        reconstruct(take, [0, 3], SMALL)
    (take.folder / "cameras.json").unlink()
    with pytest.raises(CameraError, match="likeness calibrate"):
        reconstruct(take, [0], SMALL)


def test_a_missing_scan_names_the_verb(tmp_path):
    with pytest.raises(TakeError, match="likeness recon"):
        load_scan(tmp_path / "frame_0000.ply")


def test_frames_beside_each_other_are_the_same_to_the_byte(tmp_path, few):
    other = {name: np.roll(image, 3, axis=0) for name, image in few.items()}
    shelves = []
    for at_once in (1, 3):
        take = import_take(_visit(tmp_path / str(at_once), few, other), tmp_path / f"t{at_once}")
        told: list[int] = []
        reconstruct(
            take,
            [1, 0],
            replace(SMALL, frames_at_once=at_once),
            progress=lambda done, total, what, told=told: told.append(done),
        )
        assert told == [1, 2]
        shelves.append(_shelf(take.products / "recon"))
    assert len(shelves[0]) == 6
    assert shelves[0] == shelves[1]


def test_a_bad_frame_does_not_stop_the_others(tmp_path, few):
    flat = {name: np.full((200, 200), 9, np.uint16) for name in few}
    take = import_take(_visit(tmp_path, few, flat, few), tmp_path / "take")
    settings = replace(SMALL, frames_at_once=2)
    told: list[int] = []
    with pytest.raises(SolveError, match=r"(?s)1 of 3 frames failed.*frame 1: nothing found"):
        reconstruct(take, [0, 1, 2], settings, progress=lambda done, total, what: told.append(done))
    assert told == [1, 2, 3]
    folder = take.products / "recon"
    assert sorted(path.name for path in folder.glob("*.ply")) == [
        "frame_0000.ply",
        "frame_0002.ply",
    ]
    stamp = (folder / "frame_0002.ply").stat().st_mtime_ns
    with pytest.raises(SolveError, match=r"frame 1: nothing found"):
        reconstruct(take, [1, 2], settings)
    assert (folder / "frame_0002.ply").stat().st_mtime_ns == stamp
    with pytest.raises(SolveError, match=r"frame 1: nothing found"):
        reconstruct(take, [1], settings)


def test_an_interrupt_keeps_what_is_finished_and_leaves_nothing_half_written(tmp_path, few):
    take = import_take(_visit(tmp_path, few, few, few), tmp_path / "take")

    def stop(done: int, total: int, what: str) -> None:
        raise KeyboardInterrupt

    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        reconstruct(take, [0, 1, 2], replace(SMALL, frames_at_once=2), progress=stop)
    assert time.monotonic() - start < 60
    names = sorted(path.name for path in (take.products / "recon").iterdir())
    assert names == ["frame_0000.json", "frame_0000.ply", "frame_0000.ply.record.json"]
    told: list[int] = []
    reconstruct(take, [0], SMALL, progress=lambda done, total, what: told.append(done))
    assert told == [1]


def test_points_alone_are_a_product_of_their_own(tmp_path, images, result):
    take = import_take(_visit(tmp_path, images), tmp_path / "take")
    (path,) = reconstruct(take, [0], replace(SMALL, mesh=False))
    assert path.name == "points_0000.ply"
    points = read_points(path)
    assert points.vertices.tobytes() == result.points.positions.tobytes()
    assert points.normals.tobytes() == result.points.normals.tobytes()
    assert points.confidence.tobytes() == result.points.confidence.tobytes()
    assert len(points.triangles) == 0
    report = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    assert (report["vertices"], report["triangles"]) == (len(result.points), 0)
    with pytest.raises(TakeError, match=r"points without faces.*likeness recon"):
        load_scan(path)
    with pytest.raises(SettingsError, match=r"recon\.depth_maps"):
        replace(SMALL, mesh=False, depth_maps=True)


def test_depth_maps_are_added_to_finished_scans(tmp_path, images):
    take = import_take(_visit(tmp_path, images), tmp_path / "take")
    (path,) = reconstruct(take, [0], SMALL)
    stamp = path.stat().st_mtime_ns
    assert not (path.parent / "depth").exists()
    reconstruct(take, [0], replace(SMALL, depth_maps=True))
    assert path.stat().st_mtime_ns == stamp
    out = path.parent / "depth" / "frame_0000.npz"
    maps = read_depth_maps(out, take.cameras())
    stamp = out.stat().st_mtime_ns
    reconstruct(take, [0], replace(SMALL, depth_maps=True))
    assert out.stat().st_mtime_ns == stamp
    for camera in take.cameras():
        pixels = np.array([[100.0, 95.0], [80.0, 100.0], [110.0, 120.0]])
        truth = camera.depths(hit(camera, pixels))
        columns, rows = pixels.astype(int).T
        np.testing.assert_allclose(maps[camera.name][rows, columns], truth, atol=0.8)  # mm
    scan = load_scan(path)
    again = depth_map(ARRAY[0], scan.vertices, scan.triangles)
    np.testing.assert_array_equal(again, maps[ARRAY[0].name])


def _prior(*frames: int, aside_mm: float = 2.0) -> PriorMeshes:
    """The ellipsoid, a little too large, as if tracked at some frames."""
    vertices, triangles = sphere(40, RADII_MM + aside_mm)
    return PriorMeshes(
        np.array(frames, dtype=np.int64),
        np.stack([vertices + 0.01 * f for f in frames]).astype(np.float32),
        triangles,
    )


def test_a_prior_leads_to_the_same_surface(images, result):
    found = reconstruct_images(ARRAY, images, SMALL, prior=_prior(0).at(0, 6.0))
    error = np.abs(distance(found.scan.vertices.astype(np.float64)))
    assert np.median(error) < 0.15  # mm, not the 2 mm of the prior
    assert np.percentile(error, 95) < 0.6
    assert len(found.points) > 0.9 * len(result.points)


def test_a_frame_is_remade_when_its_own_prior_changes(tmp_path, few):
    take = import_take(_visit(tmp_path, few, few), tmp_path / "take")
    folder = take.products / "recon"

    def stamps() -> list[int]:
        return [(folder / f"frame_{f:04d}.ply").stat().st_mtime_ns for f in (0, 1)]

    def inputs(frame: int) -> dict[str, str]:
        path = folder / f"frame_{frame:04d}.ply.record.json"
        told: dict[str, str] = json.loads(path.read_text(encoding="utf-8"))["inputs"]
        return told

    settings = replace(SMALL, prior_mm=6.0)
    reconstruct(take, [0, 1], settings, prior=_prior(1))
    assert set(inputs(0)) == {"take"}  # it has no mesh before the first tracked frame
    assert set(inputs(1)) == {"take", "prior"}
    first = stamps()
    reconstruct(take, [0, 1], settings, prior=_prior(1))
    assert stamps() == first
    reconstruct(take, [0], settings)  # as without a prior
    assert stamps() == first
    reconstruct(take, [0, 1], settings, prior=_prior(1, aside_mm=1.0))
    assert stamps()[0] == first[0]
    assert stamps()[1] != first[1]


@pytest.mark.slow
@pytest.mark.shared_data
@pytest.mark.parametrize("frame", [0, 6])
def test_a_face_meets_the_limits(tmp_path, frame: int):
    source = SHARED / "takes" / "dev-smile"
    take = import_take(source, tmp_path / "take")
    (path,) = reconstruct(take, [frame])
    script = SHARED / "tools" / "score_scan.py"
    done = subprocess.run(
        [sys.executable, str(script), str(source), str(frame), str(path)],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    score = json.loads(done.stdout.splitlines()[-1])
    assert score["median"] <= 0.08  # mm
    assert score["completeness_05"] >= 0.94
    assert score["outliers_1mm"] <= 0.005


def _visit(folder: Path, *frames: dict[str, np.ndarray]) -> Path:
    """A visiting take of some frames, as files."""

    source = folder / "visit"
    for number, images in enumerate(frames):
        for name, image in images.items():
            (source / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(source / name / f"{number:04d}.png"), image)
    array = CameraArray(tuple(ARRAY.by_name(name) for name in frames[0]))
    write_cameras(source / "cameras.json", array)
    return source


def _shelf(folder: Path) -> dict[str, bytes]:
    """All products of a folder by name; of the numbers, all but the time they took."""
    out = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            out[path.relative_to(folder).as_posix()] = path.read_bytes()
        if path.suffix == ".json" and "record" not in path.name:
            told = json.loads(path.read_text(encoding="utf-8"))
            del told["seconds"]
            out[path.name] = json.dumps(told).encode()
    return out
