"""A frame begins where the images fit: a region that was lost is found when it returns."""

from pathlib import Path

import numpy as np

from capture.arrays import Floats
from recon.mesh import Mesh
from recon.visiting import import_take
from tests.track.moving_patch import patch_mesh, write_visit
from track.stage import TrackSettings, track


def _tracked(folder: Path, mesh: Mesh, truth: Floats, settings: TrackSettings) -> Floats:
    """Distance (F, V) from the truth, mm."""
    (folder / "visit").mkdir()
    write_visit(folder / "visit", mesh, truth)
    take = import_take(folder / "visit", folder / "take")
    found = track(take, mesh, settings).vertices.astype(np.float64)
    error: Floats = np.linalg.norm(found - truth, axis=2)
    return error


def test_a_region_that_was_lost_is_found_when_it_returns(tmp_path: Path) -> None:
    """It jumps farther than the search, and comes back in one frame."""
    mesh = patch_mesh()
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    bump = np.exp(-(((x / 22.0) ** 2 + (y / 22.0) ** 2) ** 2))[:, None]
    slide = bump * np.array([0.0, 1.0, 0.0])
    truth = np.stack([mesh.vertices + a * slide for a in (0.0, 3.0, 6.0, 9.0, 0.0)])
    error = _tracked(tmp_path, mesh, truth, TrackSettings(search_mm=2.0))
    middle = np.hypot(x, y) < 20.0
    rms = np.sqrt((error[:, middle] ** 2).mean(axis=1))
    assert rms[-1] < 0.06  # mm
