"""`likeness template` from the command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from recon.mesh import write_obj
from rig.template import read_template, write_template
from tests.rig.test_correspondence import marks, moved
from tests.rig.toy_face import NAMES, toy_face
from tools.cli import main


def _files(folder: Path) -> list[str]:
    template, mesh = toy_face(6.0), toy_face(7.0, slant=1)
    write_template(folder / "artist.npz", template.template())
    write_obj(folder / "actor.obj", moved(mesh))
    pairs = marks(template, mesh).tolist()
    (folder / "marks.toml").write_text(f"pairs = {pairs}\n", encoding="utf-8")
    (folder / "marks.json").write_text(json.dumps({"pairs": pairs}), encoding="utf-8")
    names = {"template": "artist.npz", "mesh": "actor.obj", "out": "carried.npz"}
    return [word for key, name in names.items() for word in (f"--{key}", str(folder / name))]


@pytest.mark.parametrize("marked", ["marks.toml", "marks.json"])
def test_a_template_is_carried_and_reported(
    marked: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["template", *_files(tmp_path), "--landmarks", str(tmp_path / marked), "--json"]
    assert main([*words, "--steps", "4", "--transfer", "rbf"]) == 0
    report = json.loads(capsys.readouterr().out)
    carried = read_template(tmp_path / "carried.npz")
    assert carried.names == NAMES
    assert report["vertices"] == len(carried.neutral) == report["bound"] + report["unbound"]
    assert report["torn_edges"] == 0
    assert report["shapes_skipped"] == []
    assert report["distance_mean_mm"] < 0.5
    assert carried.lid_pairs.size
    assert carried.lip_pairs.size


def test_what_does_not_fit_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["template", *_files(tmp_path)]
    bad = tmp_path / "bad.json"
    bad.write_text('{"pairs": [[0, 1], [0, 999999], [1.5, 2]]}', encoding="utf-8")
    assert main([*words, "--landmarks", str(bad)]) == 2
    told = capsys.readouterr().err
    assert "pairs[1]: [0, 999999]: the template has vertices 0.." in told
    assert "pairs[2]: expected two vertex numbers, found [1.5, 2]" in told
    bad.write_text('{"points": []}', encoding="utf-8")
    assert main([*words, "--landmarks", str(bad)]) == 2
    assert 'expected one key, "pairs"' in capsys.readouterr().err
    mesh = toy_face(9.0).mesh
    write_obj(tmp_path / "actor.obj", mesh.with_vertices(0.1 * mesh.vertices))
    assert main(words) == 2
    assert "actor.obj: mesh: expected a face in millimetres" in capsys.readouterr().err


def test_a_settings_file_is_understood(tmp_path: Path) -> None:
    config = tmp_path / "likeness.toml"
    config.write_text('[template]\nsteps = 3\ntransfer = "rbf"\n', encoding="utf-8")
    words = ["template", *_files(tmp_path), "--landmarks", str(tmp_path / "marks.json")]
    assert main([*words, "--config", str(config)]) == 0
    assert np.isfinite(read_template(tmp_path / "carried.npz").deltas).all()
