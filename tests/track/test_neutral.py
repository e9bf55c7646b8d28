import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera import CameraArray
from capture.camera_file import write_cameras
from capture.errors import SettingsError, SolveError, TakeError
from capture.product import stage_record, write_record
from capture.take import Take
from recon.mesh import Mesh, read_obj
from recon.surface import Scan, closest_points, write_ply
from recon.visiting import import_take
from tests.track.face_scene import ACTOR, TEMPLATE, face_vertices, finer, head
from tools.bench.neutral_scene import arc_cameras, misplaced, scan_of
from track.landmark_file import Landmarks
from track.neutral import NeutralSettings, check_template, fit_template, register_neutral, viewpoint

QUICK = NeutralSettings(steps=10)
CENTRE = np.array([0.0, 0.0, 20.0])


@pytest.fixture(scope="module")
def cameras() -> CameraArray:
    return arc_cameras(CENTRE, count=8)


@pytest.fixture(scope="module")
def scan(cameras: CameraArray) -> Scan:
    return scan_of(finer(ACTOR), cameras, seed=1)


@pytest.mark.parametrize("seed", [0, 1])
def test_actor_is_recovered_from_a_misplaced_template(
    seed: int, scan: Scan, cameras: CameraArray
) -> None:
    template, actor = head(TEMPLATE), head(ACTOR)
    face = face_vertices(template)
    start = misplaced(template, seed)
    assert np.median(np.linalg.norm(start.vertices - actor.vertices, axis=1)) > 20.0
    mesh, report, fit = fit_template(start, scan, cameras, QUICK)
    gap = np.linalg.norm(mesh.vertices - actor.vertices, axis=1)
    _, _, off = closest_points(*finer(ACTOR), mesh.vertices[face])
    assert np.median(off) < 0.02  # mm
    assert np.quantile(off, 0.95) < 0.1
    assert np.median(gap[face]) < 2.0  # the same place of the face, not just its surface
    assert gap.max() < 12.0  # the back of the head, which nobody sees, came along
    assert np.array_equal(mesh.polygons, template.polygons)
    assert report["residual_median_mm"] < 0.02
    assert report["matched_share_of_seen"] > 0.6
    hidden = actor.vertices[:, 2] < -60.0
    assert hidden.any()
    assert np.isnan(fit.residual_mm[hidden]).all()


def test_noise_and_foreign_parts_are_survived(scan: Scan, cameras: CameraArray) -> None:
    """0.1 mm of noise, a shirt under the head and a ball before the mouth."""
    noisy = scan_of(finer(ACTOR), cameras, noise_mm=0.1, seed=2)
    other = head(TEMPLATE, 60, 40)
    parts = [
        (noisy.vertices, noisy.triangles),
        (other.vertices * 0.05 + [10.0, -60.0, 110.0], other.triangles),
        (other.vertices * [1.6, 0.3, 0.9] + [0.0, -190.0, -20.0], other.triangles),
    ]
    sizes = np.cumsum([0] + [len(part[0]) for part in parts])
    both = Scan(
        np.concatenate([part[0] for part in parts]).astype(np.float32),
        np.concatenate([part[1] + size for part, size in zip(parts, sizes, strict=False)]).astype(
            np.int32
        ),
        np.zeros((sizes[-1], 3), np.float32),
        np.ones(sizes[-1], np.float32),
    )
    template, actor = head(TEMPLATE), head(ACTOR)
    face = face_vertices(template)
    mesh, _, _ = fit_template(misplaced(template, 5), both, cameras, QUICK)
    gap = np.linalg.norm(mesh.vertices - actor.vertices, axis=1)
    _, _, off = closest_points(*finer(ACTOR), mesh.vertices[face])
    assert np.median(gap[face]) < 2.5
    assert np.median(off) < 0.12


def test_landmarks_place_what_the_search_need_not(scan: Scan, cameras: CameraArray) -> None:
    template, actor = head(TEMPLATE), head(ACTOR)
    lost = template.with_vertices(1.6 * template.vertices[:, [1, 2, 0]] + 2000.0)  # 1.6: too large
    rng = np.random.default_rng(0)
    face = face_vertices(template)
    chosen = np.sort(rng.choice(face, 6, replace=False)).astype(np.int64)
    marks = Landmarks(
        vertices=chosen,
        positions=actor.vertices[chosen] + rng.normal(0.0, 0.3, (6, 3)),
        miss_mm=np.zeros(6),
    )
    mesh, report, _ = fit_template(lost, scan, cameras, QUICK, marks)
    gap = np.linalg.norm(mesh.vertices - actor.vertices, axis=1)
    assert report["placed_by"] == "landmarks"
    assert np.median(gap[face]) < 1.5
    assert max(mark["residual_mm"] for mark in report["landmarks"]) < 2.5


