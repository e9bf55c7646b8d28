"""Quality of a take: its file, returns to the neutral, names of skin, flags and their words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture.archive import write_archive
from capture.camera import Camera, CameraArray
from capture.errors import ShapeError
from capture.pose import Pose
from recon.mesh import Mesh
from recon.surface import Scan, write_ply
from track.evidence import FrameEvidence
from track.performance import Performance
from track.quality import (
    CARRIED,
    FOUND,
    SEEN,
    jitter,
    measure_quality,
    read_quality,
    round_trip,
    stilled,
    write_quality,
)
from track.quality_regions import face_regions
from track.quality_report import write_quality_report
from track.quality_words import take_words, view_habits

FRAMES, VIEWS = 6, 5


def _face() -> Mesh:
    """A rough face: a bulge of 160 x 220 mm with a nose, looking along +Z."""
    x, y = np.meshgrid(np.linspace(-80, 80, 33), np.linspace(-110, 110, 45))
    z = -(((x / 80) ** 2) * 60 + ((y / 110) ** 2) * 40) + 22 * np.exp(-(x**2 + y**2) / 150)
    index = np.arange(x.size).reshape(x.shape)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return Mesh(vertices, quads.reshape(-1, 4).astype(np.int32))


def _cameras() -> CameraArray:
    cameras = []
    for index, yaw in enumerate(np.linspace(-0.8, 0.8, VIEWS)):
        away = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
        right = np.cross(-away, [0.0, 1.0, 0.0])
        turn = np.stack([right, np.cross(-away, right), -away])
        cameras.append(
            Camera(
                name=f"cam{index:02d}",
                width=640,
                height=640,
                fx=1400.0,
                fy=1400.0,
                cx=319.5,
                cy=319.5,
                distortion=np.zeros(5),
                camera_from_world=Pose(turn, -turn @ (620.0 * away)),
            )
        )  # fmt: skip
    return CameraArray(tuple(cameras))


def _motions() -> np.ndarray:
    """Head motions: a turn about +Y and a shift that grow from frame to frame."""
    out = np.tile(np.eye(4), (FRAMES, 1, 1))
    for k in range(FRAMES):
        turn = 0.02 * k
        out[k, :3, :3] = [
            [np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]
        ]  # fmt: skip
        out[k, :3, 3] = [0.8 * k, 0.0, 0.0]
    return out


def _performance(mesh: Mesh) -> Performance:
    """The head moves; the lower face opens to frame 3 and is back, but for 0.1 mm, at the end."""
    amount = np.array([0.0, 2.0, 6.0, 8.0, 3.0, 0.1])
    low = np.clip(-mesh.vertices[:, 1] / 60.0, 0.0, 1.0)
    low[:] = np.where(mesh.vertices[:, 1] < 0.0, np.maximum(low, 0.3), 0.0)
    still = mesh.vertices[None] - amount[:, None, None] * low[:, None] * [0.0, 1.0, 0.0]
    motions = _motions()
    moved = np.einsum("fij,fvj->fvi", motions[:, :3, :3], still) + motions[:, None, :3, 3]
    return Performance(
        vertices=moved.astype(np.float32),
        confidence=np.ones(moved.shape[:2], np.float32),
        polygons=mesh.polygons,
        frames=np.arange(10, 10 + FRAMES),
        head_from_neutral=motions,
        reference=np.full(FRAMES, -1),
    )


def _good(count: int) -> dict[str, np.ndarray]:
    """Evidence of skin that all views found well."""
    usual = {
        "residual_px": 0.05, "reprojection_px": 0.06, "correlation": 0.96, "views": 5.0,
        "views_open": 5.0, "information": 2500.0, "agreement": 0.9, "motion_mm": 0.02,
        "misfit_mm": 0.01,
    }  # fmt: skip
    vertex = {key: np.full(count, value, np.float32) for key, value in usual.items()}
    views = {"view_seen": 900.0, "view_believed": 880.0, "view_sum": 845.0, "view_agreed": 870.0}
    view = {key: np.full(VIEWS, value, np.float32) for key, value in views.items()}
    view["view_correlation"] = np.full(VIEWS, 0.95, np.float32)
    view["view_residual_px"] = np.full(VIEWS, 0.08, np.float32)
    blank = FrameEvidence.nothing(count, VIEWS).arrays()
    return {**blank, **vertex, **view, "view_offset_px": np.zeros((VIEWS, 2), np.float32)}


def _evidence(mesh: Mesh) -> list[FrameEvidence]:
    """Frame 1 is good; then a lost mouth, a blurred frame, nothing at all, a good frame."""
    count = len(mesh.vertices)
    lip = face_regions(mesh.vertices, np.ones(count, np.bool_))
    names = ("lower lip", "chin", "left mouth corner", "right mouth corner")
    at_lip = np.isin(lip.of_vertex, [lip.names.index(name) for name in names])
    torn = _good(count)
    torn["views"][at_lip] = 1.0
    torn["motion_mm"][at_lip] = torn["misfit_mm"][at_lip] = 3.0
    torn["view_agreed"][1] = 200.0
    blurred = _good(count)
    blurred["view_correlation"][:] = 0.6
    blurred["views"][:] = 1.2
    blurred["motion_mm"][:] = 1.5
    return [
        FrameEvidence.nothing(count, VIEWS),
        FrameEvidence(**_good(count)),
        FrameEvidence(**torn),
        FrameEvidence(**blurred),
        FrameEvidence.nothing(count, VIEWS),
        FrameEvidence(**_good(count)),
    ]


def test_head_motion_is_taken_out() -> None:
    mesh = _face()
    still = stilled(_performance(mesh))
    assert np.abs(still[0] - mesh.vertices).max() < 1e-4
    upper = mesh.vertices[:, 1] > 5.0
    assert np.abs(still[:, upper] - mesh.vertices[upper]).max() < 1e-4


def test_jitter_is_the_second_difference() -> None:
    t = np.arange(5.0)
    still = np.stack([t, 0.5 * t**2, 0 * t], axis=1)[:, None].astype(np.float32)
    found = jitter(still)[:, 0]
    assert np.isnan(found[[0, 4]]).all()
    assert found[1:4] == pytest.approx(1.0)


def test_only_a_face_that_left_comes_back() -> None:
    mesh = _face()
    still = stilled(_performance(mesh))
    found = round_trip(still, np.ones(still.shape[:2], np.bool_))
    assert np.isnan(found[:5]).all()
    assert found[5] == pytest.approx(
        np.sqrt((np.linalg.norm(still[5] - still[0], axis=1) ** 2).mean())
    )
    assert np.isnan(round_trip(still[[0, 5, 5]], np.ones((3, still.shape[1]), np.bool_))).all()


def test_quality_survives_its_file(tmp_path: Path) -> None:
    mesh = _face()
    quality = measure_quality(mesh, _performance(mesh), _evidence(mesh), 0.44)
    write_quality(tmp_path / "one.npz", quality)
    write_quality(tmp_path / "two.npz", quality)
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    back = read_quality(tmp_path / "one.npz")
    for name in ("likely_error_mm", "jitter_mm", "marks", "round_trip_mm", "reference"):
        assert np.array_equal(getattr(back, name), getattr(quality, name), equal_nan=True)
        assert getattr(back, name).dtype == getattr(quality, name).dtype
    assert set(np.unique(back.marks[2])) == {SEEN, FOUND}
    assert (back.marks[4] == CARRIED).all()


def test_damage_to_the_file_is_told(tmp_path: Path) -> None:
    mesh = _face()
    quality = measure_quality(mesh, _performance(mesh), _evidence(mesh), 0.44)
    arrays = {key: getattr(quality, key) for key in quality.__dataclass_fields__}
    write_archive(tmp_path / "q.npz", {**arrays, "marks": quality.marks[:, :7]})
    with pytest.raises(ShapeError, match=r"q\.npz: marks: expected shape"):
        read_quality(tmp_path / "q.npz")
    likely = quality.likely_error_mm.copy()
    likely[2, 3] = np.nan
    write_archive(tmp_path / "q.npz", {**arrays, "likely_error_mm": likely})
    with pytest.raises(ShapeError, match="likely_error_mm holds 1 numbers that are not finite"):
        read_quality(tmp_path / "q.npz")


def test_evidence_of_another_take_is_refused() -> None:
    mesh = _face()
    with pytest.raises(ShapeError, match="one of each of 6 frames, found 2"):
        measure_quality(mesh, _performance(mesh), _evidence(mesh)[:2], 0.44)


def test_distance_to_the_scan_ends_where_it_does(tmp_path: Path) -> None:
    mesh = _face()
    performance = _performance(mesh)
    surface = performance.vertices[1] + np.array([0.0, 0.0, 0.3], np.float32)
    left = mesh.vertices[:, 0] < 0.0
    kept = mesh.triangles[left[mesh.triangles].all(axis=1)]
    scan = Scan(surface, kept, mesh.normals().astype(np.float32), np.ones(len(surface), np.float32))
    write_ply(tmp_path / "frame_0011.ply", scan)
    scans = {11: tmp_path / "frame_0011.ply"}
    quality = measure_quality(mesh, performance, _evidence(mesh), 0.44, scans=scans)
    told = quality.scan_distance_mm
    assert np.isnan(told[[0, 2, 3, 4, 5]]).all()
    assert 0.1 < np.median(told[1][mesh.vertices[:, 0] < -8.0]) <= 0.3001
    assert np.isnan(told[1][mesh.vertices[:, 0] > 20.0]).all()


def test_regions_are_named_from_the_tip_of_the_nose() -> None:
    mesh = _face()
    shift = np.array([30.0, -12.0, 200.0])
    regions = face_regions(mesh.vertices + shift, np.ones(len(mesh.vertices), np.bool_))

    def name(x: float, y: float) -> str:
        near = np.linalg.norm(mesh.vertices[:, :2] - [x, y], axis=1).argmin()
        return regions.names[regions.of_vertex[near]]

    assert name(0, 0) == "nose"
    assert name(0, -45) == "lower lip"
    assert name(0, -68) == "chin"
    assert name(33, 30) == "left lids"
    assert name(-33, 30) == "right lids"
    assert name(0, 90) == "forehead"
    nothing = face_regions(mesh.vertices, np.zeros(len(mesh.vertices), np.bool_))
    assert set(nothing.of_vertex) == {nothing.names.index("head")}


def test_bad_frames_are_flagged_and_explained(tmp_path: Path) -> None:
    mesh = _face()
    report = write_quality_report(
        tmp_path, mesh, _performance(mesh), _evidence(mesh), _cameras(), {}
    )
    rows = report.rows
    assert [row["flagged"] for row in rows] == [False, False, True, True, True, False]
    assert rows[1]["why"] == []
    lip = " / ".join(rows[2]["why"])
    assert "lower lip: a quarter likely off by" in lip
    assert "no two of the 5 views that see it agree" in lip
    assert "cam01 disagrees with the others (23 % of its matches fit theirs)" in lip
    assert rows[3]["why"][0] == "blurred or dim: correlation fell in all views (0.60, usual 0.95)"
    assert rows[4]["why"] == ["nothing was measured: the mesh is where the frames before lead"]
    assert rows[5]["round_trip_mm"] < 0.1
    table = (tmp_path / "quality.csv").read_text(encoding="utf-8").splitlines()
    assert len(table) == 1 + FRAMES
    assert table[0].startswith("frame,likely_error_mm,likely_median_mm,flagged,why,")
    assert table[3].startswith("12,")
    joined = report.joined({"frames": [{"frame": k, "samples": 3.0} for k in range(10, 16)]})
    assert joined["flagged_frames"] == [12, 13, 14]
    assert joined["frames"][2]["samples"] == 3.0
    assert joined["frames"][2]["flagged"]


def test_a_late_view_is_told_by_its_lag() -> None:
    mesh, cameras = _face(), _cameras()
    performance = _performance(mesh)
    evidence = []
    for row in range(FRAMES):
        good = _good(len(mesh.vertices))
        if row:
            now, before = (performance.vertices[k].astype(float) for k in (row, row - 1))
            camera = cameras[3]
            moved = np.median(camera.project(now) - camera.project(before), axis=0)
            good["view_offset_px"][3] = -moved
            good["view_agreed"][3] = 100.0
        evidence.append(FrameEvidence(**good))
    habits = view_habits(list(cameras), performance.vertices, evidence)
    assert habits.lag_frames[3] == pytest.approx(1.0, abs=0.05)
    assert np.abs(np.delete(habits.lag_frames, 3)).max() < 0.05
    assert take_words(habits) == ["cam03 is late against the others, by 1.0 frames or more"]
