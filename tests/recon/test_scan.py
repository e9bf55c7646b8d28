"""The stereo stage from images to mesh: truth recovered, same bytes, error texts."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera import CameraArray
from capture.camera_file import write_cameras
from capture.errors import CameraError, SettingsError, SolveError, TakeError
from recon.scan import ReconSettings, load_scan, reconstruct, reconstruct_images
from recon.surface import SurfaceQuery
from recon.visiting import import_take
from tests.synthetic_stereo import distance, draw, hit, ring

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
ARRAY = ring((-18.0, 0.0, 18.0), (-9.0, 9.0))
SMALL = ReconSettings(depth_mm=90.0, extent_mm=110.0)


@pytest.fixture(scope="module")
def images() -> dict[str, np.ndarray]:
    return {c.name: np.rint(65535 * draw(c)).astype(np.uint16) for c in ARRAY}


@pytest.fixture(scope="module")
def result(images):
    return reconstruct_images(ARRAY, images, SMALL)


def test_the_ellipsoid_is_recovered(result):
    error = np.abs(distance(result.scan.vertices.astype(np.float64)))
    assert np.median(error) < 0.15  # mm; a pixel is 1.0 mm
    assert np.percentile(error, 95) < 0.6
    assert (error > 2.0).mean() < 0.005


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
    assert set(report["seconds"]) == {"match", "fuse", "mesh"}
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


def _visit(folder: Path, images: dict[str, np.ndarray]) -> Path:
    """A visiting take of one frame, as files."""

    source = folder / "visit"
    for name, image in images.items():
        (source / name).mkdir(parents=True)
        cv2.imwrite(str(source / name / "0000.png"), image)
    write_cameras(source / "cameras.json", ARRAY)
    return source
