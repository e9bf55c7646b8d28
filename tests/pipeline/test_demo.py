from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from capture.archive import read_archive
from capture.errors import InputError
from capture.session import Session
from rig.face_rig import read_rig
from tools.demo import run_demo
from tools.demo_session import EXPRESSIONS, DemoSettings

SMALL = DemoSettings(size_px=320, board_frames=12, expression_frames=9)


@pytest.mark.slow
def test_a_session_goes_through_every_stage(tmp_path: Path) -> None:
    """At a quarter of the demo's pixels: one pixel is 0.9 mm on the skin."""
    told: set[str] = set()
    report = run_demo(tmp_path, SMALL, progress=lambda done, total, what: told.add(what))
    assert report["scan_median_mm"] < 0.15
    assert report["track_median_mm"] < 0.2
    assert report["track_rmse_mm"] < 0.60
    solved = json.loads((tmp_path / "rig" / "report.json").read_text(encoding="utf-8"))
    assert solved["ratio"] < 0.5
    rig = read_rig(tmp_path / "rig" / "rig.npz")
    assert rig.weights.min() >= 0.0
    assert rig.weights.max() <= 1.0
    truth = np.concatenate(
        [
            read_archive(tmp_path / "session" / "truth" / slate / "truth.npz", ["weights"])[
                "weights"
            ]
            for slate in EXPRESSIONS
        ]
    )
    assert np.sqrt(((rig.weights - truth) ** 2).mean()) < 0.12
    for name in ("report.html", "cameras.html", "picture.jpg", "exports/rig.usdc"):
        assert (tmp_path / name).stat().st_size > 1000
    assert {"rig", "export", "report"} <= told
    colours = {note.slate: note.colour for note in Session.open(tmp_path / "session").takes()}
    assert set(colours.values()) == {"green"}

    again = run_demo(tmp_path, SMALL)  # everything is finished: nothing is made anew
    assert again["seconds"]["track"] < 0.2 * report["seconds"]["track"]
    with pytest.raises(InputError, match="size_px"):
        run_demo(tmp_path, DemoSettings(size_px=256))