def _take(folder: Path, cameras: CameraArray, scan: Scan) -> Take:
    """An imported take whose frame 0 has been reconstructed, as far as anyone can tell."""
    source = folder / "source"
    write_cameras(source / "cameras.json", cameras)
    for camera in cameras:
        (source / camera.name).mkdir()
        image = np.zeros((camera.height, camera.width), np.uint8)
        cv2.imwrite(str(source / camera.name / "0000.png"), image)
    take = import_take(source, folder / "take")
    path = take.products / "recon" / "frame_0000.ply"
    path.parent.mkdir(parents=True)
    write_ply(path, scan)
    write_record(path, stage_record("recon", None, {"take": take.input_hash()}))
    return take


def test_stage_writes_whole_products_once_and_the_same_each_time(
    tmp_path: Path, scan: Scan, cameras: CameraArray
) -> None:
    take = _take(tmp_path, cameras, scan)
    base = misplaced(head(TEMPLATE), 1)
    uv = np.random.default_rng(0).uniform(size=(len(base.polygons), 4, 2)).astype(np.float32)
    template = Mesh(base.vertices, base.polygons, uv)
    told: list[str] = []
    settings = NeutralSettings(steps=3)
    out = tmp_path / "made" / "neutral.obj"
    mesh = register_neutral(
        take, template, settings, out, progress=lambda done, total, what: told.append(what)
    )
    written = read_obj(out)
    assert np.array_equal(written.polygons, template.polygons)
    assert written.uv is not None
    assert np.abs(written.uv - uv).max() < 1e-6
    assert np.array_equal(written.vertices, mesh.vertices)  # to the bit: stages hash it
    report = json.loads((tmp_path / "made" / "neutral.report.json").read_text())
    assert report["vertices"] == len(template.vertices)
    with np.load(tmp_path / "made" / "neutral.residual.npz") as data:
        assert ((data["residual_mm"] >= 0).sum()) == report["matched"]
    with np.load(tmp_path / "made" / "neutral.appearance.npz") as data:
        assert data["camera_names"].tolist() == list(cameras.names)
        grey = data["grey"]
    assert grey.shape == (len(cameras), len(template.vertices))
    assert set(np.unique(grey)) == {-1.0, 0.0}  # the take's images are black
    assert told.count("register") == 3
    assert not list((tmp_path / "made").glob(".*"))

    before = out.stat().st_mtime_ns
    register_neutral(take, template, settings, out)
    assert out.stat().st_mtime_ns == before  # current: skipped
    other = tmp_path / "other.obj"
    register_neutral(take, template, settings, other)
    assert other.read_bytes() == out.read_bytes()


def test_templates_that_are_no_faces_are_refused() -> None:
    face = head(TEMPLATE)
    with pytest.raises(TakeError, match=r"largest side .* it looks like metres.*by 1000"):
        check_template(face.with_vertices(face.vertices * 0.001))
    with pytest.raises(TakeError, match="looks like centimetres: multiply its vertices by 10"):
        check_template(face.with_vertices(face.vertices * 0.1))
    with pytest.raises(TakeError, match="80 to 600 mm; expected millimetres"):
        check_template(face.with_vertices(face.vertices * 30.0))
    with pytest.raises(TakeError, match="found no faces"):
        check_template(Mesh(face.vertices, np.zeros((0, 4), np.int32)))


def test_a_scan_of_something_else_is_refused(cameras: CameraArray) -> None:
    template = head(TEMPLATE)
    pebble = head(TEMPLATE, 40, 30)
    tiny = scan_of((0.1 * pebble.vertices, pebble.triangles), cameras, holes=0)
    with pytest.raises(SolveError, match=r"neutral: .*landmarks"):
        fit_template(template, tiny, cameras, QUICK)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"neutral\.steps = 1: must be at least 2"):
        NeutralSettings(steps=1)
    with pytest.raises(SettingsError, match=r"neutral\.reach_last_mm = 0\.0"):
        NeutralSettings(reach_last_mm=0.0)


def test_viewpoint_looks_back_at_the_array(cameras: CameraArray) -> None:
    view = viewpoint(cameras, CENTRE[None])
    assert view.forward @ [0.0, 0.0, 1.0] > 0.95
    assert view.up @ [0.0, 1.0, 0.0] > 0.95
    assert abs(view.up @ view.forward) < 1e-12


@pytest.mark.shared_data
def test_ict_identity_is_recovered() -> None:
    from tools.bench.bench_neutral import measure

    row = measure(seed=11, noise_mm=0.0, angle_deg=20.0)
    assert row["surf"] < 0.1
    assert row["corr"] < 1.5
    assert row["corr"] < 0.6 * row["placed"]
