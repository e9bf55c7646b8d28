"""Meshes made beside the caller: the same bytes, errors told, nothing left running."""

import os
import time
from pathlib import Path

import numpy as np
import pytest

from capture.errors import SolveError
from recon.fusion import Points
from recon.mesh_process import Mesher
from recon.surface import SurfaceSettings, poisson_scan
from tests.recon.test_prior import sphere
from tests.synthetic_stereo import RADII_MM


def cloud(rings: int = 40) -> Points:
    vertices, _ = sphere(rings)
    normals = vertices / RADII_MM**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    count = len(vertices)
    return Points(
        positions=vertices.astype(np.float32), normals=normals.astype(np.float32),
        confidence=np.linspace(0, 1, count).astype(np.float32),
        support=np.full(count, 3, np.int32), spacing_mm=4.0, agreement_mm=(np.nan, 0.2),
    )  # fmt: skip


def children() -> set[str]:
    """Processes of ours that run."""
    found = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[1]) == os.getpid() and fields[0] != "Z":
                found.add(entry.name)
    return found


def test_a_mesh_is_the_same_from_another_process():
    before = children()
    clouds = [cloud(30), cloud(36), cloud(32)]
    settings = SurfaceSettings(evidence_spacings=4.0)
    with Mesher(settings, 2) as mesher:
        asked = [mesher.submit(points) for points in clouds]
        found = [future.result() for future in asked]
        assert len(children() - before) <= 2
    assert children() <= before
    for points, meshed in zip(clouds, found, strict=True):
        here = poisson_scan(points, settings)
        assert meshed.seconds > 0
        for name in ("vertices", "triangles", "normals", "confidence"):
            there = getattr(meshed.scan, name)
            assert there.dtype == getattr(here, name).dtype
            assert there.tobytes() == getattr(here, name).tobytes()


@pytest.mark.parametrize("processes", [0, 1])
def test_a_cloud_without_a_surface_is_an_error_of_that_frame_alone(processes: int):
    points = cloud()
    few = Points(
        points.positions[:50], points.normals[:50], points.confidence[:50], points.support[:50],
        points.spacing_mm, points.agreement_mm,
    )  # fmt: skip
    with Mesher(SurfaceSettings(evidence_spacings=4.0), processes) as mesher:
        bad, good = mesher.submit(few), mesher.submit(points)
        with pytest.raises(SolveError, match="at least 100 points, found 50"):
            bad.result()
        assert len(good.result().scan.triangles) > 100


def begin_and_be_interrupted(before: set[str], seen: bool) -> None:
    with Mesher(SurfaceSettings(), 1) as mesher:
        for _ in range(3):
            mesher.submit(cloud(150))
        while seen and not children() - before:
            time.sleep(0.01)
        raise KeyboardInterrupt


@pytest.mark.parametrize("seen", [True, False])
def test_leaving_early_stops_what_runs(seen: bool):
    before = children()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        begin_and_be_interrupted(before, seen)
    assert time.monotonic() - start < 15  # seconds
    assert children() <= before


def test_a_process_that_dies_is_told_and_replaced():
    settings = SurfaceSettings(evidence_spacings=4.0)
    before = children()
    with Mesher(settings, 1) as mesher:
        mesher.submit(cloud(30)).result()
        (child,) = children() - before
        os.kill(int(child), 9)
        with pytest.raises(SolveError, match="ended before it was done"):
            mesher.submit(cloud(30)).result()
        assert len(mesher.submit(cloud(30)).result().scan.triangles) > 100
