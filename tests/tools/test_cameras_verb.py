"""`likeness cameras`: from one format to another by the command line, and its report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from capture.camera_file import read_cameras, write_cameras
from recon.exchange.cameras import read_any
from tests.recon.exchange.camera_cases import KALIBR, METASHAPE, assert_same, random_array
from tools.cli import main


def test_there_and_back_through_every_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    array = random_array(40, count=3, k3=False)
    write_cameras(tmp_path / "0.json", array)
    last = tmp_path / "0.json"
    steps = [("a", "colmap"), ("b.xml", "metashape"), ("c.yaml", "kalibr"), ("d.yml", "opencv"),
             ("e", "colmap-text"), ("f.json", "likeness")]  # fmt: skip
    for name, kind in steps:
        assert (
            main(["cameras", str(last), "--out", str(tmp_path / name), "--to", kind, "--json"]) == 0
        )
        report = json.loads(capsys.readouterr().out)
        assert (report["to"], set(report["cameras"])) == (kind, set(array.names))
        assert report["read_back_px"] < 1e-6
        last = tmp_path / name
    assert_same(read_cameras(tmp_path / "f.json"), array)


def test_the_report_says_by_camera_what_was_converted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "m.xml").write_text(METASHAPE)
    out = tmp_path / "c.json"
    words = ["cameras", str(tmp_path / "m.xml"), "--from", "metashape", "--out", str(out)]
    assert main([*words, "--unit-mm", "10", "--scale", "3", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    left = report["cameras"]["left"]
    assert (report["from"], report["to"], report["unit_mm"], report["scale"]) == (
        "metashape", "likeness", 10.0, 3.0
    )  # fmt: skip
    assert left["distortion"] == {
        "k1": -0.08,
        "k2": 0.03,
        "p1": -0.0011,
        "p2": 0.0007,
        "k3": -0.004,
    }
    assert "p1 and p2 change places" in left["read"]
    metres = np.array([0.5 * -0.5 + 0.2, 0.5 * 0.25 + 0.1, 0.5 * 3 - 0.3])  # of the left centre
    np.testing.assert_allclose(left["place_mm"], 30.0 * metres, atol=1e-9)
    np.testing.assert_allclose(read_any(out)[0].centre, 30.0 * metres, atol=1e-9)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--out", "k.yaml", "--to", "kalibr"], "--out k.yaml: is what is read"),
        (["--out", "."], "holds k.yaml, which a model in its place would delete"),
        (["--out", "x.xml"], ".xml may be opencv or metashape; name the format with --to"),
        (["--out", "x.json", "--scale", "0"], "--scale: expected a number between"),
        (["--out", "x.json", "--from", "opencv"], "cv2.FileStorage"),
        (["--out", "x.json", "--unit-mm", "-1"], "unit_mm: expected a number between"),
        (["--out", "x.json", "--out-unit-mm", "1000"], "cameras.json is always in millimetres"),
    ],
)
def test_wrong_use_is_told_and_writes_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("k.yaml").write_text(KALIBR)
    assert main(["cameras", "k.yaml", *words]) == 2
    assert said in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["k.yaml"]


def test_help_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cameras", "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "Example: likeness cameras cameras.json --out camchain.yaml --to kalibr" in shown
    assert "--from" in shown
