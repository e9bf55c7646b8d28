from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.synthetic import small_array
from tools.bench.bench_flow import RIGID, load_scene, rows
from tools.bench.flow_methods import methods
from track.guide import GuidedView
from track.reference import ReferenceLevel
from track.schedule import Step
from track.stage import TrackSettings

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
SIZE, SIDE, SHIFT = 128, 13, (1.4, -0.8)
STEP = Step(level=0, search_px=3, iterations=3, limit_px=4.5, scale_px=1.0, bending_mm=2.0)


def texture(shift: tuple[float, float]) -> np.ndarray:
    """Waves of many directions, moved by (columns, rows)."""
    rows, columns = np.mgrid[0:SIZE, 0:SIZE].astype(float)
    rng = np.random.default_rng(3)
    total = np.zeros((SIZE, SIZE))
    for turn, wave, phase in rng.uniform((0, 0.15, 0), (np.pi, 0.7, 6.3), (60, 3)):
        along = np.cos(turn) * (columns - shift[0]) + np.sin(turn) * (rows - shift[1])
        total += np.sin(wave * along + phase)
    return (0.5 + 0.02 * total).astype(np.float32)


@pytest.mark.parametrize("name", list(methods()))
def test_every_method_finds_a_shift_and_rates_it(name: str) -> None:
    image, moved = texture((0.0, 0.0)), texture(SHIFT)
    line = np.arange(30, SIZE - 30, 9)
    centres = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2).astype(np.int32)
    down, across = np.gradient(image)
    level = ReferenceLevel(
        camera=small_array()[0],
        image=image,
        gradient=np.stack([across, down]).astype(np.float32),
        triangle=np.zeros((SIZE, SIZE), np.int32),
        barycentric=np.zeros((SIZE, SIZE, 3), np.float32),
        samples=np.arange(len(centres), dtype=np.int32),
        centres=centres,
        windows=np.ones((len(centres), SIDE, SIDE), np.uint8),
    )
    place = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), -1).astype(np.float32)
    view = GuidedView(image=moved, place=place, solid=np.ones((SIZE, SIZE), np.uint8))
    chosen = np.arange(len(centres)) % 4 > 0
    found = methods()[name].match(level, view, moved, chosen, STEP)
    assert np.isnan(found.displacement[~chosen]).all()
    assert np.abs(np.median(found.displacement[chosen], axis=0) - SHIFT).max() < 0.06
    assert np.median(found.correlation[chosen]) > 0.97
    assert (found.information[chosen][:, [0, 2]] > 0).all()


@pytest.mark.slow
@pytest.mark.shared_data
def test_on_skin_ours_is_nearest_and_the_guide_earns_its_place() -> None:
    scene = load_scene(SHARED / "takes" / "dev-smile", 4, TrackSettings())
    table = {row["flow"]: row for row in rows(scene, [5], ["ours", "LK", "DIS medium", RIGID])}
    ours = table.pop("ours")
    assert ours["epe_median_px"] < 0.15
    for name, row in table.items():
        assert ours["within_03px"] > row["within_03px"], name
        assert ours["rmse_mm"] < row["rmse_mm"], name
