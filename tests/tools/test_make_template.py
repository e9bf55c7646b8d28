"""Making a template from an ICT archive."""

from pathlib import Path

import numpy as np
import pytest

from rig.template import read_template
from tools.make_template import main


def _archive(path: Path) -> None:
    neutral = np.array(
        [[0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0], [5, 5, 5]], dtype=np.float32
    )
    expr = np.zeros((2, 5, 3), dtype=np.float32)
    expr[0, :, 1] = 0.5
    np.savez(
        path, neutral=neutral, expr=expr, expr_names=np.array(["jawOpen", "PupilDilate_L"]),
        quads=np.array([[0, 1, 2, 3], [0, 1, 2, -1], [0, 1, 4, -1]]),
    )  # fmt: skip


def test_centimetres_become_millimetres_and_names_stay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _archive(tmp_path / "ict.npz")
    out = tmp_path / "t.npz"
    assert main(["ict", str(tmp_path / "ict.npz"), str(out), "--vertices", "4"]) == 0
    template = read_template(out)
    assert template.neutral[1].tolist() == [200.0, 0.0, 0.0]
    assert template.deltas[0, 0].tolist() == [0.0, 5.0, 0.0]
    assert template.names == ("jawOpen", "PupilDilate_L")
    assert template.polygons.tolist() == [[0, 1, 2, 3], [0, 1, 2, -1]]
    assert "PupilDilate_L" in capsys.readouterr().out


def test_too_many_vertices_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _archive(tmp_path / "ict.npz")
    assert main(["ict", str(tmp_path / "ict.npz"), str(tmp_path / "t.npz")]) == 2
    assert "asked for 11248 vertices, it holds 5" in capsys.readouterr().err
    assert not (tmp_path / "t.npz").exists()
