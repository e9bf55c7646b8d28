"""The tracking stage on a small synthetic take: truth, round trip, bytes, resuming, errors."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.arrays import Floats
from capture.errors import CameraError, SettingsError, TakeError, WorkError
from capture.pose import Pose
from capture.take import Take
from recon.mesh import Mesh
from recon.visiting import import_take
from tests.track.moving_patch import patch_mesh, write_patch_visit
from track.face_tracker import FaceTracker
from track.flow_backend import make_flow
from track.performance import read_performance
from track.stage import TrackSettings, track

AMOUNTS = [0.0, 0.5, 1.0, 0.5, 0.0]


@pytest.fixture(scope="module")
def visit(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Mesh, Floats]:
    folder = tmp_path_factory.mktemp("patch")
    mesh, truth = write_patch_visit(folder, AMOUNTS)
    return folder, mesh, truth


def _take(visit: Path, out: Path) -> Take:
    return import_take(visit, out)


def _error(vertices: Floats, truth: Floats, side: int = 18) -> Floats:
    """Distances (F, n) of the vertices two rings inside the border, mm."""
    grid = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)[2:-2, 2:-2].ravel()
    return np.linalg.norm(vertices[:, grid] - truth[:, grid], axis=2)


def test_truth_is_recovered_and_the_mesh_comes_home(
    visit: tuple[Path, Mesh, Floats], tmp_path: Path
) -> None:
    folder, mesh, truth = visit
    told: list[tuple[int, int, str]] = []
    take = _take(folder, tmp_path / "take")
    performance = track(take, mesh, TrackSettings(), progress=lambda *step: told.append(step))
    error = _error(performance.vertices.astype(float), truth)
    moved = np.linalg.norm(truth[2] - truth[0], axis=1)
    assert moved.max() > 4.0  # mm
    assert np.sqrt((error**2).mean()) < 0.06  # mm; a pixel is 0.58 mm
    assert np.sqrt((error[-1] ** 2).mean()) < 0.04  # mm: the round trip
    assert [done for done, _, what in told if what == "track"] == [1, 2, 3, 4, 5]
    assert performance.confidence.min() >= 0.0
    assert performance.confidence.max() <= 1.0
    assert (performance.reference == -1).all()
    np.testing.assert_array_equal(performance.vertices[0], mesh.vertices.astype(np.float32))
    report = json.loads((take.products / "track" / "report.json").read_text())
    assert len(report["frames"]) == 5
    assert report["frames"][2]["correlation"] > 0.9


def test_same_bytes_twice_and_after_an_interruption(
    visit: tuple[Path, Mesh, Floats], tmp_path: Path
) -> None:
    folder, mesh, _ = visit
    whole, cut = _take(folder, tmp_path / "whole"), _take(folder, tmp_path / "cut")
    track(whole, mesh, TrackSettings())

    def stop(done: int, total: int, what: str) -> None:
        if what == "track" and done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        track(cut, mesh, TrackSettings(), progress=stop)
    place = cut.products / "track"
    assert not (place / "performance.npz").exists()
    kept = place / "frames" / "frame_0004.npz"  # an anchor: the patch has come home
    assert (place / "forward" / "frame_0001.npz").exists()
    stamp = kept.stat().st_mtime_ns
    track(cut, mesh, TrackSettings())
    assert kept.stat().st_mtime_ns == stamp  # used again, not made again
    bytes_of_whole = (whole.products / "track" / "performance.npz").read_bytes()
    assert (place / "performance.npz").read_bytes() == bytes_of_whole
    assert not list(place.rglob(".partial*"))
    stamp = (place / "performance.npz").stat().st_mtime_ns
    again = track(cut, mesh, TrackSettings())
    assert (place / "performance.npz").stat().st_mtime_ns == stamp  # current: skipped
    stored = read_performance(place / "performance.npz")
    np.testing.assert_array_equal(again.vertices, stored.vertices)


def test_segments_in_processes_of_their_own_give_the_same_bytes(tmp_path: Path) -> None:
    source = tmp_path / "visit"
    mesh, truth = write_patch_visit(source, [0.0, 0.6, 0.0, 0.8, 0.0])
    one, two = _take(source, tmp_path / "one"), _take(source, tmp_path / "two")
    alone = track(one, mesh, TrackSettings())
    track(two, mesh, TrackSettings(), workers=2)
    products = [take.products / "track" for take in (one, two)]
    assert json.loads((products[0] / "report.json").read_text())["anchors"] == [0, 2, 4]
    for name in ("performance.npz", "stabilised.npz", "quality.npz"):
        assert (products[0] / name).read_bytes() == (products[1] / name).read_bytes()
    assert np.median(_error(alone.vertices.astype(float), truth)) < 0.05  # mm


def test_the_stabilised_performance_holds_the_head_still(
    visit: tuple[Path, Mesh, Floats], tmp_path: Path
) -> None:
    folder, mesh, _ = visit
    take = _take(folder, tmp_path / "take")
    performance = track(take, mesh, TrackSettings())
    still = read_performance(take.products / "track" / "stabilised.npz")
    head = performance.head_from_neutral
    back = np.einsum("fxy,fvy->fvx", head[:, :3, :3], still.vertices) + head[:, None, :3, 3]
    assert np.abs(back - performance.vertices).max() < 1e-3  # mm: float32
    with pytest.raises(SettingsError, match=r"workers: expected 1\.\.64, found 0"):
        track(take, mesh, TrackSettings(), workers=0)


def test_skin_that_was_lost_is_found_from_the_other_side(
    visit: tuple[Path, Mesh, Floats], tmp_path: Path
) -> None:
    folder, mesh, truth = visit
    tracker = FaceTracker(_take(folder, tmp_path / "take"), mesh, TrackSettings(), {})
    right = tracker.direct(4, mesh.vertices)
    good = tracker.follow(3, [right])
    away = np.linalg.norm(mesh.vertices[:, :2], axis=1) < 18.0  # mm around the middle
    lost = replace(
        good,
        vertices=good.vertices + np.where(away, 4.0, 0.0).astype(np.float32)[:, None],
        confidence=np.where(away, 0.0, good.confidence).astype(np.float32),
    )
    found = tracker.again(3, lost, [right])
    before, after = (_error(one.vertices[None].astype(float), truth[3:4]) for one in (lost, found))
    assert before.max() > 5.0
    assert after.max() < 0.5  # mm
    assert tracker.again(3, good, [right]) is good  # nothing to be gained


def test_the_graphics_card_finds_the_same_mesh(tmp_path: Path) -> None:
    try:
        make_flow("gpu")
    except WorkError as error:
        pytest.skip(f"no compute shaders here: {error}")
    source = tmp_path / "visit"
    mesh, _ = write_patch_visit(source, [0.0, 0.7])
    one, two = _take(source, tmp_path / "one"), _take(source, tmp_path / "two")
    alone = track(one, mesh, TrackSettings())
    other = track(two, mesh, TrackSettings(flow="gpu"))
    assert np.abs(alone.vertices - other.vertices).max() < 0.005  # mm


def test_other_settings_do_not_use_old_frames(
    visit: tuple[Path, Mesh, Floats], tmp_path: Path
) -> None:
    folder, mesh, truth = visit
    take = _take(folder, tmp_path / "take")
    first = track(take, mesh, TrackSettings(passes=1))
    second = track(take, mesh, TrackSettings(passes=2))
    assert (first.vertices != second.vertices).any()
    assert np.median(_error(second.vertices.astype(float), truth)) < 0.06  # mm


def test_a_neutral_that_no_view_sees_is_refused(
    visit: tuple[Path, Mesh, Floats], tmp_path: Path
) -> None:
    folder, mesh, _ = visit
    take = _take(folder, tmp_path / "take")
    with pytest.raises(TakeError, match="no two views see the neutral at frame 0"):
        track(take, mesh.with_vertices(mesh.vertices + [0.0, 500.0, 0.0]), TrackSettings())
    assert not (take.products / "track" / "performance.npz").exists()


def test_a_take_without_cameras_is_refused(
    visit: tuple[Path, Mesh, Floats], tmp_path: Path
) -> None:
    folder, mesh, _ = visit
    take = _take(folder, tmp_path / "take")
    (take.folder / "cameras.json").unlink()
    with pytest.raises(CameraError, match=r"no cameras\.json"):
        track(take, mesh, TrackSettings())


def test_landmarks_lay_a_neutral_from_elsewhere_onto_the_first_frame(
    visit: tuple[Path, Mesh, Floats], tmp_path: Path
) -> None:
    folder, mesh, truth = visit
    take = _take(folder, tmp_path / "take")
    away = Pose.from_rotation_vector(np.array([0.2, -0.3, 0.1]), np.array([30.0, -20.0, 15.0]))
    elsewhere = mesh.with_vertices(away.apply(mesh.vertices))
    marks = tmp_path / "marks.json"
    points = [
        {"vertex": vertex, "position_mm": mesh.vertices[vertex].tolist()}
        for vertex in (22, 60, 300)
    ]
    marks.write_text(json.dumps({"space": "world", "points": points}), encoding="utf-8")
    performance = track(take, elsewhere, TrackSettings(), landmarks=marks)
    error = _error(performance.vertices.astype(float), truth)
    assert np.sqrt((error**2).mean()) < 0.06
    marks.write_text(json.dumps({"space": "world", "points": points[:2]}), encoding="utf-8")
    with pytest.raises(TakeError, match=r"marks\.json: placing the neutral needs 3 marks, found 2"):
        track(take, elsewhere, TrackSettings(), landmarks=marks)


def test_landmarks_that_are_not_json_are_refused(
    visit: tuple[Path, Mesh, Floats], tmp_path: Path
) -> None:
    folder, mesh, _ = visit
    marks = tmp_path / "marks.json"
    marks.write_text("{", encoding="utf-8")
    take = _take(folder, tmp_path / "take")
    with pytest.raises(TakeError, match=r"marks\.json: not readable as JSON"):
        track(take, mesh, TrackSettings(), landmarks=marks)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"track\.passes = 0: must be at least 1"):
        TrackSettings(passes=0)
    with pytest.raises(SettingsError, match=r"track\.min_cosine"):
        TrackSettings(min_cosine=float("nan"))


@pytest.mark.slow
@pytest.mark.shared_data
def test_a_smile_is_followed(tmp_path: Path) -> None:
    shared = Path(__file__).resolve().parents[2].parent / "shared" / "takes" / "dev-smile"
    if not shared.is_dir():
        pytest.skip("needs the shared folder beside the repository")
    from recon.mesh import read_obj

    take = import_take(shared, tmp_path / "take")
    performance = track(take, read_obj(shared / "neutral.obj"), TrackSettings())
    with np.load(shared / "truth.npz") as archive:
        truth = archive["vertices"].astype(float)
    error = np.linalg.norm(performance.vertices - truth, axis=2)
    sure = performance.confidence > 0.2
    assert np.sqrt((error[sure] ** 2).mean()) < 0.25  # mm
    assert np.sqrt((error[-1][sure[-1]] ** 2).mean()) < 0.08  # mm


def test_the_patch_faces_the_cameras() -> None:
    assert (patch_mesh().normals()[:, 2] > 0).all()
