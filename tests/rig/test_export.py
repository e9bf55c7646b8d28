"""Export: what is dispatched where, what is refused, and the formats that need no vendor."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from capture.archive import read_archive, write_archive
from capture.errors import ExtraError, InputError, SettingsError, ShapeError
from recon.mesh import read_obj
from rig.export import export
from rig.export_ma import euler_xyz, maya_names
from rig.export_text import read_weights_csv
from rig.face_rig import read_rig
from tests.rig.exchange_cases import (
    NAMES,
    performance_file,
    posed_rig,
    rig_file,
    template_file,
    weights_file,
)


def test_rig_npz_is_copied_array_by_array(tmp_path: Path) -> None:
    source = rig_file(tmp_path)
    assert export(source, tmp_path / "copy.npz") == [tmp_path / "copy.npz"]
    keys = ("neutral", "deltas", "names", "polygons", "weights", "head_from_rig")
    before, after = read_archive(source, keys), read_archive(tmp_path / "copy.npz", keys)
    for key in keys:
        np.testing.assert_array_equal(before[key], after[key])


def test_performance_npz_is_copied_array_by_array(tmp_path: Path) -> None:
    source = performance_file(tmp_path)
    export(source, tmp_path / "copy.npz")
    assert source.read_bytes() == (tmp_path / "copy.npz").read_bytes()


def test_weights_csv_brings_back_float32_names_and_order(tmp_path: Path) -> None:
    source = weights_file(tmp_path, stamped=True)
    export(source, tmp_path / "w.csv", fps=75.0)
    track = read_weights_csv(tmp_path / "w.csv")
    truth = read_archive(source, ("weights",))["weights"].astype(np.float32)
    np.testing.assert_array_equal(track.weights.astype(np.float32), truth)
    assert track.names == NAMES
    lines = (tmp_path / "w.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "Timecode,BlendShapeCount," + ",".join(NAMES)
    assert lines[1].startswith("00:00:00:00.000,4,")
    assert lines[2].startswith("00:00:00:03.000,4,"), "stamps 40 ms apart are 3 frames at 75/s"


def test_rig_csv_counts_frames_without_stamps(tmp_path: Path) -> None:
    export(rig_file(tmp_path), tmp_path / "w.csv", fps=2.0)
    lines = (tmp_path / "w.csv").read_text(encoding="utf-8").splitlines()
    assert [line.split(",")[0] for line in lines[1:]] == [
        "00:00:00:00.000",
        "00:00:00:01.000",
        "00:00:01:00.000",
        "00:00:01:01.000",
        "00:00:02:00.000",
    ]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a,b\n1,2\n", "first line that begins with Timecode, BlendShapeCount"),
        ("Timecode,BlendShapeCount,jawOpen\n00:00:00:00.000,1\n", ":2: expected 3 cells, found 2"),
        ("Timecode,BlendShapeCount,jawOpen\n00:00:00:00.000,1,x\n", ":2: expected numbers"),
    ],
)
def test_csv_that_does_not_fit_is_refused(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "w.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=re.escape(complaint)):
        read_weights_csv(tmp_path / "w.csv")


def test_rig_obj_keeps_float32_and_polygons(tmp_path: Path) -> None:
    source = rig_file(tmp_path)
    written = export(source, tmp_path / "head.obj")
    assert written == [tmp_path / "head.obj", tmp_path / "head_shapes"]
    rig = read_rig(source)
    neutral = read_obj(tmp_path / "head.obj")
    np.testing.assert_array_equal(neutral.vertices.astype(np.float32), rig.neutral)
    np.testing.assert_array_equal(neutral.polygons, rig.polygons)
    names = sorted(path.name for path in (tmp_path / "head_shapes").iterdir())
    assert names == sorted(f"{name}.obj" for name in (*NAMES[:3], "left_wing"))
    shape = read_obj(tmp_path / "head_shapes" / "jawOpen.obj")
    expected = rig.neutral.astype(np.float32) + rig.deltas[0].astype(np.float32)
    np.testing.assert_array_equal(shape.vertices.astype(np.float32), expected)


def test_performance_obj_is_a_sequence_numbered_as_the_take(tmp_path: Path) -> None:
    source = performance_file(tmp_path)
    written = export(source, tmp_path / "p.obj")
    assert [path.name for path in written] == ["p.0004.obj", "p.0006.obj", "p.0007.obj"]
    vertices = read_archive(source, ("vertices",))["vertices"]
    np.testing.assert_array_equal(read_obj(written[1]).vertices.astype(np.float32), vertices[1])


def test_ma_holds_mesh_targets_weights_and_head(tmp_path: Path) -> None:
    source = rig_file(tmp_path)
    export(source, tmp_path / "head.ma", fps=75.0)
    text = (tmp_path / "head.ma").read_text(encoding="ascii")
    rig = read_rig(source)
    assert "currentUnit -l millimeter -a degree -t 75fps;" in text
    points = _numbers(text, r'setAttr -s \d+ "\.vt\[0:\d+\]"').reshape(-1, 3)
    np.testing.assert_array_equal(points.astype(np.float32), rig.neutral)
    assert _faces(text) == [[v for v in face if v >= 0] for face in rig.polygons.tolist()]
    for index, delta in enumerate(rig.deltas.astype(np.float32)):
        np.testing.assert_array_equal(_target(text, index, len(delta)), delta)
        assert f'"weight[{index}]"' in text
    weights = np.stack(
        [_curve(text, "animCurveTU", f"shapes_{name}") for name in maya_names(NAMES)], axis=1
    )
    np.testing.assert_array_equal(weights.astype(np.float32), rig.weights.astype(np.float32))
    for axis, letter in enumerate("xyz"):
        moved = _curve(text, "animCurveTL", f"head_t{letter}")
        np.testing.assert_array_equal(moved, rig.head_from_rig[:, axis, 3])
    angles = np.radians(
        np.stack([_curve(text, "animCurveTA", f"head_r{letter}") for letter in "xyz"], axis=1)
    )
    for angle, matrix in zip(angles, rig.head_from_rig, strict=True):
        np.testing.assert_allclose(_rotation_xyz(angle), matrix[:3, :3], atol=1e-12)


def test_euler_angles_bring_back_every_rotation() -> None:
    rng = np.random.default_rng(5)
    angles = rng.uniform(-np.pi, np.pi, (50, 3))
    angles[0, 1], angles[1, 1] = np.pi / 2, -np.pi / 2  # locked
    rotations = np.stack([_rotation_xyz(angle) for angle in angles])
    again = np.stack([_rotation_xyz(angle) for angle in euler_xyz(rotations)])
    np.testing.assert_allclose(again, rotations, atol=1e-7)


def test_maya_names_are_plain_and_unique() -> None:
    assert maya_names(["a-b", "a b", "1x", "eyeBlink_L"]) == ["a_b", "a_b_2", "_1x", "eyeBlink_L"]


def test_ma_refuses_a_rate_maya_has_not(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no time unit of 71\.5 frames/s; it has 2, 3, 4"):
        export(rig_file(tmp_path), tmp_path / "x.ma", fps=71.5)
    assert not list(tmp_path.glob("*.ma"))


@pytest.mark.parametrize(
    ("make", "suffix", "complaint"),
    [
        (rig_file, ".fbx", "is a rig, which cannot be exported to .fbx; supported: .usdc, .usda"),
        (rig_file, "", "cannot be exported to a file without suffix"),
        (performance_file, ".csv", "CSV holds weights, and a performance has none"),
        (performance_file, ".ma", "solve a rig from it first"),
        (weights_file, ".glb", "weights alone have no mesh"),
        (template_file, ".csv", "a template has none"),
    ],
)
def test_unsupported_pairs_are_refused(
    tmp_path: Path, make: object, suffix: str, complaint: str
) -> None:
    source = make(tmp_path)  # type: ignore[operator]
    with pytest.raises(InputError, match=re.escape(complaint)):
        export(source, tmp_path / f"out{suffix}")
    assert sorted(path.name for path in tmp_path.iterdir()) == [source.name]


def test_what_is_no_thing_is_refused(tmp_path: Path) -> None:
    write_archive(tmp_path / "x.npz", {"neutral": np.zeros((3, 3))})
    with pytest.raises(InputError, match=r"x\.npz: expected a rig or template .*holds neutral"):
        export(tmp_path / "x.npz", tmp_path / "x.glb")
    with pytest.raises(ShapeError, match="no such file"):
        export(tmp_path / "none.npz", tmp_path / "x.glb")
    with pytest.raises(SettingsError, match="fps: must be above 0"):
        export(rig_file(tmp_path), tmp_path / "x.glb", fps=0.0)


def test_names_that_are_one_file_are_refused(tmp_path: Path) -> None:
    source = rig_file(tmp_path, names=("a b", "a_b", "c", "d"))
    with pytest.raises(InputError, match="shape names must stay different as file names"):
        export(source, tmp_path / "head.obj")
    assert not (tmp_path / "head.obj").exists()


@pytest.mark.parametrize("suffix", [".ma", ".csv", ".glb", ".usdc", ".usda", ".npz"])
def test_the_same_rig_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    source = rig_file(tmp_path)
    export(source, tmp_path / f"one{suffix}")
    export(source, tmp_path / f"two{suffix}")
    one, two = ((tmp_path / f"{name}{suffix}").read_bytes() for name in ("one", "two"))
    assert one == two


@pytest.mark.parametrize(
    ("module", "suffix", "package", "extra"),
    [("pxr", ".usdc", "usd-core", "usd"), ("pygltflib", ".glb", "pygltflib", "gltf")],
)
def test_a_missing_extra_is_named(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    suffix: str,
    package: str,
    extra: str,
) -> None:
    source = rig_file(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)  # Python's own way to say: not installed
    with pytest.raises(ExtraError, match=rf"needs {package}, .*likeness\[{extra}\]"):
        export(source, tmp_path / f"out{suffix}")
    assert sorted(path.name for path in tmp_path.iterdir()) == [source.name]


def test_posed_rig_moves(tmp_path: Path) -> None:
    rig = posed_rig()
    assert float(np.abs(rig.evaluate(3) - rig.neutral).max()) > 1.0


def _numbers(text: str, head: str) -> np.ndarray:
    found = re.search(head + r"([^;]*);", text)
    assert found is not None
    return np.array([float(word) for word in found.group(1).split()])


def _target(text: str, index: int, count: int) -> np.ndarray:
    place = rf'"\.it\[0\]\.itg\[{index}\]\.iti\[6000\]'
    rows = _numbers(text, place + r'\.ipt" -type "pointArray" \d+').reshape(-1, 4)
    listed = re.search(place + r'\.ict" -type "componentList" \d+([^;]*);', text)
    assert listed is not None
    ids: list[int] = []
    for run in re.findall(r"vtx\[([\d:]+)\]", listed.group(1)):
        ends = [int(word) for word in run.split(":")]
        ids += range(ends[0], ends[-1] + 1)
    assert len(ids) == len(rows)
    assert len(ids) < count, "targets are sparse"
    out = np.zeros((count, 3), np.float32)
    out[ids] = rows[:, :3]
    return out


def _curve(text: str, kind: str, name: str) -> np.ndarray:
    pairs = _numbers(text, rf'createNode {kind} -n "{name}";[^"]*"\.tan" 2;[^"]*"\.wgt" no;'
                     r'[^"]*"\.ktv\[0:\d+\]"').reshape(-1, 2)  # fmt: skip
    np.testing.assert_array_equal(pairs[:, 0], np.arange(len(pairs)))
    return pairs[:, 1]


def _faces(text: str) -> list[list[int]]:
    edges = _numbers(text, r'setAttr -s \d+ "\.ed\[0:\d+\]"').reshape(-1, 3).astype(int)
    found = re.search(r'"polyFaces"([^;]*);', text)
    assert found is not None
    faces = []
    for line in found.group(1).split("f ")[1:]:
        ids = [int(word) for word in line.split()][1:]
        faces.append([int(edges[e, 0]) if e >= 0 else int(edges[-e - 1, 1]) for e in ids])
    return faces


def _rotation_xyz(angles: np.ndarray) -> np.ndarray:
    x, y, z = angles
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x
